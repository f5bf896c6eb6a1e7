"""Evidence that the pixels of views give on the Gaussians that they show: place, normal and colour of the surface.

Samples of pixels carry sums to be spread back over Gaussians by their blending weights: 0-2 place relative to an
origin, 3-5 normal, 6 weight of both; 7 weight of saturated pixels; 8-10 square of what follows, less what noise makes
it; 11-13 captured colour less the rendered one, 14 its weight. 15 is not used: samples are moved by four numbers at a
time. A photograph shows the mean over a pixel, so that is compared with the mean of a pixel's samples.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.common.spherical_harmonics import captured_radiance, srgb_to_linear
from beam_warp.kernels.raster.project import RasterView

wp.set_module_options({"enable_backward": False})

PIXEL_CHANNELS = 16

LEAST_SURFACE_ALPHA = wp.constant(0.95)
"""Coverage by Gaussians from which on a pixel shows a surface."""

LEAST_COVERAGE = wp.constant(0.99)
"""Coverage in the image from which on its colour is the subject's alone: below are silhouettes."""


@wp.struct
class SurfaceSamples:
    """Radiance, normal, coverage and depth of the samples that a rasteriser drew, one view after the other."""

    colors: wp.array2d[float]  # radiance in columns 0-2, normals in 3-5, sums weighted by visibility
    alpha: wp.array[float]
    depth: wp.array[float]
    display_srgb: int  # whether radiance is display sRGB


@wp.struct
class CapturedPixels:
    """Image of one camera; arrays have length 0 where it has no image, or no coverage."""

    color: wp.array[wp.vec3]  # scene-linear, premultiplied
    coverage: wp.array[float]
    ceiling: float  # value that the image cannot exceed
    noise: float  # variance of a pixel over its value


@wp.func
def rendered_color(view: RasterView, drawn: SurfaceSamples, column: int, row: int, side: int) -> wp.vec4:
    """Mean of a pixel's samples, scene-linear, and of their coverage."""
    total = wp.vec4()
    for j in range(side):
        for i in range(side):
            sample = view.first_pixel + (row * side + j) * view.width + column * side + i
            for c in range(3):
                shown = wp.max(drawn.colors[sample, c], 0.0)
                if drawn.display_srgb == 1:
                    shown = srgb_to_linear(wp.min(shown, 1.0))
                total[c] = total[c] + shown
            total[3] = total[3] + drawn.alpha[sample]
    return total / float(side * side)


@wp.kernel
def write_samples_kernel(
    first: int,
    view: RasterView,
    drawn: SurfaceSamples,
    captured: CapturedPixels,
    side: int,
    origin: wp.vec3,
    out_samples: wp.array2d[float],
):
    """A pixel's samples, ``side`` in each direction, together."""
    pixel = first + wp.tid()
    column = pixel % (view.width / side)
    row = pixel / (view.width / side)
    share = 1.0 / float(side * side)
    rendered = rendered_color(view, drawn, column, row, side)
    says = int(0)
    cut = float(0.0)
    color = wp.vec3()
    if captured.color.shape[0] > 0 and rendered[3] > LEAST_SURFACE_ALPHA:
        says = 1
        if captured.coverage.shape[0] > 0:
            says = wp.where(captured.coverage[pixel] > LEAST_COVERAGE, 1, 0)
        color = captured.color[pixel]
        if says == 1 and wp.max(color[0], wp.max(color[1], color[2])) >= captured.ceiling:
            cut = share
            says = 0
    for j in range(side):
        for i in range(side):
            x = column * side + i
            y = row * side + j
            sample = view.first_pixel + y * view.width + x
            for c in range(16):
                out_samples[sample, c] = 0.0
            if drawn.alpha[sample] > LEAST_SURFACE_ALPHA:
                right = (float(x) + 0.5 - view.center[0]) / view.focal[0]
                down = (float(y) + 0.5 - view.center[1]) / view.focal[1]
                ray = wp.transpose(view.world_to_camera) * wp.vec3(right, down, 1.0)
                place = (view.position - origin) + ray * drawn.depth[sample]
                normal = wp.normalize(
                    wp.vec3(drawn.colors[sample, 3], drawn.colors[sample, 4], drawn.colors[sample, 5])
                )
                for c in range(3):
                    out_samples[sample, c] = share * place[c]
                    out_samples[sample, 3 + c] = share * normal[c]
                out_samples[sample, 6] = share
                out_samples[sample, 7] = cut
                if says == 1:
                    for c in range(3):
                        off = color[c] - rendered[c]
                        out_samples[sample, 8 + c] = share * (off * off - captured.noise * rendered[c])
                        out_samples[sample, 11 + c] = share * off
                    out_samples[sample, 14] = share


@wp.kernel
def add_views_kernel(first: int, rows: wp.array2d[float], view_count: int, columns: int, out_sums: wp.array2d[float]):
    """Add what some views spread back to each Gaussian's sums, view by view."""
    i = first + wp.tid()
    count = out_sums.shape[0]
    for view in range(view_count):
        for c in range(columns):
            out_sums[i, c] = out_sums[i, c] + rows[view * count + i, c]


@wp.kernel
def observe_kernel(
    first: int,
    rows: wp.array2d[float],
    positions: wp.array[wp.vec3],
    radiance: wp.array2d[wp.vec3],
    display_srgb: int,
    views: wp.array[RasterView],
    first_view: int,
    out_colors: wp.array2d[wp.vec4],
    out_directions: wp.array2d[wp.vec3],
):
    """Fitted radiance towards each camera, corrected by what the image shows beside it.

    Pixels are blends of Gaussians: spread back as they are they give blurred colours. A fit has undone the blend, so
    what is spread back is only the difference between image and rendering.
    """
    splat = first + wp.tid()
    count = positions.shape[0]
    i = splat % count
    local = splat / count
    toward = wp.normalize(views[local].position - positions[i])
    weight = rows[splat, 14]
    color = wp.vec3()
    if weight > 0.0:
        color = captured_radiance(radiance, i, -toward, display_srgb)
        color += wp.vec3(rows[splat, 11], rows[splat, 12], rows[splat, 13]) / weight
    out_colors[first_view + local, i] = wp.vec4(color[0], color[1], color[2], weight)
    out_directions[first_view + local, i] = toward


@wp.kernel
def finish_surface_kernel(
    first: int,
    sums: wp.array2d[float],
    positions: wp.array[wp.vec3],
    origin: wp.vec3,
    seen: wp.array[int],
    out_positions: wp.array[wp.vec3],
    out_normals: wp.array[wp.vec3],
    out_agreement: wp.array[float],
):
    """Means of the sums; a Gaussian that is not seen keeps its own place and has no normal."""
    i = first + wp.tid()
    weight = sums[i, 6]
    place = positions[i]
    normal = wp.vec3()
    agreement = float(0.0)
    if seen[i] != 0:
        place = origin + wp.vec3(sums[i, 0], sums[i, 1], sums[i, 2]) / weight
        mean = wp.vec3(sums[i, 3], sums[i, 4], sums[i, 5]) / weight
        agreement = wp.min(wp.length(mean), 1.0)
        normal = wp.normalize(mean)
    out_positions[i] = place
    out_normals[i] = normal
    out_agreement[i] = agreement


launch_write_samples = launcher(write_samples_kernel)
"""Write what one view's pixels say of their samples."""


def launch_add_views(rows, view_count, columns, out_sums, device):
    """Add the first columns of some views' rows to the Gaussians' sums."""
    launch(add_views_kernel, len(out_sums), inputs=[rows, view_count, columns], outputs=[out_sums], device=device)


launch_observe = launcher(observe_kernel)
"""Write what some views show of every Gaussian."""


launch_finish_surface = launcher(finish_surface_kernel)
"""Turn sums into a surface."""
