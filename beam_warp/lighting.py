"""How open to light surface points are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import warp as wp

from beam_warp.checks import require_count, require_number, require_same_length
from beam_warp.devices import download_like, upload_vectors
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.ambient_occlusion import (
    launch_local_surface,
    launch_reduce_visibility,
    launch_trace_occlusion,
)
from beam_warp.sampling import Sampler, sample_set
from beam_warp.scene import Scene
from beam_warp.tracing import EXACT, TraceOptions

LIFT_IN_THICKNESSES = 4.0
"""How far ``offset="auto"`` lifts ray origins off the local surface, in standard deviations of its thickness.

On tiled planes, spheres and bowls with and without noise in tilt and height, 3 still shades itself by up to 0.012 and 5
opens bowls of round Gaussians by another 0.007; 4 is the compromise.
"""

RAYS_AT_ONCE = 1 << 20
"""Rays whose results are held at a time, 4 MiB, and after which progress is reported."""

Progress = Callable[[int, int], None]
"""Called with (points done, points in all)."""


@dataclass(frozen=True)
class AmbientOcclusion:
    """How open the hemisphere above each point is.

    Attributes:
        visibility: Cosine-weighted visibility in [0, 1], 1 is open, ``(N,)`` float32.
        standard_error: Standard error of ``visibility``, ``(N,)`` float32; errs on the large side.
    """

    visibility: Any
    standard_error: Any


def ray_offsets(scene: Scene, points: wp.array, normals: wp.array, offset: float | Literal["auto"]) -> wp.array:
    """Return how far along its normal each ray origin is moved [m], ``(N,)`` float32 on the scene's device.

    ``"auto"``: to the mean of the Gaussians' opacity along the normal's line, where the surface is seen, and from
    there `LIFT_IN_THICKNESSES` standard deviations outwards. A number is taken as it is.
    """
    if offset != "auto":
        value = require_number("offset", offset)
        return wp.full(len(points), value, dtype=float, device=scene.device)
    surface = wp.empty(len(points), dtype=wp.vec2, device=scene.device)
    launch_local_surface(scene.occluders, points, normals, surface, scene.device)
    height, thickness = surface.numpy().T
    return wp.array(height + LIFT_IN_THICKNESSES * thickness, dtype=float, device=scene.device)


def ambient_occlusion(
    scene: Scene,
    points: Any,
    normals: Any,
    *,
    sample_count: int = 64,
    offset: float | Literal["auto"] = "auto",
    options: TraceOptions = EXACT,
    seed: int = 0,
    frame: int = 0,
    progress: Progress | None = None,
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
            off it by `LIFT_IN_THICKNESSES` times its thickness. The paper's absolute value is 0.02.
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
    require_count("seed", seed, 0, 2**32 - 1)
    require_count("frame", frame, 0, 2**32 - 1)
    if isinstance(offset, str) and offset != "auto":
        raise InvalidOptionError(f'offset must be a number or "auto", got {offset!r}. Give metres or "auto".')
    at = upload_vectors("points", points, scene.device)
    up = upload_vectors("normals", normals, scene.device, unit_length=True)
    require_same_length("normals", up, "points", len(at))
    mean = wp.ones(len(at), dtype=float, device=scene.device)
    error = wp.zeros(len(at), dtype=float, device=scene.device)
    if len(at):
        settings = options.settings(scene)
        offsets = ray_offsets(scene, at, up, offset)
        step = max(1, RAYS_AT_ONCE // samples.count)
        traced = wp.empty(min(step, len(at)) * samples.count, dtype=float, device=scene.device)
        for start in range(0, len(at), step):
            part = slice(start, min(start + step, len(at)))
            launch_trace_occlusion(
                scene.occluders,
                settings,
                at[part],
                up[part],
                offsets[part],
                seed,
                frame,
                start,
                samples,
                traced,
                scene.device,
            )
            launch_reduce_visibility(traced, samples, mean[part], error[part], scene.device)
            if progress is not None:
                progress(part.stop, len(at))
    return AmbientOcclusion(download_like(mean, points, normals), download_like(error, points, normals))
