"""What the relighting benchmark renders, how much of it, and how long a frame of anything takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import raster_scenes
import warp as wp
from numpy.typing import NDArray
from parts import Row
from timing import spread

from beam_warp.capture.capture import Capture
from beam_warp.device.arrays import upload
from beam_warp.raster.records import GaussianArrays
from beam_warp.render.deferred import DeferredOptions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import DirectionalLight, Light, PointLight
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.quaternions import product
from beam_warp.world.shot import Shot, ShotMesh


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        gaussians: Gaussians of the figure whose frames are timed.
        size: Width and height of its images.
        shadows: Directions that stand for the environment, where shadow maps of it are timed.
        maps: Sides of a light's and of an environment's shadow maps [texel].
        frames: Launched one after the other before the clock is read.
        repeats: Repetitions of everything that is timed.
        poses: Poses of the moving figure, which lie on the device.
        path_samples: Samples of a pixel in a timed pass.
        bounces: Bounces of paths.
        perfect_gaussians: Gaussians on true surfaces.
        views: Test views a capture at most.
        side: Side of the square of samples of a pixel, deferred, where it is scored.
        scored_shadows: The same as ``shadows``, where it is scored and timed, with the usual bounces.
        settings: Shadow maps of the environment and bounces that decomposed assets are relit with.
        levels: Samples of a pixel at which path tracing is scored, ascending.
        level_seconds: A level that would take longer, for one image, is left out.
        demo_size: Width and height of the demo figure's images.
        demo_spacing: Spacing of the grid that it is meshed with [m].
        truth_samples: Paths a pixel of its truth.
        furnace_gaussians: Gaussians of the white ball.
        furnace_size: Side of the furnace's images.
        furnace_samples: Samples of a pixel, path traced.
        bias_gaussians: Gaussians of the figure on which bias is looked for.
        bias_size: Width and height of its images.
        bias_seeds: Images of few samples, and of sixteen times as many.
    """

    gaussians: int = 140_000
    size: tuple[int, int] = (1920, 1080)
    shadows: tuple[int, ...] = (4, 16)
    maps: tuple[int, int] = (DeferredOptions().light_map_size, DeferredOptions().environment_map_size)
    frames: int = 30
    repeats: int = 5
    poses: int = 16
    path_samples: int = 16
    bounces: int = 4
    perfect_gaussians: int = 140_000
    views: int = 2
    side: int = 2
    scored_shadows: tuple[int, ...] = (0, 4, 16, 32)
    settings: tuple[tuple[int, int], ...] = (
        (0, 0),
        (0, 2),
        (1, 2),
        (4, 2),
        (8, 2),
        (16, 0),
        (16, 1),
        (16, 2),
        (16, 3),
        (32, 2),
        (64, 2),
    )
    levels: tuple[int, ...] = (4, 16, 64, 256)
    level_seconds: float = 5.0
    demo_size: tuple[int, int] = (240, 360)
    demo_spacing: float = 0.011
    truth_samples: int = 1024
    furnace_gaussians: int = 20_000
    furnace_size: int = 64
    furnace_samples: int = 256
    bias_gaussians: int = 20_000
    bias_size: tuple[int, int] = (64, 36)
    bias_seeds: tuple[int, int] = (64, 12)


FULL = Effort()

ON_CPU = Effort(
    size=(512, 512),
    frames=1,
    repeats=3,
    poses=2,
    path_samples=2,
    perfect_gaussians=40_000,
    views=1,
    levels=(16, 64),
    level_seconds=120.0,
    demo_size=(120, 180),
    truth_samples=512,
    furnace_gaussians=4000,
    furnace_size=24,
    furnace_samples=128,
    bias_gaussians=4000,
    bias_size=(24, 14),
    bias_seeds=(64, 16),
)
"""A figure of 512 x 512 is what the CPU is asked for; the rest is as small as says something."""

QUICK = Effort(
    gaussians=800,
    size=(48, 32),
    shadows=(4,),
    maps=(64, 32),
    frames=1,
    repeats=1,
    poses=2,
    path_samples=2,
    bounces=2,
    perfect_gaussians=1500,
    views=1,
    side=1,
    scored_shadows=(0, 4),
    settings=((0, 0), (4, 2)),
    levels=(2, 4),
    level_seconds=60.0,
    demo_size=(32, 48),
    demo_spacing=0.02,
    truth_samples=16,
    furnace_gaussians=400,
    furnace_size=8,
    furnace_samples=16,
    bias_gaussians=400,
    bias_size=(8, 6),
    bias_seeds=(6, 3),
)


@dataclass(frozen=True)
class Bench:
    """What parts share.

    Attributes:
        captures: Captures by name, with truth under other lights.
        assets: Decomposed reconstructions by the name of their capture.
        sky: What the figure stands under.
        effort: How much is measured.
        device: Where.
        pictures: Folder of images that ``tables.py`` draws; None for none.
    """

    captures: Mapping[str, Capture]
    assets: Mapping[str, Path]
    sky: EnvironmentMap
    effort: Effort
    device: Any
    pictures: Path | None

    def figure(self, *, lights: tuple[Light, ...] = (), mesh: ShotMesh | None = None) -> Shot:
        """Return the figure under the sky: a bumpy ball of radius 1, which covers a quarter of the image."""
        scene = raster_scenes.figure(self.effort.gaussians, *self.effort.size)
        return Shot(cloud=scene.cloud, camera=scene.camera, environment=self.sky, lights=lights, mesh=mesh)

    def deferred_options(self, shadows: int, *, side: int = 1) -> DeferredOptions:
        """Return the usual options with so many shadow maps of the environment; without any, light does not bounce."""
        usual = DeferredOptions()
        return DeferredOptions(
            environment_shadows=shadows,
            bounces=usual.bounces if shadows else 0,
            light_map_size=self.effort.maps[0],
            environment_map_size=self.effort.maps[1],
            samples=side,
            layers=(),
        )

    def small_figure(self) -> Shot:
        """Return the same, so small that what it takes is compiling."""
        scene = raster_scenes.figure(200, 32, 18)
        return Shot(cloud=scene.cloud, camera=scene.camera, environment=self.sky, lights=SUN_AND_LAMP, mesh=ground())


SUN_AND_LAMP: tuple[Light, ...] = (
    DirectionalLight(direction=(-0.6, 0.5, -0.8), irradiance=(3.0, 2.8, 2.4)),
    PointLight(position=(3.0, 2.0, 2.0), intensity=(12.0, 13.0, 16.0), radius=0.1),
)
"""Two lights that cast shadows, each with one map."""

LAMPS: tuple[Light, ...] = (
    PointLight(position=(3.0, 2.0, 2.0), intensity=(12.0, 13.0, 16.0), radius=0.2),
    PointLight(position=(3.0, -2.5, 1.0), intensity=(16.0, 10.0, 6.0), radius=0.4),
)
"""Two spheres that shine."""


def ground(height: float = -1.07, half: float = 6.0) -> ShotMesh:
    """Return a grey square below the figure."""
    surface = MaterialMesh(
        vertices=np.array([[x, y, height] for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))]),
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
        normals=np.tile([0.0, 0.0, 1.0], (4, 1)),
        base_color=np.full((4, 3), 0.4),
        roughness=np.full(4, 0.7),
    )
    return ShotMesh(surface=surface, catches_shadows=np.zeros(2, np.bool_))


class MovingFigure:
    """A figure that turns, sways and breathes: positions, orientations and scales of every pose on the device."""

    def __init__(self, cloud: GaussianCloud, count: int, device: Any) -> None:
        """Pose a cloud ``count`` times, evenly over a period."""
        self._poses = []
        for phase in 2.0 * np.pi * np.arange(count) / count:
            positions, orientations, scales = posed(cloud, float(phase))
            self._poses.append(
                (
                    upload(positions, wp.vec3, device),
                    upload(orientations, wp.quat, device),
                    upload(scales, wp.vec3, device),
                )
            )
        self._next = 0

    def arrays(self) -> tuple[wp.array, wp.array, wp.array]:
        """Return the next pose."""
        self._next = (self._next + 1) % len(self._poses)
        return self._poses[self._next]

    def move(self, gaussians: GaussianArrays) -> None:
        """Bring Gaussians into the next pose, on the device."""
        for target, source in zip(
            (gaussians.positions, gaussians.orientations, gaussians.scales), self.arrays(), strict=True
        ):
            wp.copy(target, source)


def posed(cloud: GaussianCloud, phase: float) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return a cloud turned by up to 10 degrees about z, its height swung by 3 % and its size by 1 %."""
    angle = np.radians(10.0) * np.sin(phase)
    turn = np.array([0.0, 0.0, np.sin(angle / 2.0), np.cos(angle / 2.0)])
    c, s = np.cos(angle), np.sin(angle)
    positions = cloud.positions.astype(np.float64) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    positions[:, 0] += 0.03 * np.sin(phase + 3.0 * positions[:, 2])
    size = 1.0 + 0.01 * np.cos(phase)
    orientations = product(turn, cloud.orientations.astype(np.float64))
    return (
        (size * positions).astype(np.float32),
        orientations.astype(np.float32),
        (size * cloud.scales).astype(np.float32),
    )


def seconds_of(work: Callable[[], Any], device: Any) -> float:
    """Return the seconds that work takes until the device has finished."""
    wp.synchronize_device(device)
    started = time.perf_counter()
    work()
    wp.synchronize_device(device)
    return time.perf_counter() - started


def frame_times(work: Callable[[], Any], effort: Effort, device: Any) -> Row:
    """Return milliseconds of a frame: of many launched one after the other, and of one that is waited for."""
    for _ in range(2):  # what is compiled, recorded or allocated once
        work()

    def in_a_row() -> None:
        for _ in range(effort.frames):
            work()

    rows = np.array([1e3 * seconds_of(in_a_row, device) / effort.frames for _ in range(effort.repeats)])
    alone = [1e3 * seconds_of(work, device) for _ in range(effort.repeats if effort.frames > 1 else 0)]
    return {
        "ms": spread(rows),
        "fps": spread(1e3 / rows),
        "latency_ms": spread(np.array(alone)) if alone else spread(rows),
    }
