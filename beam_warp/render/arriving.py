"""Light that reaches Gaussians in deferred shading: shadow maps of lights and of an environment's regions, and bounces.

Small bright sources of the environment become lights (`beam_warp.light.compact_sources`), shaded pixel by pixel. What
is left is cut into regions (`beam_warp.light.regions`), each with a shadow map. A Gaussian gets the irradiance of that
in closed form times the share that the regions' shadows leave, and what surfaces around it send
(``kernels/render/cluster_bounces.py``). Both are blended into pixels like a material.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import warp as wp

from beam_warp.device.arrays import members, upload, zero_struct
from beam_warp.device.morton import morton_order
from beam_warp.kernels.light.lights import Lights
from beam_warp.kernels.render.cluster_bounces import (
    PARTS,
    Clusters,
    ClusterSums,
    launch_bounce_clusters,
    launch_gather_bounces,
    launch_sum_clusters,
)
from beam_warp.kernels.render.gaussian_light import RegionShadows, SceneLight, launch_light_gaussians
from beam_warp.kernels.render.shadow_maps import ShadowMaps
from beam_warp.kernels.render.surface_lighting import DistantLight, LightShadows
from beam_warp.kernels.trace.incident_light import LightMoments
from beam_warp.light.prepared import NO_LIGHT, PreparedEnvironments
from beam_warp.light.regions import EnvironmentRegions
from beam_warp.light.uploaded import upload_lights
from beam_warp.raster.records import GaussianArrays
from beam_warp.render.options import DeferredOptions
from beam_warp.render.shadow_maps import ShadowCasters, ShadowDrawer, ShadowView, distant_view, light_views
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.lights import DirectionalLight, Light

CLUSTER_COUNT = 1024
"""Clusters that light bounces between: a subject of 1.7 m has one every 5 cm."""

LIGHT_TAPS, REGION_TAPS = (16, 32), (8, 12)
"""Taps that search, and that filter: of a light's map, and of a region's, whose errors are averaged over regions."""


class ArrivingLight:
    """Lights and an environment on a device, their shadow maps, and the irradiance that reaches Gaussians.

    Attributes:
        generation: Grows whenever launches would be given other arrays: CUDA graphs must be recorded again.
    """

    def __init__(
        self, gaussian_count: int, options: DeferredOptions, environments: PreparedEnvironments, device: Any
    ) -> None:
        """Allocate for some number of Gaussians; there is no light yet."""
        self._count, self._options, self._environments, self._device = gaussian_count, options, environments, device
        cluster_count = min(CLUSTER_COUNT, gaussian_count)
        with wp.ScopedDevice(device):
            self._shares = wp.zeros((0, gaussian_count), dtype=float)
            self._arriving = wp.zeros(gaussian_count, dtype=wp.vec4)
            self._lit = wp.zeros(gaussian_count, dtype=wp.vec3)
            self._clusters = zero_struct(Clusters, cluster_count, device)
            self._clusters.order = wp.zeros(gaussian_count, dtype=int)
            self._cluster_sums = zero_struct(ClusterSums, PARTS * cluster_count, device)
            self._radiosity = [wp.zeros(cluster_count, dtype=wp.vec4) for _ in range(2)]
            self._distant = DistantLight()
            self._distant.turn = wp.zeros(1, dtype=wp.vec2)
            self._moments = LightMoments()
            self._no_radiosity = wp.zeros(0, dtype=wp.vec4)
        self._no_maps = ShadowMaps()
        self._regions = RegionShadows()
        self._lights = Lights()
        self._shadows = LightShadows()
        self.generation = 0
        self._region_drawer: ShadowDrawer | None = None
        self._light_drawer: ShadowDrawer | None = None
        self._shown: Any = None
        self._sources: tuple[DirectionalLight, ...] = ()
        self._lamps: tuple[Light, ...] | None = None
        self._map_counts: list[int] = []
        self._stale = {"regions": True, "lights": True}

    def order(self, positions: wp.array) -> None:
        """Put Gaussians that are near each other side by side; to be called once for every cloud."""
        if self._count and self._options.lights_gaussians:
            everybody = wp.full(self._count, 1, dtype=int, device=self._device)
            items, _ = morton_order(positions, positions, everybody)
            wp.copy(self._clusters.order, items, count=self._count)

    def set(
        self,
        environment: EnvironmentMap | None,
        degrees: float,
        lights: Iterable[Light],
        casters: ShadowCasters,
        *,
        moved: bool,
    ) -> None:
        """Take an environment, turned about z, and lights; ``moved`` says that something else casts shadows now."""
        self._set_environment(environment, degrees, casters, moved=moved)
        self._set_lights((*lights, *self._sources), casters, moved=moved)

    def _set_environment(
        self, environment: EnvironmentMap | None, degrees: float, casters: ShadowCasters, *, moved: bool
    ) -> None:
        """Take an environment, turned about z, and tell its small bright sources apart."""
        shown, sources, count = self._environments.of(environment), (), 0
        if self._options.environment_shadows and shown.environment is not NO_LIGHT:
            shown, sources = shown.split
            count = max(self._options.environment_shadows - len(sources), 1)
        self._sources = tuple(source.turned(degrees) for source in sources)
        if (shown, degrees) == self._shown and not moved:
            return
        if self._shown is None or shown is not self._shown[0]:
            self._distant.light = shown.blurred
            self.generation += 1
        regions = shown.regions(count).turned(degrees) if count else None
        angle = np.radians(degrees)
        self._distant.turn.assign(np.array([[np.cos(angle), np.sin(angle)]], np.float32))
        self._set_regions(regions, casters)
        self._shown = (shown, degrees)

    def _set_regions(self, regions: EnvironmentRegions | None, casters: ShadowCasters) -> None:
        """Bring regions to the device."""
        count = 0 if regions is None else len(regions)
        if self._moments.red is None or len(self._moments.red) != count:
            self._moments = zero_struct(LightMoments, count, self._device)
            self._shares = wp.zeros((count, self._count), dtype=float, device=self._device)
            self._region_drawer = None
        views = []
        if regions is not None:
            for name, moments in zip(("red", "green", "blue"), regions.moments, strict=True):
                getattr(self._moments, name).assign(moments.astype(np.float32))
            size = self._options.environment_map_size
            pairs = zip(regions.directions, regions.half_angles, strict=True)
            views = [distant_view(direction, float(half), casters, size) for direction, half in pairs]
        self._region_drawer = self._moved(self._region_drawer, views, casters, REGION_TAPS)
        self._regions.maps = self._no_maps if self._region_drawer is None else self._region_drawer.maps
        self._regions.moments = self._moments
        self._stale["regions"] = True

    def _set_lights(self, lights: tuple[Light, ...], casters: ShadowCasters, *, moved: bool) -> None:
        """Take lights, the environment's sources among them."""
        if lights == self._lamps and not moved:
            return
        views = [
            light_views(light, casters, self._options.light_map_size) if light.casts_shadows else [] for light in lights
        ]
        counts = [len(of_light) for of_light in views]
        uploaded = upload_lights(lights, self._device)
        if self._lamps is None or counts != self._map_counts:
            self._lights = uploaded
            starts = np.concatenate([[0], np.cumsum(counts)])[: max(len(lights), 1)]
            self._shadows.first_maps = upload(starts.astype(np.int32), int, self._device)
            self._shadows.map_counts = upload(np.array(counts or [0], np.int32), int, self._device)
            self._light_drawer = None
            self.generation += 1
        else:
            for name, rows in members(uploaded).items():
                if name != "count":
                    wp.copy(getattr(self._lights, name), rows)
        self._light_drawer = self._moved(
            self._light_drawer, [view for of_light in views for view in of_light], casters, LIGHT_TAPS
        )
        self._shadows.maps = self._no_maps if self._light_drawer is None else self._light_drawer.maps
        self._lamps, self._map_counts = lights, counts
        self._stale["lights"] = True

    def _moved(
        self, drawer: ShadowDrawer | None, views: list[ShadowView], casters: ShadowCasters, taps: tuple[int, int]
    ) -> ShadowDrawer | None:
        """Return a drawer of some views: the same as before if their number is the same."""
        if not views:
            return None
        if drawer is None:
            self.generation += 1
            return ShadowDrawer(self._count, views, casters=casters, taps=taps, device=self._device)
        if drawer.maps.thickness != np.float32(casters.thickness):
            self.generation += 1
        drawer.move(views, casters)
        return drawer

    def draw(self, gaussians: GaussianArrays, mesh: Any) -> None:
        """Draw the maps that are out of date, however much room they take, and light the Gaussians.

        Args:
            gaussians: The Gaussians; if their values have room for what arrives, it is written there.
            mesh: A `beam_warp.kernels.mesh.surface.MeshSurface`, or None.
        """
        stale = any(self._stale.values())
        if self._region_drawer is not None and self._stale["regions"]:
            self._region_drawer.draw(gaussians, mesh)
        if self._light_drawer is not None and self._stale["lights"]:
            self._light_drawer.draw(gaussians, mesh)
        self._stale = dict.fromkeys(self._stale, False)
        if stale:
            self._light(gaussians)

    def redraw(self, gaussians: GaussianArrays) -> None:
        """Draw all maps again and light the Gaussians, without waiting; see `Rasterizer.redraw`."""
        for drawer in (self._region_drawer, self._light_drawer):
            if drawer is not None:
                drawer.redraw()
        self._light(gaussians)

    @property
    def capacities(self) -> tuple[int, ...]:
        """Room for pairs of splats and tiles in the drawers: where it changes, graphs must be recorded again."""
        drawers = (self._region_drawer, self._light_drawer)
        return tuple(room for drawer in drawers if drawer is not None for room in drawer.pair_capacities)

    def scene_light(self) -> SceneLight:
        """Return the struct that kernels take. It is made anew each time: a struct copies the structs in it."""
        light = SceneLight()
        light.environment, light.regions = self._distant, self._regions
        light.lights, light.shadows = self._lights, self._shadows
        return light

    def _light(self, gaussians: GaussianArrays) -> None:
        """Find the irradiance that reaches the Gaussians."""
        if not self._options.lights_gaussians or not self._count:
            return
        arrays = (self._shares, self._arriving, self._lit)
        launch_light_gaussians(self._clusters.order, gaussians, self.scene_light(), *arrays, self._device)
        radiosity = self._bounced(gaussians) if self._options.bounces else self._no_radiosity
        launch_gather_bounces(
            len(gaussians.positions),
            gaussians.positions,
            self._arriving,
            self._clusters,
            radiosity,
            gaussians.values,
            self._device,
        )

    def _bounced(self, gaussians: GaussianArrays) -> wp.array:
        """Return the radiosity of the clusters after all bounces but the last."""
        clusters, sums = self._clusters, self._cluster_sums
        launch_sum_clusters(gaussians, self._lit, self._distant.light.albedo_terms, sums, clusters, self._device)
        radiosity = clusters.sent
        for bounce in range(self._options.bounces - 1):
            following = self._radiosity[bounce % 2]
            launch_bounce_clusters(clusters, radiosity, sums, following, self._device)
            radiosity = following
        return radiosity
