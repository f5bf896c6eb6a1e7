"""Values that float32 holds, uploaded vectors, and how far results are from float64."""

import numpy as np
import pytest
import warp as wp

EPSILON = 2.0**-24
"""Largest relative rounding of a float32."""


def single(array):
    """Values that float32 holds, in float64."""
    return np.asarray(array, np.float32).astype(float)


def vectors(array, device):
    """Upload rows of three as vec3, rows of four as quaternions."""
    array = np.asarray(array, np.float32)
    return wp.array(array, dtype=wp.vec3 if array.shape[1] == 3 else wp.quat, device=device)


def zeros(count, width, device):
    return wp.zeros(count, dtype=wp.vec3 if width == 3 else wp.quat, device=device)


def relative_error(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def require_same_in_a_graph(step, out, device):
    """Require that a step writes the same bits to zeroed arrays when it is replayed from a CUDA graph; skip the CPU."""
    if device == "cpu":
        pytest.skip("CUDA graphs are for CUDA")
    step()
    before = [array.numpy() for array in out]
    with wp.ScopedCapture(device) as capture:
        step()
    for array in out:
        array.zero_()
    wp.capture_launch(capture.graph)
    for array, expected in zip(out, before, strict=True):
        np.testing.assert_array_equal(array.numpy(), expected)
