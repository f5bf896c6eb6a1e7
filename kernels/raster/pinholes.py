"""Points of the world in a camera's axes and in its image."""

import warp as wp

from beam_warp.kernels.raster.project import RasterView

wp.set_module_options({"enable_backward": False})


@wp.func
def camera_point(view: RasterView, point: wp.vec3) -> wp.vec3:
    """A point in camera axes [m]: right, down, forward."""
    return view.world_to_camera * (point - view.position)


@wp.func
def image_point(view: RasterView, p: wp.vec3) -> wp.vec2:
    """Pixel coordinates of a point in camera axes, whose depth is positive."""
    return wp.vec2(view.focal[0] * p[0] / p[2] + view.center[0], view.focal[1] * p[1] / p[2] + view.center[1])


@wp.func
def room_around(view: RasterView, pixel: wp.vec2) -> float:
    """Distance of a place to the nearest edge of the image [pixel], negative outside; NaN for NaN."""
    x = wp.min(pixel[0], float(view.width) - pixel[0])
    y = wp.min(pixel[1], float(view.height) - pixel[1])
    return wp.min(x, y)
