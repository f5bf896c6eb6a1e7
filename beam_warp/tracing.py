"""How much light passes along rays through Gaussians."""

from __future__ import annotations

import math
from typing import Any

import warp as wp

from beam_warp.checks import require_number, require_same_length
from beam_warp.devices import download_like, upload_vectors
from beam_warp.kernels.constants import LARGEST_FLOAT
from beam_warp.kernels.trace import launch_trace_visibility
from beam_warp.scene import Scene


def visibility(scene: Scene, origins: Any, directions: Any, *, t_max: float = math.inf) -> Any:
    """Return the transmittance along each ray.

    V = product of (1 - alpha_i), alpha_i = min(0.99, o_i G_i(x*)), over the Gaussians whose maximum response on the
    ray, at x*, lies in front of the origin and nearer than ``t_max``, and whose alpha there is at least 1/255.
    Traversal stops below 1e-4, so V is over-estimated by less than that.

    Args:
        scene: Occluders; the work runs on its device.
        origins: World-space ray origins [m], ``(N, 3)`` float32, NumPy or a warp array of vec3 on the scene's device.
        directions: Unit directions, like ``origins``.
        t_max: Reach of the rays [m].

    Returns:
        ``(N,)`` float32 in [0, 1], 1 is clear; NumPy, or a warp array if one came in.

    Raises:
        InvalidArrayError: A shape, type, non-finite or non-unit value breaks the contract above.
        InvalidOptionError: ``t_max`` is negative or NaN.

    Source: BEAM Eq. 7; Moenne-Loccoz et al. 2024 (3DGRT) for the response and its cap.
    """
    reach = min(require_number("t_max", t_max, low=0.0), LARGEST_FLOAT)
    starts = upload_vectors("origins", origins, scene.device)
    ways = upload_vectors("directions", directions, scene.device, unit_length=True)
    require_same_length("directions", ways, "origins", len(starts))
    if scene.bvh is None:
        return download_like(wp.ones(len(starts), dtype=float, device=scene.device), origins, directions)
    result = wp.empty(len(starts), dtype=float, device=scene.device)
    launch_trace_visibility(
        scene.bvh.id, scene.gaussians, scene.device_origin, starts, ways, reach, result, scene.device
    )
    return download_like(result, origins, directions)
