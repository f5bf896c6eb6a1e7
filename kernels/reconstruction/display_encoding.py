"""Linear images as a viewer sees them: pixels as means of samples, the sRGB curve, continued above 1, and the way back.

Errors in the dark are seen more than those in the light; a loss on encoded colours weighs them so. A photograph's pixel
is the mean over its area, in linear light: with several samples for each, so is ours.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher

wp.set_module_options({"enable_backward": False})

KNEE = wp.constant(0.0031308)


@wp.func
def mean_sample(samples: wp.array3d[float], y: int, x: int, channel: int, factor: int) -> float:
    total = float(0.0)
    for j in range(factor):
        for i in range(factor):
            total += samples[y * factor + j, x * factor + i, channel]
    return total / float(factor * factor)


@wp.struct
class Behind:
    """What samples lie before; arrays have length 0 where that is nothing."""

    color: wp.array3d[float]  # linear, of each pixel
    alpha: wp.array3d[float]  # of each sample


@wp.func
def behind_pixel(behind: Behind, y: int, x: int, channel: int, factor: int) -> float:
    value = float(0.0)
    if behind.color.shape[0] > 0:
        value = (1.0 - mean_sample(behind.alpha, y, x, 0, factor)) * behind.color[y, x, channel]
    return value


@wp.kernel
def average_kernel(
    first: int, samples: wp.array3d[float], factor: int, is_color: bool, behind: Behind, out_means: wp.array3d[float]
):
    item = first + wp.tid()
    y = item / out_means.shape[1]
    x = item % out_means.shape[1]
    for channel in range(out_means.shape[2]):
        value = mean_sample(samples, y, x, channel, factor) + behind_pixel(behind, y, x, channel, factor)
        shown = value
        if is_color:
            shown = 12.92 * value
            if value > KNEE:
                shown = 1.055 * wp.pow(value, 1.0 / 2.4) - 0.055
        out_means[y, x, channel] = shown


@wp.kernel
def add_sample_gradients_kernel(
    first: int,
    samples: wp.array3d[float],
    factor: int,
    is_color: bool,
    behind: Behind,
    gradients: wp.array3d[float],
    out_gradients: wp.array3d[float],
    out_to_alpha: wp.array3d[float],
):
    item = first + wp.tid()
    y = item / gradients.shape[1]
    x = item % gradients.shape[1]
    hidden = float(0.0)
    for channel in range(gradients.shape[2]):
        slope = float(1.0)
        if is_color:
            slope = 12.92
            value = mean_sample(samples, y, x, channel, factor) + behind_pixel(behind, y, x, channel, factor)
            if value > KNEE:
                slope = (1.055 / 2.4) * wp.pow(value, 1.0 / 2.4 - 1.0)
        share = slope * gradients[y, x, channel] / float(factor * factor)
        for j in range(factor):
            for i in range(factor):
                out_gradients[y * factor + j, x * factor + i, channel] += share
        if behind.color.shape[0] > 0:
            hidden += share * behind.color[y, x, channel]
    if behind.color.shape[0] > 0:
        for j in range(factor):
            for i in range(factor):
                out_to_alpha[y * factor + j, x * factor + i, 0] -= hidden


@wp.kernel
def believe_kernel(first: int, doubt: wp.array2d[float], known: wp.array3d[float], out_values: wp.array3d[float]):
    item = first + wp.tid()
    y = item / out_values.shape[1]
    x = item % out_values.shape[1]
    for channel in range(out_values.shape[2]):
        other = float(0.0)
        if known:
            other = known[y, x, channel]
        out_values[y, x, channel] += doubt[y, x] * (other - out_values[y, x, channel])


@wp.kernel
def square_error_kernel(first: int, encoded: wp.array3d[float], target: wp.array3d[float], out_errors: wp.array[float]):
    item = first + wp.tid()
    y = item / target.shape[1]
    x = item % target.shape[1]
    total = float(0.0)
    for channel in range(target.shape[2]):
        difference = wp.clamp(encoded[y, x, channel], 0.0, 1.0) - wp.clamp(target[y, x, channel], 0.0, 1.0)
        total += difference * difference
    out_errors[item] = total


def behind_samples(color: Any = None, alpha: Any = None) -> Behind:
    """Return what samples lie before: linear colour of each pixel, and their own alpha; nothing without."""
    behind = Behind()
    if color is not None:
        behind.color, behind.alpha = color, alpha
    return behind


NOTHING = behind_samples()


def launch_average(
    samples: Any, factor: int, is_color: bool, out_means: Any, device: Any, behind: Behind = NOTHING
) -> None:
    """Average ``factor`` x ``factor`` samples a pixel, ``(H f, W f, C)``, and encode colours; arrays may be strided.

    What is behind shows as far as samples let it through.
    """
    pixels = out_means.shape[0] * out_means.shape[1]
    launch(average_kernel, pixels, inputs=[samples, factor, is_color, behind], outputs=[out_means], device=device)


def launch_add_sample_gradients(
    samples: Any,
    factor: int,
    is_color: bool,
    gradients: Any,
    out_gradients: Any,
    device: Any,
    behind: Behind = NOTHING,
    to_alpha: Any = None,
) -> None:
    """Add the gradients of linear samples and of their alpha, given those of what `launch_average` writes."""
    pixels = gradients.shape[0] * gradients.shape[1]
    inputs = [samples, factor, is_color, behind, gradients]
    launch(add_sample_gradients_kernel, pixels, inputs=inputs, outputs=[out_gradients, to_alpha], device=device)


def launch_believe(doubt: Any, known: Any, out_values: Any, device: Any) -> None:
    """Bring values ``(H, W, C)`` as near to those known, 0 without, as pixels are in doubt; none are without."""
    if doubt is not None:
        launch(believe_kernel, doubt.size, inputs=[doubt, known], outputs=[out_values], device=device)


launch_square_error = launcher(square_error_kernel)
"""Write each pixel's sum of squared differences of values clipped to [0, 1]."""
