"""What of the image a splat reaches: the ellipse where its alpha is 1/255, never less and hardly more."""

import numpy as np
import warp as wp
from support.kernel_runs import run_kernel

from beam_warp.kernels.raster.splat_rows import (
    EXTENT_MARGIN,
    RELATIVE_MARGIN,
    reach_columns,
    reach_row,
    reach_rows,
    row_reach,
)


@wp.kernel(enable_backward=False)
def reach_kernel(
    shapes: wp.array[wp.vec4],
    squares: wp.array[float],
    rows: wp.array[wp.vec2],
    out_height: wp.array[float],
    out_columns: wp.array[wp.vec2],
    out_row: wp.array[wp.vec2],
):
    i = wp.tid()
    out_height[i] = reach_rows(shapes[i], squares[i])
    out_columns[i] = reach_columns(shapes[i], squares[i], rows[i][0], rows[i][1])
    out_row[i] = reach_row(row_reach(shapes[i], squares[i]), rows[i][0])


def test_extents_hold_the_ellipse(device, rng):
    """Ellipses of half a pixel to 100,000 pixels against (s0 x)^2 + s2^2 (y - s1 x)^2 = r^2 in float64."""
    count = 5000
    deviations = 10.0 ** rng.uniform(-0.5, 4.5, (2, count))
    lean = rng.uniform(-1.0, 1.0, count) * deviations[1] / deviations[0]
    shapes = np.stack([1.0 / deviations[0], lean, 1.0 / deviations[1], np.zeros(count)], 1).astype(np.float32)
    squares = rng.uniform(0.1, 11.0, count).astype(np.float32)
    s0, s1, s2 = shapes[:, :3].astype(np.float64).T
    r2 = squares.astype(np.float64)
    k = s0**2 + (s1 * s2) ** 2
    height = np.sqrt(r2 * k) / (s0 * s2)
    rows = (np.sort(rng.uniform(-0.9, 0.9, (count, 2)), axis=1) * height[:, None]).astype(np.float32)

    def ends(y):
        middle, half = s1 * s2**2 * y / k, np.sqrt(k * r2 - (s0 * s2 * y) ** 2) / k
        return np.stack([middle - half, middle + half], 1)

    top, bottom = rows.astype(np.float64).T
    widest = s1 * np.sqrt(r2) / s0
    columns = np.stack([ends(np.clip(side * widest, top, bottom))[:, k] for k, side in ((0, -1.0), (1, 1.0))], 1)
    found = run_kernel(
        reach_kernel, count, [(shapes, wp.vec4), (squares, float), (rows, wp.vec2)], (float, wp.vec2, wp.vec2), device
    )
    for got, wanted in zip(found, (height[:, None], columns, ends(top)), strict=True):
        outwards = (got.reshape(wanted.shape) - wanted) * ([1.0] if wanted.shape[1] == 1 else [-1.0, 1.0])
        # Rounding takes or adds a tenth of the margin at most: that is what the margin was chosen by.
        margin = RELATIVE_MARGIN * np.abs(wanted).max(axis=1, keepdims=True) + EXTENT_MARGIN
        assert (np.abs(outwards - margin) <= 0.1 * margin).all()
