using System.IO;
using UnityEngine;

namespace Beam.Relightable {
    /// <summary>An imported take: facts about it, and where its container is; or the rows of a single frame.</summary>
    public sealed class TakeAsset : ScriptableObject {
        /// <summary>The container in the project, and its identity, by which a build names it.</summary>
        public string sourcePath, guid;
        public int frames, count;
        public float rate;
        public bool isConstant, antialiased;

        /// <summary>Variance of the low-pass that the take was fitted with [pixel²].</summary>
        public float lowPass = 0.3f;

        /// <summary>Box around the first frame [m], in Unity's axes.</summary>
        public Bounds bounds;

        /// <summary>Median over the Gaussians of the middle one of their three scales [m].</summary>
        public float thickness;

        /// <summary>Rows of a take of one frame, as Gaussians.hlsl reads them; empty for a container.</summary>
        [HideInInspector] public Vector4[] rows = new Vector4[0];

        /// <summary>Length of the take [s].</summary>
        public float Duration => frames / Mathf.Max(rate, 1e-3f);

        /// <summary>Name of the container among the streaming assets of a build.</summary>
        public string BuildName => "beam/" + guid + ".b4d";

        /// <summary>File to read now.</summary>
        public string FilePath => Application.isEditor ? sourcePath : Path.Combine(Application.streamingAssetsPath, BuildName);
    }
}
