"""The device's spherical harmonics against the NumPy twin, for every degree and both colour spaces."""

import numpy as np
import pytest
import warp as wp
from reference.harmonics import sh_color
from support.kernel_runs import run_kernel
from support.shapes import unit

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
    directions = unit(rng.normal(size=(count, 3)))
    (found,) = run_kernel(
        radiance_kernel, count, [(coefficients, wp.vec3), (directions, wp.vec3), display], [wp.vec3], device
    )
    expected = sh_color(coefficients, directions)
    if display:
        expected = srgb_to_linear(np.minimum(expected, 1.0))
    # 25 terms of order 1 in float32: 25 * 6e-8, times the slope 2.4 of the sRGB curve
    assert np.abs(found - expected).max() < 5e-6
