using System;
using System.Collections.Generic;
using System.IO;
using System.Threading;
using Beam.Relightable;

/// <summary>Dump TAKE FOLDER writes what the parser reads of a container or a PLY, or prints its error; with a frame, what a GPU
/// gets; with "stream", it prints what is held while segments are wanted one after the other.</summary>
public static class Dump {
    public static int Main(string[] arguments) {
        try {
            if (arguments[0].EndsWith(".ply")) return WriteArrays(PlyFrame.Read(arguments[0]), arguments[1] + "/");
            var take = new Container(arguments[0]);
            if (arguments.Length == 3 && arguments[2] == "stream") return Stream(take);
            if (arguments.Length == 3) return WriteMoment(take, double.Parse(arguments[2]), arguments[1]);
            Write(take.Still, "static", arguments[1]);
            foreach (BlockEntry entry in take.Segments) {
                Block block = take.Read(entry);
                Write(block, Path.GetFileNameWithoutExtension(entry.File), arguments[1]);
                for (int frame = 0; frame < entry.Frames; frame++)
                    WriteArrays(take.Frame(block, frame), Path.Combine(arguments[1], (entry.First + frame) + "."));
            }
            Console.WriteLine(take.Frames + " " + take.Count + " " + take.Rate + " " + take.IsConstant);
            return 0;
        } catch (DeliveryException error) {
            Console.WriteLine(error.Message);
            return 2;
        }
    }

    private static int WriteArrays(Dictionary<string, float[]> arrays, string prefix) {
        foreach (KeyValuePair<string, float[]> pair in arrays) WriteFloats(pair.Value, prefix + pair.Key);
        return 0;
    }

    private static int Stream(Container take) {
        using (var stream = new SegmentStream(take)) {
            for (int index = 0; index < take.Segments.Count; index++) {
                stream.Want(index, index + 1 < take.Segments.Count ? index + 1 : -1);
                string before = stream.Error;
                for (int wait = 0; wait < 500 && stream.Get(index) == null && stream.Error == before; wait++) Thread.Sleep(5);
                Console.WriteLine((stream.Get(index) != null) + " " + (stream.Resident <= 2) + " " + stream.Error);
            }
        }
        return 0;
    }

    private static int WriteMoment(Container take, double time, string folder) {
        int frame = (int)time, index = take.Segments.FindIndex(entry => frame < entry.First + entry.Frames);
        BlockEntry held = take.Segments[index];
        bool isLast = frame == held.First + held.Frames - 1 && index + 1 < take.Segments.Count;
        Block segment = take.Read(held), next = isLast ? take.Read(take.Segments[index + 1]) : null;
        var terms = new Terms();
        terms.Set(take, segment, frame - held.First, next, (float)(time - frame));
        File.WriteAllBytes(Path.Combine(folder, "still"), take.Still.Planes);
        File.WriteAllBytes(Path.Combine(folder, "segment"), segment.Planes);
        File.WriteAllBytes(Path.Combine(folder, "next"), next == null ? new byte[16] : next.Planes);
        WriteFloats(terms.Ranges, Path.Combine(folder, "components"));
        var rows = new byte[16 * terms.Count];
        Buffer.BlockCopy(terms.Rows, 0, rows, 0, rows.Length);
        File.WriteAllBytes(Path.Combine(folder, "terms"), rows);
        return 0;
    }

    private static void Write(Block block, string name, string folder) {
        foreach (KeyValuePair<string, BlockComponent[]> pair in block.Arrays) {
            for (int c = 0; c < pair.Value.Length; c++) {
                string path = Path.Combine(folder, name + "." + pair.Key + c);
                WriteFloats(pair.Value[c].Weights, path + ".weights");
                var numbers = new List<float>();
                foreach (BlockPlane plane in pair.Value[c].Planes)
                    for (int i = 0; i < block.Count; i++) numbers.Add(block.At(plane, i));
                WriteFloats(numbers.ToArray(), path + ".planes");
            }
        }
    }

    private static void WriteFloats(float[] values, string path) {
        var content = new byte[4 * values.Length];
        Buffer.BlockCopy(values, 0, content, 0, content.Length);
        File.WriteAllBytes(path, content);
    }
}
