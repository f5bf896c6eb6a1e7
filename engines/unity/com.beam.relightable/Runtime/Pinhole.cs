using UnityEngine;
using UnityEngine.Rendering;

namespace Beam.Relightable {
    /// <summary>A camera in the renderer's world: an eye, or a shadow map. "Down" is the way in which rows of the target are counted.</summary>
    public struct Pinhole {
        public Vector3 position, right, down, forward;
        public Vector2 focal, center, size;

        /// <summary>How the target stores depth: (a, b, c, d) of (b - a z) / (d - c z).</summary>
        public Vector4 depths;

        private static readonly Matrix4x4[] Cameras = new Matrix4x4[2];
        private static readonly Vector4[] Lenses = new Vector4[2], Depths = new Vector4[2];

        /// <summary>Return a camera of Unity's; rows of its targets begin at the bottom of the image.</summary>
        public static Pinhole Of(Matrix4x4 worldToCamera, Matrix4x4 projection, Vector2 size) {
            Matrix4x4 pose = worldToCamera.inverse, stored = GL.GetGPUProjectionMatrix(projection, true);
            return new Pinhole {
                position = Axes.Swapped(pose.GetColumn(3)),
                right = Axes.Swapped(pose.GetColumn(0)),
                down = Axes.Swapped(pose.GetColumn(1)),
                forward = -Axes.Swapped(pose.GetColumn(2)),
                focal = new Vector2(0.5f * size.x * projection[0, 0], 0.5f * size.y * projection[1, 1]),
                center = new Vector2(0.5f * size.x * (1f - projection[0, 2]), 0.5f * size.y * (1f - projection[1, 2])),
                size = size,
                depths = new Vector4(stored[2, 2], stored[2, 3], stored[3, 2], stored[3, 3]),
            };
        }

        /// <summary>Return a square camera that looks along an axis.</summary>
        public static Pinhole Looking(Vector3 position, Vector3 axis, float halfAngle, int side) {
            Vector3 forward = axis.normalized, size = new Vector3(Mathf.Abs(forward.x), Mathf.Abs(forward.y), Mathf.Abs(forward.z));
            Vector3 up = size.x <= size.y && size.x <= size.z ? Vector3.right : size.y <= size.z ? Vector3.up : Vector3.forward;
            Vector3 right = Vector3.Cross(forward, up).normalized;
            return new Pinhole {
                position = position,
                right = right,
                down = Vector3.Cross(forward, right),
                forward = forward,
                focal = Vector2.one * (0.5f * side / Mathf.Tan(halfAngle)),
                center = Vector2.one * (0.5f * side),
                size = Vector2.one * side,
                depths = new Vector4(0f, 1f, -1f, 0f),
            };
        }

        /// <summary>Make shaders draw these eyes, one, or two of single-pass stereo, through a low-pass of that variance [pixel²].</summary>
        public static void Set(CommandBuffer commands, Pinhole first, Pinhole second, float near, float lowPass, bool isAntialiased) {
            for (int eye = 0; eye < 2; eye++) {
                Pinhole view = eye == 0 ? first : second;
                Cameras[eye].SetRow(0, view.position);
                Cameras[eye].SetRow(1, view.right);
                Cameras[eye].SetRow(2, view.down);
                Cameras[eye].SetRow(3, view.forward);
                Lenses[eye] = new Vector4(view.focal.x, view.focal.y, view.center.x, view.center.y);
                Depths[eye] = view.depths;
            }
            commands.SetGlobalMatrixArray("_BeamCamera", Cameras);
            commands.SetGlobalVectorArray("_BeamLens", Lenses);
            commands.SetGlobalVectorArray("_BeamDepths", Depths);
            float flip = SystemInfo.graphicsUVStartsAtTop ? 1f : -1f;
            commands.SetGlobalVector("_BeamTarget", new Vector4(first.size.x, first.size.y, flip, near));
            commands.SetGlobalVector("_BeamFilter", new Vector4(lowPass, isAntialiased ? 1f : 0f, 0f, 0f));
        }
    }
}
