// The part of HDRP, URP, Timeline and the editor that the package calls; see UnityEngine.cs.
#pragma warning disable 67, 169, 649
using System;
using System.Collections.Generic;

namespace UnityEngine.Rendering.HighDefinition {
    public class HDCamera { public Camera camera; public int actualWidth, actualHeight; }
    public struct CustomPassContext { public CommandBuffer cmd; public HDCamera hdCamera; public RTHandle cameraColorBuffer, cameraDepthBuffer; }
    public class CustomPass {
        protected virtual void Setup(ScriptableRenderContext context, CommandBuffer commands) { }
        protected virtual void Execute(CustomPassContext context) { }
        protected virtual void Cleanup() { }
    }
}
namespace UnityEngine.Rendering.RenderGraphModule {
    public struct TextureHandle { public static implicit operator RTHandle(TextureHandle handle) => null; }
    public enum AccessFlags { Read, ReadWrite }
    public class UnsafeCommandBuffer { }
    public class UnsafeGraphContext { public UnsafeCommandBuffer cmd; }
    public delegate void BaseRenderFunc<Data, Context>(Data data, Context context) where Data : class, new();
    public interface IUnsafeRenderGraphBuilder : IDisposable {
        void UseTexture(TextureHandle texture, AccessFlags flags);
        void AllowPassCulling(bool value);
        void AllowGlobalStateModification(bool value);
        void SetRenderFunc<Data>(BaseRenderFunc<Data, UnsafeGraphContext> function) where Data : class, new();
    }
    public class RenderGraph { public IUnsafeRenderGraphBuilder AddUnsafePass<Data>(string name, out Data data) where Data : class, new() { data = null; return null; } }
}
namespace UnityEngine.Rendering {
    public class ContextItem { }
    public class ContextContainer { public T Get<T>() where T : ContextItem, new() => null; }
    public static class CommandBufferHelpers { public static CommandBuffer GetNativeCommandBuffer(RenderGraphModule.UnsafeCommandBuffer commands) => null; }
}
namespace UnityEngine.Rendering.Universal {
    public enum RenderPassEvent { AfterRenderingSkybox }
    public enum ScriptableRenderPassInput { Depth }
    public struct RenderingData { }
    public class UniversalResourceData : ContextItem { public RenderGraphModule.TextureHandle activeColorTexture, activeDepthTexture, cameraDepthTexture; }
    public class UniversalCameraData : ContextItem { public Camera camera; public RenderTextureDescriptor cameraTargetDescriptor; }
    public abstract class ScriptableRenderPass {
        public RenderPassEvent renderPassEvent;
        public bool requiresIntermediateTexture;
        public void ConfigureInput(ScriptableRenderPassInput input) { }
        public virtual void RecordRenderGraph(RenderGraphModule.RenderGraph graph, ContextContainer frame) { }
    }
    public abstract class ScriptableRenderer { public void EnqueuePass(ScriptableRenderPass pass) { } }
    public abstract class ScriptableRendererFeature : ScriptableObject {
        public abstract void Create();
        public abstract void AddRenderPasses(ScriptableRenderer renderer, ref RenderingData data);
        protected virtual void Dispose(bool isDisposing) { }
    }
}
namespace UnityEngine.Playables {
    public interface IPlayableBehaviour { }
    public interface IPlayableAsset { }
    public struct FrameData { public float weight; }
    public struct Playable { public double GetTime() => 0; }
    public struct PlayableGraph { }
    public class PlayableBehaviour : IPlayableBehaviour { public virtual void ProcessFrame(Playable playable, FrameData info, object bound) { } }
    public struct ScriptPlayable<T> where T : class, IPlayableBehaviour, new() {
        public static ScriptPlayable<T> Create(PlayableGraph graph) => new ScriptPlayable<T>();
        public T GetBehaviour() => null;
        public static implicit operator Playable(ScriptPlayable<T> playable) => new Playable();
    }
    public abstract class PlayableAsset : ScriptableObject, IPlayableAsset { public abstract Playable CreatePlayable(PlayableGraph graph, GameObject owner); }
    public enum DirectorWrapMode { Loop }
    public class PlayableDirector : Behaviour {
        public PlayableAsset playableAsset;
        public DirectorWrapMode extrapolationMode;
        public void SetGenericBinding(Object key, Object value) { }
    }
}
namespace UnityEngine.Timeline {
    [Flags] public enum ClipCaps { Looping = 1, ClipIn = 4, SpeedMultiplier = 8 }
    public interface ITimelineClipAsset { ClipCaps clipCaps { get; } }
    public class TimelineClip { public double duration; }
    public class TrackAsset : Playables.PlayableAsset {
        public override Playables.Playable CreatePlayable(Playables.PlayableGraph graph, GameObject owner) => new Playables.Playable();
        public TimelineClip CreateClip<T>() where T : ScriptableObject, Playables.IPlayableAsset => null;
    }
    public class TimelineAsset : Playables.PlayableAsset {
        public override Playables.Playable CreatePlayable(Playables.PlayableGraph graph, GameObject owner) => new Playables.Playable();
        public T CreateTrack<T>(TrackAsset parent, string name) where T : TrackAsset, new() => null;
    }
    public sealed class TrackColor : Attribute { public TrackColor(float r, float g, float b) { } }
    public sealed class TrackClipType : Attribute { public TrackClipType(Type type) { } }
    public sealed class TrackBindingType : Attribute { public TrackBindingType(Type type) { } }
}
namespace UnityEngine.SceneManagement {
    public struct Scene { }
    public static class SceneManager { public static Scene GetActiveScene() => new Scene(); }
}
namespace UnityEditor {
    public sealed class MenuItem : Attribute { public MenuItem(string path, bool isValidation = false) { } }
    public static class Selection { public static UnityEngine.Object activeObject; }
    public static class AssetDatabase {
        public static string AssetPathToGUID(string path) => path;
        public static string GUIDToAssetPath(string guid) => guid;
        public static string[] FindAssets(string filter) => null;
        public static T LoadAssetAtPath<T>(string path) where T : UnityEngine.Object => null;
        public static void CreateAsset(UnityEngine.Object asset, string path) { }
    }
}
namespace UnityEditor.Build {
    public class BuildPlayerContext { public void AddAdditionalPathToStreamingAssets(string path, string name) { } }
    public abstract class BuildPlayerProcessor { public abstract void PrepareForBuild(BuildPlayerContext context); }
}
namespace UnityEditor.AssetImporters {
    public sealed class ScriptedImporterAttribute : Attribute {
        public ScriptedImporterAttribute(int version, string extension) { }
        public ScriptedImporterAttribute(int version, string[] extensions, string[] others) { }
    }
    public class AssetImportContext {
        public string assetPath;
        public void AddObjectToAsset(string name, UnityEngine.Object each) { }
        public void SetMainObject(UnityEngine.Object each) { }
        public void LogImportError(string message) { }
        public void LogImportWarning(string message) { }
    }
    public abstract class ScriptedImporter : UnityEngine.Object { public abstract void OnImportAsset(AssetImportContext context); }
}
namespace UnityEditor.SceneManagement {
    public enum NewSceneSetup { EmptyScene }
    public enum NewSceneMode { Single }
    public static class EditorSceneManager {
        public static UnityEngine.SceneManagement.Scene NewScene(NewSceneSetup setup, NewSceneMode mode) => new UnityEngine.SceneManagement.Scene();
        public static bool SaveScene(UnityEngine.SceneManagement.Scene scene, string path) => true;
    }
}
