"""Scenes on which ray tracers fail, and what this one makes of them.

A case builds Gaussians and rays and says what must be detected. Running it traces the rays and compares each with the
interval that float64 and a count of roundings allow (`beam_warp.trace.reference.visibility_enclosure`): a case has no
tolerance of its own. Where scales are raised or rows left out, the truth is that of what is traced, and the effect of
raising is told apart. The closest surface of the same rays must leave the same light, be finite and in order, and
Bernoulli acceptance must have the same mean.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_choice
from beam_warp.device.arrays import device_label
from beam_warp.stability.suite import CaseOutcome, StabilityCase
from beam_warp.stability.tracing_cases import Stress
from beam_warp.trace.first_surface import closest_surface
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.packing import SMALLEST_RELATIVE_SCALE, SMALLEST_SCALE_RATIO
from beam_warp.trace.reference import FLOAT32_ROUNDOFF, Enclosure, visibility_enclosure, visibility_reference
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import visibility
from beam_warp.world.gaussians import GaussianCloud

HIERARCHIES = ("quality", "fast", "refitted")
"""The tree by either build, and one that was built for other places and refitted."""

SCALE_FOR_ZERO = 1e-7
"""Part of the smallest traced scale that stands for a scale of 0 in the truth of an unraised cloud."""

REFERENCE_TOLERANCE = 1e-12
"""The reference against closed forms: both are float64, of products of up to some hundred factors."""


SURFACE_THRESHOLDS = (0.9, 0.5, 0.1)
"""Transmittances whose depths must be in order along every ray."""

BERNOULLI_SEEDS = 64
"""Samples of each ray; the mean is over all rays of a case."""

FALSE_ALARM = 1e-6
"""Probability that a sound sampler's mean is called wrong, of each case."""


@dataclass(frozen=True, kw_only=True)
class TracingOutcome(CaseOutcome):
    """What one hierarchy on one device made of one case.

    Attributes:
        hierarchy: From `HIERARCHIES`.
        gaussians: Number of Gaussians given, broken rows included.
        rays: Number of rays.
        did: What came out, in words.
        error: Largest difference from float64; a V that is not finite counts as 1.
        bound: Largest difference that rounding and the early stop explain, over the rays.
        typical_bound: Median over the rays of the same.
        raising: Largest change of V by raising scales, in float64; 0 where none was raised.
        detected: What was found in the input, in words.
        done: What was done about it, in words.
    """

    hierarchy: str
    gaussians: int
    rays: int
    did: str
    error: float
    bound: float
    typical_bound: float
    raising: float
    detected: str
    done: str


def run_case(
    case: StabilityCase[Stress], device: str | None = None, *, hierarchies: Sequence[str] = HIERARCHIES
) -> list[TracingOutcome]:
    """Run one case under each hierarchy; they share the float64 truth.

    Args:
        case: From `CASES`.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        hierarchies: From `HIERARCHIES`.
    """
    stress = case.build()
    outcomes: list[TracingOutcome] = []
    truth: ReferenceVisibility | None = None
    for hierarchy in hierarchies:
        start = time.perf_counter()
        scene = scene_under(hierarchy, stress.cloud, device, stress.response_degree)
        result = visibility(scene, *stress.rays, t_max=stress.t_max, options=stress.options)
        truth = truth or ReferenceVisibility.of(stress, scene)
        faults = _faults(stress, scene, result, truth)
        faults += _surface_faults(stress, scene, truth) + _bernoulli_faults(stress, scene, truth)
        did = _range_of("V", result)
        if stress.occlusion_points is not None:
            openness = ambient_occlusion(scene, *stress.occlusion_points, offset=0.0, options=stress.options).visibility
            did += f"; {_range_of('AO', openness)}"
            if not ((openness >= 0.0) & (openness <= 1.0)).all():
                faults.append("ambient occlusion is not finite or outside [0, 1]")
        error = np.abs(result - truth.rays.exact)
        outcomes.append(
            TracingOutcome(
                case=case.name,
                device=device_label(scene.device),
                hierarchy=hierarchy,
                gaussians=len(stress.cloud) + len(stress.left_out),
                rays=len(stress.rays[0]),
                did=did,
                error=float(np.where(np.isfinite(error), error, 1.0).max(initial=0.0)),
                bound=float(truth.rays.width.max(initial=0.0)),
                typical_bound=float(np.median(truth.rays.width)) if len(result) else 0.0,
                raising=truth.raising,
                detected=_detected(stress, scene),
                done=_done(stress, scene, truth.raising),
                faults=tuple(faults),
                seconds=time.perf_counter() - start,
            )
        )
    return outcomes


def scene_under(hierarchy: str, cloud: GaussianCloud, device: str | None, response_degree: Any = 2) -> Scene:
    """Return the scene of a cloud under one of `HIERARCHIES`.

    The refitted tree was built for a scene of the same extent in which every Gaussian was in its neighbour's place.
    """
    require_choice("hierarchy", hierarchy, HIERARCHIES)
    if hierarchy != "refitted":
        return Scene.from_gaussians(cloud, device, build=hierarchy, response_degree=response_degree)  # type: ignore[arg-type]
    seen = np.flatnonzero(cloud.opacities > 1.0 / 255.0)
    positions = cloud.positions.copy()
    positions[seen] = cloud.positions[np.roll(seen, 1)]
    scene = Scene.from_gaussians(cloud.with_arrays(positions=positions), device, response_degree=response_degree)
    scene.move(cloud.positions, cloud.orientations, cloud.scales, tree="refit")
    return scene


@dataclass(frozen=True)
class ReferenceVisibility:
    """What float64 says about the rays of a case.

    Attributes:
        rays: Visibility of what is traced, scales raised, and how far float32 may be off.
        raising: Largest change of V by raising scales; 0 where none was raised.
    """

    rays: Enclosure
    raising: float

    @classmethod
    def of(cls, stress: Stress, scene: Scene) -> ReferenceVisibility:
        """Evaluate the reference on the Gaussians that a scene traces, and on the cloud's own."""
        rules: dict[str, Any] = {
            "t_max": stress.t_max,
            "front": stress.options.front,
            "cull": stress.options.cull,
            "response_degree": stress.response_degree,
        }
        traced = traced_cloud(stress.cloud, scene)
        rays = visibility_enclosure(traced, *stress.rays, stop=stress.options.stop, middle=scene.origin, **rules)
        raising = 0.0
        if scene.report.raised_scales:
            own = _without_zero_scales(stress.cloud, traced)
            unraised = visibility_reference(own, *stress.rays, **rules)
            raising = float(np.abs(unraised - rays.exact).max(initial=0.0))
        return cls(rays, raising)


def traced_cloud(cloud: GaussianCloud, scene: Scene) -> GaussianCloud:
    """Return the cloud as a scene traces it: scales raised by the documented rule, in float32 like the tracer's."""
    seen = cloud.opacities > 1.0 / 255.0
    largest = cloud.scales.max(axis=1, initial=0.0)
    whole = max(scene.extent, float(largest[seen].max(initial=0.0)), 1e-12)
    floor = np.maximum(np.float32(SMALLEST_RELATIVE_SCALE * whole), largest * np.float32(SMALLEST_SCALE_RATIO))
    return cloud.with_arrays(scales=np.maximum(cloud.scales, floor[:, None]))


def _without_zero_scales(cloud: GaussianCloud, traced: GaussianCloud) -> GaussianCloud:
    """Return a cloud with its own scales, but none that the reference would divide by."""
    smallest = traced.scales.min(axis=1, keepdims=True) * np.float32(SCALE_FOR_ZERO)
    return cloud.with_arrays(scales=np.maximum(cloud.scales, smallest))


def _range_of(name: str, values: NDArray[np.float32]) -> str:
    """Return the range of a result in words."""
    if not len(values):
        return "nothing to trace"
    low, high = f"{values.min():.3g}", f"{values.max():.3g}"
    return f"{name} = {low}" if low == high else f"{name} {low} … {high}"


def _faults(stress: Stress, scene: Scene, result: NDArray[np.float32], truth: ReferenceVisibility) -> list[str]:
    """Return what should not be."""
    faults = []
    # Phrased so that NaN fails.
    valid = (result >= 0.0) & (result <= 1.0)
    if not valid.all():
        faults.append(f"{np.count_nonzero(~valid)} rays are not finite or outside [0, 1]")
    within = (result >= truth.rays.low) & (result <= truth.rays.high)
    if not within.all():
        faults.append(f"{np.count_nonzero(~within)} rays differ by more than rounding explains")
    if stress.known is not None:
        told = np.isfinite(stress.known)
        wrong = np.abs(truth.rays.exact - stress.known)[told] > REFERENCE_TOLERANCE
        if wrong.any():
            faults.append(f"{np.count_nonzero(wrong)} rays of the reference contradict what is known")
    for name, count in stress.expected.items():
        if getattr(scene.report, name) != count:
            faults.append(f"{name} must be {count}, got {getattr(scene.report, name)}")
    found = (stress.left_out.not_finite, stress.left_out.negative_scales, stress.left_out.zero_quaternions)
    if found != stress.expected_left_out:
        faults.append(f"rows left out must be {stress.expected_left_out}, got {found}")
    report = scene.report
    if report.traced + report.dropped + report.not_finite != len(stress.cloud):
        faults.append("the report does not account for every Gaussian")
    return faults


def _surface_faults(stress: Stress, scene: Scene, truth: ReferenceVisibility) -> list[str]:
    """Return what should not be about the closest surface of the same rays."""
    hits = [
        closest_surface(
            scene,
            *stress.rays,
            t_max=stress.t_max,
            threshold=threshold,
            options=replace(stress.options, acceptance="product"),
        )
        for threshold in SURFACE_THRESHOLDS
    ]
    hit = hits[0]
    met = hit.hit_counts > 0
    length = np.linalg.norm(hit.normals.astype(np.float64), axis=1)
    checks = {
        "let pass what rounding does not explain": (hit.transmittance >= truth.rays.low)
        & (hit.transmittance <= truth.rays.high),
        "have no finite expected depth in front": ~met
        | ((hit.expected_depth >= 0.0) & np.isfinite(hit.expected_depth)),
        # Opposite normals may cancel; those that do not are divided by their length: a square root and two roundings.
        "have normals that are no directions": (length == 0.0) | (np.abs(length - 1.0) <= 8.0 * FLOAT32_ROUNDOFF),
        "meet their thresholds out of order": np.logical_and.reduce(
            [near.depth <= far.depth for near, far in itertools.pairwise(hits)]
        ),
    }
    return [f"surfaces: {np.count_nonzero(~good)} rays {what}" for what, good in checks.items() if not good.all()]


def _bernoulli_faults(stress: Stress, scene: Scene, truth: ReferenceVisibility) -> list[str]:
    """Return whether the mean of Bernoulli samples misses that of the truth by more than chance and rounding explain.

    Bernstein's inequality for n independent draws b of variance V (1 - V): with probability at least 1 - delta,
    |mean of (b - V)| <= sqrt(2 s L) + L / (3 n), s the mean variance over n, L = ln(2 / delta). It holds for few rays
    and rare hits too, where the mean is far from normal.
    """
    count = BERNOULLI_SEEDS * len(stress.rays[0])
    if not count:
        return []
    options = replace(stress.options, acceptance="bernoulli")
    drawn = np.array(
        [
            visibility(scene, *stress.rays, t_max=stress.t_max, options=options, seed=seed)
            for seed in range(BERNOULLI_SEEDS)
        ]
    )
    if not np.isin(drawn, (0.0, 1.0)).all():
        return ["Bernoulli samples are not 0 or 1"]
    low, high = np.clip(truth.rays.low, 0.0, 1.0), np.clip(truth.rays.high, 0.0, 1.0)
    likely = np.clip(0.5, low, high)  # of the values possible, the one with the largest variance
    chance = np.log(2.0 / FALSE_ALARM)
    allowed = np.sqrt(2.0 * np.mean(likely * (1.0 - likely)) / count * chance) + chance / (3.0 * count)
    if low.mean() - allowed <= drawn.mean() <= high.mean() + allowed:
        return []
    return [f"Bernoulli samples have mean {drawn.mean():.4g}, not {truth.rays.exact.mean():.4g} within {allowed:.2g}"]


def _detected(stress: Stress, scene: Scene) -> str:
    """Say what was found in the input."""
    report = scene.report
    found = [str(stress.left_out)] if len(stress.left_out) else []
    if report.not_finite:
        found.append(f"{report.not_finite:,} unusable on the device")
    if report.dropped:
        found.append(f"{report.dropped:,} invisible")
    if report.raised_scales:
        found.append(f"{report.raised_scales:,} too thin")
    return ", ".join(found) or "nothing"


def _done(stress: Stress, scene: Scene, raising: float) -> str:
    """Say what was done about it."""
    actions = []
    if len(stress.left_out) or scene.report.dropped or scene.report.not_finite:
        actions.append("left out")
    if scene.report.raised_scales:
        actions.append(f"raised (V changes by {raising:.1e} at most)")
    shift = float(np.linalg.norm(scene.origin.astype(np.float64)))
    if shift > 10.0 * max(scene.extent, 1e-30) and shift > 1.0:
        actions.append(f"recentred by {shift:.3g} m")
    return ", ".join(actions) or "nothing"
