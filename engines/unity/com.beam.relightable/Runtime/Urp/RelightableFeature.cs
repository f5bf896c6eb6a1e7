#if BEAM_URP
using UnityEngine;
using UnityEngine.Rendering;
using UnityEngine.Rendering.RenderGraphModule;
using UnityEngine.Rendering.Universal;

namespace Beam.Relightable {
    /// <summary>Draws takes in URP, after the sky and before transparent objects. Add it to the renderer's features.</summary>
    public sealed class RelightableFeature : ScriptableRendererFeature {
        private Pass pass;

        public override void Create() {
            pass = new Pass();
        }

        public override void AddRenderPasses(ScriptableRenderer renderer, ref RenderingData data) {
            if (RelightableTake.Active.Count > 0) renderer.EnqueuePass(pass);
        }

        protected override void Dispose(bool isDisposing) {
            if (pass != null) pass.Release();
        }

        private sealed class Pass : ScriptableRenderPass {
            private RelightPass relight;

            private sealed class Data {
                public TextureHandle color, depth;
                public Camera camera;
                public Vector2Int size;
                public int eyes;
            }

            public Pass() {
                renderPassEvent = RenderPassEvent.AfterRenderingSkybox;
                requiresIntermediateTexture = true; // rows of a screen may be counted the other way
                ConfigureInput(ScriptableRenderPassInput.Depth);
            }

            public override void RecordRenderGraph(RenderGraph graph, ContextContainer frame) {
                if (relight == null) relight = new RelightPass(false);
                var resources = frame.Get<UniversalResourceData>();
                var camera = frame.Get<UniversalCameraData>();
                Data data;
                using (IUnsafeRenderGraphBuilder builder = graph.AddUnsafePass<Data>("Relightable takes", out data)) {
                    RenderTextureDescriptor target = camera.cameraTargetDescriptor;
                    data.color = resources.activeColorTexture;
                    data.depth = resources.activeDepthTexture;
                    data.camera = camera.camera;
                    data.size = new Vector2Int(target.width, target.height);
                    data.eyes = camera.camera.stereoEnabled ? Mathf.Min(target.volumeDepth, 2) : 1;
                    builder.UseTexture(data.color, AccessFlags.ReadWrite);
                    builder.UseTexture(data.depth, AccessFlags.ReadWrite);
                    builder.UseTexture(resources.cameraDepthTexture, AccessFlags.Read);
                    builder.AllowPassCulling(false);
                    builder.AllowGlobalStateModification(true);
                    builder.SetRenderFunc((Data given, UnsafeGraphContext context) => {
                        CommandBuffer commands = CommandBufferHelpers.GetNativeCommandBuffer(context.cmd);
                        RTHandle color = given.color, depth = given.depth;
                        relight.Draw(commands, given.camera, given.size, given.eyes, color.nameID, depth.nameID);
                    });
                }
            }

            public void Release() {
                if (relight != null) relight.Dispose();
                relight = null;
            }
        }
    }
}
#endif
