using System;
using System.Collections.Generic;
using System.IO;
using System.Threading;

namespace Beam.Relightable {
    /// <summary>Segments of a take, unpacked by a thread of its own; at most two are held.</summary>
    public sealed class SegmentStream : IDisposable {
        private readonly Container take;
        private readonly object gate = new object();
        private readonly Dictionary<int, Block> held = new Dictionary<int, Block>();
        private readonly HashSet<int> failed = new HashSet<int>();
        private int current = -1, next = -1;
        private bool isDone;
        private string error;

        /// <summary>Start the thread.</summary>
        public SegmentStream(Container take) {
            this.take = take;
            new Thread(Work) { IsBackground = true, Name = "Relightable segments" }.Start();
        }

        /// <summary>What went wrong last: a line that names the segment; null if nothing did.</summary>
        public string Error {
            get { lock (gate) return error; }
        }

        /// <summary>Number of segments that are held.</summary>
        public int Resident {
            get { lock (gate) return held.Count; }
        }

        /// <summary>Say which segments are wanted; others are dropped. -1 for no second one.</summary>
        public void Want(int first, int second) {
            lock (gate) {
                if (first == current && second == next) return;
                current = first;
                next = second;
                foreach (int index in new List<int>(held.Keys)) if (index != first && index != second) held.Remove(index);
                Monitor.Pulse(gate);
            }
        }

        /// <summary>Return a segment that was wanted, or null while it is not at hand or cannot be read.</summary>
        public Block Get(int index) {
            Block block;
            lock (gate) return held.TryGetValue(index, out block) ? block : null;
        }

        /// <summary>End the thread.</summary>
        public void Dispose() {
            lock (gate) {
                isDone = true;
                Monitor.Pulse(gate);
            }
        }

        private void Work() {
            while (true) {
                int index;
                lock (gate) {
                    while (!isDone && (index = Missing()) < 0) Monitor.Wait(gate);
                    if (isDone) return;
                    index = Missing();
                }
                Block block = null;
                string said = null;
                try {
                    block = take.Read(take.Segments[index]);
                } catch (Exception caught) when (caught is DeliveryException || caught is IOException || caught is UnauthorizedAccessException) {
                    said = caught is DeliveryException ? caught.Message : take.Segments[index].File + ": " + caught.Message;
                }
                lock (gate) {
                    error = said ?? error;
                    if (block == null) failed.Add(index);
                    else if (index == current || index == next) held[index] = block;
                }
            }
        }

        private int Missing() {
            foreach (int index in new[] { current, next })
                if (index >= 0 && !held.ContainsKey(index) && !failed.Contains(index)) return index;
            return -1;
        }
    }
}
