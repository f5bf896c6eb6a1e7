using System;
using UnityEngine;
using UnityEngine.Rendering;

namespace Beam.Relightable {
    /// <summary>Shadows of a stage's environment: maps of its regions, and the light that arrives at each Gaussian of each take.</summary>
    public sealed class EnvironmentShadows : IDisposable {
        private const int MostRegions = 32, Side = 256, Threads = 64;
        private readonly ShadowMaps maps = new ShadowMaps();
        private readonly GraphicsBuffer moments = new GraphicsBuffer(GraphicsBuffer.Target.Structured, 3 * MostRegions, 16);
        private readonly ComputeShader shader = Resources.Load<ComputeShader>("Beam/Arriving");

        /// <summary>Draw maps, and find what arrives at takes; what casts is in a sphere (centre, radius), its layers that thick [m].</summary>
        public void Draw(CommandBuffer commands, RelightableStage stage, EnvironmentBuffers light, Vector4 sphere, float thickness, Material material) {
            float angle = stage.rotation * Mathf.Deg2Rad;
            EnvironmentRegions regions = light.Regions(Mathf.Min(stage.environmentShadows, MostRegions)).Turned(angle);
            moments.SetData(regions.Moments);
            maps.DrawRegions(commands, stage, regions, sphere, thickness, Side, material);
            maps.Bind(commands, shader);
            commands.SetComputeBufferParam(shader, 0, "_BeamRegions", moments);
            commands.SetComputeBufferParam(shader, 0, "_BeamEnvironment", light.Texels);
            commands.SetComputeVectorArrayParam(shader, "_BeamLevels", light.Levels);
            commands.SetComputeVectorParam(shader, "_BeamTurn", new Vector4(Mathf.Cos(angle), Mathf.Sin(angle), 0f, 0f));
            foreach (RelightableTake take in RelightableTake.Active) {
                if (!take.IsReady) continue;
                int count = take.Buffers.Count;
                commands.SetComputeVectorParam(shader, "_BeamCounts", new Vector4(count, regions.HalfAngles.Count, 0f, 0f));
                commands.SetComputeMatrixParam(shader, "_BeamObject", take.ToWorld);
                commands.SetComputeBufferParam(shader, 0, "_BeamGaussians", take.Buffers.Gaussians);
                commands.SetComputeBufferParam(shader, 0, "_BeamArrivals", take.Buffers.Arriving);
                commands.DispatchCompute(shader, 0, (count + Threads - 1) / Threads, 1, 1);
            }
        }

        /// <summary>Release all memory.</summary>
        public void Dispose() {
            maps.Dispose();
            moments.Release();
        }
    }
}
