// The part of Unity's API that the package calls, as declarations of ours: enough to compile against. Vectors and matrices
// work, so that Adapter.cs can ask for cameras and lamps; all else does nothing.
#pragma warning disable 67, 169, 649, 660, 661
using System;
using System.Collections.Generic;
using UnityEngine.Experimental.Rendering;
using UnityEngine.Rendering;

namespace UnityEngine {
    public struct Vector2 {
        public float x, y;
        public Vector2(float x, float y) { this.x = x; this.y = y; }
        public static Vector2 one => new Vector2(1, 1);
        public static Vector2 operator *(Vector2 a, float b) => new Vector2(a.x * b, a.y * b);
        public static implicit operator Vector4(Vector2 v) => new Vector4(v.x, v.y, 0, 0);
    }
    public struct Vector2Int {
        public int x, y;
        public Vector2Int(int x, int y) { this.x = x; this.y = y; }
        public static implicit operator Vector2(Vector2Int v) => new Vector2(v.x, v.y);
    }
    public struct Vector3 {
        public float x, y, z;
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
        public float this[int k] {
            get { return k == 0 ? x : k == 1 ? y : z; }
            set { if (k == 0) x = value; else if (k == 1) y = value; else z = value; }
        }
        public float magnitude => (float)Math.Sqrt(x * x + y * y + z * z);
        public Vector3 normalized => this * (1 / magnitude);
        public static Vector3 zero => new Vector3(0, 0, 0);
        public static Vector3 one => new Vector3(1, 1, 1);
        public static Vector3 right => new Vector3(1, 0, 0);
        public static Vector3 left => -right;
        public static Vector3 up => new Vector3(0, 1, 0);
        public static Vector3 down => -up;
        public static Vector3 forward => new Vector3(0, 0, 1);
        public static Vector3 back => -forward;
        public static Vector3 operator +(Vector3 a, Vector3 b) => new Vector3(a.x + b.x, a.y + b.y, a.z + b.z);
        public static Vector3 operator -(Vector3 a, Vector3 b) => a + -b;
        public static Vector3 operator -(Vector3 a) => a * -1;
        public static Vector3 operator *(Vector3 a, float b) => new Vector3(a.x * b, a.y * b, a.z * b);
        public static Vector3 operator *(float a, Vector3 b) => b * a;
        public static Vector3 Cross(Vector3 a, Vector3 b) => new Vector3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
        public static float Distance(Vector3 a, Vector3 b) => (a - b).magnitude;
    }
    public struct Vector4 {
        public float x, y, z, w;
        public Vector4(float x, float y, float z, float w) { this.x = x; this.y = y; this.z = z; this.w = w; }
        public static implicit operator Vector3(Vector4 v) => new Vector3(v.x, v.y, v.z);
        public static implicit operator Vector4(Vector3 v) => new Vector4(v.x, v.y, v.z, 0);
    }
    public struct Quaternion { public static Quaternion Euler(float x, float y, float z) => new Quaternion(); }
    public struct Matrix4x4 {
        private float[] m; // row by row
        public Matrix4x4(Vector4 a, Vector4 b, Vector4 c, Vector4 d) {
            m = new[] { a.x, b.x, c.x, d.x, a.y, b.y, c.y, d.y, a.z, b.z, c.z, d.z, a.w, b.w, c.w, d.w };
        }
        public static Matrix4x4 identity => Scale(new Vector3(1, 1, 1));
        public float this[int row, int column] {
            get { return m[4 * row + column]; }
            set { (m = m == null ? new float[16] : (float[])m.Clone())[4 * row + column] = value; }
        }
        public Vector4 GetColumn(int k) => new Vector4(m[k], m[4 + k], m[8 + k], m[12 + k]);
        public void SetRow(int k, Vector4 row) { this[k, 0] = row.x; this[k, 1] = row.y; this[k, 2] = row.z; this[k, 3] = row.w; }
        public static Matrix4x4 Scale(Vector3 v) => new Matrix4x4(new Vector4(v.x, 0, 0, 0), new Vector4(0, v.y, 0, 0), new Vector4(0, 0, v.z, 0), new Vector4(0, 0, 0, 1));
        public static Matrix4x4 operator *(Matrix4x4 a, Matrix4x4 b) {
            var found = new Matrix4x4();
            for (int k = 0; k < 16; k++)
                found[k / 4, k % 4] = a[k / 4, 0] * b[0, k % 4] + a[k / 4, 1] * b[1, k % 4] + a[k / 4, 2] * b[2, k % 4] + a[k / 4, 3] * b[3, k % 4];
            return found;
        }
        public Matrix4x4 inverse { // of a rigid motion
            get {
                Vector3 t = GetColumn(3);
                var turned = new Matrix4x4(new Vector4(m[0], m[1], m[2], 0), new Vector4(m[4], m[5], m[6], 0), new Vector4(m[8], m[9], m[10], 0), new Vector4(0, 0, 0, 1));
                var shift = identity;
                for (int k = 0; k < 3; k++) shift[k, 3] = -t[k];
                return turned * shift;
            }
        }
    }
    public struct Color {
        public float r, g, b, a;
        public Color(float r, float g, float b, float a) { this.r = r; this.g = g; this.b = b; this.a = a; }
        public static Color clear;
        public Color linear => this;
        public static Color operator *(Color a, float b) => new Color(a.r * b, a.g * b, a.b * b, a.a * b);
        public static Color operator *(Color a, Color b) => a;
    }
    public struct Rect { public Rect(float x, float y, float width, float height) { } }
    public struct Bounds {
        public Bounds(Vector3 center, Vector3 size) : this() { }
        public Vector3 center, extents, size, min, max;
        public void SetMinMax(Vector3 low, Vector3 high) { }
    }
    public static class Mathf {
        public const float PI = 3.14159265f, Deg2Rad = PI / 180f;
        public static float Max(float a, float b) => Math.Max(a, b);
        public static int Max(int a, int b) => Math.Max(a, b);
        public static float Min(float a, float b) => Math.Min(a, b);
        public static int Min(int a, int b) => Math.Min(a, b);
        public static float Abs(float a) => Math.Abs(a);
        public static float Sin(float a) => (float)Math.Sin(a);
        public static float Cos(float a) => (float)Math.Cos(a);
        public static float Tan(float a) => (float)Math.Tan(a);
        public static float Asin(float a) => (float)Math.Asin(a);
        public static float Pow(float a, float b) => (float)Math.Pow(a, b);
        public static float Floor(float a) => (float)Math.Floor(a);
        public static int CeilToInt(float a) => (int)Math.Ceiling(a);
        public static int Clamp(int a, int low, int high) => Math.Max(low, Math.Min(a, high));
        public static float Clamp(float a, float low, float high) => Math.Max(low, Math.Min(a, high));
        public static float Repeat(float a, float length) => a - length * Floor(a / length);
        public static Color CorrelatedColorTemperatureToRGB(float kelvin) => new Color();
    }
    public class Object {
        public string name;
        public static bool operator ==(Object a, Object b) => ReferenceEquals(a, b);
        public static bool operator !=(Object a, Object b) => !ReferenceEquals(a, b);
        public static T[] FindObjectsByType<T>(FindObjectsSortMode mode) where T : Object => new T[0];
    }
    public enum FindObjectsSortMode { None }
    public class ScriptableObject : Object { public static T CreateInstance<T>() where T : ScriptableObject => null; }
    public class Component : Object { public Transform transform; public GameObject gameObject; public string tag; }
    public class Behaviour : Component { public bool enabled, isActiveAndEnabled; }
    public class MonoBehaviour : Behaviour { }
    public class Transform : Component {
        public Vector3 position, forward, lossyScale, localScale;
        public Quaternion rotation;
        public Matrix4x4 localToWorldMatrix;
        public Vector3 TransformPoint(Vector3 p) => p;
    }
    public enum PrimitiveType { Plane }
    public class GameObject : Object {
        public int layer;
        public Transform transform;
        public GameObject(string name) { }
        public T AddComponent<T>() where T : Component => null;
        public static GameObject CreatePrimitive(PrimitiveType type) => null;
    }
    public class Texture : Object { public int width, height, mipmapCount; public FilterMode filterMode; }
    public class RenderTexture : Texture {
        public int volumeDepth;
        public RenderTexture(RenderTextureDescriptor descriptor) { }
        public bool Create() => true;
        public void Release() { }
    }
    public struct RenderTextureDescriptor {
        public int width, height, volumeDepth;
        public TextureDimension dimension;
        public RenderTextureDescriptor(int width, int height, GraphicsFormat format, int depthBits) : this() { }
    }
    public class TextAsset : Object { public byte[] bytes; }
    public class Shader : Object { }
    public class Material : Object { public Material(Shader shader) { } }
    public class MaterialPropertyBlock {
        public void SetBuffer(string name, GraphicsBuffer value) { }
        public void SetMatrix(string name, Matrix4x4 value) { }
    }
    public class ComputeShader : Object {
        public int FindKernel(string name) => 0;
        public void SetBuffer(int kernel, string name, GraphicsBuffer buffer) { }
        public void SetTexture(int kernel, string name, Texture texture) { }
        public void SetVector(string name, Vector4 value) { }
        public void Dispatch(int kernel, int x, int y, int z) { }
    }
    public class GraphicsBuffer {
        [Flags] public enum Target { Structured = 16, Raw = 32 }
        public int count;
        public GraphicsBuffer(Target target, int count, int stride) { }
        public void SetData(Array data) { }
        public void SetData(Array data, int from, int to, int count) { }
        public void SetData<T>(List<T> data) where T : struct { }
        public void GetData(Array data, int to, int from, int count) { }
        public void Release() { }
    }
    public class Renderer : Component { public bool enabled; public Material[] sharedMaterials; }
    public enum LightType { Spot, Directional, Point, Rectangle }
    public enum LightShadows { None, Hard, Soft }
    public class Light : Behaviour {
        public LightType type;
        public LightShadows shadows;
        public Color color;
        public bool useColorTemperature;
        public float intensity, colorTemperature, spotAngle, innerSpotAngle;
    }
    public class ReflectionProbe : Behaviour { public static Texture defaultTexture; }
    public static class RenderSettings { public static float reflectionIntensity; }
    public class Camera : Behaviour {
        public enum StereoscopicEye { Left, Right }
        public bool stereoEnabled;
        public float nearClipPlane;
        public Matrix4x4 worldToCameraMatrix, nonJitteredProjectionMatrix;
        public Matrix4x4 GetStereoViewMatrix(StereoscopicEye eye) => Matrix4x4.identity;
        public Matrix4x4 GetStereoNonJitteredProjectionMatrix(StereoscopicEye eye) => Matrix4x4.identity;
    }
    public static class GL { // of Direct3D: near is stored as 1, far as 0
        public static Matrix4x4 GetGPUProjectionMatrix(Matrix4x4 projection, bool intoTexture) {
            Matrix4x4 stored = projection;
            for (int k = 0; k < 4; k++) {
                stored[1, k] = intoTexture ? -projection[1, k] : projection[1, k];
                stored[2, k] = 0.5f * (projection[3, k] - projection[2, k]);
            }
            return stored;
        }
    }
    public static class SystemInfo { public static bool graphicsUVStartsAtTop; }
    public static class Time { public static float deltaTime; }
    public static class Application { public static bool isPlaying, isEditor; public static string streamingAssetsPath; }
    public static class Resources { public static T Load<T>(string path) where T : Object => null; }
    public static class Debug { public static void LogError(object message, Object context) { } }
    public enum MeshTopology { Triangles }
    public enum FilterMode { Point }
    public enum CubemapFace { Unknown = -1 }
    public struct RenderParams {
        public RenderParams(Material material) : this() { }
        public MaterialPropertyBlock matProps;
        public ShadowCastingMode shadowCastingMode;
        public Bounds worldBounds;
        public int layer;
    }
    public static class Graphics { public static void RenderPrimitives(RenderParams draw, MeshTopology topology, int vertices) { } }
    public sealed class ExecuteAlways : Attribute { }
    public sealed class HideInInspector : Attribute { }
    public sealed class AddComponentMenu : Attribute { public AddComponentMenu(string menu) { } }
}
namespace UnityEngine.Experimental.Rendering { public enum GraphicsFormat { R32_SFloat, R16G16B16A16_SFloat, R32G32B32A32_SFloat } }
namespace UnityEngine.Rendering {
    public enum TextureDimension { Tex2DArray }
    public enum ShadowCastingMode { ShadowsOnly }
    public enum BuiltinRenderTextureType { None }
    public struct RenderTargetIdentifier {
        public static implicit operator RenderTargetIdentifier(Texture texture) => new RenderTargetIdentifier();
        public static implicit operator RenderTargetIdentifier(BuiltinRenderTextureType type) => new RenderTargetIdentifier();
    }
    public class CommandBuffer {
        public string name;
        public void Clear() { }
        public void Release() { }
        public void SetGlobalBuffer(string name, GraphicsBuffer value) { }
        public void SetGlobalTexture(string name, RenderTargetIdentifier value) { }
        public void SetGlobalVector(string name, Vector4 value) { }
        public void SetGlobalVectorArray(string name, Vector4[] values) { }
        public void SetGlobalMatrix(string name, Matrix4x4 value) { }
        public void SetGlobalMatrixArray(string name, Matrix4x4[] values) { }
        public void SetComputeBufferParam(ComputeShader shader, int kernel, string name, GraphicsBuffer buffer) { }
        public void SetComputeVectorParam(ComputeShader shader, string name, Vector4 value) { }
        public void SetComputeVectorArrayParam(ComputeShader shader, string name, Vector4[] values) { }
        public void SetComputeTextureParam(ComputeShader shader, int kernel, string name, RenderTargetIdentifier value) { }
        public void SetComputeMatrixParam(ComputeShader shader, string name, Matrix4x4 value) { }
        public void DispatchCompute(ComputeShader shader, int kernel, int x, int y, int z) { }
        public void SetRenderTarget(RenderTargetIdentifier color, RenderTargetIdentifier depth, int mip, CubemapFace face, int slice) { }
        public void SetRenderTarget(RenderTargetIdentifier[] colors, RenderTargetIdentifier depth, int mip, CubemapFace face, int slice) { }
        public void SetViewport(Rect rectangle) { }
        public void ClearRenderTarget(bool depth, bool color, Color value) { }
        public void DrawProcedural(Matrix4x4 matrix, Material material, int pass, MeshTopology topology, int vertices, int instances) { }
        public void DrawRenderer(Renderer renderer, Material material, int submesh, int pass) { }
    }
    public struct ScriptableRenderContext { public void ExecuteCommandBuffer(CommandBuffer commands) { } }
    public static class RenderPipelineManager { public static event Action<ScriptableRenderContext, List<Camera>> beginContextRendering; }
    public static class CoreUtils {
        public static Texture blackCubeTexture;
        public static void Destroy(Object each) { }
        public static void SetKeyword(Material material, string keyword, bool isOn) { }
    }
    public class RTHandle { public RenderTexture rt; public RenderTargetIdentifier nameID; }
}
