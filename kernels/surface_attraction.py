"""Gaussians drawn to the surface that is seen of them: those behind it, or before it, move along the ray.

Photographs alone do not keep Gaussians on a surface: at every silhouette the soft edges of what is drawn are pushed
inwards, and what is pushed behind others is not pulled back, since nobody sees it. A Gaussian that faces the camera and
lies within reach of the drawn depth is pulled towards it with a constant force, |z - d| / (d / f) in pixels, where d is
held still.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.launching import launch
from beam_warp.kernels.project import View

wp.set_module_options({"enable_backward": False})


@wp.struct
class Attraction:
    tolerance: float
    strength: float  # of the force [1 / pixel]
    reach: float  # farthest from the surface that is pulled, as a part of the depth
    least_cosine: float  # of a Gaussian's normal and the direction to the camera
    least_alpha: float


@wp.kernel
def attract_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    orientations: wp.array[wp.quat],
    views: wp.array[View],
    depth: wp.array2d[float],
    alpha: wp.array2d[float],
    attraction: Attraction,
    out_gradients: wp.array[wp.vec3],
):
    item = first + wp.tid()
    view = views[0]
    offset = positions[item] - view.position
    local = view.world_to_camera * offset
    if not (local[2] > 1e-6):
        return
    x = int(wp.floor(view.focal[0] * local[0] / local[2] + view.center[0]))
    y = int(wp.floor(view.focal[1] * local[1] / local[2] + view.center[1]))
    if not (x >= 0 and y >= 0 and x < view.width and y < view.height):
        return
    if not (alpha[y, x] > attraction.least_alpha):
        return
    seen = depth[y, x]
    behind = local[2] - seen
    if not (wp.abs(behind) < attraction.reach * seen):
        return
    normal = wp.quat_rotate(wp.normalize(orientations[item]), wp.vec3(0.0, 0.0, 1.0))
    if not (-wp.dot(normal, wp.normalize(offset)) > attraction.least_cosine):
        return
    # What lies within a pixel's footprint of the surface is left alone; beyond it the force rises over another one.
    footprint = attraction.tolerance * seen / view.focal[0]
    excess = wp.clamp(wp.abs(behind) / footprint - 1.0, 0.0, 1.0)
    force = attraction.strength / footprint * wp.sign(behind) * excess
    forward = wp.vec3(view.world_to_camera[2, 0], view.world_to_camera[2, 1], view.world_to_camera[2, 2])
    out_gradients[item] += force * forward


def launch_attract(
    positions: Any,
    orientations: Any,
    views: Any,
    depth: Any,
    alpha: Any,
    attraction: Attraction,
    out_gradients: Any,
    device: Any,
) -> None:
    """Add the gradients of the attraction of every Gaussian by one view's surface."""
    launch(
        attract_kernel,
        positions.size,
        inputs=[positions, orientations, views, depth, alpha, attraction],
        outputs=[out_gradients],
        device=device,
    )
