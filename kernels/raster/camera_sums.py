"""Derivatives to cameras: the rows that splats have for them, summed over each view in a fixed order."""

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.raster.project import Splats

wp.set_module_options({"enable_backward": False})

LANES = 256
"""Sums of each number of a view that are added side by side, and then to one another."""


@wp.kernel
def sum_camera_lanes_kernel(first: int, rows: wp.array2d[float], splats: Splats, out_lanes: wp.array2d[wp.float64]):
    """Add one number of a lane's rows; what is not drawn has no part, for its derivatives may not be finite."""
    item = first + wp.tid()
    length = rows.shape[1]
    column = item % length
    lane = item / length
    lanes = out_lanes.shape[0] / LANES
    count = rows.shape[0] / lanes
    view = lane / LANES
    total = wp.float64(0.0)
    for i in range(lane % LANES, count, LANES):
        splat = view * count + i
        if splats.centers[splat][2] > -wp.inf:
            total += wp.float64(rows[splat, column])
    out_lanes[lane, column] = total


@wp.kernel
def sum_cameras_kernel(first: int, lanes: wp.array2d[wp.float64], out_sums: wp.array2d[float]):
    item = first + wp.tid()
    column = item % lanes.shape[1]
    view = item / lanes.shape[1]
    total = wp.float64(0.0)
    for lane in range(view * LANES, (view + 1) * LANES):
        total += lanes[lane, column]
    out_sums[view, column] = wp.float32(total)


def launch_sum_cameras(rows, splats, lanes, out_sums, device):
    """Write the sums over each view of ``(V * N, K)`` rows to ``(V, K)``; ``lanes`` are ``(V * LANES, K)`` float64."""
    launch(sum_camera_lanes_kernel, lanes.size, inputs=[rows, splats], outputs=[lanes], device=device)
    launch(sum_cameras_kernel, out_sums.size, inputs=[lanes], outputs=[out_sums], device=device)
