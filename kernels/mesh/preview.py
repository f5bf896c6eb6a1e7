"""A quick picture of a mesh: rays to the closest triangle, a light at the camera and a little from above."""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.mesh.depth_pixels import DepthCamera, pixel_ray

wp.set_module_options({"enable_backward": False})

RAYS = wp.constant(2)
"""Rays along each side of a pixel."""

SKY = wp.constant(0.25)
"""Share of the light that comes from above; the rest comes from the camera."""


@wp.kernel
def shade_mesh_kernel(
    first: int,
    mesh: wp.uint64,
    normals: wp.array[wp.vec3],
    colors: wp.array[wp.vec3],
    camera: DepthCamera,
    background: wp.vec3,
    out_colors: wp.array[wp.vec3],
):
    """``colors`` of the vertices are linear; back sides are dark red, so that holes and flipped faces are seen."""
    pixel = first + wp.tid()
    x = float(pixel % camera.width)
    y = float(pixel / camera.width)
    turned = wp.transpose(camera.rotation)
    origin = -(turned * camera.translation)
    total = wp.vec3(0.0, 0.0, 0.0)
    for ray in range(RAYS * RAYS):
        dx = (float(ray % RAYS) + 0.5) / float(RAYS)
        dy = (float(ray / RAYS) + 0.5) / float(RAYS)
        direction = wp.normalize(turned * pixel_ray(camera, x + dx, y + dy))
        query = wp.mesh_query_ray(mesh, origin, direction, LARGEST_FLOAT)
        shade = background
        if query.result:
            i = wp.mesh_get_index(mesh, 3 * query.face)
            j = wp.mesh_get_index(mesh, 3 * query.face + 1)
            k = wp.mesh_get_index(mesh, 3 * query.face + 2)
            w = 1.0 - query.u - query.v
            normal = wp.normalize(normals[i] * query.u + normals[j] * query.v + normals[k] * w)
            light = (1.0 - SKY) * wp.max(-wp.dot(normal, direction), 0.0) + SKY * (0.5 + 0.5 * normal[2])
            if query.sign > 0.0:
                shade = (colors[i] * query.u + colors[j] * query.v + colors[k] * w) * light
            else:
                shade = wp.vec3(0.15, 0.02, 0.02)
        total += shade
    out_colors[pixel] = total / float(RAYS * RAYS)


def launch_shade_mesh(mesh, normals, colors, camera, background, out_colors, device):
    """Write the linear colour of every pixel."""
    inputs = [mesh, normals, colors, camera, background]
    launch(shade_mesh_kernel, len(out_colors), inputs=inputs, outputs=[out_colors], device=device, block_dim=64)
