"""Rays that start at surface points: how far off the surface, and where each lies in a batch of rays."""

from typing import Any

import warp as wp

from beam_warp.kernels.launching import launch
from beam_warp.kernels.occluders import surface_layer

wp.set_module_options({"enable_backward": False})


@wp.struct
class RayBatch:
    """Surface points, in the order that they are worked through, and how the rays that start there are laid out.

    A point has ``sample_count`` slots, one a ray. Of every ``group`` points the rays of slot 0 come first, then those
    of slot 1, and so on: where slots are strata, neighbouring lanes hold rays from neighbouring points in one
    direction. With a group of 1, the rays of a point are neighbours.
    """

    positions: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    offsets: wp.array[float]
    rows: wp.array[int]  # of the caller's arrays: where results go, and what random streams belong to
    base: wp.vec3  # subtracted from the positions
    sample_count: int
    group: int


@wp.func
def rays_of(batch: RayBatch, place: int) -> wp.vec2i:
    """(ray of slot 0, rays from one slot to the next) of the point at a place of the batch."""
    begin = place - place % batch.group
    size = wp.min(batch.group, batch.rows.shape[0] - begin)
    return wp.vec2i(begin * batch.sample_count + place - begin, size)


@wp.func
def ray_origin(batch: RayBatch, place: int) -> wp.vec3:
    """Relative to ``batch.base``, subtracted first: far from the world's origin the offset would be rounded away."""
    return batch.positions[place] - batch.base + batch.normals[place] * batch.offsets[place]


@wp.kernel
def local_surface_kernel(
    first: int,
    occluders: Any,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    out_surface: wp.array[wp.vec2],
):
    """(height, thickness) of the layer of Gaussians around each point, along its normal."""
    i = first + wp.tid()
    out_surface[i] = surface_layer(occluders, points[i] - occluders.origin, normals[i])


@wp.kernel
def lift_off_surface_kernel(first: int, surface: wp.array[wp.vec2], thicknesses: float, out_offsets: wp.array[float]):
    """Distance from each point to ``thicknesses`` times the layer's thickness above its height."""
    i = first + wp.tid()
    out_offsets[i] = surface[i][0] + thicknesses * surface[i][1]


def launch_local_surface(occluders, points, normals, out_surface, device):
    """Measure the layer of Gaussians around each point."""
    launch(
        local_surface_kernel,
        len(points),
        inputs=[occluders, points, normals],
        outputs=[out_surface],
        device=device,
        block_dim=64,
    )


def launch_lift_off_surface(surface, thicknesses, out_offsets, device):
    """Find how far ray origins are moved along the normals."""
    launch(lift_off_surface_kernel, len(surface), inputs=[surface, thicknesses], outputs=[out_offsets], device=device)
