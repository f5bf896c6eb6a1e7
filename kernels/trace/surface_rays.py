"""Rays that start at surface points: how far off the surface, and where each lies in a batch of rays."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch
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
    rows: wp.array[int]  # of the caller's arrays: where results go, and what random streams belong to
    base: wp.vec3  # subtracted from the positions
    sample_count: int


@wp.func
def ray_origin(batch: RayBatch, place: int) -> wp.vec3:
    """Relative to ``batch.base``, subtracted first: far from the world's origin the offset would be rounded away."""
    return batch.positions[place] - batch.base + batch.normals[place] * batch.offsets[place]


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
