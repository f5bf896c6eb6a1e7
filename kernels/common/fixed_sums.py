"""How many floats add up in a fixed order: lanes of a fixed stride, then lanes of those, then one."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})

LANES = (16384, 128)
"""Lanes of the first and the second round. Neighbouring threads read neighbouring floats, and no thread adds more than
about 128 of them until there are two million."""


@wp.kernel
def sum_floats_kernel(first: int, values: wp.array[float], count: int, lanes: int, out_sums: wp.array[wp.float64]):
    lane = first + wp.tid()
    total = wp.float64(0.0)
    for i in range(lane, count, lanes):
        total += wp.float64(values[i])
    out_sums[lane] = total


@wp.kernel
def sum_lanes_kernel(first: int, values: wp.array[wp.float64], count: int, lanes: int, out_sums: wp.array[wp.float64]):
    lane = first + wp.tid()
    total = wp.float64(0.0)
    for i in range(lane, count, lanes):
        total += values[i]
    out_sums[lane] = total


@wp.kernel
def finish_sum_kernel(first: int, values: wp.array[wp.float64], scale: wp.float64, out_sum: wp.array[float]):
    total = wp.float64(0.0)
    for i in range(first + wp.tid(), values.shape[0]):
        total += values[i]
    out_sum[0] = wp.float32(total * scale)


class SumBuffers:
    """Where the lanes' sums are kept between the rounds."""

    def __init__(self, device: Any) -> None:
        self.lanes = [wp.empty(count, dtype=wp.float64, device=device) for count in LANES]


def launch_sum_floats(values: Any, scale: float, buffers: SumBuffers, out_sum: Any, device: Any) -> None:
    """Write ``scale`` times the sum of one-dimensional ``values``, added in float64, to ``out_sum[0]``."""
    many, few = buffers.lanes
    # Lanes of small images are a float or none: as one launch they are summed sooner than spread over threads.
    alone = LANES[0] if values.size <= 16 * LANES[0] else None
    launch(
        sum_floats_kernel,
        LANES[0],
        inputs=[values, values.size, LANES[0]],
        outputs=[many],
        device=device,
        min_chunk=alone,
    )
    launch(sum_lanes_kernel, LANES[1], inputs=[many, LANES[0], LANES[1]], outputs=[few], device=device)
    launch(finish_sum_kernel, 1, inputs=[few, wp.float64(scale)], outputs=[out_sum], device=device)
