"""How a mesh looks: shaded by a light at the camera, back sides marked."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_choice
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import srgb_to_linear
from beam_warp.image.files import display_image
from beam_warp.kernels.mesh.depth_pixels import DepthCamera
from beam_warp.kernels.mesh.preview import launch_shade_mesh
from beam_warp.world.camera import Camera

CLAY = (0.62, 0.60, 0.57)
"""Linear colour of a mesh without one."""

PAPER = (1.0, 1.0, 1.0)
"""Linear colour behind it."""


def shaded_image(
    mesh: trimesh.Trimesh, camera: Camera, device: Any = None, *, color: str = "vertices"
) -> NDArray[np.uint8]:
    """Draw a mesh for a look at it.

    Args:
        mesh: At least one triangle, in the camera's world [m], z up.
        camera: From where.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        color: ``"vertices"``: their colours, display sRGB, or clay if they have none; ``"clay"`` for all.

    Returns:
        Display sRGB on white, ``(H, W, 3)`` uint8; back sides are dark red.

    Raises:
        InvalidArrayError: The mesh has no triangle.
    """
    require_choice("color", color, ("vertices", "clay"))
    if not len(mesh.faces):
        raise InvalidArrayError("mesh must hold at least one triangle, got none. Pass a mesh with a surface.")
    target = resolve_device(device)
    origin = np.asarray(mesh.vertices, np.float64).mean(axis=0)
    points = upload((mesh.vertices - origin).astype(np.float32), wp.vec3, target)
    tree = wp.Mesh(points, upload(np.asarray(mesh.faces, np.int32).reshape(-1), int, target))
    colors = np.broadcast_to(np.array(CLAY, np.float32), (len(mesh.vertices), 3))
    visual: Any = mesh.visual
    if color == "vertices" and visual.kind == "vertex":
        colors = srgb_to_linear(np.asarray(visual.vertex_colors)[:, :3] / 255.0).astype(np.float32)
    matrix = camera.world_to_camera
    view = DepthCamera()
    view.rotation = wp.mat33(matrix[:3, :3].astype(np.float32))
    view.translation = wp.vec3((matrix[:3, :3] @ origin + matrix[:3, 3]).astype(np.float32))
    view.focal, view.center = wp.vec2(camera.focal_x, camera.focal_y), wp.vec2(camera.center_x, camera.center_y)
    view.width, view.height = camera.width, camera.height
    image = wp.empty(camera.width * camera.height, dtype=wp.vec3, device=target)
    normals = upload(np.asarray(mesh.vertex_normals, np.float32), wp.vec3, target)
    launch_shade_mesh(tree.id, normals, upload(colors, wp.vec3, target), view, wp.vec3(*PAPER), image, target)
    return display_image(image.numpy().reshape(camera.height, camera.width, 3))
