"""Previews of meshes: shaded by a light at the camera, back sides marked."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import srgb_to_linear
from beam_warp.image.files import display_image
from beam_warp.kernels.mesh.preview import launch_shade_mesh
from beam_warp.mesh.depths import depth_camera
from beam_warp.world.camera import Camera

if TYPE_CHECKING:
    import trimesh

CLAY = (0.62, 0.60, 0.57)
"""Linear colour of a mesh without one."""

PAPER = (1.0, 1.0, 1.0)
"""Linear colour behind it."""


def shaded_image(mesh: trimesh.Trimesh, camera: Camera, device: Any = None) -> NDArray[np.uint8]:
    """Draw a mesh for a look at it.

    Args:
        mesh: At least one triangle, in the camera's world [m], z up.
        camera: From where.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Returns:
        Display sRGB on white, ``(H, W, 3)`` uint8: vertex colours, or clay where the mesh has none; back sides are
        dark red.

    Raises:
        InvalidArrayError: The mesh has no triangle.
    """
    if not len(mesh.faces):
        raise InvalidArrayError("mesh must hold at least one triangle, got none. Pass a mesh with a surface.")
    target = resolve_device(device)
    origin = np.asarray(mesh.vertices, np.float64).mean(axis=0)
    points = upload((mesh.vertices - origin).astype(np.float32), wp.vec3, target)
    tree = wp.Mesh(points, upload(np.asarray(mesh.faces, np.int32).reshape(-1), int, target))
    colors = np.broadcast_to(np.array(CLAY, np.float32), (len(mesh.vertices), 3))
    visual: Any = mesh.visual
    if visual.kind == "vertex":
        colors = srgb_to_linear(np.asarray(visual.vertex_colors)[:, :3] / 255.0).astype(np.float32)
    view = depth_camera(camera, origin)
    image = wp.empty(camera.width * camera.height, dtype=wp.vec3, device=target)
    normals = upload(np.asarray(mesh.vertex_normals, np.float32), wp.vec3, target)
    launch_shade_mesh(tree.id, normals, upload(colors, wp.vec3, target), view, wp.vec3(*PAPER), image, target)
    return display_image(image.numpy().reshape(camera.height, camera.width, 3))
