"""Shapes whose ambient occlusion is known in closed form, tiled with Gaussians.

Two errors are told apart. The estimator's is its distance from a float64 quadrature of the same Gaussians from the same
ray origins: noise, within its standard error. The discretisation's is the distance of that quadrature from the closed
form of the smooth shape: edges that are soft and offsets that are not zero, both a number of tile spacings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.device.arrays import device_label
from beam_warp.stability.suite import OutcomeRecord, together
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.rays import ray_offsets
from beam_warp.trace.reference import visibility_reference
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import EXACT
from beam_warp.world.directions import even_directions
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import turns_from_z

OVERLAP = 1.0
"""Tangential standard deviation of a tile in spacings: with alpha capped at 0.99 a layer of them passes about 1e-4."""

FLATNESS = 0.1
"""Thickness of a tile over its tangential standard deviation."""

SHIFTS = 8
"""Shifts of the quadrature's lattice; their spread is its own error."""


@dataclass(frozen=True, eq=False)
class TiledShape:
    """A shape made of Gaussians, and what its points see.

    Attributes:
        cloud: The tiles.
        points: Surface points [m], ``(P, 3)`` float32.
        normals: Unit normals on the open side, ``(P, 3)`` float32.
        visibility: Closed form for the smooth shape, ``(P,)``.
    """

    cloud: GaussianCloud
    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    visibility: NDArray[np.float64]


@dataclass(frozen=True)
class KnownShape:
    """One entry of the registry.

    Attributes:
        name: Short and unique.
        formula: Its ambient occlusion.
        build: From tile spacing [m] and number of points.
        spacing: The coarsest that is still the shape [m].
    """

    name: str
    formula: str
    build: Callable[[float, int], TiledShape]
    spacing: float


@dataclass(frozen=True)
class OcclusionOutcome(OutcomeRecord):
    """What one device made of one shape; all but counts and z are means over points.

    Attributes:
        shape: Name of the shape.
        device: Warp device.
        spacing: Of the tiles [m].
        gaussians: Number of tiles.
        points: Number of points.
        closed_form: Visibility of the smooth shape.
        quadrature: Visibility of the tiles from the same ray origins, float64.
        estimate: Visibility by `beam_warp.trace.occlusion.ambient_occlusion`.
        standard_error: As stated with the estimate.
        largest_z: Largest difference of estimate and quadrature in stated standard errors.
        mean_z: Mean over points of the difference of a mean over frames, in standard errors by its own spread.
        chi_square: Mean over points of the square of the same.
        discretisation: Mean absolute difference of quadrature and closed form.
    """

    shape: str
    device: str
    spacing: float
    gaussians: int
    points: int
    closed_form: float
    quadrature: float
    estimate: float
    standard_error: float
    largest_z: float
    mean_z: float
    chi_square: float
    discretisation: float

    @property
    def passed(self) -> bool:
        """Whether every point is within three standard errors."""
        return self.largest_z <= 3.0


def quadrature_directions(normals: ArrayLike, count: int, shift: float) -> NDArray[np.float64]:
    """Return cosine-distributed directions ``(P, count, 3)`` around normals ``(P, 3)``: a Fibonacci lattice.

    Args:
        normals: Unit vectors.
        count: Directions for each normal.
        shift: In [0, 1): moves the lattice along both axes (Cranley and Patterson 1976).
    """
    n = np.asarray(normals, np.float64)
    i = np.arange(count)
    u = ((i + 0.5) / count + shift) % 1.0
    phi = 2.0 * np.pi * ((i / ((1.0 + np.sqrt(5.0)) / 2.0) + shift * np.sqrt(2.0)) % 1.0)
    helper = np.where(np.abs(n[:, :1]) < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    tangent = np.cross(n, helper)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    bitangent = np.cross(n, tangent)
    x, y, z = np.sqrt(u) * np.cos(phi), np.sqrt(u) * np.sin(phi), np.sqrt(1.0 - u)
    return x[:, None] * tangent[:, None, :] + y[:, None] * bitangent[:, None, :] + z[:, None] * n[:, None, :]


def occlusion_quadrature(
    cloud: GaussianCloud, origins: ArrayLike, normals: ArrayLike, ray_count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ambient occlusion of a cloud in float64 by brute force, and its standard error, ``(P,)`` each.

    Args:
        cloud: Occluders.
        origins: Where rays start [m], ``(P, 3)``.
        normals: Unit normals, ``(P, 3)``.
        ray_count: Rays a point, a multiple of `SHIFTS`.
    """
    starts = np.asarray(origins, np.float64)
    means = []
    for shift in range(SHIFTS):
        d = quadrature_directions(normals, ray_count // SHIFTS, shift / SHIFTS)
        o = np.broadcast_to(starts[:, None, :], d.shape)
        v = visibility_reference(cloud, o.reshape(-1, 3), d.reshape(-1, 3))
        means.append(v.reshape(len(starts), -1).mean(axis=1))
    return np.mean(means, axis=0), np.std(means, axis=0, ddof=1) / np.sqrt(SHIFTS)


def traced_origins(scene: Scene, points: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return where `ambient_occlusion` with offset ``"auto"`` lets the rays of each point start [m], ``(P, 3)``."""
    at = wp.array(points, dtype=wp.vec3, device=scene.device)
    up = wp.array(normals, dtype=wp.vec3, device=scene.device)
    offsets = ray_offsets(scene, at, up, "auto").numpy()
    return points.astype(np.float64) + normals.astype(np.float64) * offsets[:, None]


def measure_occlusion(
    shape: KnownShape,
    device: str | None = None,
    *,
    spacing: float | None = None,
    point_count: int = 12,
    sample_count: int = 64,
    frame_count: int = 16,
    quadrature_count: int = 2048,
) -> OcclusionOutcome:
    """Estimate a shape's ambient occlusion and compare it with quadrature and closed form.

    Args:
        shape: From `SHAPES`.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        spacing: Of the tiles [m]; None takes the shape's own.
        point_count: Points on the shape.
        sample_count: Rays a point and frame.
        frame_count: Independent estimates, at least 4, whose spread shows the estimator's true error.
        quadrature_count: Rays a point of the float64 quadrature.
    """
    distance = shape.spacing if spacing is None else spacing
    tiled = shape.build(distance, point_count)
    scene = Scene.from_gaussians(tiled.cloud, device)
    origins = traced_origins(scene, tiled.points, tiled.normals)
    truth, truth_error = occlusion_quadrature(tiled.cloud, origins, tiled.normals, quadrature_count)
    runs = [
        ambient_occlusion(scene, tiled.points, tiled.normals, sample_count=sample_count, frame=frame)
        for frame in range(frame_count)
    ]
    values = np.array([run.visibility for run in runs], np.float64)
    stated = np.array([run.standard_error for run in runs], np.float64)
    # What the tracer stops below is not noise, and no number of samples removes it.
    other = np.square(truth_error) + EXACT.stop**2
    z = (values.mean(axis=0) - truth) / np.sqrt(values.var(axis=0, ddof=1) / frame_count + other)
    return OcclusionOutcome(
        shape=shape.name,
        device=device_label(scene.device),
        spacing=distance,
        gaussians=len(tiled.cloud),
        points=len(tiled.points),
        closed_form=float(tiled.visibility.mean()),
        quadrature=float(truth.mean()),
        estimate=float(values[0].mean()),
        standard_error=float(stated[0].mean()),
        largest_z=float((np.abs(values - truth) / np.sqrt(np.square(stated) + other))[0].max()),
        mean_z=float(z.mean()),
        chi_square=float(np.square(z).mean()),
        discretisation=float(np.abs(truth - tiled.visibility).mean()),
    )


def measure_refinements(
    shape: KnownShape, device: str | None = None, *, refinements: Sequence[float] = (1.0, 0.5, 0.25)
) -> Iterator[OcclusionOutcome]:
    """Measure a shape with ever finer tiles.

    Args:
        shape: From `SHAPES`.
        device: As `measure_occlusion`.
        refinements: Spacings of the tiles, in the shape's own.
    """
    for refinement in refinements:
        yield measure_occlusion(shape, device, spacing=shape.spacing * refinement)


UP = np.array([0.0, 0.0, 1.0])


def tile(points: ArrayLike, normals: ArrayLike, spacing: float) -> GaussianCloud:
    """Return a cloud with one flat Gaussian at each point, facing along its normal."""
    at = np.asarray(points, np.float64)
    width = OVERLAP * spacing
    return GaussianCloud(
        positions=at.astype(np.float32),
        orientations=turns_from_z(normals),
        scales=np.tile([width, width, width * FLATNESS], (len(at), 1)),
        opacities=np.ones(len(at), np.float32),
    )


def _rectangle(width: float, height: float, spacing: float) -> NDArray[np.float64]:
    """Return tile centres ``(N, 2)`` that fill [-width / 2, width / 2] by [0, height], half a tile inside its edges."""
    columns, rows = max(1, round(width / spacing)), max(1, round(height / spacing))
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * width
    y = (np.arange(rows) + 0.5) / rows * height
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)


def _disc(radius: float, spacing: float) -> NDArray[np.float64]:
    """Return a sunflower set ``(N, 3)`` on a disc in the plane z = 0."""
    count = max(1, round(np.pi * radius**2 / spacing**2))
    i = np.arange(count) + 0.5
    r, phi = radius * np.sqrt(i / count), np.pi * (1.0 + np.sqrt(5.0)) * i
    return np.stack([r * np.cos(phi), r * np.sin(phi), np.zeros(count)], axis=1)


def _sphere(spacing: float) -> NDArray[np.float64]:
    """Return a spherical Fibonacci set ``(N, 3)`` on the unit sphere."""
    return even_directions(round(4.0 * np.pi / spacing**2))


def _facing(points: NDArray[np.float64], direction: ArrayLike) -> NDArray[np.float64]:
    """Return one direction for every point."""
    return np.tile(np.asarray(direction, np.float64), (len(points), 1))


def _shape(
    cloud: GaussianCloud, points: NDArray[np.float64], normals: NDArray[np.float64], visibility: ArrayLike
) -> TiledShape:
    return TiledShape(
        cloud,
        points.astype(np.float32),
        normals.astype(np.float32),
        np.broadcast_to(np.asarray(visibility, np.float64), len(points)),
    )


def build_plane(spacing: float, count: int) -> TiledShape:
    """An open floor: every point sees everything."""
    floor = _disc(1.0, spacing)
    points = _disc(0.5, 0.5 * np.sqrt(np.pi / count))
    return _shape(tile(floor, _facing(floor, UP), spacing), points, _facing(points, UP), 1.0)


def build_disc(spacing: float, count: int) -> TiledShape:
    """A disc of radius R at height h over and parallel to the points, up to R off its axis.

    At distance a from the axis the visibility is (1 + (a^2 + h^2 - R^2) / sqrt((a^2 + h^2 + R^2)^2 - 4 R^2 a^2)) / 2
    (Howell, configuration factor B-13 of an element and a parallel disc); on the axis h^2 / (R^2 + h^2).
    """
    radius, height = 0.5, 0.4
    disc = _disc(radius, spacing) + height * UP
    points = np.linspace(0.0, radius, count)[:, None] * np.array([[1.0, 0.0, 0.0]])
    a = points[:, 0]
    root = np.sqrt((a**2 + height**2 + radius**2) ** 2 - 4.0 * radius**2 * a**2)
    visibility = 0.5 * (1.0 + (a**2 + height**2 - radius**2) / root)
    return _shape(tile(disc, _facing(disc, -UP), spacing), points, _facing(points, UP), visibility)


def build_wall(spacing: float, count: int) -> TiledShape:
    """A floor in front of a wall of height H, as long as makes its ends count for little.

    Finite length L, point opposite the middle: 1 - (atan(L / 2x) - x / s atan(L / 2s)) / pi with s^2 = x^2 + H^2; for
    L to infinity (1 + x / s) / 2. The length here is 8 H; the closed form is that of the finite wall.
    """
    height, length = 0.4, 3.2
    middle = _rectangle(length, height, spacing)
    wall = np.stack([np.zeros(len(middle)), middle[:, 0], middle[:, 1]], axis=1)
    x = np.linspace(0.15, 0.6, count)
    s = np.sqrt(x**2 + height**2)
    visibility = 1.0 - (np.arctan(length / (2.0 * x)) - x / s * np.arctan(length / (2.0 * s))) / np.pi
    points = np.stack([x, np.zeros(count), np.zeros(count)], axis=1)
    return _shape(tile(wall, _facing(wall, [1.0, 0.0, 0.0]), spacing), points, _facing(points, UP), visibility)


def build_resting_sphere(spacing: float, count: int) -> TiledShape:
    """A floor on which a sphere of radius R rests: 1 - (R / sqrt(x^2 + R^2))^3 at distance x from where it touches."""
    radius = 0.5
    unit = _sphere(spacing / radius)
    x = np.linspace(0.3, 1.0, count)
    points = np.stack([x, np.zeros(count), np.zeros(count)], axis=1)
    near = _disc(1.15, spacing)
    cloud = together(tile(radius * unit + radius * UP, unit, spacing), tile(near, _facing(near, UP), spacing))
    return _shape(cloud, points, _facing(points, UP), 1.0 - (radius / np.sqrt(x**2 + radius**2)) ** 3)


def build_bowl(spacing: float, count: int) -> TiledShape:
    """The inside of an open half-sphere: 1/2 everywhere, since all of a sphere's inside sees itself equally."""
    unit = _sphere(spacing)
    inside = unit[unit[:, 2] < 0.0]
    z = np.linspace(-0.98, -0.35, count)
    phi = np.pi * (1.0 + np.sqrt(5.0)) * np.arange(count)
    points = np.stack([np.sqrt(1.0 - z**2) * np.cos(phi), np.sqrt(1.0 - z**2) * np.sin(phi), z], axis=1)
    return _shape(tile(inside, -inside, spacing), points, -points, 0.5)


SHAPES = (
    KnownShape("plane", "1", build_plane, 0.1),
    KnownShape("coaxial disc", "h² / (R² + h²) on the axis", build_disc, 0.06),
    KnownShape("long wall", "½ (1 + x / √(x² + H²)) for infinite length", build_wall, 0.06),
    KnownShape("resting sphere", "1 - (R / √(x² + R²))³", build_resting_sphere, 0.1),
    KnownShape("half-sphere bowl", "½", build_bowl, 0.12),
)
"""Shapes with closed forms: configuration factors of an element and a disc, a rectangle, a sphere (Howell)."""
