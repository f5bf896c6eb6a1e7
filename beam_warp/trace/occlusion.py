"""How open to light surface points are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import warp as wp

from beam_warp.device.arrays import download_like
from beam_warp.jobs.listeners import CountProgress
from beam_warp.kernels.trace.ambient_occlusion import launch_draw_occlusion, launch_reduce_visibility
from beam_warp.trace.rays import checked_points, ray_batches, room_for_rays
from beam_warp.trace.sampling import Sampler, sample_set
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import EXACT, TraceOptions, trace_rays


@dataclass(frozen=True)
class AmbientOcclusion:
    """How open the hemisphere above each point is.

    Attributes:
        visibility: Cosine-weighted visibility in [0, 1], 1 is open, ``(N,)`` float32.
        standard_error: Standard error of ``visibility``, ``(N,)`` float32; errs on the large side.
    """

    visibility: Any
    standard_error: Any


def ambient_occlusion(
    scene: Scene,
    points: Any,
    normals: Any,
    *,
    sample_count: int = 64,
    offset: float | Literal["auto"] | wp.array = "auto",
    options: TraceOptions = EXACT,
    seed: int = 0,
    frame: int = 0,
    progress: CountProgress | None = None,
    sampler: Sampler = "owen",
) -> AmbientOcclusion:
    """Estimate how open the hemisphere above each surface point is.

    A(x) = 1/pi * integral over the hemisphere of V(x, w) (n.w) dw. Directions are cosine-weighted by a sample set of
    its own for each point, so the estimate is the mean of V.

    Args:
        scene: Occluders; the work runs on its device.
        points: Surface points [m], ``(N, 3)`` float32, NumPy or a warp array of vec3 on the scene's device.
        normals: Unit outward normals, like ``points``.
        sample_count: Rays per point; a power of two gives the full benefit of the sample set and a tighter error.
        offset: Distance [m] from point to ray origin along the normal, or ``"auto"``: onto the local surface and
            off it by `LIFT_IN_THICKNESSES` times its thickness; or a warp array of a distance for each point. The
            paper's absolute value is 0.02.
        options: What counts as a hit, and whether transmittances multiply or are sampled.
        seed: Same seed, same device, same bits.
        frame: Number of the frame; frames have independent noise, the same frame always the same.
        progress: Called now and then with (points done, points in all).
        sampler: Sample sets: ``"owen"`` (Owen-scrambled Sobol'), ``"stratified"`` (a jittered grid, the squarest of
            ``sample_count`` cells; one column of them if that is a prime) or ``"iid"`` (independent).

    Returns:
        Visibility and its standard error; NumPy, or warp arrays if one came in.

    Raises:
        InvalidArrayError: A shape, type, non-finite or non-unit value breaks the contract above.
        InvalidOptionError: An option is out of range.

    Source: BEAM Eq. 6; Owen's sets by hashing, Burley 2020; jittered grids, Cook 1986.
    """
    samples = sample_set(sampler, sample_count)
    at, up = checked_points(scene, points, normals, offset, seed, frame)
    mean = wp.ones(len(at), dtype=float, device=scene.device)
    error = wp.zeros(len(at), dtype=float, device=scene.device)
    is_bernoulli = options.acceptance == "bernoulli"
    done = 0
    for batch in ray_batches(scene, at, up, offset, samples.count, stream=(seed, frame)):
        rays = room_for_rays(batch, scene.device, bernoulli=is_bernoulli, reaches=False)
        launch_draw_occlusion(len(batch.rows) * samples.count, batch, samples, rays, scene.device)
        traced = wp.empty(len(rays.origins), dtype=float, device=scene.device)
        trace_rays(scene, options, rays, traced)
        launch_reduce_visibility(len(batch.rows), batch, samples, traced, mean, error, scene.device)
        done += len(batch.rows)
        if progress is not None:
            progress(done, len(at))
    return AmbientOcclusion(download_like(mean, points, normals), download_like(error, points, normals))
