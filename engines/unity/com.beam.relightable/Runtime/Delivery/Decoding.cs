using System;
using System.Collections.Generic;

namespace Beam.Relightable {
    /// <summary>What the numbers of a container stand for, on the CPU; Evaluate.compute does the same on the GPU.</summary>
    public static class Decoding {
        /// <summary>Return the arrays of a frame of a segment by name: all x, then all y, then all z.</summary>
        /// <remarks>Quaternions xyzw, linear scales [m], unit normals; axes x right, y up, z back.</remarks>
        public static Dictionary<string, float[]> Frame(this Container take, Block segment, int frame) {
            var found = new Dictionary<string, float[]>();
            foreach (Block block in new[] { take.Still, segment })
                foreach (KeyValuePair<string, BlockComponent[]> pair in block.Arrays) {
                    if (!found.ContainsKey(pair.Key)) found[pair.Key] = new float[pair.Value.Length * take.Count];
                    block.AddTo(found[pair.Key], pair.Key, block == segment ? frame : 0);
                }
            foreach (string name in new List<string>(found.Keys)) found[name] = Activated(name, found[name], take.Count);
            float[] turns;
            if (found.TryGetValue("turns", out turns)) {
                found.Remove("turns");
                for (int i = 0; i < take.Count; i++) Turn(found, turns, i, take.Count);
            }
            return found;
        }

        private static float[] Activated(string name, float[] values, int count) {
            if (name == "orientations" || name == "turns") return Quaternions(values, count);
            if (name == "normals") return Normalised(values, count);
            if (name == "positions" || name.StartsWith("radiance")) return values;
            for (int i = 0; i < values.Length; i++) {
                if (name != "scales") values[i] = Math.Max(0f, Math.Min(1f, values[i]));
                else values[i] = values[i] < -29f ? 0f : (float)Math.Exp(Math.Min(values[i], 20f));
            }
            return values;
        }

        private static float[] Quaternions(float[] rodrigues, int count) {
            var found = new float[4 * count];
            for (int i = 0; i < count; i++) {
                float x = rodrigues[i], y = rodrigues[count + i], z = rodrigues[2 * count + i];
                float square = x * x + y * y + z * z, share = 1f / (1f + square);
                for (int c = 0; c < 3; c++) found[c * count + i] = 2f * rodrigues[c * count + i] * share;
                found[3 * count + i] = (1f - square) * share;
            }
            return found;
        }

        private static float[] Normalised(float[] vectors, int count) {
            for (int i = 0; i < count; i++) {
                float x = vectors[i], y = vectors[count + i], z = vectors[2 * count + i];
                float share = 1f / Math.Max((float)Math.Sqrt(x * x + y * y + z * z), 1e-12f);
                for (int c = 0; c < 3; c++) vectors[c * count + i] *= share;
            }
            return vectors;
        }

        private static void Turn(Dictionary<string, float[]> arrays, float[] turns, int i, int count) {
            int j = count + i, k = j + count, l = k + count;
            float a = turns[i], b = turns[j], c = turns[k], d = turns[l];
            float[] q = arrays["orientations"], n;
            float x = q[i], y = q[j], z = q[k], w = q[l];
            q[i] = d * x + a * w + b * z - c * y;
            q[j] = d * y + b * w + c * x - a * z;
            q[k] = d * z + c * w + a * y - b * x;
            q[l] = d * w - a * x - b * y - c * z;
            if (!arrays.TryGetValue("normals", out n)) return;
            x = n[i]; y = n[j]; z = n[k];
            float p = 2f * (b * z - c * y), r = 2f * (c * x - a * z), s = 2f * (a * y - b * x);
            n[i] = x + d * p + b * s - c * r;
            n[j] = y + d * r + c * p - a * s;
            n[k] = z + d * s + a * r - b * p;
        }
    }
}
