using System.Collections.Generic;
using UnityEditor;
using UnityEditor.SceneManagement;
using UnityEngine;
using UnityEngine.SceneManagement;
#if BEAM_TIMELINE
using UnityEngine.Playables;
using UnityEngine.Timeline;
#endif

namespace Beam.Relightable.Samples {
    /// <summary>Makes a scene of the take that is selected: a ground, a sun, a lamp, and a Timeline.</summary>
    public static class StageScene {
        [MenuItem("Assets/Create/Relightable Stage of Take", true)]
        private static bool IsTake() => Selection.activeObject is TakeAsset;

        [MenuItem("Assets/Create/Relightable Stage of Take")]
        private static void Create() {
            var asset = (TakeAsset)Selection.activeObject;
            EditorSceneManager.NewScene(NewSceneSetup.EmptyScene, NewSceneMode.Single);
            Bounds box = asset.bounds;
            float size = box.extents.magnitude;
            var take = new GameObject(asset.name).AddComponent<RelightableTake>();
            take.asset = asset;
            GameObject ground = GameObject.CreatePrimitive(PrimitiveType.Plane);
            ground.name = "Ground";
            ground.transform.position = new Vector3(box.center.x, box.min.y, box.center.z);
            ground.transform.localScale = Vector3.one * size;
            Light sun = Lamp("Sun", LightType.Directional, box.center + 2f * size * Vector3.up, 1f);
            sun.transform.rotation = Quaternion.Euler(50f, -30f, 0f);
            Light lamp = Lamp("Lamp", LightType.Point, box.center + new Vector3(size, 0.5f * size, -size), 3f * size * size);
            var stage = new GameObject("Stage").AddComponent<RelightableStage>();
            stage.lamps = new List<RelightableStage.Lamp> {
                new RelightableStage.Lamp { light = sun, size = 0.53f }, new RelightableStage.Lamp { light = lamp, size = 0.05f * size },
            };
            Camera eye = new GameObject("Camera").AddComponent<Camera>();
            eye.tag = "MainCamera";
            eye.transform.position = box.center + 2.5f * size * Vector3.back;
            eye.nearClipPlane = 0.05f;
            Direct(take, asset);
            EditorSceneManager.SaveScene(SceneManager.GetActiveScene(), "Assets/" + asset.name + " stage.unity");
        }

        private static Light Lamp(string name, LightType type, Vector3 position, float intensity) {
            Light light = new GameObject(name).AddComponent<Light>();
            light.type = type;
            light.intensity = intensity;
            light.shadows = LightShadows.Soft;
            light.transform.position = position;
            return light;
        }

#if BEAM_TIMELINE
        private static void Direct(RelightableTake take, TakeAsset asset) {
            TimelineAsset timeline = ScriptableObject.CreateInstance<TimelineAsset>();
            AssetDatabase.CreateAsset(timeline, "Assets/" + asset.name + " stage.playable");
            RelightableTrack track = timeline.CreateTrack<RelightableTrack>(null, "Take");
            TimelineClip clip = track.CreateClip<RelightableClip>();
            clip.duration = asset.Duration;
            PlayableDirector director = take.gameObject.AddComponent<PlayableDirector>();
            director.playableAsset = timeline;
            director.extrapolationMode = DirectorWrapMode.Loop;
            director.SetGenericBinding(track, take);
        }
#else
        private static void Direct(RelightableTake take, TakeAsset asset) {
        }
#endif
    }
}
