"""A warp of the CUDA composites looks at every splat that one of its pixels counts, and at few others."""

import numpy as np
import warp as wp

from beam_warp.kernels.raster.composite_cuda import PART
from beam_warp.kernels.raster.project import LOG_CUT, WHITENING
from beam_warp.kernels.raster.splat_rows import log_alpha_of, offset_from, whiten
from beam_warp.kernels.raster.warp_lists_cuda import reaches

COUNT = 200_000


@wp.kernel(enable_backward=False)
def look_at_boxes_kernel(
    centers: wp.array[wp.vec4],
    shapes: wp.array[wp.vec4],
    firsts: wp.array[wp.vec2],
    sides: wp.array[wp.vec2i],
    out_found: wp.array[wp.vec2i],
):
    """How many pixels of a box a splat counts for, and whether it reaches the box."""
    i = wp.tid()
    counted = wp.int32(0)
    for y in range(sides[i][1]):
        for x in range(sides[i][0]):
            pixel = firsts[i] + wp.vec2(float(x), float(y))
            if log_alpha_of(centers[i], whiten(shapes[i], offset_from(centers[i], pixel))) >= -LOG_CUT:
                counted += 1
    last = firsts[i] + wp.vec2(float(sides[i][0] - 1), float(sides[i][1] - 1))
    out_found[i] = wp.vec2i(counted, reaches(centers[i], shapes[i], firsts[i], last))


def test_no_pixel_that_counts_is_passed_over(rng):
    """Splats from points to needles of 3,000 pixels and 0.01, whose rims lie about the boxes, wherever these are."""
    long = 10.0 ** rng.uniform(-2.0, 3.5, COUNT)
    thin, low_pass = long * 10.0 ** rng.uniform(-5.0, 0.0, COUNT), 10.0 ** rng.uniform(-4.0, -0.5, COUNT)
    angle, around = rng.uniform(0.0, 2.0 * np.pi, (2, COUNT))
    xx, yy = ((long * one) ** 2 + (thin * other) ** 2 + low_pass for one, other in _turns(angle))
    xy = (long**2 - thin**2) * np.sin(angle) * np.cos(angle)
    whitening = float(WHITENING)
    shapes = np.stack([whitening / np.sqrt(xx), xy / xx, whitening * np.sqrt(xx / (xx * yy - xy * xy)), long], axis=1)
    rim = 3.3 * rng.uniform(0.0, 1.15, COUNT) * np.stack([long * np.cos(around), thin * np.sin(around)])
    sideways = np.stack(
        [rim[0] * np.cos(angle) - rim[1] * np.sin(angle), rim[0] * np.sin(angle) + rim[1] * np.cos(angle)]
    )
    firsts = np.floor(rng.uniform(0.0, 1000.0, (COUNT, 2))) + 0.5
    sides = rng.integers(1, PART + 1, (COUNT, 2))
    places = firsts - sideways.T + rng.uniform(0.0, sides - 1.0)
    centers = np.c_[places, np.log2(rng.uniform(1.01 / 255.0, 1.0, COUNT)), np.ones(COUNT)]
    given = ((centers, wp.vec4), (shapes, wp.vec4), (firsts, wp.vec2), (sides, wp.vec2i))
    arrays = [wp.array(rows, dtype=dtype, device="cpu") for rows, dtype in given]
    out = wp.zeros(COUNT, dtype=wp.vec2i, device="cpu")
    wp.launch(look_at_boxes_kernel, COUNT, inputs=arrays, outputs=[out], device="cpu")
    counted, reached = out.numpy().T
    assert (counted > 0).mean() > 0.5
    assert not ((counted > 0) & (reached == 0)).any()
    far = np.abs(places - firsts).max(axis=1) > 3.4 * np.sqrt(np.maximum(xx, yy)) + PART + 1.0
    assert not reached[far].any()


def _turns(angle):
    """Cosine and sine of an angle, and the other way round."""
    return ((np.cos(angle), np.sin(angle)), (np.sin(angle), np.cos(angle)))
