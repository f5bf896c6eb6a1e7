"""The scene, rays and float64 truth of the tracing benchmark.

A closed surface of known area, tiled as trained captures are: flat Gaussians in no order, about one standard deviation
apart, with jitter. Its area gives the spacing, so that count, overlap and opacity can be varied one at a time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beam_warp.kernels.common.constants import ALPHA_MAX, ALPHA_MIN
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import rotation_matrices

RING_RADIUS = 0.4
TUBE_RADIUS = 0.13
FLATNESS = 0.1
"""Standard deviation along the normal over that along the surface."""
JITTER = 0.2
"""Standard deviation of the logarithm of every scale."""
LIFT = 0.02
"""Distance of ray origins from the surface [m]."""
POINTS_AT_ONCE = 1 << 15
"""Points tried at a time: their arrays fit into a processor's cache."""
PAIRS_AT_ONCE = 1 << 23
"""Pairs of ray and Gaussian held at a time by the brute force, 64 MiB a matrix."""


class Surface(NamedTuple):
    """The torus at parameters (u, v): points and outward normals ``(N, 3)``, area per unit of du dv ``(N,)``."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    densities: NDArray[np.float64]


class Rays(NamedTuple):
    """World-space origins [m] and unit directions, ``(N, 3)`` float32."""

    origins: NDArray[np.float32]
    directions: NDArray[np.float32]


def torus_surface(u: NDArray[np.float64], v: NDArray[np.float64]) -> Surface:
    """Return points, normals and area density of a torus whose tube has bumps and whose ring waves up and down."""
    tube = TUBE_RADIUS * (1.0 + 0.25 * np.sin(5 * u) * np.cos(3 * v) + 0.1 * np.sin(11 * u + 4 * v))
    tube_u = TUBE_RADIUS * (1.25 * np.cos(5 * u) * np.cos(3 * v) + 1.1 * np.cos(11 * u + 4 * v))
    tube_v = TUBE_RADIUS * (-0.75 * np.sin(5 * u) * np.sin(3 * v) + 0.4 * np.cos(11 * u + 4 * v))
    ring = RING_RADIUS + tube * np.cos(v)
    ring_u = tube_u * np.cos(v)
    ring_v = tube_v * np.cos(v) - tube * np.sin(v)
    points = np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v) + 0.08 * np.sin(3 * u)], axis=-1)
    along_u = np.stack(
        [
            ring_u * np.cos(u) - ring * np.sin(u),
            ring_u * np.sin(u) + ring * np.cos(u),
            tube_u * np.sin(v) + 0.24 * np.cos(3 * u),
        ],
        axis=-1,
    )
    along_v = np.stack([ring_v * np.cos(u), ring_v * np.sin(u), tube_v * np.sin(v) + tube * np.cos(v)], axis=-1)
    normals = np.cross(along_u, along_v)
    densities = np.linalg.norm(normals, axis=-1)
    return Surface(points, normals / densities[..., None], densities)


def torus_area() -> tuple[float, float]:
    """Return the area [m^2] and a bound on the area density, from midpoints: for a periodic integrand nearly exact."""
    middles = (np.arange(512) + 0.5) * (2.0 * np.pi / 512)
    densities = torus_surface(*np.meshgrid(middles, middles)).densities
    return float(densities.mean() * (2.0 * np.pi) ** 2), float(1.01 * densities.max())


def bumpy_torus(
    count: int = 140_000, *, overlap: float = 1.0, opacity: float = 0.9, seed: int = 0
) -> tuple[GaussianCloud, float]:
    """Return Gaussians spread evenly at random over the torus, in random order, and their spacing [m].

    Args:
        count: Gaussians; the spacing is sqrt(area / count).
        overlap: Standard deviation along the surface over the spacing; the driver of cost.
        opacity: Of every Gaussian.
        seed: Same seed, same cloud.

    Returns:
        The cloud, with its surface's normals, and the spacing.
    """
    rng = np.random.default_rng(seed)
    area, highest = torus_area()
    points, normals = np.empty((count, 3)), np.empty((count, 3))
    filled = 0
    while filled < count:
        u, v = rng.uniform(0.0, 2.0 * np.pi, (2, POINTS_AT_ONCE))
        surface = torus_surface(u, v)
        kept = np.flatnonzero(rng.uniform(0.0, highest, len(u)) < surface.densities)[: count - filled]
        points[filled : filled + len(kept)] = surface.points[kept]
        normals[filled : filled + len(kept)] = surface.normals[kept]
        filled += len(kept)
    spacing = float(np.sqrt(area / count))
    scales = np.exp(rng.normal(np.log([spacing, spacing, FLATNESS * spacing]), JITTER, (count, 3)))
    cloud = GaussianCloud(
        positions=points,
        orientations=spun_orientations(normals, rng.uniform(0.0, 2.0 * np.pi, count)),
        scales=overlap * scales,
        opacities=np.full(count, opacity),
        normals=normals,
    )
    return cloud, spacing


def spun_orientations(normals: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quaternions xyzw ``(N, 4)`` that turn by an angle about z and then carry z to each normal."""
    x, y, w = -normals[:, 1], normals[:, 0], np.maximum(1.0 + normals[:, 2], 1e-12)
    s, c = np.sin(0.5 * angles), np.cos(0.5 * angles)
    turned = np.stack([c * x + s * y, c * y - s * x, s * w, c * w], axis=1)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def morton_codes(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return 30-bit codes of points ``(N, 3)``, ten bits an axis: sorted by them, neighbours stay near."""
    low = points.min(axis=0)
    extent = max(float((points.max(axis=0) - low).max()), 1e-30)
    cells = ((points - low) / extent * 1023.0).astype(np.int64)
    codes = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


def cosine_rays(cloud: GaussianCloud, point_count: int, rays_per_point: int = 50, *, seed: int = 1) -> Rays:
    """Return independent cosine-distributed rays from points of the cloud, the points in Morton order.

    The sum of a unit normal and a uniform point of the unit sphere has a cosine-distributed direction.
    """
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(cloud), min(point_count, len(cloud)), replace=False)
    chosen = chosen[np.argsort(morton_codes(cloud.positions[chosen]), kind="stable")]
    normals = np.repeat(cloud.normals[chosen], rays_per_point, axis=0)
    origins = np.repeat(cloud.positions[chosen], rays_per_point, axis=0) + np.float32(LIFT) * normals
    sphere = rng.normal(size=normals.shape)
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    directions = normals + sphere
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Rays(origins.astype(np.float32), directions.astype(np.float32))


def camera_rays(cloud: GaussianCloud, width: int, height: int) -> Rays:
    """Return one ray through every pixel of a camera whose image the cloud fills, row by row."""
    camera = Camera.frame_cloud(cloud.positions, azimuth=25.0, elevation=35.0, width=width, height=height)
    directions = camera.directions().reshape(-1, 3).astype(np.float32)
    return Rays(np.tile(np.asarray(camera.position, dtype=np.float32), (len(directions), 1)), directions)


def brute_force_visibility(cloud: GaussianCloud, rays: Rays) -> NDArray[np.float64]:
    """Return what `beam_warp.trace.reference.visibility_reference` does, fast enough for 500 rays and 4 M Gaussians.

    Only Gaussians whose centre lies within their largest support radius of the ray's line are evaluated; the others
    have alpha < 1/255 and do not count.

    Args:
        cloud: Occluders; scales above 0.
        rays: Any number.

    Returns:
        Transmittances, ``(N,)`` float64, never stopped early.
    """
    centers = cloud.positions.astype(np.float64)
    opacities = cloud.opacities.astype(np.float64)
    reach_squared = 2.0 * np.log(np.maximum(opacities / ALPHA_MIN, 1.0)) * cloud.scales.max(axis=1).astype(float) ** 2
    reach_squared = reach_squared * (1.0 + 1e-6) + 1e-12  # far above the rounding of the distances below
    result = np.ones(len(rays.origins))
    step = max(1, PAIRS_AT_ONCE // max(len(cloud), 1))
    for start in range(0, len(result), step):
        o = rays.origins[start : start + step].astype(np.float64)
        d = rays.directions[start : start + step].astype(np.float64)
        along = np.einsum("nk,nk->n", o, d)[:, None] - d @ centers.T
        apart = np.einsum("nk,nk->n", o, o)[:, None] - 2.0 * (o @ centers.T) + np.einsum("nk,nk->n", centers, centers)
        ray, gaussian = np.nonzero(apart - along**2 < reach_squared)
        rotations = rotation_matrices(cloud.orientations[gaussian])
        scales = cloud.scales[gaussian].astype(np.float64)
        p = np.einsum("nkj,nk->nj", rotations, o[ray] - centers[gaussian]) / scales
        v = np.einsum("nkj,nk->nj", rotations, d[ray]) / scales
        t = -np.einsum("nk,nk->n", p, v) / np.einsum("nk,nk->n", v, v)
        closest = p + t[:, None] * v
        alpha = np.minimum(ALPHA_MAX, opacities[gaussian] * np.exp(-0.5 * np.einsum("nk,nk->n", closest, closest)))
        counted = (alpha >= ALPHA_MIN) & (t > 0.0)
        np.multiply.at(result, start + ray[counted], 1.0 - alpha[counted])
    return result
