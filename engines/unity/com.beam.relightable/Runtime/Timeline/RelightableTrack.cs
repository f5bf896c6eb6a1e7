#if BEAM_TIMELINE
using UnityEngine;
using UnityEngine.Playables;
using UnityEngine.Timeline;

namespace Beam.Relightable {
    /// <summary>A track of a Timeline that sets the moment of a take.</summary>
    [TrackColor(0.95f, 0.6f, 0.2f)]
    [TrackClipType(typeof(RelightableClip))]
    [TrackBindingType(typeof(RelightableTake))]
    public sealed class RelightableTrack : TrackAsset {
    }
}
#endif
