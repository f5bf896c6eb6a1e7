"""Gradients of the total variation of radiance: how much Gaussians differ from those around them."""

import warp as wp

from beam_warp.kernels.common.launching import launcher

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_variation_gradients_kernel(
    first: int,
    radiance: wp.array2d[wp.vec3],
    neighbors: wp.array2d[int],
    weight: float,
    rounding: float,
    out_gradients: wp.array2d[wp.vec3],
):
    """Each Gaussian's own part alone, so that no thread adds to what is another's: neighbours are taken as they are."""
    i = first + wp.tid()
    for k in range(neighbors.shape[1]):
        j = neighbors[i, k]
        if j >= 0:
            square = rounding * rounding
            for band in range(radiance.shape[1]):
                square += wp.length_sq(radiance[i, band] - radiance[j, band])
            slope = weight / wp.sqrt(square)
            for band in range(radiance.shape[1]):
                out_gradients[i, band] = out_gradients[i, band] + (radiance[i, band] - radiance[j, band]) * slope


launch_add_variation_gradients = launcher(add_variation_gradients_kernel)
"""Add ``weight`` times the gradients of sqrt(difference^2 + rounding^2), summed over neighbours; -1 is none."""
