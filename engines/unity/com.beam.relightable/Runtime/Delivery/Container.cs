using System;
using System.Collections.Generic;
using System.IO;
using System.IO.Compression;
using System.Security.Cryptography;
using System.Text;

namespace Beam.Relightable {
    /// <summary>Where a block is in its container.</summary>
    public sealed class BlockEntry {
        public string File;
        public long Offset, Bytes;
        public int Unpacked, First, Frames;
        public string Digest;
    }

    /// <summary>A delivery container (b4d) that is open for reading: a file, or a manifest.json with its blocks beside it.</summary>
    /// <remarks>docs/delivery.md specifies it. Blocks may be read by several threads at once.</remarks>
    public sealed class Container {
        private const string Manifest = "manifest.json";
        private const int MaxManifestBytes = 1 << 26, FreeBytes = 1 << 24, MaxRatio = 64, FreeCount = 1 << 18, MaxFrames = 30;
        private readonly string path;
        private readonly bool isArchive;
        private long start;

        /// <summary>Number of frames, and of Gaussians in each.</summary>
        public readonly int Frames, Count;

        /// <summary>Frames a second.</summary>
        public readonly double Rate;

        /// <summary>Whether row i is the same Gaussian in every frame, so that frames may be blended.</summary>
        public readonly bool IsConstant;

        /// <summary>Texts by key, as in the asset.</summary>
        public readonly Dictionary<string, string> Metadata = new Dictionary<string, string>();

        /// <summary>Segments in the order of their frames.</summary>
        public readonly List<BlockEntry> Segments = new List<BlockEntry>();

        /// <summary>The block that all segments need.</summary>
        public readonly Block Still;

        /// <summary>Read the manifest and the static block.</summary>
        /// <exception cref="DeliveryException">They are malformed, or a file is missing.</exception>
        public Container(string path) {
            this.path = path;
            isArchive = !path.EndsWith(".json", StringComparison.Ordinal);
            var said = Json.Parse(ReadManifest()) as Dictionary<string, object>;
            DeliveryException.Require(said != null, Manifest + " must hold an object", "another value");
            bool isKnown = Equals(Get(said, "format"), "b4d") && Equals(Get(said, "version"), 1.0);
            DeliveryException.Require(isKnown, "version must be 1 of b4d", Get(said, "version"));
            Rate = Get(said, "rate") is double ? (double)Get(said, "rate") : 0.0;
            DeliveryException.Require(Rate >= 1e-3 && Rate <= 1e6, "rate must be a rate", Get(said, "rate"));
            IsConstant = Equals(Get(said, "topology"), "constant");
            var metadata = Get(said, "metadata") as Dictionary<string, object> ?? new Dictionary<string, object>();
            foreach (var pair in metadata) Metadata[pair.Key] = pair.Value as string ?? "";
            BlockEntry still = EntryOf(Get(said, "static"));
            Count = (int)Whole(said, "count", 0, Math.Min(FreeCount + still.Bytes, int.MaxValue / 4));
            Frames = ReadSegments(Get(said, "segments") as List<object>);
            Whole(said, "frames", Math.Max(Frames, 1), Frames);
            Still = Read(still);
            foreach (string name in new[] { "positions", "orientations", "scales", "opacities" })
                DeliveryException.Require(Still.Arrays.ContainsKey(name), "the static block must hold " + name, "none");
        }

        /// <summary>Read, check and unpack a block: one range of the file.</summary>
        /// <exception cref="DeliveryException">It is missing, was altered, or is malformed.</exception>
        public Block Read(BlockEntry entry) {
            byte[] packed = ReadRange(entry);
            using (SHA256 sha = SHA256.Create()) {
                string digest = BitConverter.ToString(sha.ComputeHash(packed)).Replace("-", "").ToLowerInvariant();
                string contract = entry.File + " must have the digest that " + Manifest + " says";
                DeliveryException.Require(digest == entry.Digest, contract, digest);
            }
            try {
                return new Block(Inflate(packed, entry.Unpacked), entry.Frames, Count);
            } catch (Exception error) when (!(error is OutOfMemoryException)) {
                DeliveryException.Require(false, entry.File + " must be a sound block", "a broken one (" + error.Message + ")");
                throw;
            }
        }

        private byte[] ReadRange(BlockEntry entry) {
            string at = isArchive ? path : Path.Combine(Path.GetDirectoryName(Path.GetFullPath(path)), entry.File);
            DeliveryException.Require(File.Exists(at), "a container must hold all its files", "no " + entry.File);
            using (FileStream stream = File.OpenRead(at)) {
                long from = isArchive ? start + entry.Offset : 0;
                long there = Math.Max(0, Math.Min(entry.Bytes, stream.Length - from));
                DeliveryException.Require(there == entry.Bytes, entry.File + " must have " + entry.Bytes + " bytes", there);
                stream.Seek(from, SeekOrigin.Begin);
                return ReadFully(stream, (int)there);
            }
        }

        private string ReadManifest() {
            DeliveryException.Require(File.Exists(path), "a container must be a file", "no " + Path.GetFileName(path));
            using (FileStream stream = File.OpenRead(path)) {
                long size = stream.Length;
                if (isArchive) {
                    byte[] head = ReadFully(stream, (int)Math.Min(30, size));
                    Array.Resize(ref head, 30);
                    int names = BitConverter.ToUInt16(head, 26), extra = BitConverter.ToUInt16(head, 28);
                    size = BitConverter.ToUInt32(head, 18);
                    start = 30 + names + extra + size;
                    byte[] name = ReadFully(stream, (int)Math.Min(names + extra, stream.Length - stream.Position));
                    bool isStored = BitConverter.ToUInt32(head, 0) == 0x04034b50 && BitConverter.ToUInt16(head, 8) == 0
                        && (head[6] & 9) == 0 && name.Length >= names && Encoding.UTF8.GetString(name, 0, names) == Manifest;
                    DeliveryException.Require(
                        isStored, "a b4d file must be a zip archive that begins with " + Manifest + ", stored", "another file");
                }
                long there = Math.Min(size, stream.Length - stream.Position);
                bool fits = size <= MaxManifestBytes && there == size;
                DeliveryException.Require(fits, Manifest + " must have at most " + MaxManifestBytes + " bytes, all there", there);
                return Encoding.UTF8.GetString(ReadFully(stream, (int)size));
            }
        }

        private int ReadSegments(List<object> said) {
            DeliveryException.Require(said != null, "segments must be there", "none");
            int following = 0;
            foreach (object each in said) {
                BlockEntry entry = EntryOf(each);
                entry.First = (int)Whole((Dictionary<string, object>)each, "first", following, following);
                entry.Frames = (int)Whole((Dictionary<string, object>)each, "frames", 1, MaxFrames);
                following += entry.Frames;
                Segments.Add(entry);
            }
            return following;
        }

        private static BlockEntry EntryOf(object value) {
            var said = value as Dictionary<string, object>;
            string name = said == null ? null : Get(said, "file") as string;
            bool isName = !string.IsNullOrEmpty(name) && name.Length < 256 && name.Trim('.').Length > 0
                && name.IndexOfAny(new[] { '/', '\\', ':', '\0', '\n', '\r' }) < 0;
            DeliveryException.Require(isName, "blocks must say their file, a name beside the manifest", name);
            long bytes = Whole(said, "bytes", 1, int.MaxValue);
            var unpacked = (int)Whole(said, "unpacked", 4, Math.Min(FreeBytes + MaxRatio * bytes, int.MaxValue - 64));
            long offset = Whole(said, "offset", 0, 1L << 53);
            string digest = Get(said, "sha256") as string;
            return new BlockEntry { File = name, Offset = offset, Bytes = bytes, Unpacked = unpacked, Frames = 1, Digest = digest };
        }

        private static object Get(Dictionary<string, object> said, string key) {
            object value;
            return said.TryGetValue(key, out value) ? value : null;
        }

        private static long Whole(Dictionary<string, object> said, string key, long least, long most) {
            object value = Get(said, key);
            bool isWhole = value is double && (double)value >= least && (double)value <= most
                && Math.Floor((double)value) == (double)value;
            DeliveryException.Require(isWhole, key + " must be an integer in [" + least + ", " + most + "]", value);
            return (long)(double)value;
        }

        private static byte[] Inflate(byte[] packed, int size) {
            bool isZlib = packed.Length > 6 && (packed[0] & 15) == 8 && (packed[0] * 256 + packed[1]) % 31 == 0
                && (packed[1] & 32) == 0;
            DeliveryException.Require(isZlib, "it must be a zlib stream", "another one");
            var raw = new MemoryStream(packed, 2, packed.Length - 2);
            using (var stream = new DeflateStream(raw, CompressionMode.Decompress)) {
                byte[] content = ReadFully(stream, size);
                DeliveryException.Require(stream.ReadByte() < 0, "it must unpack to " + size + " bytes", "more");
                return content;
            }
        }

        private static byte[] ReadFully(Stream stream, int size) {
            var content = new byte[size];
            int end = 0;
            for (int part = 1; end < size && part > 0; end += part) part = stream.Read(content, end, size - end);
            DeliveryException.Require(end == size, "it must hold " + size + " bytes", end);
            return content;
        }
    }
}
