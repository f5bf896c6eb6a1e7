"""Halves of images, the black and the white fields of a chessboard: two fits then see data that they do not share."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def keep_half_kernel(first: int, width: int, field: int, half: int, out_gradients: wp.array2d[float]):
    """Set the gradients of the other half's pixels to 0."""
    pixel = first + wp.tid()
    x = pixel % width
    y = pixel / width
    if (x / field + y / field) % 2 != half:
        for column in range(out_gradients.shape[1]):
            out_gradients[pixel, column] = 0.0


def launch_keep_half(width: int, field: int, half: int, out_gradients: Any, device: Any) -> None:
    """Keep the gradients of one half of an image, rows of a pixel each, whose fields are ``field`` pixels wide."""
    inputs = [width, field, half]
    launch(keep_half_kernel, out_gradients.shape[0], inputs=inputs, outputs=[out_gradients], device=device)
