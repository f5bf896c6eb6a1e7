using System;
using System.Collections.Generic;
using UnityEngine;

namespace Beam.Relightable.Editor {
    /// <summary>What both importers make of a frame.</summary>
    internal static class Imported {
        private const float Bulk = 0.001f; // share of Gaussians that may lie beyond each side of the box

        /// <summary>Return an asset that knows how large its first frame is.</summary>
        public static TakeAsset Asset(Dictionary<string, float[]> frame, int count) {
            TakeAsset asset = ScriptableObject.CreateInstance<TakeAsset>();
            asset.count = count;
            if (count == 0) return asset;
            Vector3 low = Vector3.zero, high = Vector3.zero;
            for (int c = 0; c < 3; c++) {
                var along = new float[count];
                Array.Copy(frame["positions"], c * count, along, 0, count);
                Array.Sort(along);
                low[c] = along[(int)(Bulk * count)];
                high[c] = along[count - 1 - (int)(Bulk * count)];
            }
            asset.bounds.SetMinMax(new Vector3(low.x, low.y, -high.z), new Vector3(high.x, high.y, -low.z)); // z is forward in Unity
            var middle = new float[count];
            for (int i = 0; i < count; i++) {
                float a = frame["scales"][i], b = frame["scales"][count + i], c = frame["scales"][2 * count + i];
                middle[i] = Mathf.Max(Mathf.Min(a, b), Mathf.Min(Mathf.Max(a, b), c));
            }
            Array.Sort(middle);
            asset.thickness = middle[count / 2];
            return asset;
        }

        /// <summary>Set the filter that the take's metadata say it was fitted with.</summary>
        public static void SetFilter(TakeAsset asset, Dictionary<string, string> metadata) {
            string said;
            asset.antialiased = metadata.TryGetValue("raster_antialiased", out said) && said == "true";
            float lowPass;
            var style = System.Globalization.NumberStyles.Float;
            if (metadata.TryGetValue("raster_low_pass", out said)
                && float.TryParse(said, style, System.Globalization.CultureInfo.InvariantCulture, out lowPass) && lowPass > 0f) asset.lowPass = lowPass;
        }

        /// <summary>Return rows as Gaussians.hlsl reads them.</summary>
        public static Vector4[] Rows(Dictionary<string, float[]> frame, int count) {
            var rows = new Vector4[5 * count];
            for (int i = 0; i < count; i++) {
                rows[5 * i] = Row(frame, "positions", i, count, One(frame, "opacities", i, 1f));
                rows[5 * i + 1] = Row(frame, "orientations", i, count, frame["orientations"][3 * count + i]);
                rows[5 * i + 2] = Row(frame, "scales", i, count, One(frame, "roughness", i, 0.5f));
                rows[5 * i + 3] = Row(frame, "base_color", i, count, One(frame, "ambient_occlusion", i, 1f));
                rows[5 * i + 4] = Row(frame, "normals", i, count, 0f);
            }
            return rows;
        }

        private static Vector4 Row(Dictionary<string, float[]> frame, string name, int i, int count, float last) {
            float[] values;
            if (!frame.TryGetValue(name, out values)) return new Vector4(0.5f, 0.5f, 0.5f, last);
            return new Vector4(values[i], values[count + i], values[2 * count + i], last);
        }

        private static float One(Dictionary<string, float[]> frame, string name, int i, float without) {
            float[] values;
            return frame.TryGetValue(name, out values) ? values[i] : without;
        }
    }
}
