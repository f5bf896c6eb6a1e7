"""Rows are added to others, each number once."""

import numpy as np
import pytest
import warp as wp

from beam_warp.kernels.common.row_sums import launch_add_rows


@pytest.mark.parametrize("shape", [(1, 1), (1, 27), (1025, 4)])
def test_rows_are_added(device, rng, shape):
    rows, before = rng.normal(size=(2, *shape)).astype(np.float32)
    out = wp.array(before, dtype=float, device=device)
    launch_add_rows(rows.size, wp.array(rows, dtype=float, device=device), out, device)
    np.testing.assert_array_equal(out.numpy(), before + rows)
