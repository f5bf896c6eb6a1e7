"""Probes for engines: assets, lights and cameras, and what beam_warp's deferred renderer makes of them on the CPU.

`goldens` returns cases; each has everything that an engine needs to draw the same picture, and the picture. Nothing is
kept in files: a case takes about a second. Bounces are off, and so are environment shadows unless `REGIONS` are asked
for: ambient occlusion and specular occlusion stand for them.

    for golden in goldens(["tripod"], ["studio", "spot"]):
        golden.shot                           # cloud, camera, environment and its rotation, lights
        golden.image.rgb, golden.image.alpha  # truth: scene-linear, multiplied by alpha
        golden.buffer                         # what was blended, before light: for engines that only shade
        prefiltered(golden.shot.environment)  # irradiance, then 13 levels, (rows, 2 rows, 3) each
        shadow_maps(golden)                   # views and texels of all lamps, one after the other
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from support.figure_asset import figure_asset
from support.shapes import cloud_of, sphere_points, tiles
from web import probe

from beam_warp.demo.lights import demo_environments
from beam_warp.image.color import srgb_to_linear
from beam_warp.light.prefiltered import blurred_environment
from beam_warp.light.regions import EnvironmentRegions
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import DeferredOptions
from beam_warp.render.prepared_shot import DeferredFrame
from beam_warp.render.shadow_maps import ShadowCasters, ShadowDrawer, ShadowView, distant_view, light_views
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import DirectionalLight, Light, PointLight, SpotLight
from beam_warp.world.shot import RenderedImage, Shot

FloatArray = NDArray[np.float32]

SIDE = 128
"""Width and height of every picture [pixel]."""

MAP_SIZE = 256
"""Side of a lamp's shadow maps [texel]."""

ROTATION = 40.0
"""Rotation of environments about z [degree]."""

OPTIONS = DeferredOptions(environment_shadows=0, bounces=0, light_map_size=MAP_SIZE)
REGIONS = replace(OPTIONS, environment_shadows=16, environment_map_size=MAP_SIZE)
"""The same with shadows of the environment: a map of each of its regions."""

TAPS = (16, 32)


def tripod() -> GaussianCloud:
    """Return the tripod of `web.probe` with materials: what is up, and which hand the axes follow."""
    cloud = probe.tripod()
    count = len(cloud)
    colors = np.full((count, 3), 0.6)
    colors[:4] = srgb_to_linear(np.array([color for _, color in probe.BALLS.values()]))
    normals = np.where(np.arange(count)[:, None] < 5, (0.3, -0.8, 0.5), (0.1, -0.5, 0.9))
    return GaussianCloud(
        positions=cloud.positions,
        orientations=cloud.orientations,
        scales=cloud.scales,
        opacities=cloud.opacities,
        **_materials(colors, np.linspace(0.1, 0.9, count), np.full(count, 0.9), normals),
    )


def spheres() -> GaussianCloud:
    """Return six balls in a row, of roughness 0 to 1."""
    directions, spacing = sphere_points(500)
    parts = []
    for k, roughness in enumerate(np.linspace(0.0, 1.0, 6)):
        center = np.array([0.4 * (k % 3) - 0.4, 0.0, 0.4 * (k // 3) - 0.2])
        color = np.tile([0.8 - 0.1 * k, 0.4, 0.2 + 0.1 * k], (len(directions), 1))
        part = tiles(center + 0.17 * directions, directions, 0.17 * spacing)
        ones = np.ones(len(directions))
        parts.append(part | _materials(color, roughness * ones, ones, directions))
    return cloud_of(*parts)


def corner() -> GaussianCloud:
    """Return a floor and two walls that meet, ambient occlusion falling towards the edges, and a ball on the floor."""
    u, v = (axis.ravel() for axis in np.meshgrid((np.arange(28) + 0.5) / 28, (np.arange(28) + 0.5) / 28))
    zero = np.zeros_like(u)
    walls = [((u, v, zero), (0, 0, 1)), ((u, zero, v), (0, 1, 0)), ((zero, u, v), (1, 0, 0))]
    parts = []
    for axis, (places, normal) in enumerate(walls):
        open_share = (0.5 + 0.5 * u / (u + 0.1)) * (0.5 + 0.5 * v / (v + 0.1))
        normals = np.tile(np.array(normal, float), (len(u), 1))
        color = np.tile(np.roll([0.7, 0.5, 0.4], axis), (len(u), 1))
        part = tiles(np.stack(places, axis=1), normals, 1 / 28)
        parts.append(part | _materials(color, 0.25 + 0.5 * u, open_share, normals))
    directions, spacing = sphere_points(600)
    ball = tiles((0.45, 0.5, 0.2) + 0.2 * directions, directions, 0.2 * spacing)
    count = len(directions)
    open_share = 0.75 + 0.25 * directions[:, 2]
    parts.append(ball | _materials(np.full((count, 3), 0.5), np.full(count, 0.4), open_share, directions))
    return cloud_of(*parts)


def figure() -> GaussianCloud:
    """Return the demo figure of 6,000 Gaussians."""
    return next(iter(figure_asset(48, 1)))


def _materials(
    color: NDArray[np.float64],
    roughness: NDArray[np.float64],
    occlusion: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> dict[str, NDArray[np.float64]]:
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return {"base_color": color, "roughness": roughness, "ambient_occlusion": occlusion, "normals": normals / length}


PROBES = {"tripod": tripod, "spheres": spheres, "corner": corner, "figure": figure}
EYES = {"tripod": probe.EYE, "spheres": (0.5, -2.0, 0.6), "corner": (2.0, 1.8, 1.4), "figure": (1.3, -2.6, 1.5)}
FIELDS = {"tripod": 36.0, "spheres": 34.0, "corner": 45.0, "figure": 38.0}
TARGETS = {"tripod": probe.TARGET, "spheres": (0, 0, 0), "corner": (0.35, 0.35, 0.35), "figure": None}
ENVIRONMENTS = ("studio", "sunset", "stage")
LAMPS = ("point", "spot", "sun")
LIGHTINGS = (*ENVIRONMENTS, *LAMPS)
"""Environments without lamps, and lamps with shadows under a dim even sky."""


@cache
def environment(name: str) -> EnvironmentMap:
    """Return the environment of a lighting."""
    return demo_environments()[name] if name in ENVIRONMENTS else EnvironmentMap.constant((0.05, 0.06, 0.08), height=16)


def lamp(name: str, at: NDArray[np.float64], size: float) -> Light:
    """Return a lamp that shines on a subject of this place and radius."""
    place = at + size * np.array([1.2, -1.6, 1.9])
    direction, power = tuple((at - place).tolist()), 8.0 * size * size
    if name == "point":  # near: it has six maps
        near = at + size * np.array([0.5, -0.55, 0.95])
        return PointLight(
            position=tuple(near.tolist()), intensity=(0.3 * power, 0.25 * power, 0.2 * power), radius=0.05
        )
    if name == "spot":
        return SpotLight(
            position=tuple(place.tolist()),
            direction=direction,
            intensity=(power, 1.2 * power, 1.4 * power),
            inner_angle=10.0,
            outer_angle=25.0,
        )
    return DirectionalLight(direction=direction, irradiance=(2.0, 1.8, 1.5), angular_diameter=4.0)


@dataclass(frozen=True, eq=False)
class Buffer:
    """What ordered blending leaves of every pixel, row by row.

    Attributes:
        sums: Base colour, roughness, ambient occlusion and normal, weighted by visibility, ``(P, 8)``; with regions
            also what arrives and its share, ``(P, 12)``.
        alpha: Sum of weights, ``(P,)``.
        depth: Depth of the surface [m], ``(P,)``: the lesser of mean and median.
    """

    sums: FloatArray
    alpha: FloatArray
    depth: FloatArray


@dataclass(frozen=True, eq=False)
class Golden:
    """A case.

    Attributes:
        probe: A name of `PROBES`.
        lighting: A name of `LIGHTINGS`.
        shot: Asset, camera and light.
        frame: The shot on the device.
        image: The truth.
        regions: Regions of the environment that cast shadows, turned as it is, or None.
    """

    probe: str
    lighting: str
    shot: Shot
    frame: DeferredFrame
    image: RenderedImage
    regions: EnvironmentRegions | None = None

    @cached_property
    def buffer(self) -> Buffer:
        """What was blended."""
        count = self.frame.gaussians.values.shape[1]
        rasterizer = Rasterizer(
            len(self.shot.cloud), [self.shot.camera], value_count=count, options=RasterOptions(), device="cpu"
        )
        images = rasterizer.draw(self.frame.gaussians)
        depth = np.minimum(images.depth.numpy(), images.median_depth.numpy())
        sums = np.concatenate([channels.numpy() for channels in images.channels], axis=1)[:, :count]
        return Buffer(sums, images.alpha.numpy().copy(), depth)


def goldens(
    probes: Sequence[str] = tuple(PROBES), lightings: Sequence[str] = LIGHTINGS, options: DeferredOptions = OPTIONS
) -> Iterator[Golden]:
    """Yield the cases of some probes under some lightings."""
    for name in probes:
        cloud = PROBES[name]()
        points = cloud.positions.astype(np.float64)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        target = middle if TARGETS[name] is None else TARGETS[name]
        camera = Camera.look_at(EYES[name], target, width=SIDE, height=SIDE, vertical_fov=FIELDS[name])
        size = float(np.linalg.norm(points - middle, axis=1).max())
        for lighting in lightings:
            shot = Shot(
                cloud=cloud,
                camera=camera,
                environment=environment(lighting),
                environment_rotation=ROTATION,
                lights=(lamp(lighting, middle, size),) if lighting in LAMPS else (),
            )
            frame = DeferredRenderer(options, device="cpu").frame(shot)
            count = options.environment_shadows
            regions = EnvironmentRegions.of(shot.environment, count).turned(ROTATION) if count else None
            yield Golden(name, lighting, shot, frame, frame.image(), regions)


@cache
def prefiltered(light: EnvironmentMap) -> list[FloatArray]:
    """Return irradiance, and the blurred levels from the mirror's on, ``(rows, 2 rows, 3)`` each."""
    blurred = blurred_environment(light, "cpu")
    texels, heights, starts = blurred.texels.numpy(), blurred.heights.numpy(), blurred.offsets.numpy()
    levels = [
        texels[start : start + 2 * rows * rows].reshape(rows, 2 * rows, 3)
        for rows, start in zip(heights, starts, strict=True)
    ]
    return [blurred.irradiance.numpy(), *levels]


@dataclass(frozen=True, eq=False)
class Maps:
    """Shadow maps of lamps.

    Attributes:
        views: Their cameras, and the radius of the lamp's disc, and where shadows begin.
        texels: Alpha, median depth and mean depth of Gaussians, and depth of meshes, ``(M, MAP_SIZE, MAP_SIZE, 4)``.
        thickness: Depth within which Gaussians are one layer [m].
        largest_kernel: Largest radius of a filter [texel].
        counts: Maps of each lamp.
    """

    views: Sequence[ShadowView]
    texels: FloatArray
    thickness: float
    largest_kernel: float
    counts: Sequence[int]


def shadow_maps(golden: Golden) -> Maps:
    """Return the shadow maps of a case, those of regions after those of lamps; none without either."""
    casters = ShadowCasters.of(golden.shot.cloud)
    views = [light_views(light, casters, MAP_SIZE) for light in golden.shot.lights]
    every = [view for of_light in views for view in of_light]
    if golden.regions:
        pairs = zip(golden.regions.directions, golden.regions.half_angles, strict=True)
        every += [distant_view(direction, float(half), casters, MAP_SIZE) for direction, half in pairs]
    if not every:
        return Maps([], np.zeros((0, MAP_SIZE, MAP_SIZE, 4), np.float32), 0.0, 0.0, [])
    drawer = ShadowDrawer(len(golden.shot.cloud), every, casters=casters, taps=TAPS, device="cpu")
    drawer.draw(golden.frame.gaussians)
    texels = drawer.maps.texels.numpy().reshape(-1, MAP_SIZE, MAP_SIZE, 4)
    return Maps(every, texels, casters.thickness, float(drawer.maps.largest_kernel), [len(each) for each in views])
