"""What rays see first: depth, normal, materials and the light that is left, at the exact intersections."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp

from beam_warp.checks import require_array, require_finite, require_number, require_same_length
from beam_warp.device.arrays import download_like, upload, upload_vectors, zero_struct
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.trace.closest_surface import SurfaceRecords, launch_trace_surface
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import TraceOptions, ray_reaches

FRONT_TO_BACK = TraceOptions(stop=1e-3)
"""Blending ends where less than a thousandth of the light is left (3DGRT): nothing in eight bits."""


@dataclass(frozen=True)
class SurfaceHits:
    """What rays see, one row each; NumPy, or warp arrays if one came in.

    Attributes:
        depth: Distance [m] at which transmittance falls below the threshold, at a triangle at the latest; infinity
            where it does not. ``(N,)`` float32.
        expected_depth: Mean distance of the hit Gaussians by their blending weights [m]; infinity without hits.
        normals: Blended normals of the Gaussians' ellipsoids where the ray enters them, unit length, ``(N, 3)``;
            zero without hits.
        attributes: Blended per-Gaussian attributes, divided by the opacity met, ``(N, C)``; zero without hits.
        transmittance: What the Gaussians let pass, up to the triangle if there is one, ``(N,)``.
        gaussians: Row in the cloud of the Gaussian at ``depth``, -1 for none or for a triangle, ``(N,)`` int32.
        hit_counts: Gaussians blended, ``(N,)`` int32.
        mesh_depth: Distance of the first triangle [m], infinity for none, ``(N,)``.
        mesh_faces: Its number, -1 for none, ``(N,)`` int32.
    """

    depth: Any
    expected_depth: Any
    normals: Any
    attributes: Any
    transmittance: Any
    gaussians: Any
    hit_counts: Any
    mesh_depth: Any
    mesh_faces: Any


def closest_surface(
    scene: Scene,
    origins: Any,
    directions: Any,
    *,
    attributes: Any = None,
    t_max: Any = math.inf,
    threshold: float = 0.5,
    options: TraceOptions = FRONT_TO_BACK,
) -> SurfaceHits:
    """Trace rays front to back and return what they see.

    Hits are blended in the order of their largest response on the ray, each with weight alpha times the transmittance
    before it. Coincident Gaussians are ordered by row.

    Args:
        scene: Gaussians, and triangles if it has any; the work runs on its device.
        origins: World-space ray origins [m], ``(N, 3)`` float32, NumPy or a warp array of vec3 on the scene's device.
        directions: Unit directions, like ``origins``.
        attributes: Values to blend, one row a Gaussian of the cloud, ``(M, C)`` float32; None for none.
        t_max: Reach of the rays [m], one number or ``(N,)``.
        threshold: Transmittance below which a surface is taken to be met, at least ``options.stop``: 0.5 is the
            median depth.
        options: What counts as a hit, and the transmittance at which blending ends.

    Raises:
        InvalidArrayError: A shape, type, non-finite or non-unit value breaks the contract above.
        InvalidOptionError: An option is out of range or does not suit the scene; acceptance must be ``"product"``.

    Source: Moenne-Loccoz et al. 2024 (3DGRT) for rounds of a k-buffer; the normal is the ellipsoid's, R S^-1 y.
    """
    if options.acceptance != "product":
        raise InvalidOptionError(
            f'options.acceptance must be "product" here, got {options.acceptance!r}. Blending needs every hit.'
        )
    if require_number("threshold", threshold, 0.0, 1.0) < options.stop:
        raise InvalidOptionError(
            f"threshold must be at least options.stop, {options.stop:g}, got {threshold:g}. Lower the stop: what lies "
            "behind it is not looked at."
        )
    device = scene.device
    starts = upload_vectors("origins", origins, device)
    ways = upload_vectors("directions", directions, device, unit_length=True)
    require_same_length("directions", ways, "origins", len(starts))
    values = np.zeros((len(scene), 0), np.float32)
    if attributes is not None:
        values = require_array("attributes", attributes, (None, None))
        require_same_length("attributes", values, "the scene", len(scene))
        require_finite("attributes", values)
    count = len(starts)
    records = zero_struct(SurfaceRecords, count, device, allocate=wp.empty)
    records.attributes = wp.empty((count, values.shape[1]), dtype=float, device=device)
    launch_trace_surface(
        len(starts),
        scene.occluders,
        options.settings(scene),
        starts,
        ways,
        ray_reaches(t_max, count, device),
        threshold,
        upload(values, float, device),
        records,
        device,
    )

    seen = {field.name: getattr(records, field.name) for field in fields(SurfaceHits)}
    return SurfaceHits(**{name: download_like(rows, origins, directions) for name, rows in seen.items()})
