"""Linear images as a viewer sees them: the sRGB curve, continued above 1, and its slope for the way back.

Errors in the dark are seen more than those in the light; a loss on encoded colours weighs them so.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.launching import launch

wp.set_module_options({"enable_backward": False})

KNEE = wp.constant(0.0031308)


@wp.kernel
def encode_kernel(first: int, linear: wp.array3d[float], out_encoded: wp.array3d[float]):
    item = first + wp.tid()
    y = item / linear.shape[1]
    x = item % linear.shape[1]
    for channel in range(linear.shape[2]):
        value = linear[y, x, channel]
        encoded = 12.92 * value
        if value > KNEE:
            encoded = 1.055 * wp.pow(value, 1.0 / 2.4) - 0.055
        out_encoded[y, x, channel] = encoded


@wp.kernel
def add_linear_gradients_kernel(
    first: int, linear: wp.array3d[float], gradients: wp.array3d[float], out_gradients: wp.array3d[float]
):
    item = first + wp.tid()
    y = item / linear.shape[1]
    x = item % linear.shape[1]
    for channel in range(linear.shape[2]):
        value = linear[y, x, channel]
        slope = float(12.92)
        if value > KNEE:
            slope = (1.055 / 2.4) * wp.pow(value, 1.0 / 2.4 - 1.0)
        out_gradients[y, x, channel] += slope * gradients[y, x, channel]


def launch_encode(linear: Any, out_encoded: Any, device: Any) -> None:
    """Encode every channel of an image ``(H, W, C)``; arrays may be strided."""
    pixels = linear.shape[0] * linear.shape[1]
    launch(encode_kernel, pixels, inputs=[linear], outputs=[out_encoded], device=device)


def launch_add_linear_gradients(linear: Any, gradients: Any, out_gradients: Any, device: Any) -> None:
    """Add the gradients of a linear image, given those of the encoded one."""
    pixels = linear.shape[0] * linear.shape[1]
    launch(add_linear_gradients_kernel, pixels, inputs=[linear, gradients], outputs=[out_gradients], device=device)
