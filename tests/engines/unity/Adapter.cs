using System;
using System.Collections.Generic;
using System.Globalization;
using System.Linq;
using System.Reflection;
using Beam.Relightable;
using UnityEngine;
using UnityEngine.Rendering;

/// <summary>Reads a camera, lights, a map and the sphere of what casts shadows, a line each, and prints what shaders would get.</summary>
public static class Adapter {
    public static void Main() {
        var stage = new RelightableStage { shadowMapSize = 256, lampFactor = 1f };
        Vector4 sphere = new Vector4();
        for (string line = Console.ReadLine(); line != null; line = Console.ReadLine()) {
            string[] words = line.Split(' ');
            float[] n = words.Skip(1).Select(word => float.Parse(word, CultureInfo.InvariantCulture)).ToArray();
            if (words[0] == "camera") {
                Pinhole eye = Pinhole.Of(Matrix(n, 0), Matrix(n, 16), new Vector2(n[32], n[33]));
                Print(eye.position, eye.right, eye.down, eye.forward, new Vector4(eye.focal.x, eye.focal.y, eye.center.x, eye.center.y), eye.depths);
            }
            if (words[0] == "object") {
                Matrix4x4 found = new RelightableTake { transform = new Transform { localToWorldMatrix = Matrix(n, 0) } }.ToWorld;
                Print(found.GetColumn(0), found.GetColumn(1), found.GetColumn(2), found.GetColumn(3));
            }
            if (words[0] == "sphere") sphere = new Vector4(n[0], n[1], n[2], n[3]);
            if (words[0] == "environment") {
                int rows = (int)n[0];
                Vector4[] texels = Enumerable.Range(0, 2 * rows * rows).Select(k => new Vector4(n[4 + 3 * k], n[5 + 3 * k], n[6 + 3 * k], 1f)).ToArray();
                EnvironmentRegions regions = EnvironmentRegions.Cut(texels, rows, (int)n[1], (int)n[2]).Turned(n[3]);
                var drawn = new ShadowMaps();
                drawn.DrawRegions(new CommandBuffer(), stage, regions, sphere, 0.01f, 256, null);
                Print(regions.Directions.Zip(regions.HalfAngles, (way, half) => new Vector4(way.x, way.y, way.z, half)).ToArray());
                Print(regions.Moments.ToArray());
                Print(Held(drawn, "rows"));
            }
            if (words[0] != "light") continue;
            var place = new Transform { position = new Vector3(n[1], n[2], n[3]), forward = new Vector3(n[4], n[5], n[6]) };
            var light = new Light { type = (LightType)(int)n[0], transform = place, isActiveAndEnabled = true, shadows = LightShadows.Soft };
            light.color = new Color(n[7], n[8], n[9], 1f);
            light.intensity = 1f;
            light.innerSpotAngle = n[11];
            light.spotAngle = n[12];
            stage.lamps.Add(new RelightableStage.Lamp { light = light, size = n[10] });
        }
        var maps = new ShadowMaps();
        maps.Draw(new CommandBuffer(), stage, sphere, 0.01f, null);
        Print(Held(maps, "lamps"));
        Print(Held(maps, "rows"));
    }

    private static Vector4[] Held(ShadowMaps maps, string name) {
        FieldInfo field = typeof(ShadowMaps).GetField(name, BindingFlags.Instance | BindingFlags.NonPublic);
        return ((List<Vector4>)field.GetValue(maps)).ToArray();
    }

    private static Matrix4x4 Matrix(float[] n, int at) {
        var found = new Matrix4x4();
        for (int k = 0; k < 16; k++) found[k / 4, k % 4] = n[at + k];
        return found;
    }

    private static void Print(params Vector4[] rows) {
        var words = rows.SelectMany(row => new[] { row.x, row.y, row.z, row.w }).Select(value => value.ToString("R", CultureInfo.InvariantCulture));
        Console.WriteLine(string.Join(" ", words));
    }
}
