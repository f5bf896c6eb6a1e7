using System;
using System.Collections.Generic;
using UnityEngine;

namespace Beam.Relightable {
    /// <summary>Regions of an environment of little blur, in the renderer's world; each casts shadows from where its power is.</summary>
    /// <remarks>They are those of beam_warp/light/regions.py.</remarks>
    public sealed class EnvironmentRegions {
        private const double Widest = 75.0 * Math.PI / 180.0, Alike = 1e-6;

        /// <summary>Unit vectors towards their light.</summary>
        public readonly List<Vector3> Directions = new List<Vector3>();

        /// <summary>Half angles of their discs [rad].</summary>
        public readonly List<float> HalfAngles = new List<float>();

        /// <summary>Three rows each, of red, green and blue: radiance times direction, summed, and how wide it spreads.</summary>
        public readonly List<Vector4> Moments = new List<Vector4>();

        /// <summary>Cut a lat-long map, its top row first, into a number of regions.</summary>
        public static EnvironmentRegions Cut(Vector4[] texels, int rows, int count, int mostRows = 256) {
            var map = new Map(texels, rows, Math.Min(rows, mostRows));
            var cuts = new List<Cutting> { map.BestCut(new Box(0, map.Rows, 0, 2 * map.Rows)) };
            while (cuts.Count < count) {
                int most = FirstBest(cuts.ConvertAll(each => each.Gain));
                Cutting cut = cuts[most];
                cuts[most] = map.BestCut(cut.First);
                cuts.Insert(most + 1, map.BestCut(cut.Second));
            }
            var found = new EnvironmentRegions();
            foreach (Cutting cut in cuts) map.Sum(cut.Box, found);
            return found;
        }

        /// <summary>Return the regions of the environment turned about the vertical [rad].</summary>
        public EnvironmentRegions Turned(float angle) {
            var found = new EnvironmentRegions();
            float c = Mathf.Cos(angle), s = Mathf.Sin(angle);
            foreach (Vector3 each in Directions) found.Directions.Add(new Vector3(c * each.x - s * each.y, s * each.x + c * each.y, each.z));
            foreach (Vector4 each in Moments) found.Moments.Add(new Vector4(c * each.x - s * each.y, s * each.x + c * each.y, each.z, each.w));
            found.HalfAngles.AddRange(HalfAngles);
            return found;
        }

        private struct Box {
            public readonly int Top, Bottom, Left, Right;

            public Box(int top, int bottom, int left, int right) {
                Top = top;
                Bottom = bottom;
                Left = left;
                Right = right;
            }
        }

        /// <summary>Return the place of the first of the largest gains: mirror images gain alike, whatever their rounding.</summary>
        private static int FirstBest(List<double> gains) {
            double most = -1.0;
            foreach (double gain in gains) most = Math.Max(most, gain);
            return gains.FindIndex(gain => gain >= most - Alike);
        }

        /// <summary>A box, its halves, and what cutting it takes off its blur.</summary>
        private struct Cutting {
            public Box Box, First, Second;
            public double Gain;
        }

        private sealed class Map {
            public readonly int Rows;
            private readonly double[] flux, power, light;

            /// <summary>Sum what texels shed into cells of as many rows or fewer.</summary>
            public Map(Vector4[] texels, int texelRows, int rows) {
                Rows = rows;
                flux = new double[6 * rows * rows];
                power = new double[2 * rows * rows];
                light = new double[8 * rows * rows]; // share of the power, and direction times that
                for (int y = 0; y < texelRows; y++)
                    for (int x = 0; x < 2 * texelRows; x++) {
                        Vector4 texel = texels[2 * texelRows * y + x];
                        int cell = 2 * rows * (int)((long)y * rows / texelRows) + (int)((long)x * rows / texelRows);
                        double angle = AngleOf(y, texelRows);
                        flux[3 * cell] += angle * texel.x;
                        flux[3 * cell + 1] += angle * texel.y;
                        flux[3 * cell + 2] += angle * texel.z;
                        power[cell] += angle * (0.2126 * texel.x + 0.7152 * texel.y + 0.0722 * texel.z);
                    }
                bool isDark = !Array.Exists(power, each => each > 0.0);
                double all = 0.0;
                for (int cell = 0; cell < power.Length; cell++) {
                    if (isDark) power[cell] = AngleOf(cell / (2 * rows), rows); // which is cut evenly
                    all += power[cell];
                }
                for (int cell = 0; cell < power.Length; cell++) {
                    double[] way = WayOf(cell);
                    light[4 * cell] = power[cell] / all;
                    for (int k = 0; k < 3; k++) light[4 * cell + 1 + k] = power[cell] / all * way[k];
                }
            }

            /// <summary>Find the cut that takes most off a box's blur; one of a single cell stays, beside an empty one.</summary>
            public Cutting BestCut(Box box) {
                int tall = box.Bottom - box.Top, wide = box.Right - box.Left;
                double[][] sums = { new double[4 * tall + 4], new double[4 * wide + 4] };
                for (int y = 0; y < tall; y++)
                    for (int x = 0; x < wide; x++)
                        for (int c = 0, cell = 2 * Rows * (box.Top + y) + box.Left + x; c < 4; c++) {
                            sums[0][4 * (y + 1) + c] += light[4 * cell + c];
                            sums[1][4 * (x + 1) + c] += light[4 * cell + c];
                        }
                foreach (double[] one in sums) for (int k = 4; k < one.Length; k++) one[k] += one[k - 4];
                var gains = new List<double>();
                for (int axis = 0; axis < 2; axis++)
                    for (int k = 1, end = axis == 0 ? tall : wide; k < end; k++)
                        gains.Add(Blur(sums[axis], 0, end) - Blur(sums[axis], 0, k) - Blur(sums[axis], k, end));
                if (gains.Count == 0) return new Cutting { Box = box, Gain = -1.0, First = box, Second = new Box(box.Bottom, box.Bottom, box.Left, box.Right) };
                int best = FirstBest(gains), rowCuts = Math.Max(tall - 1, 0), row = box.Top + best + 1, column = box.Left + best - rowCuts + 1;
                bool isRow = best < rowCuts;
                return new Cutting {
                    Box = box, Gain = gains[best],
                    First = isRow ? new Box(box.Top, row, box.Left, box.Right) : new Box(box.Top, box.Bottom, box.Left, column),
                    Second = isRow ? new Box(row, box.Bottom, box.Left, box.Right) : new Box(box.Top, box.Bottom, column, box.Right)
                };
            }

            /// <summary>Return power times the standard deviation of directions between two places of running sums.</summary>
            private static double Blur(double[] sums, int from, int to) {
                double all = sums[4 * to] - sums[4 * from], square = 0.0;
                for (int c = 1; c < 4; c++) square += (sums[4 * to + c] - sums[4 * from + c]) * (sums[4 * to + c] - sums[4 * from + c]);
                return Math.Sqrt(Math.Max(all * all - square, 0.0));
            }

            /// <summary>Add a box to regions; an empty one sheds no light from above.</summary>
            public void Sum(Box box, EnvironmentRegions into) {
                double total = 0.0, lit = 0.0;
                double[] mean = new double[3], even = new double[3], fluxes = new double[3], sums = new double[9];
                for (int y = box.Top; y < box.Bottom; y++)
                    for (int x = box.Left; x < box.Right; x++) {
                        int cell = 2 * Rows * y + x;
                        double[] way = WayOf(cell);
                        total += 1.0;
                        lit += power[cell];
                        for (int k = 0; k < 3; k++) {
                            mean[k] += power[cell] * way[k];
                            even[k] += way[k];
                            fluxes[k] += flux[3 * cell + k];
                            for (int c = 0; c < 3; c++) sums[3 * c + k] += flux[3 * cell + c] * way[k];
                        }
                    }
                if (!(lit > 0.0)) mean = even;
                else total = lit;
                double length = Length(mean, 0), cosine = total > 0.0 ? length / total : 1.0;
                bool isSomewhere = length > 1e-9 * Math.Max(total, 1e-300);
                into.Directions.Add(isSomewhere ? new Vector3((float)(mean[0] / length), (float)(mean[1] / length), (float)(mean[2] / length)) : new Vector3(0f, 0f, 1f));
                into.HalfAngles.Add((float)Math.Acos(Math.Min(Math.Max(2.0 * cosine - 1.0, Math.Cos(Widest)), 1.0)));
                for (int c = 0; c < 3; c++) {
                    double size = Length(sums, 3 * c), spread = Math.Max(1.0 - size / Math.Max(fluxes[c], 1e-300), 0.0);
                    into.Moments.Add(new Vector4((float)sums[3 * c], (float)sums[3 * c + 1], (float)sums[3 * c + 2], (float)(size * Math.Sqrt(3.0 * spread))));
                }
            }

            private double[] WayOf(int cell) {
                double theta = (cell / (2 * Rows) + 0.5) * Math.PI / Rows, phi = Math.PI - (cell % (2 * Rows) + 0.5) * Math.PI / Rows;
                return new[] { Math.Sin(theta) * Math.Cos(phi), Math.Sin(theta) * Math.Sin(phi), Math.Cos(theta) };
            }

            private static double AngleOf(int row, int rows) => Math.PI / rows * (Math.Cos(Math.PI * row / rows) - Math.Cos(Math.PI * (row + 1) / rows));

            private static double Length(double[] v, int at) => Math.Sqrt(v[at] * v[at] + v[at + 1] * v[at + 1] + v[at + 2] * v[at + 2]);
        }
    }
}
