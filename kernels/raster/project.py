"""Projection of Gaussians to splats on the image plane: elliptical weighted averaging with a low-pass filter.

Source: Zwicker et al. 2001, EWA Volume Splatting; Kerbl et al. 2023 for the constants. Both square forms are kept as
factors, so that nothing cancels: with T = J M (2 x 3; M the scaled axes in camera space), det(T T^T) = |t0 x t1|^2 is a
sum of squares (Cauchy-Binet), and the exponent is a sum of two squares by Cholesky. A needle a thousand pixels long is
then as exact as a ball.

Depth is that of the largest response on the pixel's ray. With a = W R^T c and b = W R^T d (c the centre's ray, d the
way from it to the pixel's, both on the plane z = 1; W the inverse scales up to a factor), it is z / (l + e / l), where
l = 1 + a.b / a.a and e = |a x b|^2 / (a.a)^2: no inverse of a covariance, and finite for a disc of no thickness. For
that disc e = 0, so that z / l is exact over its whole footprint; for others z / l is the plane through the centre that
is tangent to the surface of largest response (Zhang et al. 2024, RaDe-GS), and z / (l + e / l) the surface itself.

Warp makes the adjoint of this module. The kernel writes only what it is differentiated for, because the adjoint writes
its outputs again.

Derivatives to cameras are those of a second form of the kernel, in which every splat has a camera of its own, moved by
a `CameraMove` of zeros: each splat then has a row of derivatives that no other splat adds to, and the rows of a view
are summed in a fixed order (`kernels.raster.camera_sums`). Two of its numbers are the radial terms of a lens, taken at
the pinhole that is drawn. Elliptical weighted averaging puts the affine map at the centre in the place of the way from
space to the image, and a lens is part of that way: with D its Jacobian at the centre, T becomes F D F^-1 T (F the focal
lengths), and b goes by D^-1. So a lens moves centres, covariances and depths alike. Its radius is that of the place at
which J is taken.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.launching import launch, launch_adjoint
from beam_warp.kernels.raster.strided_rows import store_row

LOG_CUT = wp.constant(7.994353436858858)
"""log2 255: an alpha below 1/255 does not reach an 8-bit image and is left out."""

WHITENING = wp.constant(0.8493218002880191)
"""sqrt(log2(e) / 2): a standard deviation in whitened offsets, whose squares are exponents of two."""

DEPTH_REACH = wp.constant(3.0)
"""A depth stays within this many of the largest standard deviation of the centre's, where the Gaussian ends."""

SMALLEST_SCALE = wp.constant(1.0e-12)
"""A thickness of 0 is taken for this [m]: a disc keeps a normal."""


@wp.struct
class RasterView:
    """A camera, and where its tiles and pixels are among those of all cameras that are drawn together."""

    world_to_camera: wp.mat33
    position: wp.vec3
    focal: wp.vec2
    center: wp.vec2
    width: int
    height: int
    columns: int  # tiles in a row
    first_tile: int
    first_pixel: int


@wp.struct
class Projection:
    """Options of the projection."""

    low_pass: float  # variance [pixel^2] of the pixel filter that every splat is widened by
    near: float  # depth [m] before which a Gaussian's centre is not drawn
    antialiased: int  # 1: what the filter adds in area it takes in height


@wp.struct
class Splats:
    """Splats of every (view, Gaussian), view by view.

    A splat that is not drawn has an opacity of 0. With d the pixel's offset from the centre, alpha is
    2^(log2 o - e0^2 - e1^2), e0 = s0 dx, e1 = s2 (dy - s1 dx), and c is `WHITENING`: what GPUs have is the power of
    two, and a pixel then costs two operations less than by exp(-|e|^2 / 2).
    """

    centers: wp.array[wp.vec4]  # x, y [pixel], log2 of opacity, depth of the centre [m]
    shapes: wp.array[wp.vec4]  # s0 = c/sqrt(xx), s1 = xy/xx, s2 = c sqrt(xx/det) of the filtered covariance; reach [m]
    slopes: wp.array[wp.vec4]  # l = 1 + gx dx + gy dy; e = exx dx^2 + 2 exy dx dy + eyy dy^2: gx, gy, exx, exy
    bends: wp.array[float]  # eyy
    normals: wp.array[wp.vec3]  # unit, in the world, towards the camera: of the surface of largest response; or none


@wp.struct
class Splat:
    """One of `Splats`."""

    center: wp.vec4
    shape: wp.vec4
    slope: wp.vec4
    bend: float
    normal: wp.vec3


CameraMove = wp.types.vector(length=12, dtype=float)
"""A small change of a camera: turn [rad] and shift [m] in its own axes, after which a point p in them is at
p + turn x p + shift; added focal lengths and principal point [pixel]; radial terms k1 and k2 of a lens, with which the
tangents u, v of a ray are those times 1 + k1 r^2 + k2 r^4."""


@wp.func
def moved_point(p: wp.vec3, move: CameraMove) -> wp.vec3:
    return p + wp.cross(wp.vec3(move[0], move[1], move[2]), p) + wp.vec3(move[3], move[4], move[5])


@wp.func
def lens_jacobian(u: float, v: float, move: CameraMove) -> wp.mat22:
    """Jacobian of a lens at the tangents of a ray."""
    square = u * u + v * v
    growth = 1.0 + square * (move[10] + square * move[11])
    slope = 2.0 * (move[10] + 2.0 * square * move[11])
    mixed = slope * u * v
    return wp.mat22(growth + slope * u * u, mixed, mixed, growth + slope * v * v)


@cache
def project_function(with_camera: bool):
    """Return the function that makes the splat of a Gaussian in a view, whose camera is moved where there is one."""

    @wp.func
    def project(
        i: int,
        positions: wp.array[wp.vec3],
        orientations: wp.array[wp.quat],
        scales: wp.array[wp.vec3],
        opacities: wp.array[float],
        view: RasterView,
        move: CameraMove,
        projection: Projection,
    ) -> Splat:
        splat = Splat()
        splat.center = wp.vec4(0.0, 0.0, -wp.inf, 0.0)
        p = view.world_to_camera * (positions[i] - view.position)
        focal = view.focal
        middle = view.center
        if wp.static(with_camera):
            p = moved_point(p, move)
            focal = focal + wp.vec2(move[6], move[7])
            middle = middle + wp.vec2(move[8], move[9])
        z = p[2]
        if not (z > projection.near):
            return splat
        u = p[0] / z
        v = p[1] / z
        width = float(view.width)
        height = float(view.height)
        # The Jacobian is taken inside the image grown by 15 % of its size to each side: far outside it would explode.
        margin_x = 0.15 * width / focal[0]
        margin_y = 0.15 * height / focal[1]
        ju = wp.clamp(u, -middle[0] / focal[0] - margin_x, (width - middle[0]) / focal[0] + margin_x)
        jv = wp.clamp(v, -middle[1] / focal[1] - margin_y, (height - middle[1]) / focal[1] + margin_y)
        orientation = orientations[i]
        # Warp normalises a quaternion of NaN to 0, and turns 0 into a rotation.
        if not (wp.dot(orientation, orientation) > 0.0):
            return splat
        axes = view.world_to_camera * wp.quat_to_matrix(wp.normalize(orientation))
        if wp.static(with_camera):
            axes = axes + wp.skew(wp.vec3(move[0], move[1], move[2])) * axes
        s = scales[i]
        scaled = axes * wp.diag(s)
        row_x = wp.vec3(scaled[0, 0], scaled[0, 1], scaled[0, 2])
        row_y = wp.vec3(scaled[1, 0], scaled[1, 1], scaled[1, 2])
        row_z = wp.vec3(scaled[2, 0], scaled[2, 1], scaled[2, 2])
        right = wp.vec3(axes[0, 0], axes[0, 1], axes[0, 2])
        down = wp.vec3(axes[1, 0], axes[1, 1], axes[1, 2])
        across_x = row_x - ju * row_z
        across_y = row_y - jv * row_z
        x = focal[0] * u + middle[0]
        y = focal[1] * v + middle[1]
        if wp.static(with_camera):
            lens = lens_jacobian(ju, jv, move)
            bent_x = lens[0, 0] * across_x + lens[0, 1] * across_y
            across_y = lens[1, 0] * across_x + lens[1, 1] * across_y
            across_x = bent_x
            back = wp.inverse(lens)
            straight = back[0, 0] * right + back[1, 0] * down
            down = back[0, 1] * right + back[1, 1] * down
            right = straight
            square = ju * ju + jv * jv
            growth = 1.0 + square * (move[10] + square * move[11])
            x = focal[0] * u * growth + middle[0]
            y = focal[1] * v * growth + middle[1]
        t0 = (focal[0] / z) * across_x
        t1 = (focal[1] / z) * across_y
        sharp_xx = wp.dot(t0, t0)
        xy = wp.dot(t0, t1)
        sharp_yy = wp.dot(t1, t1)
        cross = wp.cross(t0, t1)
        sharp_det = wp.dot(cross, cross)
        low_pass = projection.low_pass
        det = sharp_det + low_pass * (sharp_xx + sharp_yy) + low_pass * low_pass
        xx = sharp_xx + low_pass
        opacity = opacities[i]
        kept = float(1.0)
        if projection.antialiased != 0:
            # Yu et al. 2024, Mip-Splatting, Eq. 9.
            kept = sharp_det / det
        # What is too faint is not drawn: after this line no logarithm or root is near its pole. Positions beyond 1e19
        # overflow.
        faint = not (opacity * opacity * kept > 1.5378700499807768e-05)  # 1 / 255^2
        if faint or not (wp.isfinite(x) and wp.isfinite(y) and wp.isfinite(det) and det > 0.0):
            return splat
        log_opacity = wp.log2(opacity) + 0.5 * wp.log2(kept)
        # Floored one by one: the adjoint of a maximum of equal numbers goes to one of them, and scales are often equal.
        thick = wp.vec3(wp.max(s[0], SMALLEST_SCALE), wp.max(s[1], SMALLEST_SCALE), wp.max(s[2], SMALLEST_SCALE))
        least = wp.min(thick[0], wp.min(thick[1], thick[2]))
        largest = wp.max(s[0], wp.max(s[1], s[2]))
        inverse = wp.vec3(least / thick[0], least / thick[1], least / thick[2])
        away = wp.vec3(u, v, 1.0)
        a = wp.cw_mul(inverse, wp.transpose(axes) * away)
        b0 = wp.cw_mul(inverse, right) / focal[0]
        b1 = wp.cw_mul(inverse, down) / focal[1]
        aa = wp.dot(a, a)
        c0 = wp.cross(a, b0) / aa
        c1 = wp.cross(a, b1) / aa
        normal = -(axes * wp.cw_mul(inverse, a))
        if wp.static(with_camera):
            normal = normal - wp.cross(wp.vec3(move[0], move[1], move[2]), normal)
        splat.center = wp.vec4(x, y, log_opacity, z)
        splat.shape = wp.vec4(WHITENING / wp.sqrt(xx), xy / xx, WHITENING * wp.sqrt(xx / det), DEPTH_REACH * largest)
        splat.slope = wp.vec4(wp.dot(a, b0) / aa, wp.dot(a, b1) / aa, wp.dot(c0, c0), wp.dot(c0, c1))
        splat.bend = wp.dot(c1, c1)
        splat.normal = wp.normalize(wp.transpose(view.world_to_camera) * normal)
        return splat

    return project


project_still, project_moved = project_function(False), project_function(True)


@wp.func
def write_splat(i: int, splat: Splat, out_splats: Splats):
    """Write all rows of a splat."""
    store_row(out_splats.centers, i, splat.center)
    store_row(out_splats.shapes, i, splat.shape)
    store_row(out_splats.slopes, i, splat.slope)
    out_splats.bends[i] = splat.bend
    if out_splats.normals.shape[0] > 0:
        out_splats.normals[i] = splat.normal


@wp.kernel(launch_bounds=(256, 2))
def project_gaussians_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    orientations: wp.array[wp.quat],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    views: wp.array[RasterView],
    projection: Projection,
    out_splats: Splats,
):
    i = first + wp.tid()
    count = positions.shape[0]
    gaussian = i % count
    splat = project_still(
        gaussian, positions, orientations, scales, opacities, views[i / count], CameraMove(), projection
    )
    write_splat(i, splat, out_splats)


@wp.kernel(launch_bounds=(256, 2))
def project_with_cameras_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    orientations: wp.array[wp.quat],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    views: wp.array[RasterView],
    projection: Projection,
    moves: wp.array[CameraMove],
    out_splats: Splats,
):
    i = first + wp.tid()
    count = positions.shape[0]
    gaussian = i % count
    splat = project_moved(gaussian, positions, orientations, scales, opacities, views[i / count], moves[i], projection)
    write_splat(i, splat, out_splats)


def launch_project(gaussians, views, projection, out_splats, device):
    """Project every Gaussian into every view; ``gaussians`` are positions, orientations, scales and opacities."""
    inputs = [*gaussians, views, projection]
    launch(project_gaussians_kernel, len(out_splats.centers), inputs=inputs, outputs=[out_splats], device=device)


def launch_project_adjoint(gaussians, views, projection, splats, out_gradients, device, moves=None):
    """Add to ``out_gradients``, those of the four ``gaussians``, from the gradients of ``splats``.

    The arrays of ``splats`` carry their gradients as Warp's ``grad``: Warp reads none from a struct of its own. Those
    of the zeros in ``moves``, a camera for every splat, are added to their ``grad``; None leaves cameras out.
    """
    kernel = project_gaussians_kernel if moves is None else project_with_cameras_kernel
    count = len(gaussians[0])
    for view in range(len(views)):  # one view at a time: each Gaussian is then added to once a launch, in this order
        launch_adjoint(
            kernel,
            range(view * count, (view + 1) * count),
            inputs=[*gaussians, views, projection, *([] if moves is None else [moves])],
            outputs=[splats],
            input_gradients=[*out_gradients, None, Projection(), *([] if moves is None else [moves.grad])],
            output_gradients=[Splats()],
            device=device,
        )
