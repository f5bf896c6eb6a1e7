"""Base colour of pixels from their captured radiance and both residues, and which pixels baking may rely on."""

import warp as wp

from beam_warp.kernels.common.launching import launcher

wp.set_module_options({"enable_backward": False})


@wp.struct
class ShownPixels:
    """Drawn and captured values of the pixels of one view, flat."""

    alpha: wp.array[float]  # coverage as drawn
    surface: wp.array[float]  # 1 where residues were measured, else 0
    captured_alpha: wp.array[float]  # none: not known
    captured: wp.array[wp.vec3]  # premultiplied
    ambient_occlusion: wp.array[float]
    diffuse: wp.array[wp.vec3]
    specular: wp.array[wp.vec3]


@wp.struct
class PixelGuards:
    """Values below which a pixel does not count."""

    least_alpha: float  # coverage, drawn and captured
    least_diffuse: float  # light of a white diffuser


@wp.kernel
def write_bake_targets_kernel(
    first: int, pixels: ShownPixels, guards: PixelGuards, out_targets: wp.array2d[float], out_weights: wp.array2d[float]
):
    """Base colour (3) and ambient occlusion, times coverage, and 1 for each that counts; NaN counts as nothing."""
    pixel = first + wp.tid()
    alpha = pixels.alpha[pixel]
    drawn = pixels.surface[pixel] > 0.0 and alpha >= guards.least_alpha
    whole = drawn
    if pixels.captured_alpha.shape[0] > 0:
        whole = drawn and pixels.captured_alpha[pixel] >= guards.least_alpha
    for c in range(3):
        target = float(0.0)
        weight = float(0.0)
        diffuse = pixels.diffuse[pixel][c]
        if whole and diffuse >= guards.least_diffuse:
            left = wp.max(pixels.captured[pixel][c] - pixels.specular[pixel][c], 0.0)
            target = alpha * wp.min(left / diffuse, 1.0)
            weight = 1.0
        out_targets[pixel, c] = target
        out_weights[pixel, c] = weight
    out_targets[pixel, 3] = wp.where(drawn, alpha * wp.clamp(pixels.ambient_occlusion[pixel], 0.0, 1.0), 0.0)
    out_weights[pixel, 3] = wp.where(drawn, 1.0, 0.0)


launch_write_bake_targets = launcher(write_bake_targets_kernel)
"""Write every pixel's targets and weights, ``(P, 4)`` each."""
