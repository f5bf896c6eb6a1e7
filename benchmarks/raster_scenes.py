"""The scenes of the raster benchmark: a thin shell that covers a quarter of the image, and a cube that fills it.

What a rasteriser's time depends on is varied one at a time: how many splats there are, how many pixels, and how many
splats lie on a pixel. No opacity is above 0.98, so that programs that cap alpha at 0.99 and at 0.999 draw the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tracing_scenes import FLATNESS, JITTER, Surface, spun_orientations

from beam_warp.image.color import LINEAR_REC709
from beam_warp.world.camera import Camera, focal_length
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import sh_basis

BUMP = 0.06
"""Height of the bumps over the radius."""
FIELD_OF_VIEW = 35.0
"""Angle between the top and bottom edges of the image [degree]."""
FIGURE_SHARE = 0.26
"""Share of an image that a figure covers."""
CUBE_DISTANCE = 1.2
"""Distance of the camera from the middle of a cube of side 1 [m]: its front then fills an image of up to 16 to 9."""


class RasterScene(NamedTuple):
    """A cloud and the camera that sees it; the cloud is relightable and has captured colour."""

    name: str
    cloud: GaussianCloud
    camera: Camera

    def values(self) -> NDArray[np.float32]:
        """Return what is composited beside depth, ``(N, 11)``: colour, base colour, roughness, occlusion, normals."""
        cloud = self.cloud
        toward = cloud.positions - self.camera.position
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        basis = sh_basis(toward, cloud.sh_degree)
        columns = (
            np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, cloud.radiance.astype(np.float64)), 0.0),
            cloud.base_color,
            cloud.roughness[:, None],
            cloud.ambient_occlusion[:, None],
            cloud.normals,
        )
        return np.concatenate(columns, axis=1, dtype=np.float32)


def figure(count: int = 140_000, width: int = 1920, height: int = 1080, *, seed: int = 0) -> RasterScene:
    """Return flat discs spread evenly over a bumpy sphere, in random order, as trained figures are."""
    rng = np.random.default_rng(seed)
    middles = _unit_vectors(rng, 1 << 16)
    densities = bumpy_sphere(middles).densities
    area, highest = 4.0 * np.pi * float(densities.mean()), 1.05 * float(densities.max())
    chosen = np.empty((0, 3))
    while len(chosen) < count:
        directions = _unit_vectors(rng, 1 << 16)
        kept = rng.uniform(0.0, highest, len(directions)) < bumpy_sphere(directions).densities
        chosen = np.concatenate([chosen, directions[kept]])[:count]
    surface = bumpy_sphere(chosen)
    spacing = np.sqrt(area / count)
    scales = np.exp(rng.normal(np.log([spacing, spacing, FLATNESS * spacing]), JITTER, (count, 3)))
    orientations = spun_orientations(surface.normals, rng.uniform(0.0, 2.0 * np.pi, count))
    cloud = _painted(rng, surface.points, orientations, scales, rng.uniform(0.3, 0.98, count), surface.normals)
    # A sphere of radius 1 at distance d is a disc of f / sqrt(d^2 - 1) pixels.
    radius = np.sqrt(FIGURE_SHARE * width * height / np.pi)
    distance = float(np.hypot(1.0, focal_length(height, FIELD_OF_VIEW) / radius))
    return RasterScene("figure", cloud, _camera(distance, width, height))


def cube(count: int = 100_000, width: int = 512, height: int = 512, *, seed: int = 0) -> RasterScene:
    """Return thick Gaussians anywhere in a cube: opaque all over the image, after many layers."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(-0.5, 0.5, (count, 3))
    orientations = rng.normal(size=(count, 4))
    orientations /= np.linalg.norm(orientations, axis=1, keepdims=True)
    scales = 0.5 * count ** (-1 / 3) * np.exp(rng.normal(0.0, 0.4, (count, 3)))
    normals = _unit_vectors(rng, count)
    cloud = _painted(rng, positions, orientations, scales, rng.uniform(0.05, 0.5, count), normals)
    return RasterScene("cube", cloud, _camera(CUBE_DISTANCE, width, height))


def growth(
    counts: Iterable[int],
    sizes: Iterable[tuple[int, int]],
    *,
    count: int = 140_000,
    size: tuple[int, int] = (1920, 1080),
    seed: int = 0,
) -> Iterator[tuple[str, RasterScene]]:
    """Yield figures of more and more splats, and then of more and more pixels, each with what grows.

    Args:
        counts: Splats at ``size``.
        sizes: Widths and heights at ``count``.
        count: See above.
        size: See above.
        seed: Of every figure.
    """
    for splats in counts:
        yield "gaussians", figure(splats, *size, seed=seed)
    for width, height in sizes:
        yield "pixels", figure(count, width, height, seed=seed)


def bumpy_sphere(directions: NDArray[np.float64]) -> Surface:
    """Return points and outward normals along unit directions ``(N, 3)``, and the area per unit of solid angle.

    The radius is r = 1 + BUMP sin(9 x + 1) sin(7 y + 2) sin(8 z + 3); the normal is along r d less r's gradient on the
    sphere, and a solid angle holds r times the length of that of area.
    """
    phase = directions * (9.0, 7.0, 8.0) + (1.0, 2.0, 3.0)
    s, c = np.sin(phase), np.cos(phase)
    radius = 1.0 + BUMP * s.prod(axis=1, keepdims=True)
    around = BUMP * np.stack(
        [9.0 * c[:, 0] * s[:, 1] * s[:, 2], 7.0 * s[:, 0] * c[:, 1] * s[:, 2], 8.0 * s[:, 0] * s[:, 1] * c[:, 2]],
        axis=1,
    )
    around -= (around * directions).sum(axis=1, keepdims=True) * directions
    normals = radius * directions - around
    lengths = np.linalg.norm(normals, axis=1)
    return Surface(radius * directions, normals / lengths[:, None], radius[:, 0] * lengths)


def _unit_vectors(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    found = rng.normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def _camera(distance: float, width: int, height: int) -> Camera:
    """Return a camera in front of the origin, as high as that."""
    return Camera.orbit((0, 0, 0), distance, 0.0, 0.0, width=width, height=height, vertical_fov=FIELD_OF_VIEW)


def _painted(
    rng: np.random.Generator,
    positions: NDArray[np.float64],
    orientations: NDArray[np.float64],
    scales: NDArray[np.float64],
    opacities: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> GaussianCloud:
    """Return a cloud with materials that vary over space and a little from one Gaussian to the next."""
    waves = 0.5 + 0.35 * np.sin(positions @ rng.normal(0.0, 6.0, (3, 8)) + rng.uniform(0.0, 2.0 * np.pi, 8))
    paint = np.clip(waves + rng.normal(0.0, 0.03, waves.shape), 0.0, 1.0)
    return GaussianCloud(
        positions=positions,
        orientations=orientations,
        scales=scales,
        opacities=opacities,
        normals=normals,
        base_color=paint[:, :3],
        roughness=paint[:, 3],
        ambient_occlusion=paint[:, 4],
        radiance=(paint[:, None, 5:] - 0.5) * np.sqrt(4.0 * np.pi),  # degree 0, whose basis is 1 / sqrt(4 pi)
        radiance_color_space=LINEAR_REC709,
    )
