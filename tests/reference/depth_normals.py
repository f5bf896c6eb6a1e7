"""Normals of a depth image in float64 NumPy, as the paper writes them: back-project, subtract, cross, normalise."""

import numpy as np


def rays(camera):
    """Directions through pixel centres with z = 1 in camera axes, (H, W, 3)."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack(
        [(x - camera.center_x) / camera.focal_x, (y - camera.center_y) / camera.focal_y, np.ones_like(x)], axis=-1
    )


def has_normal(depth, alpha, *, minimum_alpha=0.5, largest_jump=0.03):
    """Which pixels have a normal, (H, W) bool, one pixel at a time."""
    found = np.zeros(depth.shape, dtype=bool)
    for y in range(1, depth.shape[0] - 1):
        for x in range(1, depth.shape[1] - 1):
            stencil = [(y, x), (y, x - 1), (y, x + 1), (y - 1, x), (y + 1, x)]
            z = np.array([depth[p] for p in stencil])
            if not (all(alpha[p] > minimum_alpha for p in stencil) and np.isfinite(z).all() and (z > 1e-6).all()):
                continue
            found[y, x] = (np.abs(z - z[0]) <= largest_jump * z[0]).all()
    return found


def depth_normals(depth, camera, found):
    """Unit normals in world axes, 0 where ``found`` is False, (H, W, 3)."""
    normals = np.zeros((*depth.shape, 3))
    if min(depth.shape) < 3:
        return normals
    points = np.where(np.isfinite(depth), depth, 0.0)[..., None].astype(np.float64) * rays(camera)
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    inner = np.cross(down, right)
    inside = found[1:-1, 1:-1]
    inner[inside] /= np.linalg.norm(inner[inside], axis=-1, keepdims=True)
    inner[~inside] = 0.0
    normals[1:-1, 1:-1] = inner @ camera.camera_to_world[:3, :3].T
    return normals
