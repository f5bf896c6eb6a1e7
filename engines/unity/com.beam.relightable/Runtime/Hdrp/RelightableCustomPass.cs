#if BEAM_HDRP
using System;
using UnityEngine;
using UnityEngine.Rendering;
using UnityEngine.Rendering.HighDefinition;

namespace Beam.Relightable {
    /// <summary>Draws takes in HDRP. Put it into a Custom Pass Volume, injected before transparent objects.</summary>
    [Serializable]
    public sealed class RelightableCustomPass : CustomPass {
        [NonSerialized] private RelightPass pass;

        protected override void Setup(ScriptableRenderContext context, CommandBuffer commands) {
            pass = new RelightPass(true);
        }

        protected override void Execute(CustomPassContext context) {
            HDCamera camera = context.hdCamera;
            int eyes = camera.camera.stereoEnabled ? Mathf.Min(context.cameraColorBuffer.rt.volumeDepth, 2) : 1;
            var size = new Vector2Int(camera.actualWidth, camera.actualHeight);
            pass.Draw(context.cmd, camera.camera, size, eyes, context.cameraColorBuffer.nameID, context.cameraDepthBuffer.nameID);
        }

        protected override void Cleanup() {
            if (pass != null) pass.Dispose();
        }
    }
}
#endif
