"""Triangles among the Gaussians: ground and props that block and receive rays."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class NoMesh:
    """A scene of Gaussians alone."""

    unused: int


@wp.struct
class MeshOccluder:
    """A ``wp.Mesh`` relative to the scene's origin, opaque from both sides."""

    mesh: wp.uint64


@wp.struct
class NearestTriangle:
    """The first triangle on a ray."""

    t: float  # the reach given, where nothing is hit
    face: int  # -1 where nothing is hit
    normal: wp.vec3  # geometric, of the face's counter-clockwise side


@wp.func
def mesh_blocks(occluder: NoMesh, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:
    return False


@wp.func
def mesh_blocks(occluder: MeshOccluder, origin: wp.vec3, direction: wp.vec3, t_max: float) -> bool:  # noqa: F811
    """Whether a triangle lies before ``t_max``."""
    return wp.mesh_query_ray_anyhit(occluder.mesh, origin, direction, t_max)


@wp.func
def nearest_on_mesh(occluder: NoMesh, origin: wp.vec3, direction: wp.vec3, t_max: float) -> NearestTriangle:
    hit = NearestTriangle()
    hit.t = t_max
    hit.face = -1
    return hit


@wp.func
def nearest_on_mesh(  # noqa: F811
    occluder: MeshOccluder, origin: wp.vec3, direction: wp.vec3, t_max: float
) -> NearestTriangle:
    """The first triangle before ``t_max``."""
    hit = NearestTriangle()
    hit.t = t_max
    hit.face = -1
    query = wp.mesh_query_ray(occluder.mesh, origin, direction, t_max)
    if query.result:
        hit.t = query.t
        hit.face = query.face
        hit.normal = query.normal
    return hit
