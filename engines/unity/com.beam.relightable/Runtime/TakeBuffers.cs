using System;
using UnityEngine;
using UnityEngine.Rendering;

namespace Beam.Relightable {
    /// <summary>A take on the graphics card: planes, Gaussians of a moment, and their order.</summary>
    public sealed class TakeBuffers : IDisposable {
        private const int RowsOfOne = 5, Run = 1024, Threads = 64;
        private readonly ComputeShader evaluate, sort;
        private readonly GraphicsBuffer components, first, second, digits;
        private GraphicsBuffer still, segment, next, terms, arriving;
        private Block segmentBlock, nextBlock;

        /// <summary>Number of Gaussians.</summary>
        public readonly int Count;

        /// <summary>Rows of Gaussians, and their numbers, farthest first.</summary>
        public readonly GraphicsBuffer Gaussians, Order;

        /// <summary>What arrives of an environment at each Gaussian, once it casts shadows.</summary>
        public GraphicsBuffer Arriving => arriving = arriving ?? new GraphicsBuffer(GraphicsBuffer.Target.Structured, Mathf.Max(Count, 1), 16);

        /// <summary>Allocate for a number of Gaussians.</summary>
        public TakeBuffers(int count) {
            Count = count;
            evaluate = Resources.Load<ComputeShader>("Beam/Evaluate");
            sort = Resources.Load<ComputeShader>("Beam/Sort");
            int some = Mathf.Max(count, 1), groups = (some + Run - 1) / Run;
            Gaussians = new GraphicsBuffer(GraphicsBuffer.Target.Structured, RowsOfOne * some, 16);
            Order = new GraphicsBuffer(GraphicsBuffer.Target.Structured, some, 4);
            first = new GraphicsBuffer(GraphicsBuffer.Target.Structured, some, 8);
            second = new GraphicsBuffer(GraphicsBuffer.Target.Structured, some, 8);
            digits = new GraphicsBuffer(GraphicsBuffer.Target.Structured, 16 * groups, 4);
            components = new GraphicsBuffer(GraphicsBuffer.Target.Structured, 21, 16);
        }

        /// <summary>Put the rows of a single frame.</summary>
        public void Set(Vector4[] rows) {
            Gaussians.SetData(rows);
        }

        /// <summary>Evaluate a moment; planes are uploaded when their block is another one than before.</summary>
        public void Evaluate(Container take, Block now, Block after, Terms moment) {
            if (still == null) still = Uploaded(null, take.Still.Planes);
            if (now != segmentBlock && now == nextBlock) {
                GraphicsBuffer kept = segment;
                segment = next;
                next = kept;
                nextBlock = segmentBlock;
                segmentBlock = now;
            }
            if (now != segmentBlock) segment = Uploaded(segment, (segmentBlock = now).Planes);
            if (after != null && after != nextBlock) next = Uploaded(next, (nextBlock = after).Planes);
            if (terms == null || terms.count < moment.Count) {
                if (terms != null) terms.Release();
                terms = new GraphicsBuffer(GraphicsBuffer.Target.Structured, Mathf.Max(moment.Rows.Length / 4, 1), 16);
            }
            terms.SetData(moment.Rows, 0, 0, 4 * moment.Count);
            components.SetData(moment.Ranges);
            evaluate.SetBuffer(0, "_BeamStill", still);
            evaluate.SetBuffer(0, "_BeamSegment", segment);
            evaluate.SetBuffer(0, "_BeamNext", next ?? segment);
            evaluate.SetBuffer(0, "_BeamTerms", terms);
            evaluate.SetBuffer(0, "_BeamComponents", components);
            evaluate.SetBuffer(0, "_BeamEvaluated", Gaussians);
            evaluate.SetVector("_BeamCounts", new Vector4(Count, 0f, 0f, 0f));
            evaluate.Dispatch(0, Groups(Threads), 1, 1);
        }

        /// <summary>Sort by depth along a way from a position, both in the renderer's world.</summary>
        public void Sort(CommandBuffer commands, Matrix4x4 toWorld, Vector3 position, Vector3 way) {
            int keys = sort.FindKernel("Keys"), count = sort.FindKernel("Count"), scan = sort.FindKernel("Scan");
            int scatter = sort.FindKernel("Scatter"), order = sort.FindKernel("Order");
            GraphicsBuffer here = first, there = second;
            commands.SetComputeMatrixParam(sort, "_BeamObject", toWorld);
            commands.SetComputeVectorParam(sort, "_BeamSortPlane", position);
            commands.SetComputeVectorParam(sort, "_BeamSortWay", way);
            commands.SetComputeVectorParam(sort, "_BeamSort", new Vector4(Count, Groups(Run), 0f, 0f));
            commands.SetComputeBufferParam(sort, keys, "_BeamGaussians", Gaussians);
            commands.SetComputeBufferParam(sort, keys, "_BeamSorted", here);
            commands.DispatchCompute(sort, keys, Groups(Threads), 1, 1);
            for (int shift = 0; shift < 32; shift += 4) {
                commands.SetComputeVectorParam(sort, "_BeamSort", new Vector4(Count, Groups(Run), shift, 0f));
                foreach (int kernel in new[] { count, scan, scatter }) {
                    if (kernel != scan) commands.SetComputeBufferParam(sort, kernel, "_BeamUnsorted", here);
                    if (kernel == scatter) commands.SetComputeBufferParam(sort, kernel, "_BeamSorted", there);
                    commands.SetComputeBufferParam(sort, kernel, "_BeamDigits", digits);
                    commands.DispatchCompute(sort, kernel, kernel == scan ? 1 : Groups(Run), 1, 1);
                }
                GraphicsBuffer sorted = there;
                there = here;
                here = sorted;
            }
            commands.SetComputeBufferParam(sort, order, "_BeamUnsorted", here);
            commands.SetComputeBufferParam(sort, order, "_BeamOrdered", Order);
            commands.DispatchCompute(sort, order, Groups(Threads), 1, 1);
        }

        /// <summary>Release all memory.</summary>
        public void Dispose() {
            foreach (GraphicsBuffer each in new[] { Gaussians, Order, first, second, digits, components, still, segment, next, terms, arriving })
                if (each != null) each.Release();
        }

        private int Groups(int size) => (Mathf.Max(Count, 1) + size - 1) / size;

        private static GraphicsBuffer Uploaded(GraphicsBuffer held, byte[] planes) {
            int words = Mathf.Max((planes.Length + 3) / 4, 1);
            if (held == null || held.count < words) {
                if (held != null) held.Release();
                held = new GraphicsBuffer(GraphicsBuffer.Target.Raw, words, 4);
            }
            held.SetData(planes);
            return held;
        }
    }
}
