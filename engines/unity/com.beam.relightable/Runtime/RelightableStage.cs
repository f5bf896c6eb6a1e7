using System;
using System.Collections.Generic;
using UnityEngine;
using UnityEngine.Rendering;

namespace Beam.Relightable {
    /// <summary>The light of all takes in a scene: environment, lamps, and meshes that cast shadows on takes.</summary>
    [ExecuteAlways]
    [AddComponentMenu("Rendering/Relightable Stage")]
    public sealed class RelightableStage : MonoBehaviour {
        /// <summary>A lamp, and how large it is: radius [m], or angular diameter of a directional light [degree].</summary>
        [Serializable]
        public sealed class Lamp {
            public Light light;
            public float size = 0.05f;
        }

        /// <summary>The stage that takes are lit by.</summary>
        public static RelightableStage Current { get; private set; }

        /// <summary>An environment that engines/unity/prefilter.py wrote; outranks cubes.</summary>
        public TextAsset prefiltered;

        /// <summary>A cube whose mip levels are blurred (import it with specular convolution); none: the scene's default reflection.</summary>
        public Texture cube;

        /// <summary>Angle by which the environment is turned about the vertical [degree].</summary>
        public float rotation;

        /// <summary>Regions of the environment that cast shadows, at most 32; 0: ambient occlusion stands for them.</summary>
        public int environmentShadows;

        /// <summary>Exposure of takes [stops].</summary>
        public float exposure;

        /// <summary>Lamps; none: all lights that are there when the stage is enabled.</summary>
        public List<Lamp> lamps = new List<Lamp>();

        /// <summary>Meshes that cast shadows on takes.</summary>
        public List<Renderer> casters = new List<Renderer>();

        /// <summary>Side of a shadow map [texel].</summary>
        public int shadowMapSize = 1024;

        /// <summary>Irradiance [W/m²] that a light of intensity 1 sheds: π in URP, 1 in HDRP. Set by the pass.</summary>
        [NonSerialized] public float lampFactor = 1f;
        private readonly List<Lamp> found = new List<Lamp>();
        private EnvironmentBuffers environment;
        private GraphicsBuffer albedo;
        private ShadowMaps maps;
        private EnvironmentShadows shadows;
        private Material material;
        private CommandBuffer commands;

        /// <summary>Lamps that are on.</summary>
        public IEnumerable<Lamp> Lit {
            get {
                foreach (Lamp lamp in lamps.Count > 0 ? lamps : found)
                    if (lamp.light != null && lamp.light.isActiveAndEnabled && (int)lamp.light.type <= (int)LightType.Point) yield return lamp;
            }
        }

        /// <summary>Read the environment and the scene's lights again.</summary>
        public void Refresh() {
            if (environment != null) environment.Dispose();
            environment = null;
            found.Clear();
            foreach (Light light in FindObjectsByType<Light>(FindObjectsSortMode.None))
                found.Add(new Lamp { light = light, size = light.type == LightType.Directional ? 0.53f : 0.05f });
        }

        /// <summary>Let the deferred pass read all light; false while there is none.</summary>
        public bool Bind(CommandBuffer into) {
            if (maps == null || environment == null) return false;
            float angle = rotation * Mathf.Deg2Rad;
            into.SetGlobalBuffer("_BeamEnvironment", environment.Texels);
            into.SetGlobalVectorArray("_BeamLevels", environment.Levels);
            into.SetGlobalBuffer("_BeamAlbedo", albedo);
            var turn = new Vector4(Mathf.Cos(angle), Mathf.Sin(angle), maps.Lamps, Mathf.Pow(2f, exposure));
            into.SetGlobalVector("_BeamTurn", turn);
            maps.Bind(into);
            return true;
        }

        private void OnEnable() {
            Current = this;
            material = new Material(Resources.Load<Shader>("Beam/Relight"));
            albedo = new GraphicsBuffer(GraphicsBuffer.Target.Structured, 64 * 64, 16);
            albedo.SetData(Resources.Load<TextAsset>("Beam/Albedo").bytes);
            maps = new ShadowMaps();
            shadows = new EnvironmentShadows();
            commands = new CommandBuffer { name = "Relightable shadow maps" };
            Refresh();
            RenderPipelineManager.beginContextRendering += Prepare;
        }

        private void OnDisable() {
            RenderPipelineManager.beginContextRendering -= Prepare;
            if (Current == this) Current = null;
            maps.Dispose();
            shadows.Dispose();
            albedo.Release();
            commands.Release();
            if (environment != null) environment.Dispose();
            maps = null;
            environment = null;
        }

        private void Prepare(ScriptableRenderContext context, List<Camera> cameras) {
            if (environment == null) environment = Environment();
            if (RelightableTake.Active.Count == 0) return;
            commands.Clear();
            Vector4 sphere = Around();
            float thickness = 0f;
            foreach (RelightableTake take in RelightableTake.Active)
                if (take.IsReady) thickness = Mathf.Max(thickness, take.asset.thickness * take.transform.lossyScale.x);
            maps.Draw(commands, this, sphere, thickness, material);
            if (environmentShadows > 0) shadows.Draw(commands, this, environment, sphere, thickness, material);
            context.ExecuteCommandBuffer(commands);
        }

        private EnvironmentBuffers Environment() {
            if (prefiltered != null) {
                try {
                    return EnvironmentBuffers.OfFile(prefiltered.bytes, prefiltered.name);
                } catch (DeliveryException error) {
                    Debug.LogError("Relightable stage " + name + ": " + error.Message, this);
                }
            }
            Texture light = cube != null ? cube : ReflectionProbe.defaultTexture;
            return EnvironmentBuffers.OfCube(light != null ? light : CoreUtils.blackCubeTexture, RenderSettings.reflectionIntensity);
        }

        private static Vector4 Around() {
            Vector4 sphere = new Vector4(0f, 0f, 0f, -1f);
            foreach (RelightableTake take in RelightableTake.Active) {
                if (!take.IsReady) continue;
                Vector4 other = take.Sphere;
                Vector3 between = (Vector3)other - (Vector3)sphere;
                float distance = between.magnitude;
                if (sphere.w < 0f || distance + sphere.w <= other.w) sphere = other;
                else if (distance + other.w > sphere.w) {
                    float radius = 0.5f * (distance + sphere.w + other.w);
                    Vector3 center = (Vector3)sphere + between * ((radius - sphere.w) / distance);
                    sphere = new Vector4(center.x, center.y, center.z, radius);
                }
            }
            return sphere.w < 0f ? new Vector4(0f, 0f, 0f, 1f) : sphere;
        }
    }
}
