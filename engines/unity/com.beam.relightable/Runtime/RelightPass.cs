using System;
using System.Collections.Generic;
using UnityEngine;
using UnityEngine.Experimental.Rendering;
using UnityEngine.Rendering;

namespace Beam.Relightable {
    /// <summary>Draws all takes into a camera's colour and depth: order, G-buffer and light, take by take, farthest first.</summary>
    public sealed class RelightPass : IDisposable {
        /// <summary>Passes of Relight.shader.</summary>
        public const int SplatPass = 0, ShadowPass = 1, MeshPass = 2, LightPass = 3, DepthPass = 4;
        private const int AllSlices = -1;
        private static readonly string[] Names = { "_BeamLook", "_BeamNormal", "_BeamRest", "_BeamFirst", "_BeamArrived" };
        private static readonly GraphicsFormat[] Formats = {
            GraphicsFormat.R16G16B16A16_SFloat, GraphicsFormat.R16G16B16A16_SFloat, GraphicsFormat.R32G32B32A32_SFloat, GraphicsFormat.R32_SFloat, GraphicsFormat.R16G16B16A16_SFloat,
        };
        private readonly RenderTexture[] buffers = new RenderTexture[5];
        private RenderTargetIdentifier[] targets = new RenderTargetIdentifier[0];
        private readonly Material material = new Material(Resources.Load<Shader>("Beam/Relight"));
        private readonly bool isHighDefinition;

        /// <summary>Make a pass of HDRP, whose depth textures are arrays, and whose colours are exposed; or of URP.</summary>
        public RelightPass(bool isHighDefinition) {
            this.isHighDefinition = isHighDefinition;
            CoreUtils.SetKeyword(material, "BEAM_EXPOSED", isHighDefinition);
        }

        /// <summary>Return takes that can be drawn, farthest from a camera first.</summary>
        public static List<RelightableTake> FarthestFirst(Pinhole view) {
            var takes = new List<RelightableTake>();
            foreach (RelightableTake take in RelightableTake.Active) if (take.IsReady) takes.Add(take);
            takes.Sort((a, b) => Vector3.Distance(b.Sphere, view.position).CompareTo(Vector3.Distance(a.Sphere, view.position)));
            return takes;
        }

        /// <summary>Draw the splats of a take, which are sorted.</summary>
        public static void DrawSplats(CommandBuffer commands, RelightableTake take, Material material, int pass) {
            commands.SetGlobalBuffer("_BeamGaussians", take.Buffers.Gaussians);
            commands.SetGlobalBuffer("_BeamOrder", take.Buffers.Order);
            commands.SetGlobalMatrix("_BeamObject", take.ToWorld);
            if (RelightableStage.Current.environmentShadows > 0) commands.SetGlobalBuffer("_BeamArriving", take.Buffers.Arriving);
            commands.DrawProcedural(Matrix4x4.identity, material, pass, MeshTopology.Triangles, 6 * take.Buffers.Count, 1);
        }

        /// <summary>Make layers of a texture that can be drawn to.</summary>
        public static RenderTexture Layers(int width, int height, int count, GraphicsFormat format) {
            var layers = new RenderTexture(new RenderTextureDescriptor(width, height, format, 0) {
                dimension = TextureDimension.Tex2DArray,
                volumeDepth = count,
            });
            layers.filterMode = FilterMode.Point;
            layers.Create();
            return layers;
        }

        /// <summary>Draw; eyes are 1, or 2 in single-pass stereo, when targets have two slices.</summary>
        public void Draw(CommandBuffer commands, Camera camera, Vector2Int size, int eyes, RenderTargetIdentifier color, RenderTargetIdentifier depth) {
            RelightableStage stage = RelightableStage.Current;
            if (stage == null) return;
            stage.lampFactor = isHighDefinition ? 1f : Mathf.PI;
            if (!stage.Bind(commands)) return;
            Pinhole first = EyeOf(camera, 0, eyes, size), second = EyeOf(camera, eyes - 1, eyes, size);
            CoreUtils.SetKeyword(material, "BEAM_DEPTH_ARRAY", isHighDefinition || eyes > 1);
            CoreUtils.SetKeyword(material, "BEAM_REGIONS", stage.environmentShadows > 0);
            Allocate(size, eyes, stage.environmentShadows > 0 ? 5 : 4);
            foreach (RelightableTake take in FarthestFirst(first)) {
                take.Buffers.Sort(commands, take.ToWorld, 0.5f * (first.position + second.position), first.forward);
                Pinhole.Set(commands, first, second, Mathf.Max(camera.nearClipPlane, 0.01f), take.asset.lowPass, take.asset.antialiased);
                commands.SetRenderTarget(targets, BuiltinRenderTextureType.None, 0, CubemapFace.Unknown, AllSlices);
                commands.ClearRenderTarget(false, true, Color.clear);
                DrawSplats(commands, take, material, SplatPass);
                for (int k = 0; k < targets.Length; k++) commands.SetGlobalTexture(Names[k], buffers[k]);
                commands.SetRenderTarget(color, depth, 0, CubemapFace.Unknown, AllSlices);
                commands.SetViewport(new Rect(0f, 0f, size.x, size.y));
                commands.DrawProcedural(Matrix4x4.identity, material, LightPass, MeshTopology.Triangles, 3, 1);
                commands.DrawProcedural(Matrix4x4.identity, material, DepthPass, MeshTopology.Triangles, 3, 1);
            }
        }

        /// <summary>Release all memory.</summary>
        public void Dispose() {
            foreach (RenderTexture each in buffers) if (each != null) each.Release();
            CoreUtils.Destroy(material);
        }

        private static Pinhole EyeOf(Camera camera, int eye, int eyes, Vector2Int size) {
            if (eyes == 1 && !camera.stereoEnabled) return Pinhole.Of(camera.worldToCameraMatrix, camera.nonJitteredProjectionMatrix, size);
            Camera.StereoscopicEye which = eye == 0 ? Camera.StereoscopicEye.Left : Camera.StereoscopicEye.Right;
            return Pinhole.Of(camera.GetStereoViewMatrix(which), camera.GetStereoNonJitteredProjectionMatrix(which), size);
        }

        private void Allocate(Vector2Int size, int eyes, int count) {
            RenderTexture held = buffers[0];
            if (held != null && held.width == size.x && held.height == size.y && held.volumeDepth == eyes && targets.Length == count) return;
            foreach (RenderTexture each in buffers) if (each != null) each.Release();
            targets = new RenderTargetIdentifier[count];
            for (int k = 0; k < count; k++) {
                buffers[k] = Layers(size.x, size.y, eyes, Formats[k]);
                targets[k] = buffers[k];
            }
        }
    }
}
