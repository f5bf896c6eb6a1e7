"""Signed distance to the silhouette of a mask, in pixels: how far inside, or outside, every pixel's centre is.

The silhouette crosses the line between two neighbouring centres where the coverage, linear between them, is one half:
with a box filter that is the edge itself to a small part of a pixel. The distance is the one to the nearest crossing,
exact (Felzenszwalb and Huttenlocher 2012: first along one axis, then across it), of those on columns and on rows.
Crossings lie at most a pixel apart, so beside a straight edge at d pixels it is too large by at most
sqrt(d^2 + 1/4) - d.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})

MIN_LINES = 16
"""Fewest rows or columns of one launch on the CPU."""


@wp.func
def is_inside(coverage: float) -> bool:
    return coverage >= 0.5


@wp.func
def crossing(here: float, there: float) -> float:
    """Where the coverage is one half, as a part of the way; below 0 where it is not."""
    part = float(-1.0)
    if is_inside(here) != is_inside(there):
        part = (0.5 - here) / (there - here)
    return part


@wp.kernel
def measure_lines_kernel(first: int, alpha: wp.array2d[float], across: int, limit: float, out_gaps: wp.array2d[float]):
    # Down the line and up again; columns for across = 0, rows for 1.
    line = first + wp.tid()
    length = alpha.shape[across]
    for way in range(2):
        gap = float(limit)
        before = float(0.0)
        for j in range(length):
            y = j
            if way == 1:
                y = length - 1 - j
            x = line
            if across == 1:
                x = y
                y = line
            here = alpha[y, x]
            gap = wp.min(gap + 1.0, limit)
            if j > 0:
                part = crossing(before, here)
                if part >= 0.0:
                    gap = 1.0 - part
            if way == 0:
                out_gaps[y, x] = gap
            else:
                out_gaps[y, x] = wp.min(out_gaps[y, x], gap)
            before = here


@wp.kernel
def measure_pixels_kernel(
    first: int,
    alpha: wp.array2d[float],
    column_gaps: wp.array2d[float],
    row_gaps: wp.array2d[float],
    limit: float,
    first_pixel: int,
    out_distances: wp.array[float],
):
    pixel = first + wp.tid()
    width = alpha.shape[1]
    height = alpha.shape[0]
    x = pixel % width
    y = pixel / width
    best = limit * limit
    for step in range(int(limit) + 1):
        away = float(step * step)
        if away >= best:
            break
        for side in range(2):
            shift = step * (1 - 2 * side)
            if x + shift >= 0 and x + shift < width:
                gap = column_gaps[y, x + shift]
                best = wp.min(best, away + gap * gap)
            if y + shift >= 0 and y + shift < height:
                gap = row_gaps[y + shift, x]
                best = wp.min(best, away + gap * gap)
    distance = wp.sqrt(best)
    if not is_inside(alpha[y, x]):
        distance = -distance
    out_distances[first_pixel + pixel] = distance


def launch_measure_silhouette(
    alpha: Any, limit: float, column_gaps: Any, row_gaps: Any, first_pixel: int, out_distances: Any, device: Any
) -> None:
    """Write the signed distances [pixel] of one mask ``(H, W)``, at most ``limit``, from ``first_pixel`` on.

    ``column_gaps`` and ``row_gaps`` are room for as many floats as the mask has.
    """
    for across, gaps in enumerate((column_gaps, row_gaps)):
        launch(
            measure_lines_kernel,
            alpha.shape[1 - across],
            inputs=[alpha, across, limit],
            outputs=[gaps],
            device=device,
            min_chunk=MIN_LINES,
        )
    inputs = [alpha, column_gaps, row_gaps, limit, first_pixel]
    launch(measure_pixels_kernel, alpha.size, inputs=inputs, outputs=[out_distances], device=device)
