"""Base colour of all Gaussians of a frame at once: the equations that drawn views give, and how alike neighbours are.

A view shows y of a Gaussian that base colour x must explain by the light D that a white one would send: y = D x. Pixels
are blends, so that it is blends of D x that are compared with blends of y.
"""

import warp as wp

from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.materials.residues import (
    LEAST_SPREAD,
    RELATIVE_SPREAD,
    GatheredLight,
    Observations,
    ShadedPoints,
    brightness,
    facing_weight,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class LitView:
    """What one view shows of the points whose light is known, and which Gaussians they are."""

    views: Observations
    light: GatheredLight
    surface: ShadedPoints
    view: int
    gaussians: wp.array[int]  # of each point, -1 where its base colour is not looked for
    points: wp.array[int]  # of each Gaussian, -1 for none


@wp.func
def facing_of(lit: LitView, point: int) -> float:
    """How much a view of a point counts; 0 where it does not see it."""
    facing = facing_weight(wp.dot(lit.surface.normals[point], lit.views.directions[lit.view, point]))
    return wp.where(lit.views.colors[lit.view, point][3] > 0.0, facing, 0.0)


@wp.func
def diffuse_light(lit: LitView, point: int) -> wp.vec3:
    """What a white point sends to the view by diffusion, as far as the view counts: D."""
    arriving = lit.light.arriving[point] + lit.light.bounce[point]
    return arriving * (lit.views.diffuse_share[lit.view, point] * facing_of(lit, point))


@wp.kernel
def write_unexplained_kernel(
    first: int, lit: LitView, colors: wp.array2d[wp.vec4], x: wp.array2d[float], out_values: wp.array2d[float]
):
    """Unexplained is y - D x; then the mean of the channels of what is explained: all, of Gaussians in no light."""
    gaussian = first + wp.tid()
    point = lit.points[gaussian]
    color = colors[lit.view, gaussian]
    shown = wp.vec3(color[0], color[1], color[2])
    off = wp.vec3()
    if point >= 0:
        off = (shown - lit.views.specular[lit.view, point]) * facing_of(lit, point)
        off -= wp.cw_mul(diffuse_light(lit, point), wp.vec3(x[point, 0], x[point, 1], x[point, 2]))
    for c in range(3):
        out_values[gaussian, c] = off[c]
    out_values[gaussian, 3] = brightness(shown - off) / 3.0


@wp.kernel
def write_explained_kernel(first: int, lit: LitView, x: wp.array2d[float], out_values: wp.array2d[float]):
    """Explained is D x: nothing of Gaussians in no light."""
    gaussian = first + wp.tid()
    point = lit.points[gaussian]
    explained = wp.vec4()
    if point >= 0:
        diffuse = diffuse_light(lit, point)
        for c in range(3):
            explained[c] = diffuse[c] * x[point, c]
    for c in range(4):
        out_values[gaussian, c] = explained[c]


@wp.kernel
def weigh_unexplained_kernel(first: int, pixels: wp.array2d[float], out_weights: wp.array[float]):
    """Cauchy's weights, as of one Gaussian's views; pixels become theirs times the weight, and the weight."""
    pixel = first + wp.tid()
    off = wp.vec3(pixels[pixel, 0], pixels[pixel, 1], pixels[pixel, 2])
    spread = wp.max(RELATIVE_SPREAD * pixels[pixel, 3], LEAST_SPREAD)
    weight = spread * spread / (spread * spread + wp.dot(off, off))
    out_weights[pixel] = weight
    for c in range(3):
        pixels[pixel, c] = weight * off[c]
    pixels[pixel, 3] = weight


@wp.kernel
def weigh_explained_kernel(first: int, weights: wp.array[float], out_pixels: wp.array2d[float]):
    pixel = first + wp.tid()
    for c in range(4):
        out_pixels[pixel, c] = weights[pixel] * out_pixels[pixel, c]


@wp.kernel
def add_said_kernel(first: int, lit: LitView, rows: wp.array2d[float], scale: float, out_sums: wp.array2d[float]):
    """Add a multiple of D times what pixels say of each point."""
    point = first + wp.tid()
    gaussian = lit.gaussians[point]
    if gaussian >= 0:
        diffuse = diffuse_light(lit, point)
        for c in range(3):
            out_sums[point, c] = out_sums[point, c] + scale * diffuse[c] * rows[gaussian, c]


@wp.kernel
def add_worth_kernel(first: int, lit: LitView, rows: wp.array2d[float], out_worth: wp.array2d[float]):
    """Add D^2 times the weight of the pixels that show each point."""
    point = first + wp.tid()
    gaussian = lit.gaussians[point]
    if gaussian >= 0:
        diffuse = diffuse_light(lit, point)
        for c in range(3):
            out_worth[point, c] = out_worth[point, c] + diffuse[c] * diffuse[c] * rows[gaussian, 3]


@wp.kernel
def add_differences_kernel(
    first: int,
    x: wp.array2d[float],
    starts: wp.array[int],
    neighbors: wp.array[int],
    weights: wp.array[float],
    out_sums: wp.array2d[float],
):
    """Add to each point the weighted sum of what it has more than its neighbours, in rows from ``starts`` on."""
    point = first + wp.tid()
    for c in range(3):
        total = float(0.0)
        for k in range(starts[point], starts[point + 1]):
            total += weights[k] * (x[point, c] - x[neighbors[k], c])
        out_sums[point, c] = out_sums[point, c] + total


launch_write_unexplained = launcher(write_unexplained_kernel)
"""Write what base colours leave of a view, for every Gaussian."""


launch_write_explained = launcher(write_explained_kernel)
"""Write what base colours send to a view, for every Gaussian."""


launch_weigh_unexplained = launcher(weigh_unexplained_kernel)
"""Find what pixels count, and multiply them by it."""


launch_weigh_explained = launcher(weigh_explained_kernel)
"""Multiply pixels by what they count."""


launch_add_said = launcher(add_said_kernel)
"""Add what a view's pixels say of each point."""


launch_add_worth = launcher(add_worth_kernel)
"""Add how much a view's pixels say of each point."""


launch_add_differences = launcher(add_differences_kernel)
"""Add the product with the Laplacian of a graph of neighbours."""
