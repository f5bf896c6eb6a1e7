"""From Gaussians in the world to splats on the image plane: elliptical weighted averaging with a low-pass filter.

Source: Zwicker et al. 2001, EWA Volume Splatting; Kerbl et al. 2023 for the constants. Both square forms are kept as
factors, so that nothing cancels: with T = J M (2 x 3; M the scaled axes in camera space), det(T T^T) = |t0 x t1|^2 is a
sum of squares (Cauchy-Binet), and the exponent is a sum of two squares by Cholesky. A needle a thousand pixels long is
then as exact as a ball.

Depth is the plane through the Gaussian's centre whose normal is Sigma^-1 (centre ray): the first-order surface of
maximum response (Zhang et al. 2024, RaDe-GS). It is kept as inverse depth, which is linear in the pixel for a plane, so
that a flat Gaussian's depth is exact over its whole footprint and not only near its centre.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LOW_PASS = wp.constant(0.3)
"""Variance [pixel^2] of the pixel filter that every splat is widened by (Kerbl et al. 2023)."""

NEAR = wp.constant(0.01)
"""Depth [m] before which a Gaussian's centre is not drawn: perspective explodes there."""

LOG_CUT = wp.constant(5.541263545158426)
"""ln 255: an alpha below 1/255 does not reach an 8-bit image and is left out."""

EXTENT_MARGIN = wp.constant(0.01)
"""Pixels added to an extent, so that rounding in it never hides a pixel that passes the alpha cut."""

DEPTH_REACH = wp.constant(3.0)
"""A grazing plane's depth stays within this many of the largest standard deviation, where the Gaussian ends."""


@wp.struct
class Gaussians:
    positions: wp.array[wp.vec3]
    orientations: wp.array[wp.quat]
    scales: wp.array[wp.vec3]
    opacities: wp.array[float]


@wp.struct
class Pinhole:
    world_to_camera: wp.mat33
    position: wp.vec3
    focal: wp.vec2
    center: wp.vec2
    width: int
    height: int


@wp.struct
class Splats:
    centers: wp.array[wp.vec2]  # pixel
    shapes: wp.array[wp.vec4]  # 1/sqrt(xx), xy/xx, sqrt(xx/det), ln opacity; of the filtered covariance
    planes: wp.array[wp.vec3]  # inverse depth at the centre [1/m], and its slope along x and y [1/m/pixel]
    depth_ranges: wp.array[wp.vec2]  # least and greatest inverse depth
    depths: wp.array[float]  # of the centre, for sorting; infinite if the splat is on no pixel
    boxes: wp.array[wp.vec4i]  # first x, first y, end x, end y [pixel]; empty if the splat is on no pixel


@wp.func
def inverse_depth_plane(center: wp.vec3, axes: wp.mat33, scales: wp.vec3, depth: float, focal: wp.vec2) -> wp.vec3:
    """Inverse depth at the centre and its slope along the pixel axes; ``center`` is on the plane z = 1."""
    # Sigma^-1 up to a factor, finite for a disc whose thickness is 0.
    least = wp.max(wp.min(scales[0], wp.min(scales[1], scales[2])), 1.0e-12)
    local = wp.transpose(axes) * center
    for i in range(3):
        ratio = least / wp.max(scales[i], least)
        local[i] = local[i] * ratio * ratio
    normal = axes * local
    facing = wp.dot(normal, center)
    inverse = 1.0 / depth
    if not (facing > 1.0e-12 * wp.length(normal)):
        return wp.vec3(inverse, 0.0, 0.0)  # seen exactly edge on
    return wp.vec3(inverse, inverse * normal[0] / (facing * focal[0]), inverse * normal[1] / (facing * focal[1]))


@wp.kernel
def project_gaussians_kernel(first: int, gaussians: Gaussians, camera: Pinhole, antialiased: int, out_splats: Splats):
    i = first + wp.tid()
    out_splats.depths[i] = wp.inf
    out_splats.boxes[i] = wp.vec4i(0, 0, 0, 0)
    p = camera.world_to_camera * (gaussians.positions[i] - camera.position)
    z = p[2]
    if not (z > NEAR):
        return
    u = p[0] / z
    v = p[1] / z
    width = float(camera.width)
    height = float(camera.height)
    focal = camera.focal
    # The Jacobian is taken inside the image grown by 15 % of its size to each side: far outside it would explode.
    margin_x = 0.15 * width / focal[0]
    margin_y = 0.15 * height / focal[1]
    ju = wp.clamp(u, -camera.center[0] / focal[0] - margin_x, (width - camera.center[0]) / focal[0] + margin_x)
    jv = wp.clamp(v, -camera.center[1] / focal[1] - margin_y, (height - camera.center[1]) / focal[1] + margin_y)
    axes = camera.world_to_camera * wp.quat_to_matrix(wp.normalize(gaussians.orientations[i]))
    scales = gaussians.scales[i]
    scaled = axes * wp.diag(scales)
    t0 = (focal[0] / z) * (scaled[0] - ju * scaled[2])
    t1 = (focal[1] / z) * (scaled[1] - jv * scaled[2])
    xx = wp.dot(t0, t0)
    xy = wp.dot(t0, t1)
    yy = wp.dot(t1, t1)
    cross = wp.cross(t0, t1)
    sharp_det = wp.dot(cross, cross)
    det = sharp_det + LOW_PASS * (xx + yy) + LOW_PASS * LOW_PASS
    xx += LOW_PASS
    yy += LOW_PASS
    opacity = gaussians.opacities[i]
    if antialiased != 0:
        # What the filter adds in area it takes in height (Yu et al. 2024, Mip-Splatting, Eq. 9).
        opacity *= wp.sqrt(sharp_det / det)
    log_opacity = wp.log(opacity)
    if not (log_opacity > -LOG_CUT):
        return
    # Alpha falls to 1/255 at this many standard deviations.
    extent = wp.sqrt(2.0 * (LOG_CUT + log_opacity))
    center = wp.vec2(focal[0] * u + camera.center[0], focal[1] * v + camera.center[1])
    reach_x = extent * wp.sqrt(xx) + EXTENT_MARGIN
    reach_y = extent * wp.sqrt(yy) + EXTENT_MARGIN
    # Pixels whose centre (+0.5) is in reach. Clamped as floats: an integer cannot hold every float.
    x0 = int(wp.clamp(wp.ceil(center[0] - reach_x - 0.5), 0.0, width))
    y0 = int(wp.clamp(wp.ceil(center[1] - reach_y - 0.5), 0.0, height))
    x1 = int(wp.clamp(wp.floor(center[0] + reach_x - 0.5) + 1.0, 0.0, width))
    y1 = int(wp.clamp(wp.floor(center[1] + reach_y - 0.5) + 1.0, 0.0, height))
    finite = wp.isfinite(center[0]) and wp.isfinite(center[1]) and wp.isfinite(det)  # positions beyond 1e19 overflow
    if not (finite and x1 > x0 and y1 > y0):
        return
    largest = DEPTH_REACH * wp.max(scales[0], wp.max(scales[1], scales[2]))
    out_splats.centers[i] = center
    out_splats.shapes[i] = wp.vec4(1.0 / wp.sqrt(xx), xy / xx, wp.sqrt(xx / det), log_opacity)
    out_splats.planes[i] = inverse_depth_plane(wp.vec3(u, v, 1.0), axes, scales, z, focal)
    out_splats.depth_ranges[i] = wp.vec2(1.0 / (z + largest), 1.0 / wp.max(z - largest, NEAR))
    out_splats.depths[i] = z
    out_splats.boxes[i] = wp.vec4i(x0, y0, x1, y1)
