"""The finest scale of a Gaussian that a training view can show: the 3D filter of Mip-Splatting."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.pinholes import camera_point, image_point
from beam_warp.kernels.raster.project import RasterView

wp.set_module_options({"enable_backward": False})


@wp.kernel
def write_sampling_limits_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    views: wp.array[RasterView],
    near: float,
    margin: float,
    factor: float,
    out_limits: wp.array[float],
):
    i = first + wp.tid()
    finest = float(wp.inf)
    for v in range(views.shape[0]):
        view = views[v]
        p = camera_point(view, positions[i])
        if p[2] > near:
            pixel = image_point(view, p)
            width = float(view.width)
            height = float(view.height)
            if (
                pixel[0] >= -margin * width
                and pixel[0] <= (1.0 + margin) * width
                and pixel[1] >= -margin * height
                and pixel[1] <= (1.0 + margin) * height
            ):
                finest = wp.min(finest, p[2] / wp.max(view.focal[0], view.focal[1]))
    limit = float(0.0)
    if finest < wp.inf:
        limit = factor * finest
    out_limits[i] = limit


def launch_write_sampling_limits(
    positions: Any, views: Any, near: float, margin: float, factor: float, out_limits: Any, device: Any
) -> None:
    """Write ``factor`` times the size of a pixel at each position [m] in the view that sees it largest; 0 if none does.

    A view sees what is farther than ``near`` [m] and inside its image grown by ``margin`` of its sides.
    """
    inputs = [positions, views, near, margin, factor]
    launch(write_sampling_limits_kernel, len(positions), inputs=inputs, outputs=[out_limits], device=device)
