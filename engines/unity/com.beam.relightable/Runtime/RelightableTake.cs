using System;
using System.Collections.Generic;
using UnityEngine;
using UnityEngine.Rendering;

namespace Beam.Relightable {
    /// <summary>Plays a take. It is lit and drawn by the HDRP custom pass or the URP renderer feature of this package.</summary>
    [ExecuteAlways]
    [AddComponentMenu("Rendering/Relightable Take")]
    public sealed class RelightableTake : MonoBehaviour {
        /// <summary>All takes that can be drawn.</summary>
        public static readonly List<RelightableTake> Active = new List<RelightableTake>();

        /// <summary>What is played.</summary>
        public TakeAsset asset;

        /// <summary>Moment that is shown [s].</summary>
        public float time;

        /// <summary>Seconds of the take a second.</summary>
        public float rate = 1f;
        public bool isPlaying = true, loop = true;

        /// <summary>Show moments between two frames, where rows stay with their Gaussians.</summary>
        public bool interpolate = true;

        /// <summary>Cast shadows on the scene's meshes by Unity's shadow maps.</summary>
        public bool castShadows = true;
        private readonly Terms terms = new Terms();
        private Container container;
        private SegmentStream stream;
        private Material caster;
        private MaterialPropertyBlock properties;
        private string said;
        private float shown = -1f;
        private TakeAsset opened;

        /// <summary>Gaussians of the moment; null until there are any.</summary>
        public TakeBuffers Buffers { get; private set; }

        /// <summary>Whether there is something to draw.</summary>
        public bool IsReady => Buffers != null && Buffers.Count > 0 && shown >= 0f;

        /// <summary>From the take's axes (x right, y up, z back) to the renderer's world (x right, y forward, z up).</summary>
        public Matrix4x4 ToWorld => Axes.Swap * transform.localToWorldMatrix * Matrix4x4.Scale(new Vector3(1f, 1f, -1f));

        /// <summary>Sphere around the take: centre in the renderer's world, and radius [m].</summary>
        public Vector4 Sphere {
            get {
                Vector3 center = Axes.Swapped(transform.TransformPoint(asset.bounds.center));
                float radius = asset.bounds.extents.magnitude * transform.lossyScale.x;
                return new Vector4(center.x, center.y, center.z, Mathf.Max(radius, 1e-3f));
            }
        }

        private void OnEnable() {
            Active.Add(this);
        }

        private void OnDisable() {
            Active.Remove(this);
            Close();
        }

        private void LateUpdate() {
            if (asset != opened) Open();
            if (opened == null || Buffers == null) return;
            if (isPlaying && Application.isPlaying) time += rate * Time.deltaTime;
            float moment = MomentAt(time);
            if (moment != shown && container != null && container.Count > 0) Show(moment);
            if (castShadows && IsReady) Cast();
        }

        /// <summary>Frame, and share of the way to the next one, at a time [s].</summary>
        public float MomentAt(float seconds) {
            float last = asset.frames - 1, frame = seconds * asset.rate;
            if (loop) frame = Mathf.Repeat(frame, asset.frames);
            frame = Mathf.Clamp(frame, 0f, last);
            return interpolate && asset.isConstant ? frame : Mathf.Floor(frame);
        }

        private void Open() {
            Close();
            opened = asset;
            if (asset == null) return;
            try {
                if (asset.rows.Length == 0) {
                    container = new Container(asset.FilePath);
                    stream = new SegmentStream(container);
                }
                Buffers = new TakeBuffers(container == null ? asset.count : container.Count);
                if (container != null) return;
                Buffers.Set(asset.rows);
                shown = 0f;
            } catch (Exception error) when (error is DeliveryException || error is System.IO.IOException) {
                Say(error.Message);
            }
        }

        private void Close() {
            if (stream != null) stream.Dispose();
            if (Buffers != null) Buffers.Dispose();
            container = null;
            stream = null;
            Buffers = null;
            opened = null;
            shown = -1f;
        }

        private void Show(float moment) {
            int frame = (int)moment, index = container.Segments.FindIndex(each => frame < each.First + each.Frames);
            BlockEntry entry = container.Segments[index];
            int following = index + 1 < container.Segments.Count ? index + 1 : loop ? 0 : -1;
            stream.Want(index, following == index ? -1 : following);
            Say(stream.Error);
            Block now = stream.Get(index);
            if (now == null) return; // the last frame is held
            bool isLast = frame == entry.First + entry.Frames - 1;
            Block after = isLast && index + 1 < container.Segments.Count ? stream.Get(index + 1) : null;
            float share = isLast && after == null ? 0f : moment - frame;
            terms.Set(container, now, frame - entry.First, after, share);
            Buffers.Evaluate(container, now, after, terms);
            shown = isLast && after == null && moment > frame ? frame : moment;
        }

        private void Cast() {
            if (caster == null) caster = new Material(Resources.Load<Shader>("Beam/Caster"));
            if (properties == null) properties = new MaterialPropertyBlock();
            properties.SetBuffer("_BeamGaussians", Buffers.Gaussians);
            properties.SetMatrix("_BeamObject", ToWorld);
            var draw = new RenderParams(caster) {
                matProps = properties,
                shadowCastingMode = ShadowCastingMode.ShadowsOnly,
                worldBounds = new Bounds(transform.TransformPoint(asset.bounds.center), 4f * asset.bounds.size * transform.lossyScale.x),
                layer = gameObject.layer,
            };
            Graphics.RenderPrimitives(draw, MeshTopology.Triangles, 6 * Buffers.Count);
        }

        private void Say(string error) {
            if (error == null || error == said) return;
            said = error;
            Debug.LogError("Relightable take " + name + ": " + error, this);
        }
    }

    /// <summary>Unity's world (y up, left-handed) and the renderer's (z up, right-handed): y and z change places.</summary>
    public static class Axes {
        public static readonly Matrix4x4 Swap = new Matrix4x4(
            new Vector4(1f, 0f, 0f, 0f), new Vector4(0f, 0f, 1f, 0f), new Vector4(0f, 1f, 0f, 0f), new Vector4(0f, 0f, 0f, 1f));

        /// <summary>Return a vector with y and z exchanged.</summary>
        public static Vector3 Swapped(Vector3 v) => new Vector3(v.x, v.z, v.y);
    }
}
