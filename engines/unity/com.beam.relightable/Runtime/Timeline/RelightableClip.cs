#if BEAM_TIMELINE
using System;
using UnityEngine;
using UnityEngine.Playables;
using UnityEngine.Timeline;

namespace Beam.Relightable {
    /// <summary>A stretch of a take on a Timeline. Clip-in and speed are those of the clip.</summary>
    [Serializable]
    public sealed class RelightableClip : PlayableAsset, ITimelineClipAsset {
        /// <summary>Moment of the take at which the clip begins [s].</summary>
        public float start;

        /// <summary>What the Timeline may do with the clip.</summary>
        public ClipCaps clipCaps => ClipCaps.ClipIn | ClipCaps.SpeedMultiplier | ClipCaps.Looping;

        public override Playable CreatePlayable(PlayableGraph graph, GameObject owner) {
            ScriptPlayable<Behaviour> playable = ScriptPlayable<Behaviour>.Create(graph);
            playable.GetBehaviour().start = start;
            return playable;
        }

        private sealed class Behaviour : PlayableBehaviour {
            public float start;

            public override void ProcessFrame(Playable playable, FrameData info, object bound) {
                var take = bound as RelightableTake;
                if (take == null || info.weight <= 0f) return;
                take.isPlaying = false;
                take.time = start + (float)playable.GetTime();
            }
        }
    }
}
#endif
