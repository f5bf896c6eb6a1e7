"""Colours of points in each view, and one colour for each point that most views agree on."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.raster.pinholes import camera_point, image_point, room_around
from beam_warp.kernels.raster.project import RasterView

wp.set_module_options({"enable_backward": False})

LEAST_COVERAGE = wp.constant(0.5)
"""Coverage below which a pixel shows more of the background."""

ROUNDS = wp.constant(3)
"""Rounds of reweighting around the most central sample: by then the weights have settled."""

RELATIVE_SPREAD = wp.constant(0.1)
LEAST_SPREAD = wp.constant(0.01)
"""Deviation of a colour at which it counts half: a tenth of the mean, and for dark ones no less than this."""


@wp.struct
class SeenImage:
    """The image of a view, and the depth of the surface that it shows."""

    view: RasterView
    color: wp.array[wp.vec3]  # premultiplied, row by row
    alpha: wp.array[float]
    depth: wp.array[float]  # of the surface [m]; 0 where there is none


@wp.kernel
def sample_colors_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    image: SeenImage,
    slack: float,
    least_facing: float,
    row: int,
    out_samples: wp.array2d[wp.vec4],
):
    i = first + wp.tid()
    sample = wp.vec4(0.0, 0.0, 0.0, 0.0)
    view = image.view
    p = camera_point(view, positions[i])
    z = p[2]
    normal = normals[i]
    facing = wp.dot(normal, wp.normalize(view.position - positions[i]))
    if wp.length_sq(normal) == 0.0:
        facing = 1.0
    if z > 0.0 and facing > least_facing:
        place = image_point(view, p)
        if room_around(view, place) > 0.0:
            pixel = int(place[1]) * view.width + int(place[0])
            coverage = image.alpha[pixel]
            seen = image.depth[pixel]
            if coverage >= LEAST_COVERAGE and seen > 0.0 and z <= seen + slack:
                straight = image.color[pixel] / coverage
                sample = wp.vec4(straight[0], straight[1], straight[2], facing * facing)
    out_samples[row, i] = sample


@wp.func
def color_of(sample: wp.vec4) -> wp.vec3:
    return wp.vec3(sample[0], sample[1], sample[2])


@wp.func
def most_central(samples: wp.array2d[wp.vec4], i: int) -> wp.vec3:
    """The sample that is nearest to all others, which a minority of outliers cannot move."""
    best = float(wp.inf)
    center = wp.vec3(0.0, 0.0, 0.0)
    for a in range(samples.shape[0]):
        candidate = samples[a, i]
        if candidate[3] > 0.0:
            total = float(0.0)
            for b in range(samples.shape[0]):
                other = samples[b, i]
                total += other[3] * wp.length(color_of(candidate) - color_of(other))
            if total < best:
                best = total
                center = color_of(candidate)
    return center


@wp.kernel
def agree_colors_kernel(
    first: int, samples: wp.array2d[wp.vec4], out_colors: wp.array[wp.vec3], out_seen: wp.array[int]
):
    i = first + wp.tid()
    mean = most_central(samples, i)
    seen = int(0)
    for _ in range(ROUNDS):
        total = float(0.0)
        added = wp.vec3(0.0, 0.0, 0.0)
        spread = wp.max(RELATIVE_SPREAD * wp.length(mean), LEAST_SPREAD)
        seen = int(0)
        for row in range(samples.shape[0]):
            sample = samples[row, i]
            if sample[3] > 0.0:
                seen += 1
                off = color_of(sample) - mean
                weight = sample[3] * spread * spread / (spread * spread + wp.length_sq(off))
                total += weight
                added += color_of(sample) * weight
        if total > 0.0:
            mean = added / total
    out_colors[i] = mean
    out_seen[i] = seen


def launch_sample_colors(
    positions: Any,
    normals: Any,
    image: SeenImage,
    slack: float,
    least_facing: float,
    row: int,
    out_samples: Any,
    device: Any,
) -> None:
    """Write the straight colour and the weight of every point in one view; a weight of 0 where it is not seen.

    A point is seen where it is not farther than the image's depth by more than ``slack`` [m], and its normal faces the
    camera by a cosine above ``least_facing``; points whose normal is 0 face all cameras.
    """
    inputs = [positions, normals, image, slack, least_facing, row]
    launch(sample_colors_kernel, len(positions), inputs=inputs, outputs=[out_samples], device=device)


launch_agree_colors = launcher(agree_colors_kernel)
"""Write the weighted mean of every point's samples, outliers counted little, and how many there are.

Source: Cauchy's weights, Holland and Welsch 1977.
"""
