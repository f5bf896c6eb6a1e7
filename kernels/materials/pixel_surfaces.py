"""The surface points that the pixels of one view show: which pixels have one, and where it is."""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.raster.image_losses import SHORTEST_NORMAL
from beam_warp.kernels.raster.project import RasterView

wp.set_module_options({"enable_backward": False})

LEAST_FACING = wp.constant(1.0e-3)
"""Least cosine between a normal and the way to the camera: normals that lean further back are turned up to it."""


@wp.struct
class PixelSurfaces:
    """Surface points, in the order of the pixels that show them."""

    pixels: wp.array[int]
    positions: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]  # unit, towards the camera
    to_camera: wp.array[wp.vec3]  # unit
    roughness: wp.array[float]


@wp.struct
class SurfaceImages:
    """Images of the surface that a view shows."""

    alpha: wp.array[float]
    depth: wp.array[float]  # along the optical axis
    channels: wp.array2d[float]  # sums of normals (3) and of roughness


@wp.func
def channel_normal(channels: wp.array2d[float], pixel: int) -> wp.vec3:
    return wp.vec3(channels[pixel, 0], channels[pixel, 1], channels[pixel, 2])


@wp.func
def facing_camera(normal: wp.vec3, to_camera: wp.vec3) -> wp.vec3:
    """The normal, turned within the plane of both as far as it takes to face the camera."""
    cosine = wp.dot(normal, to_camera)
    result = normal
    if cosine < LEAST_FACING:
        across = wp.normalize(normal - cosine * to_camera)
        result = wp.sqrt(1.0 - LEAST_FACING * LEAST_FACING) * across + LEAST_FACING * to_camera
    return result


@wp.kernel
def mark_surfaces_kernel(first: int, images: SurfaceImages, least_alpha: float, out_marks: wp.array[int]):
    """1 where a pixel shows a surface; guards are such that NaN fails them."""
    pixel = first + wp.tid()
    depth = images.depth[pixel]
    mark = int(0)
    if images.alpha[pixel] >= least_alpha and depth > 0.0 and depth < wp.inf:
        if wp.length(channel_normal(images.channels, pixel)) > SHORTEST_NORMAL:
            mark = 1
    out_marks[pixel] = mark


@wp.kernel
def gather_surfaces_kernel(
    first: int,
    images: SurfaceImages,
    view: RasterView,
    marks: wp.array[int],
    ends: wp.array[int],
    out_surfaces: PixelSurfaces,
):
    pixel = first + wp.tid()
    if marks[pixel] == 0:
        return
    row = ends[pixel] - 1
    x = (float(pixel % view.width) + 0.5 - view.center[0]) / view.focal[0]
    y = (float(pixel / view.width) + 0.5 - view.center[1]) / view.focal[1]
    ray = wp.transpose(view.world_to_camera) * wp.vec3(x, y, 1.0)
    to_camera = -wp.normalize(ray)
    out_surfaces.pixels[row] = pixel
    out_surfaces.positions[row] = view.position + images.depth[pixel] * ray
    out_surfaces.normals[row] = facing_camera(wp.normalize(channel_normal(images.channels, pixel)), to_camera)
    out_surfaces.to_camera[row] = to_camera
    out_surfaces.roughness[row] = wp.clamp(images.channels[pixel, 3] / images.alpha[pixel], 0.0, 1.0)


@wp.kernel
def scatter_floats_kernel(first: int, pixels: wp.array[int], values: wp.array[float], out_image: wp.array[float]):
    row = first + wp.tid()
    out_image[pixels[row]] = values[row]


@wp.kernel
def scatter_vectors_kernel(first: int, pixels: wp.array[int], values: wp.array[wp.vec3], out_image: wp.array[wp.vec3]):
    row = first + wp.tid()
    out_image[pixels[row]] = values[row]


launch_mark_surfaces = launcher(mark_surfaces_kernel)
"""Find the pixels that show a surface."""


launch_gather_surfaces = launcher(gather_surfaces_kernel)
"""Write the point of every marked pixel to its row; ``ends`` are the inclusive sums of ``marks``."""


def launch_scatter(pixels, values, out_image, device):
    """Write floats or vectors of rows to their pixels."""
    kernel = scatter_vectors_kernel if values.dtype is wp.vec3 else scatter_floats_kernel
    launch(kernel, len(pixels), inputs=[pixels, values], outputs=[out_image], device=device)
