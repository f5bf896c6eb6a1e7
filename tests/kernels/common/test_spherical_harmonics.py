"""The device's spherical harmonics against the NumPy twin, for every degree and both colour spaces."""

import numpy as np
import pytest
import warp as wp
from reference.harmonics import sh_color

from beam_warp.image.color import srgb_to_linear
from beam_warp.kernels.common.spherical_harmonics import captured_radiance


@wp.kernel
def radiance_kernel(
    coefficients: wp.array2d[wp.vec3], directions: wp.array[wp.vec3], display: int, out: wp.array[wp.vec3]
):
    i = wp.tid()
    out[i] = captured_radiance(coefficients, i, directions[i], display)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("display", [0, 1])
def test_equals_the_numpy_twin(device, rng, degree, display):
    count = 500
    coefficients = rng.normal(0.0, 0.3, (count, (degree + 1) ** 2, 3)).astype(np.float32)
    directions = rng.normal(size=(count, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    out = wp.empty(count, dtype=wp.vec3, device=device)
    wp.launch(
        radiance_kernel,
        count,
        inputs=[
            wp.array(coefficients, dtype=wp.vec3, device=device),
            wp.array(directions, dtype=wp.vec3, device=device),
            display,
        ],
        outputs=[out],
        device=device,
    )
    expected = sh_color(coefficients, directions)
    if display:
        expected = srgb_to_linear(np.minimum(expected, 1.0))
    # 25 terms of order 1 in float32: 25 * 6e-8, times the slope 2.4 of the sRGB curve
    assert np.abs(out.numpy() - expected).max() < 5e-6
