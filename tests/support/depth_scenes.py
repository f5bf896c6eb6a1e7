"""Depth images whose truth has a closed form."""

import numpy as np

from beam_warp.mesh.depths import DepthView
from beam_warp.world.camera import Camera


def around(center, *, width, azimuths=8, elevations=(-50.0, 0.0, 50.0), distance=2.0):
    """Cameras on a sphere around a point, rings turned against one another."""
    return [
        Camera.orbit(
            center, distance, 360.0 * i / azimuths + elevation, elevation, width=width, height=width, vertical_fov=35.0
        )
        for elevation in elevations
        for i in range(azimuths)
    ]


def sphere_view(camera, radius, center=(0.0, 0.0, 0.0)):
    """The nearer root of a ray's quadratic equation, along the optical axis."""
    rays = camera.directions()
    start = camera.position - np.asarray(center)
    half = rays @ start
    root = half**2 - (start @ start - radius**2)
    depth = (-half - np.sqrt(np.maximum(root, 0.0))) * (rays @ camera.forward)
    hit = root > 0.0
    return DepthView(camera=camera, depth=np.where(hit, depth, 0.0).astype(np.float32), alpha=hit.astype(np.float32))


def points_of(view):
    """The point that each pixel shows, (H, W, 3); where there is no depth, the camera's position."""
    rays = view.camera.directions() / (view.camera.directions() @ view.camera.forward)[..., None]
    return view.camera.position + rays * view.depth[..., None]


def plane_view(camera, height, side=None):
    """The plane z = height, seen from above or below; ``side``: only so many pixels from the middle."""
    rays = camera.directions()
    with np.errstate(divide="ignore"):
        t = (height - camera.position[2]) / rays[..., 2]
    hit = t > 0.0
    if side is not None:
        rows, columns = np.mgrid[: camera.height, : camera.width]
        hit &= (abs(rows - camera.height // 2) <= side) & (abs(columns - camera.width // 2) <= side)
    depth = np.where(hit, t * (rays @ camera.forward), 0.0)
    return DepthView(camera=camera, depth=depth.astype(np.float32), alpha=hit.astype(np.float32))
