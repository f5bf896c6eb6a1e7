"""Rays that start at surface points: how far off the surface, and where each lies in a batch of rays."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.common.sampling import stream_of
from beam_warp.kernels.trace.occluders import surface_layer

wp.set_module_options({"enable_backward": False})


@wp.struct
class RayBatch:
    """Surface points, in the order that they are worked through; the ``sample_count`` rays of a point are neighbours.

    Groups of points whose rays of one stratum are neighbours, so that a warp's rays share a direction, were tried: on
    an H200 groups of 32 to 4,096 are 4 to 9 % slower (878 to 915 against 958 Mray/s), on the CPU up to 26 %.
    """

    positions: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    offsets: wp.array[float]
    rows: wp.array[int]  # of the caller's arrays: where results go
    base: wp.vec3  # subtracted from the positions
    sample_count: int
    seed: wp.uint32  # random streams belong to (seed, frame, row)
    frame: wp.uint32


@wp.func
def ray_origin(batch: RayBatch, place: int) -> wp.vec3:
    """Relative to ``batch.base``, subtracted first: far from the world's origin the offset would be rounded away."""
    return batch.positions[place] - batch.base + batch.normals[place] * batch.offsets[place]


@wp.func
def stream_of_place(batch: RayBatch, place: int) -> wp.uint32:
    return stream_of(batch.seed, batch.frame, wp.uint32(batch.rows[place]))


@wp.kernel
def local_surface_kernel(
    first: int, occluders: Any, points: wp.array[wp.vec3], normals: wp.array[wp.vec3], out_surface: wp.array[wp.vec2]
):
    """(height, thickness) of the layer of Gaussians around each point, along its normal."""
    i = first + wp.tid()
    out_surface[i] = surface_layer(occluders, points[i] - occluders.origin, normals[i])


@wp.kernel
def lift_off_surface_kernel(first: int, surface: wp.array[wp.vec2], thicknesses: float, out_offsets: wp.array[float]):
    """Distance from each point to ``thicknesses`` times the layer's thickness above its height."""
    i = first + wp.tid()
    out_offsets[i] = surface[i][0] + thicknesses * surface[i][1]


launch_local_surface = launcher(local_surface_kernel, block_dim=64)
"""Measure the layer of Gaussians around each point."""


launch_lift_off_surface = launcher(lift_off_surface_kernel)
"""Find how far ray origins are moved along the normals."""
