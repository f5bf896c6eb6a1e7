"""How much light passes along rays through Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp

from beam_warp.checks import require_array, require_choice, require_count, require_number, require_same_length
from beam_warp.device.arrays import download_like, require_rows, upload, upload_vectors
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.common.constants import LARGEST_FLOAT, TRANSMITTANCE_STOP
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.visibility import Rays, launch_block_rays, launch_trace_rays, launch_trace_rays_wide
from beam_warp.trace.scene import Scene

ACCEPTANCES = ("product", "bernoulli")
FRONTS = ("peak", "entry")


@dataclass(frozen=True)
class TraceOptions:
    """What counts as a hit, and how hits add up.

    Attributes:
        acceptance: ``"product"``: V is the product of the transmittances. ``"bernoulli"``: every hit blocks the ray
            with probability alpha, so that V is 0 or 1 with the right mean; faster, for means over many rays.
        front: ``"peak"``: a Gaussian counts if its largest response lies in front of the ray's origin. ``"entry"``:
            if the origin lies outside its support, as in 3DGRT.
        cull: Leave out Gaussians whose normal points along the ray (n.d > 0): they face away, like the layer that the
            ray starts from. The cloud must have normals.
        stop: Traversal ends below this transmittance; V is over-estimated by less. 0 never stops early.

    Raises:
        InvalidOptionError: A value is none of its choices or out of range.
    """

    acceptance: Literal["product", "bernoulli"] = "product"
    front: Literal["peak", "entry"] = "peak"
    cull: bool = False
    stop: float = TRANSMITTANCE_STOP

    def __post_init__(self) -> None:
        """Check every option once."""
        require_choice("acceptance", self.acceptance, ACCEPTANCES)
        require_choice("front", self.front, FRONTS)
        require_number("stop", self.stop, 0.0, 1.0)

    def settings(self, scene: Scene) -> TraceSettings:
        """Return the options as kernels take them.

        Raises:
            InvalidOptionError: Culling is asked of a scene without normals.
        """
        if self.cull and not scene.has_normals:
            raise InvalidOptionError(
                "cull must be False for a scene without normals, got True. Give the cloud normals (estimate_normals)."
            )
        settings = TraceSettings()
        settings.bernoulli = int(self.acceptance == "bernoulli")
        settings.entry_in_front = int(self.front == "entry")
        settings.cull = int(self.cull)
        settings.stop = self.stop
        return settings


EXACT = TraceOptions()
"""Products, peaks in front, stopped below 1e-4: what everything uses unless told otherwise."""

FACING = TraceOptions(cull=True)
"""The same among Gaussians that face the ray: for rays that start within the layer of a surface that is closed."""


def visibility(
    scene: Scene, origins: Any, directions: Any, *, t_max: Any = math.inf, options: TraceOptions = EXACT, seed: int = 0
) -> Any:
    """Return the transmittance along each ray.

    V = product of (1 - alpha_i), alpha_i = min(0.99, o_i G_i(x*)), over the Gaussians whose maximum response on the
    ray, at x*, lies in front of the origin and nearer than ``t_max``, and whose alpha there is at least 1/255.

    Args:
        scene: Occluders; the work runs on its device.
        origins: World-space ray origins [m], ``(N, 3)`` float32, NumPy or a warp array of vec3 on the scene's device.
        directions: Unit directions, like ``origins``.
        t_max: Reach of the rays [m], one number or ``(N,)``: the distance to a local light.
        options: What counts as a hit, how hits add up, and when to stop.
        seed: For Bernoulli acceptance; same seed, same device, same bits.

    Returns:
        ``(N,)`` float32 in [0, 1], 1 is clear; NumPy, or a warp array if one came in.

    Raises:
        InvalidArrayError: A shape, type, non-finite or non-unit value breaks the contract above.
        InvalidOptionError: ``t_max`` is negative or NaN, or an option does not suit the scene.

    Source: BEAM Eq. 7; Moenne-Loccoz et al. 2024 (3DGRT) for the response and its cap.
    """
    rays = Rays()
    rays.origins = upload_vectors("origins", origins, scene.device)
    rays.directions = upload_vectors("directions", directions, scene.device, unit_length=True)
    require_same_length("directions", rays.directions, "origins", len(rays.origins))
    rays.reaches = ray_reaches(t_max, len(rays.origins), scene.device)
    rays.base = scene.occluders.origin
    rays.stream = require_count("seed", seed, 0, 2**32 - 1)
    result = wp.empty(len(rays.origins), dtype=float, device=scene.device)
    trace_rays(scene, options, rays, result)
    return download_like(result, origins, directions)


def trace_rays(scene: Scene, options: TraceOptions, rays: Rays, out_visibility: wp.array) -> None:
    """Trace rays that are on the scene's device already, by the fastest way that their rules allow.

    Where triangles block rays, ``rays`` gets reaches of its own.
    """
    settings = options.settings(scene)
    if options.front != "peak" or options.cull or scene.response_degree != 2:
        launch_trace_rays(len(rays.origins), scene.occluders, settings, rays, out_visibility, scene.device)
        return
    if scene.mesh is not None:
        reaches = wp.empty(len(rays.origins), dtype=float, device=scene.device)
        launch_block_rays(len(rays.origins), scene.occluders.mesh, rays, reaches, scene.device)
        rays.reaches = reaches
    launch_trace_rays_wide(scene.occluders.tree, settings, rays, out_visibility, scene.device)


def ray_reaches(t_max: Any, count: int, device: Any) -> wp.array:
    """Return ``t_max`` on the device, one number or one a ray; infinity becomes the largest float."""
    if isinstance(t_max, wp.array):
        require_same_length("t_max", require_rows("t_max", t_max, wp.float32, device), "origins", count)
        return t_max
    if np.ndim(t_max) == 0:
        return wp.full(1, min(require_number("t_max", t_max, low=0.0), LARGEST_FLOAT), dtype=float, device=device)
    array = require_array("t_max", t_max, (None,))
    require_same_length("t_max", array, "origins", count)
    if not (array >= 0.0).all():
        row = int(np.flatnonzero(~(array >= 0.0))[0])
        raise InvalidArrayError(
            f"t_max must be at least 0, got {array[row]} at row {row}. Give distances along the rays."
        )
    return upload(np.minimum(array, np.float32(LARGEST_FLOAT)), float, device)
