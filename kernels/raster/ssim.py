"""Structural similarity of two images and its gradient: one pass each, separable, without maps in between.

A thread walks down `STRIP` rows of one column and channel. At every row it takes the moments under the window's row,
and adds them to the windows in flight: eleven of them, each one row further, which move up by one. When a window is
complete its similarity follows, and three derivatives are stored for the way back, which is the same walk over them.
A pixel is in the windows of its neighbours as they are in its own; beyond the image everything is 0.

Similarity is close to 1 where images are alike, and their variances are small differences of squares where they are
bright and smooth. So that neither costs digits, the image x is compared with its difference d = x - y from the target,
and moments are taken about the pixel in the middle of the strip (exact: the window's weights add up to one):

    1 - S = l + s - l s,   l = mean(d)^2 / L,   s = var(d) / D,
    L = mean(x)^2 + mean(y)^2 + C1,   D = var(x) + var(y) + C2 = 2 cov(x, y) + var(d) + C2

(Wang et al. 2004, Eq. 13, with L - 2 mean(x) mean(y) - C1 = mean(d)^2, and likewise for the variances). The slope of S
with respect to a pixel x of the window is, up to the window's weight there,

    S_x = m + e (x - mean(x)) - c (d - mean(d)),
    c = 2 (1 - l) / D,   e = c s,   m = 2 (1 - s) (l mean(x) - mean(d)) / L,

so that (m - e mean(x) + c mean(d), e, c) is what a window stores, times its weight.
"""

import math

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.image_losses import pixel_weight

wp.set_module_options({"enable_backward": False})

RADIUS = 5
"""The window is 11 pixels wide."""

SIGMA = 1.5
"""Standard deviation of the window [pixel]."""

STRIP = 16
"""Rows of one thread. It reads ten more: longer strips read less, shorter ones make more threads."""

LUMINANCE_FLOOR = wp.constant(0.01**2)
"""C1 of Wang et al. 2004 for values in [0, 1]."""

CONTRAST_FLOOR = wp.constant(0.03**2)
"""C2 of Wang et al. 2004 for values in [0, 1]."""

_SHARES = [math.exp(-0.5 * (k / SIGMA) ** 2) for k in range(-RADIUS, RADIUS + 1)]

Window = wp.types.vector(length=2 * RADIUS + 1, dtype=float)
WINDOW = wp.constant(Window(*[share / sum(_SHARES) for share in _SHARES]))

MomentWindows = wp.types.matrix(shape=(2 * RADIUS + 1, 4), dtype=float)
SlopeWindows = wp.types.matrix(shape=(2 * RADIUS + 1, 3), dtype=float)


@wp.func
def row_moments(image: wp.array3d[float], target: wp.array3d[float], y: int, x: int, c: int, about: wp.vec2) -> wp.vec4:
    """Moments of x, d, x y and d^2 about ``about`` under one row of the window; 0 is the value beyond the image."""
    moments = wp.vec4(0.0, 0.0, 0.0, 0.0)
    inside_rows = y >= 0 and y < image.shape[0]
    for k in range(11):
        p = -about[0]
        q = -about[1]
        column = x + k - 5
        if inside_rows and column >= 0 and column < image.shape[1]:
            value = image[y, column, c]
            p += value
            q += value - target[y, column, c]
        moments += WINDOW[k] * wp.vec4(p, q, p * (p - q), q * q)
    return moments


@wp.struct
class Dissimilarity:
    value: float  # 1 - S
    slopes: wp.vec3  # what a window stores, for S


@wp.func
def dissimilarity(m: wp.vec4, about: wp.vec2) -> Dissimilarity:
    """One minus the similarity of a window, from its moments about ``about``."""
    mean_x = m[0] + about[0]
    mean_d = m[1] + about[1]
    mean_y = mean_x - mean_d
    cov_xy = m[2] - m[0] * (m[0] - m[1])
    var_d = m[3] - m[1] * m[1]
    light = mean_x * mean_x + mean_y * mean_y + LUMINANCE_FLOOR
    contrast = 2.0 * cov_xy + var_d + CONTRAST_FLOOR
    less_light = mean_d * mean_d / light
    less_shape = var_d / contrast
    result = Dissimilarity()
    result.value = less_light + less_shape - less_light * less_shape
    to_d = 2.0 * (1.0 - less_light) / contrast
    to_x = to_d * less_shape
    to_mean = 2.0 * (1.0 - less_shape) * (less_light * mean_x - mean_d) / light
    result.slopes = wp.vec3(to_mean - to_x * mean_x + to_d * mean_d, to_x, to_d)
    return result


@wp.kernel
def compare_windows_kernel(
    first: int,
    image: wp.array3d[float],
    target: wp.array3d[float],
    mask: wp.array2d[float],
    scale: float,
    out_terms: wp.array[float],
    out_slopes: wp.array4d[float],
):
    # Items go along a row, channels next to one another.
    item = first + wp.tid()
    channels = image.shape[2]
    width = image.shape[1]
    height = image.shape[0]
    c = item % channels
    x = (item / channels) % width
    start = (item / (channels * width)) * wp.static(STRIP)
    end = wp.min(start + wp.static(STRIP), height)
    middle = (start + end) / 2
    about = wp.vec2(image[middle, x, c], image[middle, x, c] - target[middle, x, c])
    windows = MomentWindows()
    total = float(0.0)
    for y in range(start - 5, end + 5):
        moments = row_moments(image, target, y, x, c, about)
        for k in range(10):
            windows[k] = windows[k + 1] + WINDOW[k] * moments
        windows[10] = WINDOW[10] * moments
        done = y - 5
        if done >= start:
            weight = pixel_weight(mask, done, x)
            found = dissimilarity(windows[0], about)
            total += weight * found.value
            if out_slopes:
                for k in range(3):
                    out_slopes[k, done, x, c] = -scale * weight * found.slopes[k]
    out_terms[item] = total


@wp.kernel
def add_window_gradients_kernel(
    first: int,
    image: wp.array3d[float],
    target: wp.array3d[float],
    slopes: wp.array4d[float],
    out_gradient: wp.array3d[float],
):
    item = first + wp.tid()
    channels = image.shape[2]
    width = image.shape[1]
    height = image.shape[0]
    c = item % channels
    x = (item / channels) % width
    start = (item / (channels * width)) * wp.static(STRIP)
    end = wp.min(start + wp.static(STRIP), height)
    windows = SlopeWindows()
    for y in range(start - 5, end + 5):
        row = wp.vec3(0.0, 0.0, 0.0)
        if y >= 0 and y < height:
            for k in range(11):
                column = x + k - 5
                if column >= 0 and column < width:
                    row += WINDOW[k] * wp.vec3(
                        slopes[0, y, column, c], slopes[1, y, column, c], slopes[2, y, column, c]
                    )
        for k in range(10):
            windows[k] = windows[k + 1] + WINDOW[k] * row
        windows[10] = WINDOW[10] * row
        done = y - 5
        if done >= start:
            mean = windows[0]
            value = image[done, x, c]
            out_gradient[done, x, c] += mean[0] + value * mean[1] - (value - target[done, x, c]) * mean[2]


def strip_count(height: int, width: int, channels: int) -> int:
    """Return how many threads walk an image, and so how many terms they write."""
    return -(-height // STRIP) * width * channels


def launch_compare_windows(image, target, mask, scale, out_terms, out_slopes, device):
    """Write every strip's sum of 1 - similarity, and ``scale`` times its derivatives."""
    inputs = [image, target, mask, scale]
    outputs = [out_terms, out_slopes]
    launch(compare_windows_kernel, strip_count(*image.shape), inputs=inputs, outputs=outputs, device=device)


def launch_add_window_gradients(image, target, slopes, out_gradient, device):
    """Add the gradient to every pixel that stored derivatives lead to."""
    inputs = [image, target, slopes]
    launch(add_window_gradients_kernel, strip_count(*image.shape), inputs=inputs, outputs=[out_gradient], device=device)
