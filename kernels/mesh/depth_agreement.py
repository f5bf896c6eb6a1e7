"""Agreement of the depth images of several views about the points that one of them shows.

Another view confirms a point where it shows a surface at it, within a tolerance; it contradicts it where it looks
through it, at something behind or at nothing; where something is in front of the point, or where the point is outside
the image or at an edge, the view says nothing.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.mesh.depth_pixels import (
    DepthCamera,
    footprint,
    is_background,
    pixel_point,
    project_point,
    sample_pixels,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def compare_depths_kernel(
    first: int,
    view: int,
    cameras: wp.array[DepthCamera],
    pixels: wp.array[wp.vec3],
    tolerance: float,
    out_confirmed: wp.array[int],
    out_contradicted: wp.array[int],
    out_residuals: wp.array[float],
):
    """``tolerance`` in widths of the coarser of the two pixels; residuals [m] are means over confirming views.

    A pixel that does not count itself is confirmed by -1.
    """
    pixel = first + wp.tid()
    own = cameras[view]
    value = pixels[own.first_pixel + pixel]
    confirmed = int(0)
    contradicted = int(0)
    residual = float(0.0)
    if value[2] > 0.0:
        x = float(pixel % own.width) + 0.5
        y = float(pixel / own.width) + 0.5
        point = pixel_point(own, x, y, value[0])
        for i in range(cameras.shape[0]):
            if i != view:
                camera = cameras[i]
                at = project_point(camera, point)
                # Far outside, the place on the image would overflow an integer.
                inside = at[0] >= 0.0 and at[1] >= 0.0 and at[0] < float(camera.width) and at[1] < float(camera.height)
                if at[2] > 0.0 and inside:
                    other = sample_pixels(pixels, camera, at[0], at[1])
                    if other[2] > 0.0:
                        distance = (1.0 / other[0] - at[2]) * other[1]
                        allowed = tolerance * wp.max(footprint(own, value[0]), footprint(camera, other[0]))
                        if wp.abs(distance) <= allowed:
                            confirmed += 1
                            residual += wp.abs(distance)
                        elif distance > allowed:
                            contradicted += 1
                    elif is_background(pixels, camera, at[0], at[1]):
                        contradicted += 1
    if confirmed > 0:
        residual /= float(confirmed)
    if not (value[2] > 0.0):
        confirmed = -1
    out_confirmed[own.first_pixel + pixel] = confirmed
    out_contradicted[own.first_pixel + pixel] = contradicted
    out_residuals[own.first_pixel + pixel] = residual


@wp.kernel
def flag_agreed_kernel(
    first: int, confirmed: wp.array[int], contradicted: wp.array[int], confirmations: int, out_flags: wp.array[int]
):
    pixel = first + wp.tid()
    agreed = confirmed[pixel] >= confirmations and contradicted[pixel] <= confirmed[pixel]
    out_flags[pixel] = wp.where(agreed, 1, 0)


launch_flag_agreed = launcher(flag_agreed_kernel)
"""Flag the pixels that enough views confirm, and no more contradict."""


def launch_compare_depths(view, pixel_count, cameras, pixels, tolerance, confirmed, contradicted, residuals, device):
    """Compare the points of one view with all others."""
    inputs = [view, cameras, pixels, tolerance]
    outputs = [confirmed, contradicted, residuals]
    launch(compare_depths_kernel, pixel_count, inputs=inputs, outputs=outputs, device=device)
