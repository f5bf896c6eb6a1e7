"""Normals of a depth image by central differences, and the way back of their gradients to the depth.

The surface points of the four neighbours of a pixel are P = z r, with r = (u, v, 1) on the plane z = 1, and the normal
is the step down times the step to the right. Written out, with every factor that is common to the three components
divided away, it is

    n ~ (p, q, -(1 + u p + v q)),   p = fx (z_right - z_left) / (z_right + z_left),   q alike with fy, below and above,

in camera axes, at the pixel's own (u, v). Nothing cancels but the two differences of depth, which floats next to one
another subtract exactly; n r = -1 before normalising, so that every normal faces the camera; and it has no zero.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})

LEAST_DEPTH = wp.constant(1.0e-6)
"""Depth [m] that counts as none: the adjoint divides by it. The rasteriser draws nothing nearer than 0.01 m."""


@wp.struct
class DepthNormalCamera:
    """A camera, and which of its pixels have a normal."""

    camera_to_world: wp.mat33
    focal: wp.vec2  # pixel
    center: wp.vec2  # pixel
    minimum_alpha: float
    largest_jump: float  # between neighbours, of the depth between them


@wp.func
def is_covered(depth: wp.array2d[float], alpha: wp.array2d[float], view: DepthNormalCamera, y: int, x: int) -> bool:
    """Whether a pixel shows a surface; guards are such that NaN fails them."""
    z = depth[y, x]
    return alpha[y, x] > view.minimum_alpha and z > LEAST_DEPTH and z < wp.inf


@wp.func
def is_near(
    depth: wp.array2d[float], alpha: wp.array2d[float], view: DepthNormalCamera, y: int, x: int, center_depth: float
) -> bool:
    """Whether a pixel continues the surface of the pixel beside it."""
    step = wp.abs(depth[y, x] - center_depth)
    return is_covered(depth, alpha, view, y, x) and step <= view.largest_jump * center_depth


@wp.func
def has_normal(depth: wp.array2d[float], alpha: wp.array2d[float], view: DepthNormalCamera, y: int, x: int) -> bool:
    """Whether the five pixels of the stencil are inside the image and on one surface."""
    if x < 1 or y < 1 or x + 1 >= depth.shape[1] or y + 1 >= depth.shape[0]:
        return False
    if not is_covered(depth, alpha, view, y, x):
        return False
    z = depth[y, x]
    along = is_near(depth, alpha, view, y, x - 1, z) and is_near(depth, alpha, view, y, x + 1, z)
    return along and is_near(depth, alpha, view, y - 1, x, z) and is_near(depth, alpha, view, y + 1, x, z)


@wp.func
def slope(near: float, far: float) -> float:
    return (far - near) / (far + near)


@wp.func
def surface_slopes(depth: wp.array2d[float], view: DepthNormalCamera, y: int, x: int) -> wp.vec2:
    """p and q of the module's formula."""
    return wp.vec2(
        view.focal[0] * slope(depth[y, x - 1], depth[y, x + 1]), view.focal[1] * slope(depth[y - 1, x], depth[y + 1, x])
    )


@wp.func
def pixel_tangents(view: DepthNormalCamera, y: int, x: int) -> wp.vec2:
    """u and v of a pixel's centre."""
    return wp.vec2((float(x) + 0.5 - view.center[0]) / view.focal[0], (float(y) + 0.5 - view.center[1]) / view.focal[1])


@wp.func
def facing_normal(slopes: wp.vec2, tangents: wp.vec2) -> wp.vec3:
    """The normal in camera axes, before it is normalised."""
    return wp.vec3(slopes[0], slopes[1], -(1.0 + wp.dot(slopes, tangents)))


@wp.kernel
def write_depth_normals_kernel(
    first: int,
    depth: wp.array2d[float],
    alpha: wp.array2d[float],
    views: wp.array[DepthNormalCamera],
    out_normals: wp.array3d[float],
):
    view = views[0]
    pixel = first + wp.tid()
    x = pixel % depth.shape[1]
    y = pixel / depth.shape[1]
    normal = wp.vec3(0.0, 0.0, 0.0)
    if has_normal(depth, alpha, view, y, x):
        facing = facing_normal(surface_slopes(depth, view, y, x), pixel_tangents(view, y, x))
        normal = view.camera_to_world * wp.normalize(facing)
    for k in range(3):
        out_normals[y, x, k] = normal[k]


@wp.func
def slope_gradients(
    depth: wp.array2d[float], view: DepthNormalCamera, normal_gradients: wp.array3d[float], y: int, x: int
) -> wp.vec2:
    """Gradient with respect to p and q of the normal of a pixel that has one."""
    tangents = pixel_tangents(view, y, x)
    facing = facing_normal(surface_slopes(depth, view, y, x), tangents)
    length = wp.length(facing)
    normal = facing / length
    upstream = wp.transpose(view.camera_to_world) * wp.vec3(
        normal_gradients[y, x, 0], normal_gradients[y, x, 1], normal_gradients[y, x, 2]
    )
    to_facing = (upstream - normal * wp.dot(normal, upstream)) / length
    return wp.vec2(to_facing[0] - tangents[0] * to_facing[2], to_facing[1] - tangents[1] * to_facing[2])


@wp.func
def depth_share(
    depth: wp.array2d[float],
    alpha: wp.array2d[float],
    view: DepthNormalCamera,
    normal_gradients: wp.array3d[float],
    y: int,
    x: int,
    axis: int,
    side: int,
) -> float:
    """Gradient that the normal at (x, y) passes to its neighbour along an axis, on the side -1 or 1."""
    if not has_normal(depth, alpha, view, y, x):
        return 0.0
    gradients = slope_gradients(depth, view, normal_gradients, y, x)
    near = depth[y - axis, x - (1 - axis)]
    far = depth[y + axis, x + (1 - axis)]
    span = far + near
    across = near
    if side < 0:
        across = far
    return float(side) * gradients[axis] * view.focal[axis] * 2.0 * (across / span) / span


@wp.kernel
def add_depth_gradients_kernel(
    first: int,
    depth: wp.array2d[float],
    alpha: wp.array2d[float],
    views: wp.array[DepthNormalCamera],
    normal_gradients: wp.array3d[float],
    out_depth_gradients: wp.array2d[float],
):
    view = views[0]
    # A gather: a pixel asks the four normals that read it, in this order, so that no two threads write one sum.
    pixel = first + wp.tid()
    x = pixel % depth.shape[1]
    y = pixel / depth.shape[1]
    total = depth_share(depth, alpha, view, normal_gradients, y, x - 1, 0, 1)
    total += depth_share(depth, alpha, view, normal_gradients, y, x + 1, 0, -1)
    total += depth_share(depth, alpha, view, normal_gradients, y - 1, x, 1, 1)
    total += depth_share(depth, alpha, view, normal_gradients, y + 1, x, 1, -1)
    out_depth_gradients[y, x] += total


def launch_write_depth_normals(depth, alpha, views, out_normals, device):
    """Write the normals of every pixel; the only one of ``views`` is the camera."""
    launch(write_depth_normals_kernel, depth.size, inputs=[depth, alpha, views], outputs=[out_normals], device=device)


def launch_add_depth_gradients(depth, alpha, views, normal_gradients, out_depth_gradients, device):
    """Add to the gradients of every pixel's depth, from those of the normals."""
    inputs = [depth, alpha, views, normal_gradients]
    launch(add_depth_gradients_kernel, depth.size, inputs=inputs, outputs=[out_depth_gradients], device=device)
