"""Closest points of a triangle mesh, and the points of a mesh that cameras see."""

import warp as wp

from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.mesh.surface import RAY_LIFT

wp.set_module_options({"enable_backward": False})

QUERY_CHUNK = 256
"""Fewest points of one launch on the CPU: each walks a tree."""


@wp.struct
class SeeingCameras:
    """Pinhole cameras; one row each."""

    positions: wp.array[wp.vec3]
    world_to_camera: wp.array[wp.mat33]
    focal: wp.array[wp.vec2]
    center: wp.array[wp.vec2]
    size: wp.array[wp.vec2]  # width, height


@wp.kernel
def find_closest_points_kernel(
    first: int, mesh: wp.uint64, points: wp.array[wp.vec3], out_faces: wp.array[int], out_weights: wp.array[wp.vec3]
):
    """Triangle and barycentric weights of the point of a mesh that is closest."""
    index = first + wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[index], LARGEST_FLOAT)
    out_faces[index] = query.face
    out_weights[index] = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)


@wp.func
def is_on_image(cameras: SeeingCameras, camera: int, point: wp.vec3) -> bool:
    local = cameras.world_to_camera[camera] * (point - cameras.positions[camera])
    if not local[2] > 0.0:
        return False
    focal = cameras.focal[camera]
    center = cameras.center[camera]
    size = cameras.size[camera]
    x = focal[0] * local[0] / local[2] + center[0]
    y = focal[1] * local[1] / local[2] + center[1]
    return x >= 0.0 and y >= 0.0 and x <= size[0] and y <= size[1]


@wp.kernel
def find_seen_points_kernel(
    first: int,
    mesh: wp.uint64,
    cameras: SeeingCameras,
    least_cosine: float,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    out_seen: wp.array[wp.uint8],
):
    """1 for points that some camera sees from the front, by no less than a cosine, past every triangle."""
    index = first + wp.tid()
    normal = normals[index]
    origin = points[index] + RAY_LIFT * normal
    seen = wp.uint8(0)
    for camera in range(cameras.positions.shape[0]):
        if seen == wp.uint8(0):
            towards = cameras.positions[camera] - origin
            distance = wp.length(towards)
            if wp.dot(towards, normal) > least_cosine * distance and is_on_image(cameras, camera, points[index]):
                if not wp.mesh_query_ray_anyhit(mesh, origin, towards / distance, distance):
                    seen = wp.uint8(1)
    out_seen[index] = seen


launch_find_closest_points = launcher(find_closest_points_kernel, min_chunk=QUERY_CHUNK)
"""Find the closest point of a mesh for every point."""


launch_find_seen_points = launcher(find_seen_points_kernel, min_chunk=QUERY_CHUNK)
"""Find which points of a mesh some camera sees."""
