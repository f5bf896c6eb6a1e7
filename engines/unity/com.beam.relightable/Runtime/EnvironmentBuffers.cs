using System;
using UnityEngine;

namespace Beam.Relightable {
    /// <summary>An environment blurred for every roughness, and its irradiance, on the graphics card.</summary>
    public sealed class EnvironmentBuffers : IDisposable {
        private const int LevelCount = 13, Mirror = 128, Smallest = 32, Threads = 64;
        private const float FirstRoughness = 0.125f, CubeSteps = 6f;

        /// <summary>Texels of all levels, from the mirror's on, then irradiance.</summary>
        public readonly GraphicsBuffer Texels;

        /// <summary>Of each: rows, and its first texel.</summary>
        public readonly Vector4[] Levels = new Vector4[LevelCount + 1];

        private EnvironmentRegions regions;
        private int cutInto;

        private EnvironmentBuffers(Func<int, int> rowsOf) {
            int end = 0;
            for (int level = 0; level <= LevelCount; level++) {
                Levels[level] = new Vector4(rowsOf(level), end, 0f, 0f);
                end += 2 * rowsOf(level) * rowsOf(level);
            }
            Texels = new GraphicsBuffer(GraphicsBuffer.Target.Structured, end, 16);
        }

        /// <summary>Return what engines/unity/prefilter.py wrote: rows of 14 levels as integers, then texels as floats.</summary>
        /// <exception cref="DeliveryException">The file has another size than it says.</exception>
        public static EnvironmentBuffers OfFile(byte[] content, string name) {
            bool isWhole = content.Length >= 4 * (LevelCount + 1);
            long texels = 0;
            for (int level = 0; isWhole && level <= LevelCount; level++) {
                int rows = BitConverter.ToInt32(content, 4 * level);
                isWhole = rows >= 1 && rows <= 4096;
                texels += 2L * rows * rows;
            }
            isWhole = isWhole && content.Length == 4 * (LevelCount + 1) + 12 * texels;
            if (!isWhole) throw new DeliveryException(name + " must be written by prefilter.py, got " + content.Length + " bytes. Write it again.");
            var found = new EnvironmentBuffers(level => BitConverter.ToInt32(content, 4 * level));
            var rgb = new float[3 * texels];
            Buffer.BlockCopy(content, 4 * (LevelCount + 1), rgb, 0, 4 * rgb.Length);
            var rows4 = new Vector4[texels];
            for (int i = 0; i < rows4.Length; i++) rows4[i] = new Vector4(rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2], 1f);
            found.Texels.SetData(rows4);
            return found;
        }

        /// <summary>Return the light of a cube whose mip levels are blurred as those of reflection probes are, times a factor.</summary>
        public static EnvironmentBuffers OfCube(Texture cube, float factor) {
            ComputeShader shader = Resources.Load<ComputeShader>("Beam/Environment");
            int fromCube = shader.FindKernel("FromCube"), irradiance = shader.FindKernel("Irradiance");
            var found = new EnvironmentBuffers(RowsOf);
            shader.SetTexture(fromCube, "_BeamCube", cube);
            shader.SetBuffer(fromCube, "_BeamTexels", found.Texels);
            shader.SetBuffer(irradiance, "_BeamTexels", found.Texels);
            for (int level = 0; level < LevelCount; level++) {
                float roughness = RoughnessOf(level), mip = Mathf.Min(CubeSteps * roughness * (1.7f - 0.7f * roughness), cube.mipmapCount - 1);
                shader.SetVector("_BeamLevel", new Vector4(found.Levels[level].x, found.Levels[level].y, mip, factor));
                shader.Dispatch(fromCube, Groups(found.Levels[level].x), 1, 1);
            }
            shader.SetVector("_BeamLevel", found.Levels[LevelCount]);
            shader.SetVector("_BeamSource", found.Levels[6]); // 64 rows or fewer, hardly blurred for a cosine
            shader.Dispatch(irradiance, Groups(found.Levels[LevelCount].x), 1, 1);
            return found;
        }

        /// <summary>Return a number of regions of little blur. The first time waits for the graphics card.</summary>
        public EnvironmentRegions Regions(int count) {
            if (regions != null && cutInto == count) return regions;
            var texels = new Vector4[(int)Levels[1].y];
            Texels.GetData(texels, 0, 0, texels.Length);
            cutInto = count;
            return regions = EnvironmentRegions.Cut(texels, (int)Levels[0].x, count);
        }

        /// <summary>Release all memory.</summary>
        public void Dispose() {
            Texels.Release();
        }

        private static float RoughnessOf(int level) =>
            level == 0 ? 0f : FirstRoughness * Mathf.Pow(1f / FirstRoughness, (level - 1f) / (LevelCount - 2f));

        private static int RowsOf(int level) {
            if (level == 0) return Mirror;
            if (level == LevelCount) return Smallest / 2;
            return Mathf.Clamp(Mathf.CeilToInt(Mathf.PI / (0.8f * RoughnessOf(level) * RoughnessOf(level))), Smallest, Mirror);
        }

        private static int Groups(float rows) => ((int)(2f * rows * rows) + Threads - 1) / Threads;
    }
}
