"""A cloud's arrays made into what tracing reads: packed rows and exact, opacity-adaptive ellipsoid bounds."""

import warp as wp

from beam_warp.kernels.common.constants import ALPHA_MIN
from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.trace.gaussian import QUARTIC_FALLOFF, Gaussians

wp.set_module_options({"enable_backward": False})

TRACED, RAISED, INVISIBLE, NOT_FINITE = (wp.constant(k) for k in range(4))
"""What becomes of a Gaussian; raised ones are traced with a scale raised to the smallest that float32 resolves."""

LARGEST_LENGTH = wp.constant(1.0e18)
"""Beyond it squares overflow float32."""


@wp.struct
class CloudArrays:
    """A cloud as it was given, in world space."""

    positions: wp.array[wp.vec3]
    orientations: wp.array[wp.quat]
    scales: wp.array[wp.vec3]
    opacities: wp.array[float]


@wp.struct
class GaussianBounds:
    """What trees are built from, relative to the scene's origin."""

    lower: wp.array[wp.vec3]
    upper: wp.array[wp.vec3]
    fate: wp.array[int]  # one of the four above
    takes_part: wp.array[int]  # 1 for what is traced


@wp.kernel
def pack_gaussians_kernel(
    first: int,
    cloud: CloudArrays,
    origin: wp.vec3,
    smallest_scale: float,
    largest_ratio: float,
    out_gaussians: Gaussians,
    out_bounds: GaussianBounds,
):
    """Pack one Gaussian; what cannot be traced gets radius -1 and a point for bounds, and its fate says why."""
    i = first + wp.tid()
    center = cloud.positions[i] - origin
    scale = cloud.scales[i]
    orientation = cloud.orientations[i]
    opacity = cloud.opacities[i]
    norm = wp.length(orientation)
    fate = int(TRACED)
    # Comparisons are phrased so that NaN and infinity fail them; minima and maxima would pass over NaN.
    usable = wp.length(center) < LARGEST_LENGTH and norm > 0.0 and norm < LARGEST_LENGTH and opacity <= 1.0
    for k in range(3):
        usable = usable and scale[k] >= 0.0 and scale[k] < LARGEST_LENGTH
    if not usable:
        fate = NOT_FINITE
        center = wp.vec3()
        orientation = wp.quat_identity()
        scale = wp.vec3(1.0)
    if not (opacity > ALPHA_MIN):
        if usable:
            fate = INVISIBLE
        opacity = 0.0
    if not usable:
        opacity = 0.0
    floor = wp.max(smallest_scale, wp.max(scale) * largest_ratio)
    if fate == TRACED and wp.min(scale) < floor:
        fate = RAISED
    scale = wp.vec3(wp.max(scale[0], floor), wp.max(scale[1], floor), wp.max(scale[2], floor))
    rotation = wp.quat_to_matrix(wp.normalize(orientation))
    radius_squared = float(-1.0)
    if fate == TRACED or fate == RAISED:
        radius_squared = 2.0 * wp.log(opacity / ALPHA_MIN)
        if out_gaussians.degree == 4:
            radius_squared = wp.sqrt(wp.log(opacity / ALPHA_MIN) / QUARTIC_FALLOFF)

    out_gaussians.center_opacity[i] = wp.vec4(center[0], center[1], center[2], opacity)
    out_gaussians.whitening_0[i] = wp.vec4(
        rotation[0, 0] / scale[0], rotation[1, 0] / scale[0], rotation[2, 0] / scale[0], radius_squared
    )
    out_gaussians.whitening_1[i] = wp.vec4(
        rotation[0, 1] / scale[1], rotation[1, 1] / scale[1], rotation[2, 1] / scale[1], 0.0
    )
    out_gaussians.whitening_2[i] = wp.vec4(
        rotation[0, 2] / scale[2], rotation[1, 2] / scale[2], rotation[2, 2] / scale[2], 0.0
    )

    # The half-extent of {x : |M x| <= r} along axis k is r |row k of R S|: tight, unlike the box of the rotated box.
    radius = wp.sqrt(wp.max(radius_squared, 0.0))
    half = wp.vec3()
    for k in range(3):
        row = wp.vec3(rotation[k, 0] * scale[0], rotation[k, 1] * scale[1], rotation[k, 2] * scale[2])
        # Rounding must not lose the ellipsoid: a relative 1e-5 of the extent plus two ulp of the coordinate.
        half[k] = radius * wp.length(row) * 1.00001 + 2.4e-7 * wp.abs(center[k])
    out_bounds.lower[i] = center - half
    out_bounds.upper[i] = center + half
    out_bounds.fate[i] = fate
    out_bounds.takes_part[i] = wp.where(fate == TRACED or fate == RAISED, 1, 0)


FATES_A_THREAD = wp.constant(32)


@wp.kernel
def count_fates_kernel(first: int, fates: wp.array[int], out_counts: wp.array[int]):
    """How many Gaussians met each fate."""
    begin = (first + wp.tid()) * FATES_A_THREAD
    counts = wp.vec4i()
    for i in range(begin, wp.min(begin + FATES_A_THREAD, fates.shape[0])):
        counts[fates[i]] += 1
    for fate in range(4):
        wp.atomic_add(out_counts, fate, counts[fate])


def launch_count_fates(fates, out_counts, device):
    """Count into ``out_counts``, four numbers that must be 0."""
    groups = -(-len(fates) // FATES_A_THREAD)
    launch(count_fates_kernel, groups, inputs=[fates], outputs=[out_counts], device=device, in_order=True)


launch_pack_gaussians = launcher(pack_gaussians_kernel)
"""Pack every Gaussian and its bounds; ``cloud`` is in world space, the outputs relative to ``origin``."""
