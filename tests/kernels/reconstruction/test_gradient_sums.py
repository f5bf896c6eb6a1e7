"""Lengths of gradients are summed and counted, but for gradients of 0 or NaN."""

import numpy as np
import pytest
import warp as wp

from beam_warp.kernels.reconstruction.gradient_sums import launch_add_gradient_lengths


@pytest.mark.parametrize("count", [1, 1023, 1025])
def test_lengths_are_summed_and_counted(device, rng, count):
    sums, counts = (wp.zeros(count, dtype=float, device=device) for _ in range(2))
    expected_sums, expected_counts = np.zeros(count), np.zeros(count)
    for _ in range(5):
        gradients = rng.normal(size=(count, 3)).astype(np.float32)
        gradients[rng.uniform(size=count) < 0.5] = 0.0
        launch_add_gradient_lengths(wp.array(gradients, dtype=wp.vec3, device=device), sums, counts, device)
        length = np.linalg.norm(gradients.astype(np.float64), axis=1)
        expected_sums += length
        expected_counts += length > 0.0
    np.testing.assert_allclose(sums.numpy(), expected_sums, rtol=5 * 4 * 2.0**-24)
    np.testing.assert_array_equal(counts.numpy(), expected_counts)


def test_what_is_not_a_number_is_not_counted(device):
    sums, counts = (wp.zeros(2, dtype=float, device=device) for _ in range(2))
    gradients = wp.array([[np.nan, 0, 0], [3, 4, 0]], dtype=wp.vec3, device=device)
    launch_add_gradient_lengths(gradients, sums, counts, device)
    assert sums.numpy().tolist() == [0.0, 5.0]
    assert counts.numpy().tolist() == [0.0, 1.0]
