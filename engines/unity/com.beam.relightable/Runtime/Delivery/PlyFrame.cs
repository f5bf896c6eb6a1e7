using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Text;

namespace Beam.Relightable {
    /// <summary>Reader of a frame in a PLY that beam-convert wrote with the profile "beam".</summary>
    public static class PlyFrame {
        private const int LongestHeader = 1 << 16;

        /// <summary>Return arrays as <see cref="Decoding.Frame"/> does: axes x right, y up, z back, in metres.</summary>
        /// <exception cref="DeliveryException">The file is of another profile, or malformed.</exception>
        public static Dictionary<string, float[]> Read(string path) {
            string name = Path.GetFileName(path);
            using (FileStream stream = File.OpenRead(path)) {
                var comments = new Dictionary<string, string>();
                var columns = new List<string>();
                long count = ReadHeader(stream, name, comments, columns);
                bool isBeam = comments.ContainsKey("beam_material") && comments.ContainsKey("beam_axes");
                DeliveryException.Require(isBeam, name + " must be written with --profile beam", "another profile");
                long bytes = 4L * columns.Count * count;
                DeliveryException.Require(stream.Length - stream.Position == bytes && bytes < int.MaxValue - 64,
                    name + " must hold " + count + " Gaussians of " + columns.Count + " numbers", stream.Length - stream.Position + " bytes");
                var content = new byte[bytes];
                for (int at = 0, part = 1; at < bytes && part > 0; at += part) part = stream.Read(content, at, (int)bytes - at);
                return Arrays(content, (int)count, columns, comments, name);
            }
        }

        private static long ReadHeader(Stream stream, string name, Dictionary<string, string> comments, List<string> columns) {
            long count = -1;
            var line = new StringBuilder();
            for (int read = 0, lines = 0; read < LongestHeader; read++) {
                int letter = stream.ReadByte();
                if (letter < 0) break;
                if (letter != '\n') {
                    line.Append((char)letter);
                    continue;
                }
                string[] words = line.ToString().Trim().Split(' ');
                line.Length = 0;
                if (lines++ == 0) DeliveryException.Require(words[0] == "ply", name + " must be a PLY", "another file");
                if (words[0] == "end_header" && count >= 0) return count;
                if (words[0] == "comment" && words.Length > 2) comments[words[1]] = words[2];
                if (words[0] == "format") DeliveryException.Require(words[1] == "binary_little_endian", name + " must be binary_little_endian", words[1]);
                bool isCount = words[0] == "element" && words.Length == 3 && words[1] == "vertex" && count < 0
                    && long.TryParse(words[2], NumberStyles.None, CultureInfo.InvariantCulture, out count) && count <= int.MaxValue / 4;
                if (words[0] == "element") DeliveryException.Require(isCount, name + " must have one element, vertex", string.Join(" ", words));
                if (words[0] != "property") continue;
                DeliveryException.Require(words.Length == 3 && words[1] == "float", name + " must have properties of floats", string.Join(" ", words));
                columns.Add(words[2]);
            }
            throw new DeliveryException(name + " must have a header that ends, got none. Export or download it again.");
        }

        private static Dictionary<string, float[]> Arrays(
            byte[] content, int count, List<string> columns, Dictionary<string, string> comments, string name) {
            float unit = 1f;
            string said;
            if (comments.TryGetValue("beam_meters_per_unit", out said))
                DeliveryException.Require(
                    float.TryParse(said, NumberStyles.Float, CultureInfo.InvariantCulture, out unit) && unit > 0f, name + " must state its unit", said);
            float[] axes = AxesOf(comments["beam_axes"], name);
            Func<string[], float[]> planar = names => {
                var found = new float[names.Length * count];
                for (int c = 0; c < names.Length; c++) {
                    int column = columns.IndexOf(names[c]);
                    DeliveryException.Require(column >= 0, name + " must have all properties of the profile", "no " + names[c]);
                    for (int i = 0; i < count; i++) found[c * count + i] = BitConverter.ToSingle(content, 4 * (i * columns.Count + column));
                }
                return found;
            };
            var arrays = new Dictionary<string, float[]> {
                { "positions", Turned(axes, planar(new[] { "x", "y", "z" }), count, unit) },
                { "normals", Turned(axes, planar(new[] { "nx", "ny", "nz" }), count, 1f) },
                { "orientations", Orientations(axes, planar(new[] { "rot_1", "rot_2", "rot_3", "rot_0" }), count) },
                { "scales", Mapped(planar(new[] { "scale_0", "scale_1", "scale_2" }), value => unit * (float)Math.Exp(value)) },
                { "opacities", Mapped(planar(new[] { "opacity" }), value => 1f / (1f + (float)Math.Exp(-value))) },
            };
            foreach (string material in new[] { "roughness", "ambient_occlusion" })
                if (columns.Contains(material)) arrays[material] = planar(new[] { material });
            if (columns.Contains("base_color_0")) arrays["base_color"] = planar(new[] { "base_color_0", "base_color_1", "base_color_2" });
            return arrays;
        }

        // Rows are x right, y up, z back; columns the file's axes, of which letters say where they point.
        private static float[] AxesOf(string letters, string name) {
            var axes = new float[9];
            for (int column = 0; column < 3; column++) {
                int place = letters.Length == 3 ? "rlubdf".IndexOf(letters[column]) : -1;
                DeliveryException.Require(place >= 0, name + " must state its axes", letters);
                int row = "rl".IndexOf(letters[column]) >= 0 ? 0 : "ud".IndexOf(letters[column]) >= 0 ? 1 : 2;
                axes[3 * row + column] = "rub".IndexOf(letters[column]) >= 0 ? 1f : -1f;
            }
            return axes;
        }

        private static float[] Turned(float[] axes, float[] vectors, int count, float unit) {
            var found = new float[3 * count];
            for (int row = 0; row < 3; row++)
                for (int column = 0; column < 3; column++)
                    if (axes[3 * row + column] != 0f)
                        for (int i = 0; i < count; i++) found[row * count + i] = unit * axes[3 * row + column] * vectors[column * count + i];
            return found;
        }

        // A mirror is a rotation and a point reflection, which no Gaussian shows.
        private static float[] Orientations(float[] axes, float[] q, int count) {
            float[] m = (float[])axes.Clone();
            float det = m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6]) + m[2] * (m[3] * m[7] - m[4] * m[6]);
            for (int k = 0; k < 9; k++) m[k] *= det;
            // of the four forms of a quaternion, the one with the largest divisor
            float[][] forms = {
                new[] { 1 + m[0] - m[4] - m[8], m[1] + m[3], m[2] + m[6], m[7] - m[5] }, new[] { m[1] + m[3], 1 - m[0] + m[4] - m[8], m[5] + m[7], m[2] - m[6] },
                new[] { m[2] + m[6], m[5] + m[7], 1 - m[0] - m[4] + m[8], m[3] - m[1] }, new[] { m[7] - m[5], m[2] - m[6], m[3] - m[1], 1 + m[0] + m[4] + m[8] },
            };
            int best = 0;
            for (int k = 1; k < 4; k++) if (forms[k][k] > forms[best][best]) best = k;
            float a = forms[best][0], b = forms[best][1], c = forms[best][2], d = forms[best][3];
            var found = new float[4 * count];
            for (int i = 0; i < count; i++) {
                float x = q[i], y = q[count + i], z = q[2 * count + i], w = q[3 * count + i];
                float share = 1f / (float)Math.Sqrt(Math.Max((a * a + b * b + c * c + d * d) * (x * x + y * y + z * z + w * w), 1e-30f));
                found[i] = share * (d * x + a * w + b * z - c * y);
                found[count + i] = share * (d * y + b * w + c * x - a * z);
                found[2 * count + i] = share * (d * z + c * w + a * y - b * x);
                found[3 * count + i] = share * (d * w - a * x - b * y - c * z);
            }
            return found;
        }

        private static float[] Mapped(float[] values, Func<float, float> change) {
            for (int i = 0; i < values.Length; i++) values[i] = change(values[i]);
            return values;
        }
    }
}
