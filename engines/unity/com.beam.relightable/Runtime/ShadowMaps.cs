using System;
using System.Collections.Generic;
using UnityEngine;
using UnityEngine.Experimental.Rendering;
using UnityEngine.Rendering;

namespace Beam.Relightable {
    /// <summary>Lamps of a stage as shaders read them, and shadow maps of takes and chosen meshes: theirs, or an environment's.</summary>
    /// <remarks>Where maps look from is that of beam_warp/render/shadow_maps.py.</remarks>
    public sealed class ShadowMaps : IDisposable {
        private const float Far = 500f, Room = 1.06f, Near = 0.02f, Widest = 60f, FaceAngle = 48f, LargestKernel = 0.25f, Thickest = 0.02f, LowPass = 0.1f;
        private const int MostMaps = 64, MapRows = 6, LampRows = 4;
        private readonly List<Vector4> lamps = new List<Vector4>(), rows = new List<Vector4>();
        private readonly List<Pinhole> views = new List<Pinhole>();
        private readonly GraphicsBuffer lampBuffer = new GraphicsBuffer(GraphicsBuffer.Target.Structured, LampRows * MostMaps, 16);
        private readonly GraphicsBuffer viewBuffer = new GraphicsBuffer(GraphicsBuffer.Target.Structured, MapRows * MostMaps, 16);
        private RenderTexture sums, nearest, meshes;

        /// <summary>Number of lamps.</summary>
        public int Lamps => lamps.Count / LampRows;

        /// <summary>Draw the maps of all lamps; what casts is in a sphere (centre, radius), its layers that thick [m].</summary>
        public void Draw(CommandBuffer commands, RelightableStage stage, Vector4 sphere, float thickness, Material material) {
            Clear();
            foreach (RelightableStage.Lamp each in stage.Lit)
                if (Lamps < MostMaps) Add(each, sphere, Mathf.Min(thickness, Thickest * sphere.w), stage);
            if (lamps.Count > 0) lampBuffer.SetData(lamps);
            DrawViews(commands, stage, stage.shadowMapSize, material);
        }

        /// <summary>Draw the maps of an environment's regions.</summary>
        public void DrawRegions(CommandBuffer commands, RelightableStage stage, EnvironmentRegions regions, Vector4 sphere, float thickness, int side, Material material) {
            Clear();
            for (int k = 0; k < regions.Directions.Count; k++)
                AddDistant(-regions.Directions[k], regions.HalfAngles[k], sphere, Mathf.Min(thickness, Thickest * sphere.w), side);
            DrawViews(commands, stage, side, material);
        }

        private void Clear() {
            lamps.Clear();
            rows.Clear();
            views.Clear();
        }

        private void DrawViews(CommandBuffer commands, RelightableStage stage, int side, Material material) {
            if (rows.Count > 0) viewBuffer.SetData(rows);
            Allocate(side, Mathf.Max(views.Count, 1));
            RenderTargetIdentifier[] targets = { sums, nearest };
            for (int map = 0; map < views.Count; map++) {
                commands.SetRenderTarget(targets, BuiltinRenderTextureType.None, 0, CubemapFace.Unknown, map);
                commands.ClearRenderTarget(false, true, Color.clear);
                foreach (RelightableTake take in RelightPass.FarthestFirst(views[map])) {
                    take.Buffers.Sort(commands, take.ToWorld, views[map].position, views[map].forward);
                    Pinhole.Set(commands, views[map], views[map], Near, LowPass, true);
                    RelightPass.DrawSplats(commands, take, material, RelightPass.ShadowPass);
                }
                commands.SetRenderTarget(meshes, BuiltinRenderTextureType.None, 0, CubemapFace.Unknown, map);
                commands.ClearRenderTarget(false, true, new Color(3e38f, 0f, 0f, 0f));
                Pinhole.Set(commands, views[map], views[map], Near, LowPass, true);
                foreach (Renderer caster in stage.casters)
                    for (int part = 0; caster != null && caster.enabled && part < caster.sharedMaterials.Length; part++)
                        commands.DrawRenderer(caster, material, part, RelightPass.MeshPass);
            }
        }

        /// <summary>Let the deferred pass read lamps and maps.</summary>
        public void Bind(CommandBuffer commands) {
            commands.SetGlobalBuffer("_BeamLamps", lampBuffer);
            commands.SetGlobalBuffer("_BeamShadowViews", viewBuffer);
            commands.SetGlobalTexture("_BeamShadowSums", sums);
            commands.SetGlobalTexture("_BeamShadowFirst", nearest);
            commands.SetGlobalTexture("_BeamShadowMeshes", meshes);
        }

        /// <summary>Let a compute shader read maps.</summary>
        public void Bind(CommandBuffer commands, ComputeShader shader) {
            commands.SetComputeBufferParam(shader, 0, "_BeamShadowViews", viewBuffer);
            commands.SetComputeTextureParam(shader, 0, "_BeamShadowSums", sums);
            commands.SetComputeTextureParam(shader, 0, "_BeamShadowFirst", nearest);
            commands.SetComputeTextureParam(shader, 0, "_BeamShadowMeshes", meshes);
        }

        /// <summary>Release all memory.</summary>
        public void Dispose() {
            lampBuffer.Release();
            viewBuffer.Release();
            foreach (RenderTexture each in new[] { sums, nearest, meshes }) if (each != null) each.Release();
        }

        private void Add(RelightableStage.Lamp lamp, Vector4 sphere, float thickness, RelightableStage stage) {
            Light light = lamp.light;
            bool isDistant = light.type == LightType.Directional, isSpot = light.type == LightType.Spot;
            Vector3 place = Axes.Swapped(light.transform.position), way = Axes.Swapped(light.transform.forward);
            Color color = light.color.linear * light.intensity * stage.lampFactor;
            if (light.useColorTemperature) color *= Mathf.CorrelatedColorTemperatureToRGB(light.colorTemperature);
            float size = isDistant ? Mathf.Sin(0.5f * Mathf.Deg2Rad * lamp.size) : lamp.size;
            int first = views.Count;
            if (light.shadows != LightShadows.None && first + 6 <= MostMaps) {
                if (isDistant) AddDistant(way, 0.5f * Mathf.Deg2Rad * lamp.size, sphere, thickness, stage.shadowMapSize);
                else AddLamp(place, lamp.size, way, isSpot ? 0.5f * Mathf.Deg2Rad * light.spotAngle : Mathf.PI, sphere, thickness, stage.shadowMapSize);
            }
            float outer = Mathf.Cos(0.5f * Mathf.Deg2Rad * light.spotAngle);
            float inner = Mathf.Max(Mathf.Cos(0.5f * Mathf.Deg2Rad * light.innerSpotAngle), outer + 1e-4f);
            lamps.Add(new Vector4(place.x, place.y, place.z, isDistant ? 0f : isSpot ? 2f : 1f));
            lamps.Add(new Vector4(way.x, way.y, way.z, size));
            lamps.Add(new Vector4(color.r, color.g, color.b, first));
            lamps.Add(new Vector4(inner, outer, views.Count - first, 0f));
        }

        private void AddDistant(Vector3 way, float halfAngle, Vector4 sphere, float thickness, int side) {
            float distance = Far * sphere.w;
            Pinhole view = Pinhole.Looking((Vector3)sphere - distance * way, way, Mathf.Asin(Room / Far), side);
            AddView(view, distance * Mathf.Tan(halfAngle), distance - Room * sphere.w, thickness);
        }

        private void AddLamp(Vector3 place, float radius, Vector3 way, float cone, Vector4 sphere, float thickness, int side) {
            Vector3 axis = (Vector3)sphere - place;
            float distance = axis.magnitude, extent = Room * sphere.w;
            float half = distance > extent ? Mathf.Asin(extent / distance) : Mathf.PI;
            if (cone < half) {
                axis = way;
                half = cone;
            }
            if (half <= Widest * Mathf.Deg2Rad) {
                AddView(Pinhole.Looking(place, axis, half, side), radius, Mathf.Max(distance - extent, Near), thickness);
                return;
            }
            foreach (Vector3 face in new[] { Vector3.right, Vector3.left, Vector3.up, Vector3.down, Vector3.forward, Vector3.back })
                AddView(Pinhole.Looking(place, face, FaceAngle * Mathf.Deg2Rad, side), radius, Near, thickness);
        }

        private void AddView(Pinhole view, float radius, float front, float thickness) {
            views.Add(view);
            rows.Add(new Vector4(view.position.x, view.position.y, view.position.z, radius));
            rows.Add(new Vector4(view.right.x, view.right.y, view.right.z, front));
            rows.Add(new Vector4(view.down.x, view.down.y, view.down.z, thickness));
            rows.Add(new Vector4(view.forward.x, view.forward.y, view.forward.z, LargestKernel * view.size.x));
            rows.Add(new Vector4(view.focal.x, view.focal.y, view.center.x, view.center.y));
            rows.Add(view.size);
        }

        private void Allocate(int side, int maps) {
            if (sums != null && sums.width == side && sums.volumeDepth == maps) return;
            foreach (RenderTexture each in new[] { sums, nearest, meshes }) if (each != null) each.Release();
            sums = RelightPass.Layers(side, side, maps, GraphicsFormat.R32G32B32A32_SFloat);
            nearest = RelightPass.Layers(side, side, maps, GraphicsFormat.R32_SFloat);
            meshes = RelightPass.Layers(side, side, maps, GraphicsFormat.R32_SFloat);
        }
    }
}
