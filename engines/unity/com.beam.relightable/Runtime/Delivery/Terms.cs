using System;

namespace Beam.Relightable {
    /// <summary>A moment of a take as a sum of planes, which Evaluate.hlsl works out: 21 components, each an offset and terms.</summary>
    public sealed class Terms {
        private static readonly string[] Names =
            { "positions", "orientations", "turns", "scales", "opacities", "base_color", "roughness", "ambient_occlusion", "normals" };

        private static readonly float[] Missing = { 0f, 0f, 0f, 0f, 1f, 0.5f, 0.5f, 1f, 0f };

        /// <summary>Of each component: sum of offsets, first term, number of terms, 0.</summary>
        public readonly float[] Ranges = new float[4 * 21];

        /// <summary>Of each term: bits of the weight, offset of the plane [byte], its kind, its buffer (0 still, 1 segment, 2 next).</summary>
        public uint[] Rows = new uint[256];

        /// <summary>Number of terms.</summary>
        public int Count;

        /// <summary>Put a moment between a frame of a segment and the one after it, which may be the first of the next segment.</summary>
        public void Set(Container take, Block segment, int frame, Block next, float blend) {
            Count = 0;
            for (int n = 0, row = 0; n < Names.Length; n++)
                for (int c = 0; c < Block.ComponentsOf(Names[n]); c++, row += 4) {
                    bool isThere = take.Still.Arrays.ContainsKey(Names[n]) || segment.Arrays.ContainsKey(Names[n]);
                    Ranges[row] = isThere ? 0f : Missing[n];
                    Ranges[row + 1] = Count;
                    Add(take.Still, 0, Names[n], c, 0, 1f, row);
                    Add(segment, 1, Names[n], c, frame, 1f - blend, row);
                    if (blend > 0f && next == null) Add(segment, 1, Names[n], c, frame + 1, blend, row);
                    if (blend > 0f && next != null) Add(next, 2, Names[n], c, 0, blend, row);
                    Ranges[row + 2] = Count - Ranges[row + 1];
                }
        }

        private void Add(Block block, uint buffer, string name, int c, int frame, float share, int row) {
            BlockComponent[] components;
            if (!block.Arrays.TryGetValue(name, out components)) return;
            BlockComponent each = components[c];
            Ranges[row] += share * each.Weights[frame * each.Columns];
            for (int k = 1; k < each.Columns; k++) {
                float weight = share * each.Weights[frame * each.Columns + k];
                if (weight == 0f) continue;
                if (4 * Count + 4 > Rows.Length) Array.Resize(ref Rows, 2 * Rows.Length);
                Rows[4 * Count] = BitConverter.ToUInt32(BitConverter.GetBytes(weight), 0);
                Rows[4 * Count + 1] = (uint)each.Planes[k - 1].Offset;
                Rows[4 * Count + 2] = (uint)each.Planes[k - 1].Kind;
                Rows[4 * Count + 3] = buffer;
                Count++;
            }
        }
    }
}
