"""Kernels of baking beside the rasteriser: residuals of pixels, pulls towards other values, sums over views."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def weigh_pixels_kernel(
    first: int, drawn: wp.array2d[float], weights: wp.array2d[float], out_pixels: wp.array2d[float]
):
    """Columns that are drawn beyond those of the weights count nothing."""
    item = first + wp.tid()
    row = item / drawn.shape[1]
    c = item % drawn.shape[1]
    value = float(0.0)
    if c < weights.shape[1]:
        value = weights[row, c] * drawn[row, c]
    out_pixels[row, c] = value


@wp.kernel
def weigh_residuals_kernel(
    first: int,
    drawn: wp.array2d[float],
    targets: wp.array2d[float],
    weights: wp.array2d[float],
    out_pixels: wp.array2d[float],
):
    """Masked targets may hold any value; columns beyond those of the weights count nothing."""
    item = first + wp.tid()
    row = item / drawn.shape[1]
    c = item % drawn.shape[1]
    value = float(0.0)
    if c < weights.shape[1]:
        weight = weights[row, c]
        if weight > 0.0:
            value = weight * (drawn[row, c] - targets[row, c])
    out_pixels[row, c] = value


@wp.kernel
def add_pull_kernel(
    first: int,
    values: wp.array2d[float],
    anchors: wp.array2d[float],
    strength: wp.array2d[float],
    scale: float,
    out_sums: wp.array2d[float],
):
    """Add scale times strength times (values - anchors); no anchors are anchors of 0."""
    item = first + wp.tid()
    row = item / values.shape[1]
    c = item % values.shape[1]
    value = values[row, c]
    if anchors:
        value -= anchors[row, c]
    out_sums[row, c] += scale * strength[row, c] * value


@wp.kernel
def add_rows_kernel(first: int, rows: wp.array2d[float], out_sums: wp.array2d[float]):
    item = first + wp.tid()
    row = item / rows.shape[1]
    c = item % rows.shape[1]
    out_sums[row, c] += rows[row, c]


@wp.kernel
def clamp_rows_kernel(first: int, low: float, high: float, out_rows: wp.array2d[float]):
    item = first + wp.tid()
    row = item / out_rows.shape[1]
    c = item % out_rows.shape[1]
    out_rows[row, c] = wp.clamp(out_rows[row, c], low, high)


def launch_weigh_pixels(drawn: Any, weights: Any, out_pixels: Any, device: Any) -> None:
    """Multiply images by weights."""
    launch(weigh_pixels_kernel, drawn.size, inputs=[drawn, weights], outputs=[out_pixels], device=device)


def launch_weigh_residuals(drawn: Any, targets: Any, weights: Any, out_pixels: Any, device: Any) -> None:
    """Multiply the differences of images and their targets by weights."""
    launch(weigh_residuals_kernel, drawn.size, inputs=[drawn, targets, weights], outputs=[out_pixels], device=device)


def launch_add_pull(values: Any, anchors: Any, strength: Any, scale: float, out_sums: Any, device: Any) -> None:
    """Add the gradient of half of strength times the squared distance from the anchors."""
    launch(add_pull_kernel, values.size, inputs=[values, anchors, strength, scale], outputs=[out_sums], device=device)


def launch_add_rows(rows: Any, out_sums: Any, device: Any) -> None:
    """Add rows to sums."""
    launch(add_rows_kernel, rows.size, inputs=[rows], outputs=[out_sums], device=device)


def launch_clamp_rows(low: float, high: float, out_rows: Any, device: Any) -> None:
    """Cut rows to bounds."""
    launch(clamp_rows_kernel, out_rows.size, inputs=[low, high], outputs=[out_rows], device=device)
