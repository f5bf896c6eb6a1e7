using System;
using System.Collections.Generic;
using System.Text;

namespace Beam.Relightable {
    /// <summary>A plane of numbers, one a Gaussian, in <see cref="Block.Planes"/>.</summary>
    public struct BlockPlane {
        /// <summary>First byte, a multiple of 4.</summary>
        public int Offset;

        /// <summary>Bytes of a number: 1, 2 or 4 of a signed integer, 0 for a 32-bit float.</summary>
        public int Kind;
    }

    /// <summary>A component of an array: at frame f it is weights[f][0] + Σ weights[f][1 + k] plane[k].</summary>
    public sealed class BlockComponent {
        public float[] Weights;
        public int Columns;
        public BlockPlane[] Planes;
    }

    /// <summary>An unpacked block: its arrays by name, a component after the other.</summary>
    public sealed class Block {
        private const float Largest = 1e6f;
        public readonly Dictionary<string, BlockComponent[]> Arrays = new Dictionary<string, BlockComponent[]>();

        /// <summary>All planes, decoded: summed ones as floats, others as integers.</summary>
        public readonly byte[] Planes;

        /// <summary>Number of Gaussians.</summary>
        public readonly int Count;
        private int used;

        internal Block(byte[] content, int frames, int count) {
            Count = count;
            int at = 4 + BitConverter.ToInt32(content, 0);
            DeliveryException.Require(at >= 4 && at <= content.Length, "its header must be inside", at);
            var said = (Dictionary<string, object>)Json.Parse(Encoding.UTF8.GetString(content, 4, at - 4));
            var sizes = new List<int[]>();
            var components = new List<BlockComponent>();
            foreach (Dictionary<string, object> array in (List<object>)said["arrays"]) {
                string name = (string)array["name"];
                var pairs = (List<object>)array["planes"];
                DeliveryException.Require(pairs.Count == ComponentsOf(name), "arrays must be known", name);
                Arrays[name] = new BlockComponent[pairs.Count];
                for (int c = 0; c < pairs.Count; c++) {
                    sizes.Add(SizesOf((List<object>)pairs[c]));
                    components.Add(Arrays[name][c] = Weighed(content, ref at, frames, 1 + sizes[sizes.Count - 1].Length, name));
                }
            }
            long room = 0;
            foreach (int[] each in sizes)
                foreach (int size in each) room += ((long)Count * Width(size) + 3) / 4 * 4;
            DeliveryException.Require(room < int.MaxValue - 64, "planes must fit into memory", room);
            DeliveryException.Require(Needed(sizes) == content.Length - at, "planes must fill it", content.Length - at);
            Planes = new byte[room];
            for (int k = 0; k < sizes.Count; k++)
                for (int n = 0; n < sizes[k].Length; n++) components[k].Planes[n] = Decoded(content, ref at, sizes[k][n]);
        }

        /// <summary>Return the number of components of an array, or 0 for an unknown one.</summary>
        public static int ComponentsOf(string name) {
            int degree;
            if (name == "opacities" || name == "roughness" || name == "ambient_occlusion") return 1;
            if (name.StartsWith("radiance_") && int.TryParse(name.Substring(9), out degree)) return degree >= 0 && degree < 25 ? 3 : 0;
            return Array.IndexOf(new[] { "positions", "orientations", "turns", "scales", "base_color", "normals" }, name) < 0 ? 0 : 3;
        }

        /// <summary>Return a number of a plane.</summary>
        public float At(BlockPlane plane, int i) {
            if (plane.Kind == 0) return BitConverter.ToSingle(Planes, plane.Offset + 4 * i);
            if (plane.Kind == 1) return (sbyte)Planes[plane.Offset + i];
            return plane.Kind == 2 ? BitConverter.ToInt16(Planes, plane.Offset + 2 * i) : BitConverter.ToInt32(Planes, plane.Offset + 4 * i);
        }

        /// <summary>Add the numbers of an array at a frame, component after component, to some of as many.</summary>
        public void AddTo(float[] values, string name, int frame) {
            BlockComponent[] components = Arrays[name];
            for (int c = 0; c < components.Length; c++) {
                BlockComponent each = components[c];
                int row = frame * each.Columns;
                for (int i = 0; i < Count; i++) {
                    double sum = values[c * Count + i] + (double)each.Weights[row];
                    for (int k = 1; k < each.Columns; k++)
                        if (each.Weights[row + k] != 0f) sum += (double)each.Weights[row + k] * At(each.Planes[k - 1], i);
                    values[c * Count + i] = (float)sum;
                }
            }
        }

        // Sizes of the summed planes are negated: one list tells both.
        private static int[] SizesOf(List<object> pair) {
            var summed = (List<object>)pair[0];
            var plain = (List<object>)pair[1];
            var sizes = new int[summed.Count + plain.Count];
            for (int k = 0; k < sizes.Length; k++) {
                object said = k < summed.Count ? summed[k] : plain[k - summed.Count];
                DeliveryException.Require(
                    said is double && ((double)said == 1 || (double)said == 2 || (double)said == 3 || (double)said == 4),
                    "planes must have 1 to 4 bytes", said);
                sizes[k] = (int)(double)said * (k < summed.Count ? -1 : 1);
            }
            return sizes;
        }

        private static BlockComponent Weighed(byte[] content, ref int at, int frames, int columns, string name) {
            DeliveryException.Require(4L * frames * columns <= content.Length - at, "weights must be there", name);
            var found = new BlockComponent { Columns = columns, Weights = new float[frames * columns], Planes = new BlockPlane[columns - 1] };
            Buffer.BlockCopy(content, at, found.Weights, 0, 4 * found.Weights.Length);
            foreach (float weight in found.Weights)
                DeliveryException.Require(Math.Abs(weight) <= Largest, "weights must be at most 1e6", name);
            at += 4 * found.Weights.Length;
            return found;
        }

        private static int Width(int size) {
            return size < 0 || size > 2 ? 4 : size;
        }

        private long Needed(List<int[]> sizes) {
            long bytes = 0;
            foreach (int[] each in sizes)
                foreach (int size in each) bytes += (long)Math.Abs(size) * Count;
            return bytes;
        }

        private BlockPlane Decoded(byte[] content, ref int at, int size) {
            var plane = new BlockPlane { Offset = used, Kind = size < 0 ? 0 : Width(size) };
            int orders = Math.Abs(size), sum = 0;
            var sums = new float[size < 0 ? Count : 0];
            for (int i = 0; i < Count; i++) {
                uint code = 0;
                for (int order = 0; order < orders; order++) code |= (uint)content[at + order * Count + i] << (8 * order);
                int number = (int)(code >> 1) ^ -(int)(code & 1);
                if (size < 0) sums[i] = sum = unchecked(sum + number);
                for (int order = 0; order < plane.Kind; order++) Planes[used++] = unchecked((byte)(number >> (8 * order)));
            }
            Buffer.BlockCopy(sums, 0, Planes, used, 4 * sums.Length);
            at += orders * Count;
            used = (used + 4 * sums.Length + 3) / 4 * 4;
            return plane;
        }
    }
}
