"""Rays that start at surface points: how far off the surface, in which order, and how many at a time."""

from __future__ import annotations

from typing import Any, Literal

import warp as wp

from beam_warp.checks import require_count, require_number, require_same_length
from beam_warp.device.arrays import upload_vectors
from beam_warp.device.morton import morton_order
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.trace.surface_rays import RayBatch, launch_lift_off_surface, launch_local_surface
from beam_warp.kernels.trace.visibility import Rays
from beam_warp.trace.scene import Scene

LIFT_IN_THICKNESSES = 4.0
"""How far ``offset="auto"`` lifts ray origins off the local surface, in standard deviations of its thickness.

On tiled planes, spheres and bowls with and without noise in tilt and height, 3 still shades itself by up to 0.012 and 5
opens bowls of round Gaussians by another 0.007; 4 is the compromise.
"""

RAYS_AT_ONCE = 1 << 20
"""Rays held at a time, and after which progress is reported: of 28 to 48 bytes each, 28 to 48 MiB."""

RAYS_AT_ONCE_ON_CUDA = 1 << 23
"""The same on a GPU, which wants more work at once: 224 to 384 MiB."""

WEIGHTED_POINTS_AT_ONCE = 1 << 15
"""Points whose 512 block weights are held at a time for the product density: 64 MiB."""

WEIGHTED_POINTS_AT_ONCE_ON_CUDA = 1 << 17
"""The same on a GPU: 256 MiB."""


def checked_points(
    scene: Scene, points: Any, normals: Any, offset: Any, seed: int, frame: int
) -> tuple[wp.array, wp.array]:
    """Check what every estimate at surface points takes, and bring points and normals to the scene's device.

    Raises:
        InvalidArrayError: A shape, type, non-finite or non-unit value breaks the contract of points.
        InvalidOptionError: The offset, the seed or the frame is out of range.
    """
    require_count("seed", seed, 0, 2**32 - 1)
    require_count("frame", frame, 0, 2**32 - 1)
    if isinstance(offset, str) and offset != "auto":
        raise InvalidOptionError(f'offset must be a number or "auto", got {offset!r}. Give metres or "auto".')
    at = upload_vectors("points", points, scene.device)
    up = upload_vectors("normals", normals, scene.device, unit_length=True)
    require_same_length("normals", up, "points", len(at))
    return at, up


def ray_offsets(scene: Scene, points: wp.array, normals: wp.array, offset: float | Literal["auto"]) -> wp.array:
    """Return how far along its normal each ray origin is moved [m], ``(N,)`` float32 on the scene's device.

    ``"auto"``: to the mean of the Gaussians' opacity along the normal's line, where the surface is seen, and from
    there `LIFT_IN_THICKNESSES` standard deviations outwards. A number is taken as it is.
    """
    if offset != "auto":
        value = require_number("offset", offset)
        return wp.full(len(points), value, dtype=float, device=scene.device)
    surface = wp.empty(len(points), dtype=wp.vec2, device=scene.device)
    launch_local_surface(len(points), scene.occluders, points, normals, surface, scene.device)
    offsets = wp.empty(len(points), dtype=float, device=scene.device)
    launch_lift_off_surface(len(surface), surface, LIFT_IN_THICKNESSES, offsets, scene.device)
    return offsets


def ray_batches(
    scene: Scene,
    points: wp.array,
    normals: wp.array,
    offset: float | Literal["auto"] | Any,
    sample_count: int,
    *,
    stream: tuple[int, int] = (0, 0),
    points_at_once: int | None = None,
    chosen: wp.array | None = None,
) -> list[RayBatch]:
    """Return points in Morton order, so many at a time that their rays are at most `RAYS_AT_ONCE`.

    Trained clouds come in random order. Rays of points in Morton order trace 1.03 to 1.15 times faster on a CPU core.
    Results do not depend on the order: random streams belong to the points' rows.

    Args:
        scene: What the rays will be traced through.
        points: World-space points [m], ``(N,)`` vec3 on the scene's device.
        normals: Unit normals, like ``points``.
        offset: As for `ray_offsets`, or an offset for each point.
        sample_count: Rays a point.
        stream: Seed and number of the frame.
        points_at_once: At most so many points a batch.
        chosen: Rows of the points that are asked for, ``(K,)`` int; None takes all.
    """
    at = points if chosen is None else points[chosen].contiguous()
    count, device = len(at), scene.device
    if count == 0:
        return []
    rows = morton_order(at, at, wp.ones(count, dtype=int, device=device))[0][:count]
    rows = rows if chosen is None else chosen[rows].contiguous()
    positions, directions = points[rows].contiguous(), normals[rows].contiguous()
    given: Any = offset
    if isinstance(given, wp.array):
        offsets = given[rows].contiguous()
    else:
        offsets = ray_offsets(scene, positions, directions, given)
    rays_at_once = RAYS_AT_ONCE_ON_CUDA if device.is_cuda else RAYS_AT_ONCE
    step = min(max(1, rays_at_once // sample_count), points_at_once or count)
    batches = []
    for start in range(0, count, step):
        part = slice(start, min(start + step, count))
        batch = RayBatch()
        batch.positions, batch.normals = positions[part], directions[part]
        batch.offsets, batch.rows = offsets[part], rows[part]
        batch.base = scene.occluders.origin
        batch.sample_count = sample_count
        batch.seed, batch.frame = stream
        batches.append(batch)
    return batches


def points_for_weights(device: Any) -> int:
    """Return how many points' block weights a device holds at a time."""
    return WEIGHTED_POINTS_AT_ONCE_ON_CUDA if device.is_cuda else WEIGHTED_POINTS_AT_ONCE


def room_for_rays(batch: RayBatch, device: Any, *, bernoulli: bool, reaches: bool) -> Rays:
    """Return the rays of a batch, to be drawn: unbounded ones, or such that each has a reach of its own.

    Args:
        batch: The points.
        device: Where they are.
        bernoulli: Whether rays need random streams.
        reaches: Whether rays may be left out, by a negative reach.
    """
    count = len(batch.rows) * batch.sample_count
    rays = Rays()
    rays.origins = wp.empty(count, dtype=wp.vec3, device=device)
    rays.directions = wp.empty(count, dtype=wp.vec3, device=device)
    rays.reaches = wp.full(count if reaches else 1, LARGEST_FLOAT, dtype=float, device=device)
    rays.streams = wp.empty(count if bernoulli else 0, dtype=wp.uint32, device=device)
    return rays
