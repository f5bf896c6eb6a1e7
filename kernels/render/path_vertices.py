"""Where paths meet Gaussians and triangles, and what scatters there.

A camera's ray meets Gaussians in the order of their largest response. Hits that follow each other without a gap are one
layer of a surface; the layer that stops the ray is drawn with the probability that blending gives it, and it scatters
as one surface: the mean normal, material and place of its hits. A layer that faces away is drawn where those before it
leak; the one before it that faces the camera then takes its place. Rays from surfaces are stopped by one Gaussian,
drawn with the same probability: what they see is averaged over many of them anyway.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.mesh.occluder import nearest_on_mesh
from beam_warp.kernels.mesh.surface import RAY_LIFT, MeshSurface, surface_point
from beam_warp.kernels.trace.closest_surface import BUFFER_SIZE, LAST, hit_index, hit_time, nearest_hits
from beam_warp.kernels.trace.gaussian import ray_peak
from beam_warp.kernels.trace.occluders import surface_layer
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.wide_traversal import tree_sampled_hit

wp.set_module_options({"enable_backward": False})

LIFT = wp.constant(4.0)
"""How far rays start above a layer, in root mean squares of how far its Gaussians reach from it: as for measured
materials (`beam_warp.materials.normals`)."""

LEANING_COSINE = wp.constant(0.2)
"""Normals within 12 degrees of a right angle with the ray are those of an outline, not of a back."""

GAP_IN_SIZES = wp.constant(2.0)
"""Hits that follow each other by more than this many times the middle scale of the smaller Gaussian are of different
surfaces: neighbours on one overlap, and are turned against each other by less than that."""


@wp.struct
class PathMaterials:
    """What Gaussians and triangles look like; positions are relative to the scene's origin."""

    color_roughness: wp.array[wp.vec4]  # of Gaussians: base colour, roughness
    normal_thickness: wp.array[wp.vec4]  # unit normal, standard deviation along it [m]
    sizes: wp.array[float]  # middle scale of Gaussians [m]
    surface: MeshSurface  # one triangle of nothing where there is no mesh
    catches: wp.array[int]  # of triangles: 1 if they show nothing but the shadows on them


@wp.struct
class Vertex:
    """A surface point on a path."""

    found: bool
    catches: bool
    on_gaussian: bool
    t: float  # along the ray that found it [m]
    origin: wp.vec3  # where rays leave
    position: wp.vec3
    normal: wp.vec3
    base_color: wp.vec3
    roughness: float


@wp.func
def mesh_vertex(materials: PathMaterials, origin: wp.vec3, direction: wp.vec3, t: float, face: int) -> Vertex:
    """The point of a triangle that a ray meets; seen from behind it is turned around."""
    position = origin + direction * t
    corners = materials.surface.faces[face]
    a = materials.surface.points[corners[0]]
    b = materials.surface.points[corners[1]]
    c = materials.surface.points[corners[2]]
    across = wp.cross(b - a, c - a)
    area = wp.dot(across, across)
    u = wp.dot(wp.cross(b - position, c - position), across) / area
    v = wp.dot(wp.cross(c - position, a - position), across) / area
    point = surface_point(materials.surface, face, wp.vec3(u, v, 1.0 - u - v))
    vertex = Vertex()
    vertex.found = True
    vertex.catches = materials.catches[face] == 1
    vertex.t = t
    vertex.position = point.position
    vertex.origin = point.origin
    vertex.normal = point.normal
    if wp.dot(point.face_normal, direction) > 0.0:
        # The smooth surface's origin is on the other side; from behind a convex part is a concave one.
        vertex.origin = point.position - point.face_normal * RAY_LIFT
        vertex.normal = -point.normal
    vertex.base_color = point.base_color
    vertex.roughness = point.roughness
    return vertex


@wp.struct
class Layer:
    """Running sums over the hits of one layer, by their blending weights."""

    weight: float
    start: float  # t of the first hit: moments are about it, or squares of distances would cancel
    t: float
    t_squared: float
    thickness_squared: float
    last: float
    last_size: float
    normal: wp.vec3
    color_roughness: wp.vec4


@wp.func
def seen_side(normal: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """A normal that faces away, turned around: what is seen is the other side of a thin surface.

    One that leans back just a little belongs to an outline, where shading turns it to graze the viewer.
    """
    result = normal
    if wp.dot(normal, direction) > LEANING_COSINE:
        result = -normal
    return result


@wp.func
def layer_vertex(layer: Layer, origin: wp.vec3, direction: wp.vec3) -> Vertex:
    """The surface that a layer is."""
    vertex = Vertex()
    vertex.found = True
    behind = layer.t / layer.weight
    vertex.t = layer.start + behind
    vertex.position = origin + direction * vertex.t
    vertex.normal = -direction  # normals that cancel have no direction: the one that is seen best
    size = wp.length(layer.normal)
    if size > 1.0e-6 * layer.weight:
        vertex.normal = seen_side(layer.normal / size, direction)
    cosine = wp.dot(vertex.normal, direction)
    spread = wp.max(layer.t_squared / layer.weight - behind * behind, 0.0)
    reach = wp.sqrt(spread * cosine * cosine + layer.thickness_squared / layer.weight)
    vertex.origin = vertex.position + vertex.normal * (LIFT * reach)
    mean = layer.color_roughness / layer.weight
    vertex.base_color = wp.vec3(mean[0], mean[1], mean[2])
    vertex.roughness = mean[3]
    return vertex


@wp.func
def first_vertex(
    occluders: Any,
    materials: PathMaterials,
    settings: TraceSettings,
    origin: wp.vec3,
    direction: wp.vec3,
    choice: float,
) -> Vertex:
    """What a camera's ray is stopped by, if anything; ``choice`` in [0, 1) draws it."""
    mesh = nearest_on_mesh(occluders.mesh, origin, direction, LARGEST_FLOAT)
    layer = Layer()
    facing = Layer()  # the last one passed that faces the camera
    transmittance = float(1.0)
    chosen = int(0)  # the layer at hand stops the ray
    t_last = float(0.0)
    index_last = int(-1)
    more = int(1)
    while more == 1:
        buffer = nearest_hits(
            occluders.tree, occluders.gaussians, settings, origin, direction, t_last, index_last, mesh.t
        )
        taken = wp.min(buffer.count, BUFFER_SIZE)
        more = 0
        if buffer.count >= BUFFER_SIZE:  # a full buffer may have hidden others from view
            more = 1
        k = int(0)
        while k < taken and transmittance >= settings.stop:
            index = hit_index(buffer, k)
            t = hit_time(buffer, k)
            peak = ray_peak(occluders.gaussians, index, origin, direction)
            size = materials.sizes[index]
            if layer.weight > 0.0 and t - layer.last > GAP_IN_SIZES * wp.min(size, layer.last_size):
                if chosen == 1:
                    transmittance = 0.0
                else:
                    if wp.dot(layer.normal, direction) < 0.0:
                        facing = layer
                    layer = Layer()
            if peak.alpha > 0.0 and transmittance > 0.0:
                weight = transmittance * peak.alpha
                shape = load_row(materials.normal_thickness, index)
                if layer.weight == 0.0:
                    layer.start = t
                behind = t - layer.start
                layer.weight += weight
                layer.t += weight * behind
                layer.t_squared += weight * behind * behind
                layer.thickness_squared += weight * shape[3] * shape[3]
                layer.normal += weight * wp.vec3(shape[0], shape[1], shape[2])
                layer.color_roughness += weight * load_row(materials.color_roughness, index)
                layer.last = t
                layer.last_size = size
                transmittance *= 1.0 - peak.alpha
                if 1.0 - transmittance > choice:
                    chosen = 1
            k += 1
        if transmittance < settings.stop:
            more = 0
        t_last = hit_time(buffer, LAST)
        index_last = hit_index(buffer, LAST)
    vertex = Vertex()
    if chosen == 1:
        # The inside of a surface is seen through leaks of its outside, which is what was meant to be seen.
        if wp.dot(layer.normal, direction) > 0.0 and facing.weight > 0.0:
            layer = facing
        vertex = layer_vertex(layer, origin, direction)
    elif mesh.face >= 0:
        vertex = mesh_vertex(materials, origin, direction, mesh.t, mesh.face)
    return vertex


@wp.func
def next_vertex(
    occluders: Any,
    materials: PathMaterials,
    settings: TraceSettings,
    origin: wp.vec3,
    direction: wp.vec3,
    stream: wp.uint32,
) -> Vertex:
    """What a ray from a surface is stopped by, if anything."""
    mesh = nearest_on_mesh(occluders.mesh, origin, direction, LARGEST_FLOAT)
    vertex = Vertex()
    hit = tree_sampled_hit(occluders.tree, occluders.gaussians, settings, origin, direction, mesh.t, stream)
    if hit >= 0:
        shape = load_row(materials.normal_thickness, hit)
        look = load_row(materials.color_roughness, hit)
        vertex.found = True
        vertex.on_gaussian = True
        vertex.t = ray_peak(occluders.gaussians, hit, origin, direction).t
        vertex.position = origin + direction * vertex.t
        vertex.normal = seen_side(wp.vec3(shape[0], shape[1], shape[2]), direction)
        vertex.base_color = wp.vec3(look[0], look[1], look[2])
        vertex.roughness = look[3]
    elif mesh.face >= 0:
        vertex = mesh_vertex(materials, origin, direction, mesh.t, mesh.face)
    return vertex


@wp.func
def lifted_vertex(occluders: Any, vertex: Vertex) -> Vertex:
    """A vertex on a Gaussian, with the place from which its rays leave: off the layer of Gaussians around it."""
    surface = surface_layer(occluders, vertex.position, vertex.normal)
    result = vertex
    result.origin = vertex.position + vertex.normal * (surface[0] + LIFT * surface[1])
    return result
