"""The scenes of the stability suite: Gaussians and rays on which ray tracers fail, and what must be found out of them.

A case gives no tolerance; `beam_warp.stability.tracing` derives the interval of every ray.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.stability.suite import StabilityCase
from beam_warp.trace.reference import visibility_reference
from beam_warp.trace.transmittance import EXACT, TraceOptions
from beam_warp.world.gaussians import GaussianCloud, InvalidRows
from beam_warp.world.quaternions import rotation_matrices

NONE_LEFT_OUT = InvalidRows(np.zeros(0, np.int64), 0, 0, 0)


@dataclass(frozen=True, kw_only=True)
class Stress:
    """Gaussians, rays, and what must be found out about them.

    Attributes:
        cloud: What is traced.
        rays: Ray origins [m] and unit directions, ``(N, 3)`` each.
        t_max: Reach [m], one number or ``(N,)``.
        options: Rules of the trace.
        response_degree: 2 or 4.
        left_out: Rows that the cloud lacks because they were broken.
        expected: Counts of the scene's report that are known beforehand.
        expected_left_out: (not finite, negative scales, zero quaternions) known beforehand.
        known: Visibility by a closed form or symmetry, ``(N,)``, NaN where there is none.
        occlusion_points: Surface points and normals for ambient occlusion with offset 0; None for none.
    """

    cloud: GaussianCloud
    rays: tuple[NDArray[np.float32], NDArray[np.float32]]
    t_max: Any = np.inf
    options: TraceOptions = EXACT
    response_degree: Any = 2
    left_out: InvalidRows = NONE_LEFT_OUT
    expected: dict[str, int] = field(default_factory=dict)
    expected_left_out: tuple[int, int, int] = (0, 0, 0)
    known: NDArray[np.float64] | None = None
    occlusion_points: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None


CASES: list[StabilityCase[Stress]] = []
"""Every case, in the order of the table."""


def stress_case(
    seed: int, name: str, fails: str, *, large: bool = False
) -> Callable[[Callable[[np.random.Generator], Stress]], Callable[[np.random.Generator], Stress]]:
    """Register the function below it as a case, which is given a generator of its own: the same in any selection."""

    def register(make: Callable[[np.random.Generator], Stress]) -> Callable[[np.random.Generator], Stress]:
        CASES.append(StabilityCase(name, fails, "", lambda: make(np.random.default_rng(seed)), large))
        return make

    return register


def _unit(vectors: NDArray[Any]) -> NDArray[np.float32]:
    """Return directions of unit length, ``(N, 3)`` float32."""
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def _orientations(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Return uniform rotations, xyzw."""
    q = rng.normal(size=(count, 4))
    return (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)


def _unturned(count: int) -> NDArray[np.float64]:
    """Return rotations by nothing, xyzw."""
    return np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))


def _cloud(
    rng: np.random.Generator, count: int, scales: Any, *, side: float = 1.0, opacities: Any = (0.2, 1.0), **changes: Any
) -> GaussianCloud:
    """Return Gaussians placed and turned at random in a cube of half-side ``side`` [m].

    ``opacities`` is a range as a tuple, or one for each; ``changes`` replace arrays.
    """
    arrays: dict[str, Any] = {
        "positions": rng.uniform(-side, side, (count, 3)),
        "orientations": _orientations(rng, count),
        "scales": np.broadcast_to(scales, (count, 3)),
        "opacities": rng.uniform(opacities[0], opacities[1], count) if isinstance(opacities, tuple) else opacities,
    }
    return GaussianCloud(**(arrays | changes))


def aimed_rays(
    rng: np.random.Generator,
    cloud: GaussianCloud,
    count: int,
    *,
    distance: tuple[float, float] = (0.2, 1.0),
    directions: NDArray[np.float32] | None = None,
    spread: float = 1.5,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return rays that pass random Gaussians at some standard deviations: random ones would miss thin Gaussians."""
    index = rng.integers(0, len(cloud), count)
    inside = spread * rng.normal(size=(count, 3)) * cloud.scales[index]
    target = cloud.positions[index] + np.einsum("nij,nj->ni", rotation_matrices(cloud.orientations)[index], inside)
    d = _unit(rng.normal(size=(count, 3))) if directions is None else directions
    return (target - d * rng.uniform(*distance, (count, 1))).astype(np.float32), d


def _axis_parallel(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Return directions along the axes, with zeros of both signs."""
    d = np.where(rng.uniform(size=(count, 3)) < 0.5, np.float32(-0.0), np.float32(0.0)).astype(np.float32)
    d[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-1.0, 1.0], count)
    return d


def box_planes(cloud: GaussianCloud) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return lower and upper box planes ``(N, 3)`` of unturned Gaussians, rounded as the tracer rounds them."""
    one = np.float32(1.0)
    levels = np.float32(2.0) * np.log(cloud.opacities / np.float32(1.0 / 255.0))
    half = np.sqrt(levels)[:, None] * cloud.scales * (one + np.float32(1e-5))
    half = half + np.float32(2.4e-7) * np.abs(cloud.positions)
    return (cloud.positions - half).astype(np.float32), (cloud.positions + half).astype(np.float32)


@stress_case(1, "round", "nothing: the control")
def _round(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 600, 0.05 * np.exp(rng.normal(0.0, 0.4, (600, 3))))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300), expected={"traced": 600, "raised_scales": 0})


@stress_case(2, "round, degree 4", "a support radius of degree 2 for a response of degree 4 cuts or leaks")
def _quartic(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 600, 0.05 * np.exp(rng.normal(0.0, 0.4, (600, 3))))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300), response_degree=4)


@stress_case(3, "needles 1:10⁴", "the discriminant of the quadratic cancels: errors of 1")
def _needles(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 400, (0.1, 1.001e-5, 1.001e-5))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300), expected={"raised_scales": 0})


@stress_case(4, "needles 1:10⁶", "beyond float32: M has entries 10⁶ apart")
def _thinner_needles(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 400, (0.1, 1e-7, 1e-7))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300), expected={"raised_scales": 400})


@stress_case(5, "needles along the ray", "the whitened direction is short and its error large")
def _along_needles(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 300, (0.1, 1.001e-5, 1.001e-5))
    index = rng.integers(0, 300, 300)
    axes = rotation_matrices(cloud.orientations)[index, :, 0]
    tilt = 10.0 ** rng.uniform(-6.0, -2.0, (300, 1)) * rng.normal(size=(300, 3))
    d = _unit(axes + tilt)
    return Stress(cloud=cloud, rays=((cloud.positions[index] - 0.6 * d).astype(np.float32), d))


@stress_case(6, "discs 1:10⁴", "thin along one axis: the same cancellation")
def _discs(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 400, (0.1, 0.1, 1.001e-5), opacities=(0.02, 0.4))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300), expected={"raised_scales": 0})


@stress_case(7, "discs of no thickness", "1 / 0")
def _flat(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 400, (0.1, 0.1, 0.0), opacities=(0.02, 0.4))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300), expected={"raised_scales": 400})


@stress_case(8, "discs, grazing rays", "the peak slides far along a ray that hardly crosses the disc")
def _grazing(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 300, (0.1, 0.1, 1e-4), opacities=(0.02, 0.4))
    index = rng.integers(0, 300, 400)
    frames = rotation_matrices(cloud.orientations)[index]
    angle = rng.uniform(0.0, 2.0 * np.pi, 400)
    within = np.stack([np.cos(angle), np.sin(angle), 10.0 ** rng.uniform(-6.0, -1.0, 400)], axis=1)
    d = _unit(np.einsum("nij,nj->ni", frames, within))
    target = cloud.positions[index] + frames[:, :, 2] * (1e-4 * rng.normal(size=(400, 1)))
    return Stress(cloud=cloud, rays=((target - 0.5 * d).astype(np.float32), d))


@stress_case(9, "σ = 10⁻⁶, one metre away", "float32 rays are 0.06 σ coarse: the best that any tracer can do")
def _tiny(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 400, 1e-6 * np.exp(rng.uniform(0.0, 2.0, (400, 3))))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300), expected={"raised_scales": 0})


@stress_case(10, "scales of 0", "1 / 0 along every axis")
def _points(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 200, 0.0)
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 200), expected={"raised_scales": 200})


@stress_case(11, "10⁴ from the origin", "an affine form M o + b loses every digit")
def _far_away(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 500, 0.05 * np.exp(rng.normal(0.0, 0.4, (500, 3))))
    cloud = cloud.with_arrays(positions=cloud.positions + np.array([1e4, -1e4, 1e4], np.float32))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300), expected={"traced": 500})


@stress_case(12, "10⁴ from the origin, thin", "the same, and the centres' own grid of 1 mm is coarser than σ")
def _far_away_thin(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 500, (0.05, 0.05, 4e-4))
    cloud = cloud.with_arrays(positions=cloud.positions + np.array([1e4, -1e4, 1e4], np.float32))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300), expected={"raised_scales": 0})


@stress_case(13, "rays from 10³ extents away", "o - μ loses three digits; box tests lose hits")
def _long_rays(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 400, 0.1 * np.exp(rng.normal(0.0, 0.3, (400, 3))), opacities=(0.05, 0.5))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300, distance=(1.9e3, 2.1e3)))


@stress_case(35, "two clusters, 10⁵ of their sizes apart", "no middle suits both: o - c keeps two digits")
def _clusters(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 400, 1e-3 * np.exp(rng.normal(0.0, 0.3, (400, 3))), side=0.01, opacities=(0.05, 0.6))
    side = np.where(np.arange(400) % 2 == 0, 500.0, -500.0)[:, None] * np.array([1.0, 0.3, -0.7])
    cloud = cloud.with_arrays(positions=cloud.positions + side)
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300, distance=(0.0, 0.05)))


@stress_case(14, "axis-parallel rays", "1 / 0 in the box test")
def _parallel(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 500, 0.08 * np.exp(rng.normal(0.0, 0.4, (500, 3))), opacities=(0.05, 0.6))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300, directions=_axis_parallel(rng, 300)))


@stress_case(
    15, "axis-parallel rays on box planes", "0 · ∞ is NaN in the box test: boxes that a ray touches are missed"
)
def _on_planes(rng: np.random.Generator) -> Stress:
    # A grid whose middle is the origin exactly, so that box planes are at the same floats in world and scene.
    side = np.linspace(-1.0, 1.0, 5)
    positions = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    cloud = _cloud(
        rng,
        125,
        rng.uniform(0.1, 0.3, (125, 3)),
        positions=positions,
        orientations=_unturned(125),
        opacities=(0.05, 0.6),
    )
    count = 900
    planes = np.stack(box_planes(cloud))
    origins = planes[rng.integers(0, 2, (count, 3)), rng.integers(0, 125, (count, 3)), np.arange(3)]
    nudge = rng.integers(-1, 2, (count, 3))
    origins = np.where(nudge < 0, np.nextafter(origins, np.float32(-9.0)), origins)
    origins = np.where(nudge > 0, np.nextafter(origins, np.float32(9.0)), origins)
    d = _axis_parallel(rng, count)
    return Stress(cloud=cloud, rays=(np.where(d != 0.0, -3.0 * d, origins).astype(np.float32), d))


@stress_case(16, "denormal direction components", "1 / 10⁻⁴⁵ overflows to infinity, and 0 · ∞ follows")
def _denormal(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 400, 0.1 * np.exp(rng.normal(0.0, 0.4, (400, 3))), opacities=(0.05, 0.5))
    d = _axis_parallel(rng, 400)
    tiny = np.float32(10.0) ** rng.uniform(-44.0, -9.0, (400, 3)).astype(np.float32)
    d = np.where(d == 0.0, tiny * rng.choice(np.array([-1.0, 1.0], np.float32), (400, 3)), d).astype(np.float32)
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 400, directions=d))


@stress_case(17, "10⁴ coincident Gaussians", "no split separates them: endless recursion, or a stack that overflows")
def _coincident(rng: np.random.Generator) -> Stress:
    cloud = _cloud(
        rng,
        10_000,
        0.1,
        positions=np.zeros((10_000, 3)),
        orientations=_unturned(10_000),
        opacities=np.full(10_000, 1.0 / 250.0),
    )
    rays = aimed_rays(rng, cloud, 30, spread=0.3)
    rays[0][:10] += 1.0  # these miss all
    known = np.full(30, np.nan)
    known[:10] = 1.0
    return Stress(cloud=cloud, rays=rays, known=known, expected={"traced": 10_000})


@stress_case(18, "duplicates on 2⁻ᵏ", "each split halves nothing but space: the tree grows as deep as the series")
def _chain(rng: np.random.Generator) -> Stress:
    place = np.repeat(2.0 ** -np.arange(100.0), 8)
    cloud = _cloud(
        rng, 800, (place * 0.2)[:, None], positions=place[:, None] * np.array([1.0, 0.5, 0.25]), opacities=(0.02, 0.2)
    )
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 200), expected={"traced": 800})


@stress_case(19, "all centres on a line", "boxes of centres with no area: costs of 0 / 0")
def _line(rng: np.random.Generator) -> Stress:
    positions = rng.uniform(-1.0, 1.0, (500, 1)) * np.array([1.0, 0.0, 0.0])
    cloud = _cloud(rng, 500, rng.uniform(0.01, 0.05, (500, 3)), positions=positions)
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 200))


@stress_case(20, "all centres on a plane", "one axis without extent: 0 / 0 in Morton codes")
def _plane(rng: np.random.Generator) -> Stress:
    positions = rng.uniform(-1.0, 1.0, (500, 3)) * np.array([1.0, 1.0, 0.0])
    cloud = _cloud(rng, 500, rng.uniform(0.01, 0.05, (500, 3)), positions=positions)
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 200))


@stress_case(21, "all centres at one point, other shapes", "no extent at all")
def _one_place(rng: np.random.Generator) -> Stress:
    cloud = _cloud(
        rng, 300, rng.uniform(0.01, 0.2, (300, 3)), positions=np.tile([3.0, 1.0, 2.0], (300, 1)), opacities=(0.01, 0.05)
    )
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 200))


@stress_case(22, "opacity 0, 1/255, just above, 1", "log 0, a radius of 0, 1 / (1 - α)")
def _opacities(rng: np.random.Generator) -> Stress:
    cut = np.float32(1.0 / 255.0)
    levels = np.array([0.0, cut, np.nextafter(cut, np.float32(1.0)), 1.001 * cut, 0.99, 1.0], np.float32)
    cloud = _cloud(rng, 600, 0.05, opacities=np.repeat(levels, 100))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 400, spread=0.5), expected={"dropped": 200, "traced": 400})


@stress_case(23, "broken rows", "one NaN centre makes every bound, and so every ray, NaN")
def _broken(rng: np.random.Generator) -> Stress:
    good = _cloud(rng, 500, 0.05 * np.exp(rng.normal(0.0, 0.4, (500, 3))))
    arrays: dict[str, Any] = {name: np.repeat(array, 2, axis=0) for name, array in good.arrays().items()}
    for row, (name, value) in enumerate(
        (name, value) for name in arrays for value in (np.nan, np.inf, -np.inf) for _ in range(5)
    ):
        arrays[name].reshape(1000, -1)[2 * row, -1] = value
    arrays["scales"][300:320:2, 1] = -0.1
    arrays["orientations"][400:420:2] = 0.0
    cloud, left_out = GaussianCloud.leaving_out_invalid(**arrays)
    return Stress(
        cloud=cloud,
        rays=aimed_rays(rng, cloud, 300),
        left_out=left_out,
        expected={"traced": 920, "not_finite": 0},
        expected_left_out=(60, 10, 10),
    )


@stress_case(24, "rays that start inside, peak in front", "half of a Gaussian counts, or all of it, or none")
def _inside_peak(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 300, rng.uniform(0.1, 0.4, (300, 3)), opacities=(0.02, 0.3))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 300, distance=(-0.1, 0.1)))


@stress_case(25, "rays that start inside, entry in front", "the same; the rule of 3DGRT")
def _inside_entry(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 300, rng.uniform(0.1, 0.4, (300, 3)), opacities=(0.02, 0.3))
    return Stress(
        cloud=cloud, rays=aimed_rays(rng, cloud, 300, distance=(-0.1, 0.6)), options=TraceOptions(front="entry")
    )


@stress_case(26, "offset 0", "a ray that starts in a centre meets its own Gaussian, or not, by chance")
def _no_offset(rng: np.random.Generator) -> Stress:
    side = (np.arange(20) - 9.5) * 0.05
    positions = np.stack(np.meshgrid(side, side, [0.0], indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    cloud = _cloud(
        rng,
        400,
        (0.0325, 0.0325, 0.00325),
        positions=positions,
        orientations=_unturned(400),
        opacities=np.full(400, 0.95),
    )
    up = rng.normal(size=(400, 3))
    up[:, 2] = np.abs(up[:, 2])
    normals = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (400, 1))
    return Stress(cloud=cloud, rays=(positions, _unit(up)), occlusion_points=(positions, normals))


@stress_case(26, "offset 0, culled by normal", "the layer that a ray starts from hides it from the light")
def _culled(rng: np.random.Generator) -> Stress:
    stress = _no_offset(rng)
    assert stress.occlusion_points is not None
    cloud = stress.cloud.with_arrays(normals=stress.occlusion_points[1])
    return replace(stress, cloud=cloud, options=TraceOptions(cull=True), known=np.ones(400))


@stress_case(27, "σ from 10⁻⁵ to 10² in one scene", "one grid, one offset or one epsilon for all of them")
def _ratios(rng: np.random.Generator) -> Stress:
    scales = 10.0 ** rng.uniform(-4.6, 2.0, (800, 1)) * rng.uniform(0.5, 1.0, (800, 3))
    opacities = np.where(scales.max(axis=1) > 0.3, 0.01, rng.uniform(0.1, 1.0, 800))
    cloud = _cloud(rng, 800, scales, opacities=opacities)
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud.select(np.flatnonzero(opacities > 0.01)), 300))


@stress_case(28, "t_max cuts through Gaussians", "boxes in reach whose peak is not")
def _reach(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 400, rng.uniform(0.05, 0.3, (400, 3)), opacities=(0.02, 0.3))
    rays = aimed_rays(rng, cloud, 400, distance=(0.5, 0.5))
    t_max = 0.5 + 0.1 * rng.normal(size=400)
    t_max[:20], t_max[20:40] = 0.0, np.inf
    known = np.full(400, np.nan)
    known[:20] = 1.0
    return Stress(cloud=cloud, rays=rays, t_max=np.maximum(t_max, 0.0).astype(np.float32), known=known)


@stress_case(29, "forth and back", "front-to-back shortcuts that depend on the direction")
def _symmetry(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 500, 0.06 * np.exp(rng.normal(0.0, 0.4, (500, 3))), opacities=(0.05, 0.6))
    # On a grid of 2^-10, with axis-parallel directions, the reversed ray lies on the same line to the last bit.
    d = _axis_parallel(rng, 200)
    origins = (np.round(rng.uniform(-1.0, 1.0, (200, 3)) * 1024.0) / 1024.0).astype(np.float32)
    start, end = np.where(d != 0.0, -4.0 * d, origins), np.where(d != 0.0, 4.0 * d, origins)
    forth = visibility_reference(cloud, start, d)
    return Stress(
        cloud=cloud,
        rays=(np.concatenate([start, end]).astype(np.float32), np.concatenate([d, -d])),
        known=np.tile(forth, 2),
    )


@stress_case(30, "one Gaussian", "a tree without an inner node")
def _one(rng: np.random.Generator) -> Stress:
    cloud = _cloud(
        rng,
        1,
        [0.1, 0.2, 0.3],
        positions=np.array([[1.0, 2.0, 3.0]]),
        orientations=_unturned(1),
        opacities=np.array([0.7]),
    )
    z = np.linspace(-1.2, 1.2, 49)
    origins = np.stack([np.zeros(49), np.full(49, 2.0), 3.0 + z], axis=1).astype(np.float32)
    offset = origins[:, 2].astype(np.float64) - 3.0
    alpha = float(cloud.opacities[0]) * np.exp(-0.5 * np.square(offset / float(cloud.scales[0, 2])))
    return Stress(
        cloud=cloud,
        rays=(origins, np.tile(np.array([1.0, 0.0, 0.0], np.float32), (49, 1))),
        known=np.where(alpha >= 1.0 / 255.0, 1.0 - alpha, 1.0),
        expected={"traced": 1},
    )


@stress_case(31, "no Gaussian", "an empty array, a box of infinities")
def _none(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 1, 0.1).select(np.arange(0))
    return Stress(
        cloud=cloud,
        rays=(rng.normal(size=(50, 3)).astype(np.float32), _unit(rng.normal(size=(50, 3)))),
        known=np.ones(50),
        expected={"traced": 0},
        occlusion_points=(np.zeros((3, 3), np.float32), np.tile(np.array([0.0, 0.0, 1.0], np.float32), (3, 1))),
    )


@stress_case(32, "none that can be seen", "a tree over nothing")
def _invisible(rng: np.random.Generator) -> Stress:
    cloud = _cloud(rng, 100, 0.1, opacities=np.full(100, 1.0 / 300.0))
    return Stress(
        cloud=cloud, rays=aimed_rays(rng, cloud, 50), known=np.ones(50), expected={"traced": 0, "dropped": 100}
    )


@stress_case(33, "no rays", "a launch of size 0")
def _no_rays(rng: np.random.Generator) -> Stress:
    nothing = np.zeros((0, 3), np.float32)
    return Stress(cloud=_cloud(rng, 10, 0.1), rays=(nothing, nothing))


@stress_case(34, "2 million Gaussians", "indices of 16 bits, stacks of 32, quadratic builds", large=True)
def _two_million(rng: np.random.Generator) -> Stress:
    count = 2_000_000
    direction = _unit(rng.normal(size=(count, 3)))
    positions = direction * (1.0 + 0.01 * rng.normal(size=(count, 1)))
    scales = 0.001 * np.exp(rng.normal(0.0, 0.3, (count, 3)))
    cloud = _cloud(rng, count, scales, positions=positions, opacities=(0.02, 0.6))
    return Stress(cloud=cloud, rays=aimed_rays(rng, cloud, 192, distance=(0.05, 1.5)), expected={"traced": count})
