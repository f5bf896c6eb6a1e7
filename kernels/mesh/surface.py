"""A triangle mesh with a material at every vertex, and where rays meet it.

The mesh stands for the smooth surface that its vertex normals describe. Rays leave from that surface
(`SurfacePoint.origin`), not from the flat triangle: on convex parts they would otherwise hit neighbouring triangles
below the shading horizon and draw dark facets along the terminator (Hanika 2021).
"""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT

RAY_LIFT = wp.constant(2.0e-5)
"""Lift of a ray's origin along the triangle's normal [m]: some twenty float32 steps of a coordinate of a few metres,
which is what the intersection's rounding amounts to."""


@wp.struct
class MeshSurface:
    mesh: wp.uint64
    points: wp.array[wp.vec3]
    faces: wp.array[wp.vec3i]
    normals: wp.array[wp.vec3]  # outward, at the vertices
    base_color: wp.array[wp.vec3]
    roughness: wp.array[float]


@wp.struct
class SurfacePoint:
    position: wp.vec3
    origin: wp.vec3  # where rays leave
    normal: wp.vec3  # interpolated
    face_normal: wp.vec3
    base_color: wp.vec3
    roughness: float


@wp.struct
class MeshHit:
    found: bool
    front: bool  # the outer side was hit
    face: int
    weights: wp.vec3


@wp.func
def closest_hit(surface: MeshSurface, origin: wp.vec3, direction: wp.vec3) -> MeshHit:
    query = wp.mesh_query_ray(surface.mesh, origin, direction, LARGEST_FLOAT)
    hit = MeshHit()
    hit.found = query.result
    if query.result:
        hit.front = query.sign > 0.0
        hit.face = query.face
        hit.weights = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)
    return hit


@wp.func
def is_open(surface: MeshSurface, origin: wp.vec3, direction: wp.vec3) -> bool:
    """True if the ray meets nothing."""
    return not wp.mesh_query_ray_anyhit(surface.mesh, origin, direction, LARGEST_FLOAT)


@wp.func
def lifted(position: wp.vec3, corner: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """``position`` raised to the tangent plane of a corner, if it lies below it."""
    return position - wp.min(wp.dot(position - corner, normal), 0.0) * normal


@wp.func
def surface_point(surface: MeshSurface, face: int, weights: wp.vec3) -> SurfacePoint:
    """Interpolate the attributes of a face's corners."""
    corners = surface.faces[face]
    i = corners[0]
    j = corners[1]
    k = corners[2]
    a = surface.points[i]
    b = surface.points[j]
    c = surface.points[k]
    na = surface.normals[i]
    nb = surface.normals[j]
    nc = surface.normals[k]
    point = SurfacePoint()
    point.position = a * weights[0] + b * weights[1] + c * weights[2]
    point.face_normal = wp.normalize(wp.cross(b - a, c - a))
    point.normal = wp.normalize(na * weights[0] + nb * weights[1] + nc * weights[2])
    p = point.position
    smooth = lifted(p, a, na) * weights[0] + lifted(p, b, nb) * weights[1] + lifted(p, c, nc) * weights[2]
    point.origin = smooth + point.face_normal * RAY_LIFT
    point.base_color = (
        surface.base_color[i] * weights[0] + surface.base_color[j] * weights[1] + surface.base_color[k] * weights[2]
    )
    point.roughness = (
        surface.roughness[i] * weights[0] + surface.roughness[j] * weights[1] + surface.roughness[k] * weights[2]
    )
    return point
