"""Quadratic forms of the errors of pixels: found by differences of their shading, and applied to errors.

A form of 9 x 9 is stored as its lower triangle, row by row: the first 36 of 45 numbers are the form of 8 x 8 of all
columns but the last.
"""

import warp as wp

from beam_warp.kernels.common.launching import launcher

wp.set_module_options({"enable_backward": False})

COLUMNS = wp.constant(9)
MATERIALS = wp.constant(8)
TRIANGLE = wp.constant(36)

Slopes = wp.types.matrix(shape=(9, 3), dtype=float)
Sums = wp.types.vector(length=9, dtype=float)


@wp.func
def display_value(linear: float) -> float:
    """sRGB of a value, cut to [0, 1]."""
    value = wp.clamp(linear, 0.0, 1.0)
    return wp.where(value <= 0.0031308, 12.92 * value, 1.055 * wp.pow(wp.max(value, 1e-8), 1.0 / 2.4) - 0.055)


@wp.func
def display_color(color: wp.vec4) -> wp.vec3:
    return wp.vec3(display_value(color[0]), display_value(color[1]), display_value(color[2]))


@wp.kernel
def nudge_kernel(
    first: int,
    channels: wp.array2d[float],
    alpha: wp.array[float],
    column: int,
    step: float,
    out_channels: wp.array2d[float],
    out_alpha: wp.array[float],
):
    """The sums of pixels with one column changed by a step; no column beyond the last."""
    i = first + wp.tid()
    for k in range(MATERIALS):
        out_channels[i, k] = channels[i, k] + wp.where(k == column, step, 0.0)
    out_alpha[i] = wp.max(alpha[i] + wp.where(column == MATERIALS, step, 0.0), 0.0)


@wp.kernel
def add_forms_kernel(
    first: int,
    pixels: wp.array[int],
    shades: wp.array2d[wp.vec4],
    steps: wp.array[float],
    share: float,
    out_forms: wp.array2d[float],
):
    """Add J^T J of covered pixels: ``shades`` are as they are, and then with each column changed by its step."""
    i = first + wp.tid()
    pixel = pixels[i]
    base = display_color(shades[0, pixel])
    slopes = Slopes()
    for row in range(COLUMNS):
        slopes[row] = (display_color(shades[row + 1, pixel]) - base) / steps[row]
    entry = int(0)
    for row in range(COLUMNS):
        for column in range(row + 1):
            out_forms[i, entry] += share * wp.dot(slopes[row], slopes[column])
            entry += 1


@wp.kernel
def blend_forms_kernel(first: int, mean: wp.array[float], share: float, out_forms: wp.array2d[float]):
    """Forms become so much of the mean one."""
    i = first + wp.tid()
    for entry in range(out_forms.shape[1]):
        out_forms[i, entry] += share * (mean[entry] - out_forms[i, entry])


@wp.kernel
def add_edges_kernel(
    first: int, width: int, height: int, shades: wp.array2d[wp.vec4], share: float, out_edges: wp.array[float]
):
    """Add the mean squared slope of an image along x and y, by central differences."""
    i = first + wp.tid()
    x = i % width
    y = i / width
    left = wp.max(x - 1, 0)
    right = wp.min(x + 1, width - 1)
    up = wp.max(y - 1, 0)
    down = wp.min(y + 1, height - 1)
    across = display_color(shades[0, y * width + right]) - display_color(shades[0, y * width + left])
    along = display_color(shades[0, down * width + x]) - display_color(shades[0, up * width + x])
    across /= float(wp.max(right - left, 1))
    along /= float(wp.max(down - up, 1))
    out_edges[i] += 0.5 * share * (wp.dot(across, across) + wp.dot(along, along))


@wp.kernel
def carry_kernel(
    first: int,
    start: int,
    places: wp.array[int],
    forms: wp.array2d[float],
    edges: wp.array[float],
    out_pixels: wp.array2d[float],
):
    """Columns from ``start`` on of what is carried back, as many as fit: 36 numbers of the form, slope, 1, zeros."""
    i = first + wp.tid()
    place = places[i]
    for k in range(out_pixels.shape[1]):
        column = start + k
        value = float(0.0)
        if column < TRIANGLE:
            if place >= 0:
                value = forms[place, column]
        elif column == TRIANGLE:
            value = edges[i]
        elif column == TRIANGLE + 1:
            value = 1.0
        out_pixels[i, k] = value


@wp.kernel
def add_columns_kernel(first: int, rows: wp.array2d[float], start: int, out_sums: wp.array2d[float]):
    """Add rows to the columns from ``start`` on."""
    i = first + wp.tid()
    for k in range(rows.shape[1]):
        out_sums[i, start + k] += rows[i, k]


@wp.kernel
def form_slopes_kernel(
    first: int,
    places: wp.array[int],
    forms: wp.array2d[float],
    target: wp.array2d[float],
    target_alpha: wp.array[float],
    empty_weight: float,
    channels: wp.array2d[float],
    alpha: wp.array[float],
    out_channels: wp.array2d[float],
    out_alpha: wp.array[float],
):
    """Derivatives of d^T M d to the sums of pixels, d being how far they are from the target."""
    i = first + wp.tid()
    place = places[i]
    away = alpha[i] - target_alpha[i]
    found = Sums()
    found[MATERIALS] = empty_weight * away
    if place >= 0:
        error = Sums()
        for k in range(MATERIALS):
            error[k] = channels[i, k] - target[i, k]
        error[MATERIALS] = away
        found[MATERIALS] = 0.0
        entry = int(0)
        for row in range(COLUMNS):
            for column in range(row):
                value = forms[place, entry]
                found[row] += value * error[column]
                found[column] += value * error[row]
                entry += 1
            found[row] += forms[place, entry] * error[row]
            entry += 1
    for k in range(MATERIALS):
        out_channels[i, k] = 2.0 * found[k]
    out_alpha[i] = 2.0 * found[MATERIALS]


launch_nudge = launcher(nudge_kernel)
launch_add_forms = launcher(add_forms_kernel)
launch_blend_forms = launcher(blend_forms_kernel)
launch_add_edges = launcher(add_edges_kernel)
launch_carry = launcher(carry_kernel)
launch_add_columns = launcher(add_columns_kernel)
launch_form_slopes = launcher(form_slopes_kernel)
