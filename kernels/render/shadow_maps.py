"""Shadow maps drawn from Gaussians and meshes: what of a light's radiance reaches a point, its disc taken into account.

A texel knows of the Gaussians before it how much they hide and how deep they lie, by median and by mean, and how deep
the first triangle lies. Of one layer both depths agree. Where they differ, the texel sees two: an edge with something
behind. If the nearer layer hides more than half it is the median's, and its share is what brings the mean to its place;
if it hides less, its depth is not known, and it casts no shadow on Gaussians behind it in the texel.

Filtering: percentages of comparisons (Reeves et al. 1987) over the part of the map that the light's disc covers as seen
from the point through what is in the way (Fernando 2005). Every comparison is with the point's tangent plane at the
texel, so that a kernel of any size leaves a plane unshadowed, and begins a bias before it.
"""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.mesh.surface import MeshSurface
from beam_warp.kernels.raster.depth_normals import LEAST_DEPTH
from beam_warp.kernels.raster.pinholes import camera_point, image_point, room_around
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.raster.splat_rows import quick_divide

wp.set_module_options({"enable_backward": False})

STEEPEST = wp.constant(10.0)
"""Largest tangent of a receiver's slope against the light: 84 degrees. Beyond it a texel cannot tell what is in the way
from the receiver itself, and little of the light arrives."""

EDGE_ON = wp.constant(20.0)
"""Tangent, 87 degrees, from which on no shadow is received; it fades in between: terminators are lit, not dirty."""

CURVATURE_TEXELS = wp.constant(0.5)
"""What a surface rises over its tangent plane within a texel, in texels."""

SMOOTH_KERNEL = wp.constant(4.0)
"""Radius below which taps are bilinear [texel]: in wider kernels they are texels apart, and hit many."""

ROUNDING = wp.constant(4.0e-7)
"""Share of a depth that is rounding: a few float32 steps."""


@wp.struct
class ShadowMaps:
    """Maps of several lights, in one array of texels."""

    views: wp.array[RasterView]
    texels: wp.array[wp.vec4]  # of the Gaussians alpha, median depth, mean depth; depth of the mesh [m]
    radii: wp.array[float]  # of each light's disc, at its view's position [m]
    fronts: wp.array[float]  # depth before which nothing is [m]
    search_taps: wp.array[wp.vec2]  # places in the unit disc
    filter_taps: wp.array[wp.vec2]
    thickness: float  # depth within which Gaussians are one layer [m]
    largest_kernel: float  # radius [texel]


@wp.struct
class Receiver:
    """A point as a map sees it."""

    place: wp.vec2  # [texel]
    depth: float
    slope: wp.vec2  # of its tangent plane's depth [m/texel]
    bias: float
    trust: float  # how far a map can tell what is in the way from the receiver itself
    inside: bool


@wp.kernel
def gather_texels_kernel(
    first: int,
    alpha: wp.array[float],
    median_depth: wp.array[float],
    mean_depth: wp.array[float],
    mesh_depth: wp.array[float],
    out_texels: wp.array[wp.vec4],
):
    """Depths of nothing are put behind everything."""
    i = first + wp.tid()
    behind = float(LARGEST_FLOAT)
    if mesh_depth.shape[0] > 0:
        behind = mesh_depth[i]
    out_texels[i] = wp.vec4(wp.min(alpha[i], 1.0), median_depth[i], mean_depth[i], behind)


@wp.kernel
def cast_mesh_kernel(
    first: int, surface: MeshSurface, views: wp.array[RasterView], texels_of_view: int, out_depth: wp.array[float]
):
    """Depth of the first triangle along every texel's ray."""
    i = first + wp.tid()
    view = views[i / texels_of_view]
    within = i % texels_of_view
    x = (float(within % view.width) + 0.5 - view.center[0]) / view.focal[0]
    y = (float(within / view.width) + 0.5 - view.center[1]) / view.focal[1]
    ray = wp.vec3(x, y, 1.0)
    length = wp.length(ray)
    direction = wp.transpose(view.world_to_camera) * (ray / length)
    query = wp.mesh_query_ray(surface.mesh, view.position, direction, LARGEST_FLOAT)
    depth = float(LARGEST_FLOAT)
    if query.result:
        depth = query.t / length
    out_depth[i] = depth


@wp.func
def receive(maps: ShadowMaps, k: int, point: wp.vec3, normal: wp.vec3) -> Receiver:
    """A point of a surface in a map; not ``inside`` if the map does not see it."""
    view = maps.views[k]
    p = camera_point(view, point)
    receiver = Receiver()
    receiver.inside = False
    if p[2] > LEAST_DEPTH:
        receiver.depth = p[2]
        receiver.place = image_point(view, p)
        receiver.inside = room_around(view, receiver.place) > 0.0
        n = view.world_to_camera * normal
        texel = p[2] / view.focal[0]
        across = wp.vec2(n[0], n[1])
        facing = -wp.dot(n, p) / p[2]
        receiver.trust = 1.0  # what faces away is behind itself
        if facing > 0.0:
            steep = wp.length(across) / facing
            receiver.trust = wp.clamp((EDGE_ON - steep) / (EDGE_ON - STEEPEST), 0.0, 1.0)
        facing = wp.max(facing, wp.max(wp.length(across) / STEEPEST, 1.0e-6))
        receiver.slope = across * (texel / facing)
        receiver.bias = CURVATURE_TEXELS * (texel + wp.length(receiver.slope)) + ROUNDING * p[2]
    return receiver


@wp.func
def rise(distance: float, width: float) -> float:
    """0 before, 1 from the width on."""
    return wp.clamp(quick_divide(distance, wp.max(width, 1.0e-9)), 0.0, 1.0)


@wp.func
def hidden_share(texel: wp.vec4, depth: float, bias: float, thickness: float) -> float:
    """How much of the light something before a depth takes away."""
    soft = bias + thickness
    by_gaussians = float(0.0)
    if texel[0] > 0.0:
        median = texel[1]
        mean = texel[2]
        layer = median
        if wp.abs(mean - median) < thickness:
            layer = wp.max(mean, median)
        by_gaussians = texel[0] * rise(depth - layer - soft, soft)
        if mean > median + thickness and depth > median:
            share = wp.clamp(quick_divide(depth - mean, depth - median), 0.5, 1.0)
            by_gaussians = by_gaussians * share
    by_mesh = rise(depth - texel[3] - bias, bias)
    return 1.0 - (1.0 - by_gaussians) * (1.0 - by_mesh)


@wp.func
def first_depth(texel: wp.vec4) -> float:
    """Depth of what hides."""
    depth = texel[3]
    if texel[0] > 0.0:
        depth = wp.min(depth, texel[1])
    return depth


@wp.func
def texel_at(maps: ShadowMaps, view: RasterView, x: int, y: int) -> wp.vec4:
    column = wp.clamp(x, 0, view.width - 1)
    row = wp.clamp(y, 0, view.height - 1)
    return load_row(maps.texels, view.first_pixel + row * view.width + column)


@wp.func
def plane_depth(receiver: Receiver, x: int, y: int) -> float:
    """Depth of the receiver's tangent plane at a texel's centre."""
    offset = wp.vec2(float(x) + 0.5, float(y) + 0.5) - receiver.place
    return receiver.depth + wp.dot(receiver.slope, offset)


@wp.func
def hidden_at(maps: ShadowMaps, view: RasterView, receiver: Receiver, x: int, y: int) -> float:
    return hidden_share(texel_at(maps, view, x, y), plane_depth(receiver, x, y), receiver.bias, maps.thickness)


@wp.func
def hidden_between(maps: ShadowMaps, view: RasterView, receiver: Receiver, place: wp.vec2) -> float:
    """Bilinear between the comparisons of four texels."""
    x = place[0] - 0.5
    y = place[1] - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - float(column)
    fy = y - float(row)
    top = hidden_at(maps, view, receiver, column, row) * (1.0 - fx)
    top += hidden_at(maps, view, receiver, column + 1, row) * fx
    bottom = hidden_at(maps, view, receiver, column, row + 1) * (1.0 - fx)
    bottom += hidden_at(maps, view, receiver, column + 1, row + 1) * fx
    return top * (1.0 - fy) + bottom * fy


@wp.func
def turned(tap: wp.vec2, turn: wp.vec2) -> wp.vec2:
    return wp.vec2(tap[0] * turn[0] - tap[1] * turn[1], tap[0] * turn[1] + tap[1] * turn[0])


@wp.func
def disc_kernel(view: RasterView, radius: float, depth: float, blocker: float) -> float:
    """Radius, in texels at a blocker's depth, of the cone from a point to the light's disc [texel]."""
    return view.focal[0] * radius * wp.max(depth - blocker, 0.0) / (depth * wp.max(blocker, LEAST_DEPTH))


@wp.func
def blocker_depth(maps: ShadowMaps, k: int, view: RasterView, receiver: Receiver, turn: wp.vec2) -> float:
    """Mean depth of what hides the light's disc, weighted by how much of it; 0 if nothing does."""
    reach = disc_kernel(view, maps.radii[k], receiver.depth, maps.fronts[k])
    reach = wp.clamp(reach, 1.0, maps.largest_kernel)
    total = float(0.0)
    weight = float(0.0)
    for i in range(maps.search_taps.shape[0]):
        place = receiver.place + reach * turned(maps.search_taps[i], turn)
        x = int(wp.floor(place[0]))
        y = int(wp.floor(place[1]))
        texel = texel_at(maps, view, x, y)
        hidden = hidden_share(texel, plane_depth(receiver, x, y), receiver.bias, maps.thickness)
        total += hidden * first_depth(texel)
        weight += hidden
    depth = float(0.0)
    if weight > 0.0:
        depth = total / weight
    return depth


@wp.func
def visible_share(maps: ShadowMaps, k: int, point: wp.vec3, normal: wp.vec3, turn: wp.vec2) -> float:
    """Share of a light that reaches a point; 1 outside of its map. Taps turn by the angle of a cosine and sine."""
    receiver = receive(maps, k, point, normal)
    if not receiver.inside or receiver.trust <= 0.0:
        return 1.0
    view = maps.views[k]
    radius = float(1.0)
    if maps.radii[k] > 0.0:
        blocker = blocker_depth(maps, k, view, receiver, turn)
        if not (blocker > 0.0):
            return 1.0
        radius = wp.clamp(disc_kernel(view, maps.radii[k], receiver.depth, blocker), 1.0, maps.largest_kernel)
    hidden = float(0.0)
    count = maps.filter_taps.shape[0]
    for i in range(count):
        place = receiver.place + radius * turned(maps.filter_taps[i], turn)
        if radius < SMOOTH_KERNEL:
            hidden += hidden_between(maps, view, receiver, place)
        else:
            hidden += hidden_at(maps, view, receiver, int(wp.floor(place[0])), int(wp.floor(place[1])))
    return 1.0 - receiver.trust * hidden / float(count)


@wp.func
def face_towards(away: wp.vec3) -> int:
    """Which of six faces a direction from the middle of a cube goes through: +x, -x, +y, -y, +z, -z."""
    size = wp.vec3(wp.abs(away[0]), wp.abs(away[1]), wp.abs(away[2]))
    axis = int(0)
    if size[1] > size[axis]:
        axis = 1
    if size[2] > size[axis]:
        axis = 2
    return 2 * axis + wp.where(away[axis] < 0.0, 1, 0)


def launch_gather_texels(images, mesh_depth, out_texels, device):
    """Put what a rasteriser drew, and depths of meshes (none: an empty array), into texels."""
    inputs = [images.alpha, images.median_depth, images.depth, mesh_depth]
    launch(gather_texels_kernel, len(out_texels), inputs=inputs, outputs=[out_texels], device=device)


launch_cast_mesh = launcher(cast_mesh_kernel)
"""Cast a ray through every texel of every view, all of one size."""
