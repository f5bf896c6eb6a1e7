"""How the transmittance along rays changes with the Gaussians that they meet, and with the rays."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_array, require_finite, require_same_length
from beam_warp.device.arrays import download_like, members, require_rows, upload, upload_vectors, zero_struct
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.trace.hit_gradients import HitGradients, HitMoments, HitRecords
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.visibility_adjoint import (
    SUM_BLOCK,
    HitTallies,
    RayGradients,
    WeightedRays,
    launch_add_moments,
    launch_count_hits,
    launch_resolve_moments,
    launch_store_hits,
    launch_sum_blocks,
)
from beam_warp.trace.packing import SMALLEST_SCALE_RATIO
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import EXACT, TraceOptions, ray_reaches

HITS_AT_ONCE = 1 << 22
"""Hits held at a time, 33 bytes each: 132 MiB, or one ray's hits if they are more."""


@dataclass(frozen=True)
class VisibilityGradients:
    """Gradients of a weighted sum of visibilities.

    Attributes:
        positions: With respect to the cloud's positions [1/m], ``(N, 3)`` float32.
        orientations: To its quaternions xyzw as given, which tracing normalises: orthogonal to them; ``(N, 4)``.
        scales: To its scales [1/m], ``(N, 3)``; 0 for a scale that the scene had to raise.
        opacities: To its opacities, ``(N,)``.
        origins: With respect to the rays' origins [1/m], ``(R, 3)``.
        directions: To their unit directions, orthogonal to them; ``(R, 3)``.
    """

    positions: Any
    orientations: Any
    scales: Any
    opacities: Any
    origins: Any
    directions: Any


def visibility_gradients(
    scene: Scene, origins: Any, directions: Any, adjoints: Any, *, t_max: Any = math.inf, options: TraceOptions = EXACT
) -> VisibilityGradients:
    """Return the gradients of L = sum over rays of adjoint V, V as `visibility` returns it for the same arguments.

    dV/dalpha_i = -V / (1 - alpha_i) for each hit, and alpha_i = min(0.99, o_i G_i) is differentiated in closed form
    through the point of the ray that is closest to the Gaussian: 0 where it is capped. Which Gaussians count, by the
    cut at 1/255, the front rule, ``t_max``, culling and the stop, is held still; V jumps where that changes, and no
    gradient sees it. Scales are held still where the scene raised them, and so is the floor they were raised to.

    Where a stop above 0 ended a traversal, the gradient is that of the product so far, as V is: Gaussians behind the
    stop get none from that ray. Each dV/dalpha is then wrong by less than stop / 0.01. Pass
    ``TraceOptions(stop=0.0)``, to `visibility` as well, for the exact gradients.

    The bits depend on the device alone, not on the run or the number of threads. Memory besides inputs and outputs is
    8 bytes a ray, 80 bytes a Gaussian and 33 bytes a hit, of which at most `HITS_AT_ONCE` are held, or one ray's.

    Args:
        scene: Occluders; the work runs on its device.
        origins: World-space ray origins [m], ``(R, 3)`` float32, NumPy or a warp array of vec3 on the scene's device.
        directions: Unit directions, like ``origins``.
        adjoints: dL/dV of each ray, ``(R,)`` float32, NumPy or a warp array of float on the scene's device.
        t_max: Reach of the rays [m], one number or ``(R,)``.
        options: As for `visibility`; product acceptance only.

    Returns:
        Gradients; NumPy, or warp arrays if one came in.

    Raises:
        InvalidArrayError: A shape, type, non-finite or non-unit value breaks the contract above.
        InvalidOptionError: Acceptance is Bernoulli, ``t_max`` is negative or NaN, or culling lacks normals.

    Source: closed forms in ``kernels/trace/hit_gradients.py``, derived there.
    """
    device, rays = scene.device, WeightedRays()
    rays.origins = upload_vectors("origins", origins, device)
    rays.directions = upload_vectors("directions", directions, device, unit_length=True)
    require_same_length("directions", rays.directions, "origins", len(rays.origins))
    rays.adjoints = _upload_adjoints(adjoints, len(rays.origins), device)
    rays.reaches = ray_reaches(t_max, len(rays.origins), device)
    if options.acceptance != "product":
        raise InvalidOptionError(
            f"options.acceptance must be 'product' for gradients, got {options.acceptance!r}. A Bernoulli sample of V "
            "is 0 or 1 and has no derivative; the product is what its mean estimates."
        )
    moments, to_rays = _summed_hits(scene, options.settings(scene), rays)
    gradients = members(_resolved(scene, moments)) | members(to_rays)
    inputs = origins, directions, adjoints
    return VisibilityGradients(**{name: download_like(rows, *inputs) for name, rows in gradients.items()})


def _summed_hits(scene: Scene, settings: TraceSettings, rays: WeightedRays) -> tuple[wp.array, RayGradients]:
    """Return the moments of every Gaussian's hits, and the gradients with respect to the rays."""
    device, gaussian_count, ray_count = scene.device, len(scene), len(rays.origins)
    degree = scene.occluders.gaussians.degree
    moments = wp.zeros(gaussian_count, dtype=HitMoments, device=device)
    to_rays, tallies = (zero_struct(structure, ray_count, device) for structure in (RayGradients, HitTallies))
    launch_count_hits(len(rays.origins), scene.occluders, settings, rays, tallies, device)
    for part, hit_count in _parts(tallies.count.numpy()):
        ends = wp.empty(part.stop - part.start, dtype=int, device=device)
        wp.utils.array_scan(tallies.count[part], ends, inclusive=True)
        hits = HitRecords()
        hits.gaussian = wp.empty(2 * hit_count, dtype=int, device=device)  # the sort wants room for as many again
        hits.record = wp.empty(hit_count, dtype=wp.vec4, device=device)
        order = wp.empty(2 * hit_count, dtype=int, device=device)
        some, their_tallies, to_some = (_rows_of(arrays, part) for arrays in (rays, tallies, to_rays))
        launch_store_hits(
            len(some.origins), scene.occluders, settings, some, their_tallies, ends, hits, order, to_some, device
        )
        wp.utils.radix_sort_pairs(hits.gaussian, order, hit_count, end_bit=gaussian_count.bit_length())
        sums = wp.empty(hit_count // SUM_BLOCK, dtype=HitMoments, device=device)
        launch_sum_blocks(len(sums), degree, hits, order, sums, device)
        launch_add_moments(len(moments), degree, hits, order, hit_count, sums, moments, device)
    return moments, to_rays


def _rows_of(arrays: Any, part: slice) -> Any:
    """Return a structure of arrays with some of its rows; an array of one number for all rows stays whole."""
    some = arrays._cls()
    for name, array in members(arrays).items():
        setattr(some, name, array if name == "reaches" and len(array) == 1 else array[part])
    return some


def _resolved(scene: Scene, moments: wp.array) -> HitGradients:
    """Return the gradients with respect to the cloud's arrays."""
    gradients = zero_struct(HitGradients, len(scene), scene.device)
    launch_resolve_moments(
        len(moments),
        scene.occluders.gaussians,
        scene.packed.orientations,
        scene.packed.scales,
        scene.packed.smallest_scale,
        SMALLEST_SCALE_RATIO,
        moments,
        gradients,
        scene.device,
    )
    return gradients


def _upload_adjoints(adjoints: Any, count: int, device: Any) -> wp.array:
    """Return ``adjoints`` on the device; a warp array that is there already passes through unread."""
    if isinstance(adjoints, wp.array):
        require_same_length("adjoints", require_rows("adjoints", adjoints, wp.float32, device), "origins", count)
        return adjoints
    array = require_array("adjoints", adjoints, (None,))
    require_finite("adjoints", array)
    require_same_length("adjoints", array, "origins", count)
    return upload(array, float, device)


def _parts(counts: NDArray[np.int32]) -> Iterator[tuple[slice, int]]:
    """Cut rays into runs of at most `HITS_AT_ONCE` hits, or of one ray; runs without hits are left out."""
    ends = np.cumsum(counts, dtype=np.int64)
    first, done = 0, 0
    while first < len(ends) and done < ends[-1]:
        last = max(first + 1, int(np.searchsorted(ends, done + HITS_AT_ONCE, side="right")))
        if ends[last - 1] > done:
            yield slice(first, last), int(ends[last - 1]) - done
        first, done = last, int(ends[last - 1])
