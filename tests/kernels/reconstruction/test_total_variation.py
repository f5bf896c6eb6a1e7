"""Gradients of the total variation of radiance: finite differences in double precision, and what has no neighbour."""

import numpy as np
import warp as wp

from beam_warp.kernels.reconstruction.total_variation import launch_add_variation_gradients


def variation_around(radiance, others, near, rounding):
    """The sum over Gaussians and neighbours, which are taken from ``others``, in double precision."""
    total = 0.0
    for own, row in zip(radiance, near, strict=True):
        for j in row[row >= 0]:
            total += np.sqrt(((own - others[j]) ** 2).sum() + rounding**2)
    return total


def gradients(radiance, near, weight, rounding, device, before=0.0):
    out = wp.array(np.full(radiance.shape, before, np.float32), dtype=wp.vec3, device=device)
    arrays = wp.array(radiance, dtype=wp.vec3, device=device), wp.array(near, dtype=int, device=device)
    launch_add_variation_gradients(len(radiance), *arrays, weight, rounding, out, device)
    return out.numpy()


def test_finite_differences(device, rng):
    """Four Gaussians with four harmonics have two neighbours, one or none; a step of 1e-5 is exact to 1e-8."""
    radiance = rng.normal(size=(4, 4, 3)).astype(np.float32)
    near = np.array([[1, 2], [0, 3], [3, -1], [-1, -1]], np.int32)
    found = gradients(radiance, near, 0.5, 0.05, device, before=2.0)
    exact = radiance.astype(np.float64)
    for place in np.ndindex(radiance.shape):
        ends = []
        for step in (1e-5, -1e-5):
            moved = exact.copy()
            moved[place] += step
            ends.append(variation_around(moved, exact, near, 0.05))
        assert abs(found[place] - 2.0 - 0.5 * (ends[0] - ends[1]) / 2e-5) < 1e-6
    assert (found[3] == 2.0).all()


def test_what_is_alike_stays(device):
    """Equal neighbours have no gradient, and none is infinite; one that is far off pulls by the weight, however far."""
    radiance = np.zeros((3, 2, 3), np.float32)
    radiance[2, 0, 0] = 1e6
    found = gradients(radiance, np.array([[1], [0], [0]], np.int32), 0.25, 0.05, device)
    assert (found[:2] == 0.0).all()
    np.testing.assert_allclose(found[2, 0], (0.25, 0.0, 0.0), rtol=1e-6)
