"""Pixels of depth images as fusion reads them, and how a point of the world finds its pixel.

A pixel is three numbers: inverse depth [1/m], slope and weight. Inverse depth is linear over the image of a plane, so
that interpolating it is exact there. Slope turns a difference of depth into a distance from the plane that the pixel
sees: with the ray r = (u, v, 1) through the pixel and the unit normal n towards the camera, a point that is dz nearer
than the surface on that ray is at the distance dz (-n r) in front of it. From depth alone, with q = 1/z and its
derivatives a, b by u and v, the plane's normal is along (a, b, q - u a - v b), and -n r = q / |(a, b, q - u a - v b)|.

A curved surface leaves that plane: a point at the height e above it is seen at e tan(t) beside its foot, t being the
angle between normal and ray, where the plane is off by (e tan(t))^2 / 2R. Weights fall with the fourth power of the
cosine, so that a mean over views is off by a bounded (e^2 / 2R) / 4 and mostly by what is seen from the front.

All zeros are background. Inverse depth without weight is a surface that is not trusted there: grazing, or at an edge.
"""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.raster.depth_normals import LEAST_DEPTH

wp.set_module_options({"enable_backward": False})

LARGEST_TILT = wp.constant(10.0)
"""Largest tangent of a surface's tilt, in pixels of depth per pixel of width: 84 degrees. Beyond it, one surface and
the edge between two are not told apart."""

LEAST_COSINE = wp.constant(0.1)
"""Smallest cosine between normal and ray at which a pixel counts, as for `LARGEST_TILT`."""


@wp.struct
class DepthCamera:
    """A pinhole, in a world whose origin is moved near to the subject so that floats are fine there."""

    rotation: wp.mat33  # world to camera
    translation: wp.vec3
    focal: wp.vec2  # pixel
    center: wp.vec2  # pixel
    width: int
    height: int
    first_pixel: int  # of this view, among those of all


@wp.func
def pixel_ray(camera: DepthCamera, x: float, y: float) -> wp.vec3:
    """The ray through a place on the image, in camera axes, of depth 1."""
    return wp.vec3((x - camera.center[0]) / camera.focal[0], (y - camera.center[1]) / camera.focal[1], 1.0)


@wp.func
def project_point(camera: DepthCamera, point: wp.vec3) -> wp.vec3:
    """Pixel x, y and depth of a point; depth 0 if it is not before the camera."""
    local = camera.rotation * point + camera.translation
    if not (local[2] > LEAST_DEPTH):
        return wp.vec3(-1.0, -1.0, 0.0)
    return wp.vec3(
        camera.focal[0] * local[0] / local[2] + camera.center[0],
        camera.focal[1] * local[1] / local[2] + camera.center[1],
        local[2],
    )


@wp.func
def pixel_point(camera: DepthCamera, x: float, y: float, inverse_depth: float) -> wp.vec3:
    """The point of the world that a place on the image shows."""
    local = pixel_ray(camera, x, y) / inverse_depth
    return wp.transpose(camera.rotation) * (local - camera.translation)


@wp.func
def footprint(camera: DepthCamera, inverse_depth: float) -> float:
    """Width of a pixel at a depth [m]."""
    return 1.0 / (inverse_depth * wp.min(camera.focal[0], camera.focal[1]))


@wp.func
def is_near(camera: DepthCamera, inverse_depth: float, other: float) -> bool:
    """Whether two neighbouring pixels see one surface."""
    step = wp.abs(other - inverse_depth)
    return other > 0.0 and step * wp.min(camera.focal[0], camera.focal[1]) <= LARGEST_TILT * wp.max(
        inverse_depth, other
    )


@wp.func
def sample_pixels(pixels: wp.array[wp.vec3], camera: DepthCamera, x: float, y: float) -> wp.vec3:
    """The pixel at a place on the image; zeros outside it and where no pixel is to be trusted.

    Bilinear where the four pixels around see one surface, the nearest one elsewhere; its weight in any case.
    """
    nothing = wp.vec3(0.0, 0.0, 0.0)
    # Guards come before conversions: far outside, the integer would overflow.
    if not (x >= 0.0 and y >= 0.0 and x < float(camera.width) and y < float(camera.height)):
        return nothing
    nearest = pixels[camera.first_pixel + int(y) * camera.width + int(x)]
    if not (nearest[2] > 0.0):
        return nothing
    if camera.width < 2 or camera.height < 2:
        return nearest
    # Half a pixel along the border is extrapolated, which planes allow as well.
    column = wp.clamp(int(wp.floor(x - 0.5)), 0, camera.width - 2)
    row = wp.clamp(int(wp.floor(y - 0.5)), 0, camera.height - 2)
    index = camera.first_pixel + row * camera.width + column
    a = pixels[index]
    b = pixels[index + 1]
    c = pixels[index + camera.width]
    d = pixels[index + camera.width + 1]
    if not (wp.min(wp.min(a[2], b[2]), wp.min(c[2], d[2])) > 0.0):
        return nearest
    q = nearest[0]
    if not (
        is_near(camera, q, a[0]) and is_near(camera, q, b[0]) and is_near(camera, q, c[0]) and is_near(camera, q, d[0])
    ):
        return nearest
    s = x - 0.5 - float(column)
    t = y - 0.5 - float(row)
    mixed = (a * (1.0 - s) + b * s) * (1.0 - t) + (c * (1.0 - s) + d * s) * t
    return wp.vec3(mixed[0], mixed[1], nearest[2])


@wp.func
def is_background(pixels: wp.array[wp.vec3], camera: DepthCamera, x: float, y: float) -> bool:
    """Whether a place on the image, and the pixels around it, show nothing at all."""
    if not (x >= 1.0 and y >= 1.0 and x < float(camera.width - 1) and y < float(camera.height - 1)):
        return False
    column = int(x)
    row = int(y)
    # The middle first: where a surface is seen, one read decides.
    if pixels[camera.first_pixel + row * camera.width + column][0] > 0.0:
        return False
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if pixels[camera.first_pixel + (row + dy) * camera.width + column + dx][0] > 0.0:
                return False
    return True


@wp.func
def covered_inverse_depth(
    depth: wp.array[float], alpha: wp.array[float], camera: DepthCamera, minimum_alpha: float, x: int, y: int
) -> float:
    """Inverse depth of a pixel, 0 where nothing is seen and outside the image; NaN fails every guard."""
    if x < 0 or y < 0 or x >= camera.width or y >= camera.height:
        return 0.0
    pixel = y * camera.width + x
    z = depth[pixel]
    if alpha[pixel] >= minimum_alpha and z > LEAST_DEPTH and z < wp.inf:
        return 1.0 / z
    return 0.0


@wp.func
def step_of(camera: DepthCamera, before: float, here: float, after: float) -> wp.vec2:
    """Change of inverse depth from pixel to pixel, and whether it is known: central, or towards the one near side."""
    back = is_near(camera, here, before)
    ahead = is_near(camera, here, after)
    if back and ahead:
        return wp.vec2(0.5 * (after - before), 1.0)
    if back:
        return wp.vec2(here - before, 1.0)
    if ahead:
        return wp.vec2(after - here, 1.0)
    return wp.vec2(0.0, 0.0)


@wp.kernel
def write_depth_pixels_kernel(
    first: int,
    depth: wp.array[float],
    alpha: wp.array[float],
    normals: wp.array2d[float],
    camera: DepthCamera,
    minimum_alpha: float,
    out_pixels: wp.array[wp.vec3],
):
    """``normals`` in world axes, or no rows: then those of the depth."""
    pixel = first + wp.tid()
    x = pixel % camera.width
    y = pixel / camera.width
    place = camera.first_pixel + pixel
    q = covered_inverse_depth(depth, alpha, camera, minimum_alpha, x, y)
    if not (q > 0.0):
        out_pixels[place] = wp.vec3(0.0, 0.0, 0.0)
        return
    near = int(0)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            inside = x + dx >= 0 and y + dy >= 0 and x + dx < camera.width and y + dy < camera.height
            other = covered_inverse_depth(depth, alpha, camera, minimum_alpha, x + dx, y + dy)
            if not inside or is_near(camera, q, other):  # the image's border is no edge of the surface
                near += 1
    left = covered_inverse_depth(depth, alpha, camera, minimum_alpha, x - 1, y)
    right = covered_inverse_depth(depth, alpha, camera, minimum_alpha, x + 1, y)
    above = covered_inverse_depth(depth, alpha, camera, minimum_alpha, x, y - 1)
    below = covered_inverse_depth(depth, alpha, camera, minimum_alpha, x, y + 1)
    along = step_of(camera, left, q, right)
    down = step_of(camera, above, q, below)
    ray = pixel_ray(camera, float(x) + 0.5, float(y) + 0.5)
    a = camera.focal[0] * along[0]
    b = camera.focal[1] * down[0]
    slope = float(0.0)
    if along[1] * down[1] > 0.0:
        slope = q / wp.length(wp.vec3(a, b, q - ray[0] * a - ray[1] * b))
    if normals.shape[0] > 0:
        normal = camera.rotation * wp.vec3(normals[pixel, 0], normals[pixel, 1], normals[pixel, 2])
        length = wp.length(normal)
        if length > 0.0:
            slope = -wp.dot(normal, ray) / length
    cosine = slope / wp.length(ray)
    share = float(near - 1) / 8.0
    squared = cosine * cosine
    weight = wp.min(alpha[pixel], 1.0) * squared * squared * share * share
    if cosine >= LEAST_COSINE and weight > 0.0:
        out_pixels[place] = wp.vec3(q, slope, weight)
    else:
        out_pixels[place] = wp.vec3(q, 0.0, 0.0)


@wp.kernel
def write_pixel_colors_kernel(
    first: int, color: wp.array2d[float], alpha: wp.array[float], first_pixel: int, out_colors: wp.array[wp.vec3]
):
    """Colour that is no longer multiplied by alpha."""
    pixel = first + wp.tid()
    straight = wp.vec3(0.0, 0.0, 0.0)
    if alpha[pixel] > 0.0:
        straight = wp.vec3(color[pixel, 0], color[pixel, 1], color[pixel, 2]) / alpha[pixel]
    out_colors[first_pixel + pixel] = straight


@wp.kernel
def drop_pixels_kernel(first: int, keep: wp.array[int], out_pixels: wp.array[wp.vec3]):
    pixel = first + wp.tid()
    if keep[pixel] == 0:
        out_pixels[pixel] = wp.vec3(out_pixels[pixel][0], 0.0, 0.0)


def launch_write_depth_pixels(depth, alpha, normals, camera, minimum_alpha, out_pixels, device):
    """Write the pixels of one view among those of all."""
    inputs = [depth, alpha, normals, camera, minimum_alpha]
    launch(write_depth_pixels_kernel, camera.width * camera.height, inputs=inputs, outputs=[out_pixels], device=device)


launch_write_pixel_colors = launcher(write_pixel_colors_kernel)
"""Write the colours of one view among those of all."""


launch_drop_pixels = launcher(drop_pixels_kernel)
"""Take away the weight of pixels that are not to be kept."""
