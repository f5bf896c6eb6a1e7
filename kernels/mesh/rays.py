"""Distances along rays to a triangle mesh."""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})

RAY_CHUNK = 256
"""Fewest rays of one launch on the CPU: each walks a tree."""


@wp.kernel
def cast_rays_kernel(
    first: int,
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    out_distances: wp.array[float],
):
    """Distance to the closest triangle; negative for a ray that meets none."""
    index = first + wp.tid()
    query = wp.mesh_query_ray(mesh, origins[index], directions[index], LARGEST_FLOAT)
    if query.result:
        out_distances[index] = query.t
    else:
        out_distances[index] = -1.0


def launch_cast_rays(mesh, origins, directions, out_distances):
    """Find how far every ray goes."""
    inputs = [mesh, origins, directions]
    outputs = [out_distances]
    launch(cast_rays_kernel, len(origins), inputs=inputs, outputs=outputs, device=origins.device, min_chunk=RAY_CHUNK)
