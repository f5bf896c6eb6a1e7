"""Points on a surface push each other apart until they lie evenly on it."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch

wp.set_module_options({"enable_backward": False})

STEP = wp.constant(0.4)
"""Part of its neighbours' overlaps that a point moves by: above a half, two points would jump over each other."""

LONGEST_STEP = wp.constant(0.5)
"""Longest step, in spacings: a point stays in its neighbourhood."""


@wp.struct
class ShadedMesh:
    """A mesh that points are brought back to, and the normals that they take there."""

    mesh: wp.uint64
    faces: wp.array[int]  # three corners each
    normals: wp.array[wp.vec3]  # of the vertices


@wp.kernel
def push_apart_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    neighbors: wp.array2d[int],
    spacing: float,
    surface: ShadedMesh,
    out_positions: wp.array[wp.vec3],
    out_normals: wp.array[wp.vec3],
):
    i = first + wp.tid()
    here = positions[i]
    normal = normals[i]
    push = wp.vec3(0.0, 0.0, 0.0)
    for k in range(neighbors.shape[1]):
        j = neighbors[i, k]
        away = here - positions[j]
        distance = wp.length(away)
        # The other side of something thin is no neighbour; nor is a point itself.
        if distance > 0.0 and distance < spacing and wp.dot(normal, normals[j]) > 0.0:
            push += away * ((spacing - distance) / distance)
    push = STEP * (push - normal * wp.dot(push, normal))
    length = wp.length(push)
    if length > LONGEST_STEP * spacing:
        push = push * (LONGEST_STEP * spacing / length)
    moved = here + push
    turned = normal
    nearest = wp.mesh_query_point_no_sign(surface.mesh, moved, 4.0 * spacing)
    if nearest.result:
        a = surface.faces[3 * nearest.face]
        b = surface.faces[3 * nearest.face + 1]
        c = surface.faces[3 * nearest.face + 2]
        w = 1.0 - nearest.u - nearest.v
        moved = wp.mesh_eval_position(surface.mesh, nearest.face, nearest.u, nearest.v)
        normals = surface.normals
        turned = wp.normalize(normals[a] * nearest.u + normals[b] * nearest.v + normals[c] * w)
    else:
        moved = here
    out_positions[i] = moved
    out_normals[i] = turned


def launch_push_apart(
    positions: Any,
    normals: Any,
    neighbors: Any,
    spacing: float,
    surface: ShadedMesh,
    out_positions: Any,
    out_normals: Any,
    device: Any,
) -> None:
    """Move every point away from neighbours nearer than ``spacing``, and back to the mesh."""
    inputs = [positions, normals, neighbors, spacing, surface]
    launch(push_apart_kernel, len(positions), inputs=inputs, outputs=[out_positions, out_normals], device=device)
