"""Where on a pixel, and at which of its random numbers, a sample is: counter based, so that order does not matter."""

import warp as wp

from beam_warp.kernels.common.sampling import hash_combine, owen_scramble, owen_sobol_x, owen_sobol_y, unit_float

PIXEL_CHUNK = 128
"""Fewest pixels of one launch on the CPU: each is many rays."""


@wp.struct
class PixelRays:
    """A pinhole camera, to shoot rays from."""

    origin: wp.vec3
    camera_to_world: wp.mat33  # OpenCV axes: right, down, forward
    focal: wp.vec2
    center: wp.vec2
    width: int


@wp.func
def sample_pair(sample: int, stream: wp.uint32, pair: int) -> wp.vec2:
    """Two uniform numbers of one sample: a scrambled Sobol' set of its own for every pair of dimensions.

    The sets are shuffled against each other by a nested permutation of the sample's number: unshuffled, equal bits of
    that number would tie the dimensions of different pairs together (Burley 2020, padding).
    """
    own = hash_combine(stream, wp.uint32(pair))
    index = int(owen_scramble(wp.uint32(sample), own))
    return wp.vec2(unit_float(owen_sobol_x(index, own)), unit_float(owen_sobol_y(index, own)))


@wp.func
def pixel_direction(rays: PixelRays, pixel: int, at: wp.vec2) -> wp.vec3:
    """World direction through a point of a pixel's square: a box filter."""
    x = float(pixel % rays.width) + at[0]
    y = float(pixel / rays.width) + at[1]
    local = wp.vec3((x - rays.center[0]) / rays.focal[0], (y - rays.center[1]) / rays.focal[1], 1.0)
    return wp.normalize(rays.camera_to_world * local)
