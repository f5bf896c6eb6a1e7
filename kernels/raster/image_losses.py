"""Losses that look at one pixel at a time: absolute difference of images, and disagreement of normals.

A pixel writes what it adds to the loss, and adds its gradients; `fixed_sums` adds the former up.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})

SHORTEST_NORMAL = wp.constant(1.0e-3)
"""Length below which a rendered normal has no direction. A pixel that any splat covers has an alpha of at least 1/255;
a shorter sum is of normals that cancel, and its gradient, which grows as 1/length, says nothing."""


@wp.func
def pixel_weight(mask: wp.array2d[float], y: int, x: int) -> float:
    """Weight of a pixel: 1 without a mask."""
    weight = float(1.0)
    if mask:
        weight = mask[y, x]
    return weight


@wp.kernel
def add_l1_kernel(
    first: int,
    image: wp.array3d[float],
    target: wp.array3d[float],
    mask: wp.array2d[float],
    scale: float,
    out_terms: wp.array[float],
    out_gradient: wp.array3d[float],
):
    pixel = first + wp.tid()
    x = pixel % image.shape[1]
    y = pixel / image.shape[1]
    weight = pixel_weight(mask, y, x)
    total = float(0.0)
    if weight != 0.0:  # what is masked away is not read
        for c in range(image.shape[2]):
            difference = image[y, x, c] - target[y, x, c]
            total += wp.abs(difference)
            if out_gradient and difference != 0.0:
                out_gradient[y, x, c] += scale * weight * wp.sign(difference)
    out_terms[pixel] = weight * total


@wp.func
def read_vector(image: wp.array3d[float], y: int, x: int) -> wp.vec3:
    return wp.vec3(image[y, x, 0], image[y, x, 1], image[y, x, 2])


@wp.func
def add_vector(out_image: wp.array3d[float], y: int, x: int, v: wp.vec3):
    for k in range(3):
        out_image[y, x, k] += v[k]


@wp.kernel
def add_normal_kernel(
    first: int,
    rendered: wp.array3d[float],
    expected: wp.array3d[float],
    mask: wp.array2d[float],
    bluntness: float,
    scale: float,
    out_terms: wp.array[float],
    out_rendered_gradient: wp.array3d[float],
    out_expected_gradient: wp.array3d[float],
):
    """``bluntness`` is one over the tolerance squared: 0 takes 1 - cosine as it is."""
    pixel = first + wp.tid()
    x = pixel % rendered.shape[1]
    y = pixel / rendered.shape[1]
    out_terms[pixel] = 0.0
    weight = pixel_weight(mask, y, x)
    normal = read_vector(rendered, y, x)
    other = read_vector(expected, y, x)
    length = wp.length(normal)
    if not (length > SHORTEST_NORMAL) or not (wp.length_sq(other) > 0.0) or weight == 0.0:
        return
    direction = normal / length
    cosine = wp.dot(direction, other)
    disagreement = wp.max(1.0 - cosine, 0.0)
    root = wp.sqrt(1.0 + 2.0 * bluntness * disagreement)
    out_terms[pixel] = weight * 2.0 * disagreement / (1.0 + root)
    upstream = -scale * weight / root
    if out_rendered_gradient:
        add_vector(out_rendered_gradient, y, x, (upstream / length) * (other - direction * cosine))
    if out_expected_gradient:
        add_vector(out_expected_gradient, y, x, upstream * direction)


def launch_add_l1(image, target, mask, scale, out_terms, out_gradient, device):
    """Write every pixel's sum of absolute differences, and add ``scale`` times their gradients."""
    inputs = [image, target, mask, scale]
    launch(add_l1_kernel, out_terms.size, inputs=inputs, outputs=[out_terms, out_gradient], device=device)


def launch_add_normal(
    rendered, expected, mask, bluntness, scale, out_terms, out_rendered_gradient, out_expected_gradient, device
):
    """Write every pixel's disagreement of normals, and add ``scale`` times its gradients."""
    inputs = [rendered, expected, mask, bluntness, scale]
    outputs = [out_terms, out_rendered_gradient, out_expected_gradient]
    launch(add_normal_kernel, out_terms.size, inputs=inputs, outputs=outputs, device=device)
