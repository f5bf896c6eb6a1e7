"""Some pixels in float64 by brute force: every Gaussian, covariances and their inverses, no tiles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import rotation_matrices

LOW_PASS = 0.3
NEAR = 0.01
ALPHA_CAP = 0.99
ALPHA_CUT = 1.0 / 255.0
STOP = 1e-4
REACH = 3.0
"""Depths stay within this many of the largest standard deviation of the centre's."""


class Truth(NamedTuple):
    """Images at some pixels; both kinds of depth, of the tangent plane and of the largest response on the ray [m].

    Attributes:
        values: Sums ``(M, K)``.
        alpha: ``(M,)``.
        depth: Mean depth by kind, ``(M,)``.
        median_depth: By kind, ``(M,)``.
    """

    values: NDArray[np.float64]
    alpha: NDArray[np.float64]
    depth: dict[str, NDArray[np.float64]]
    median_depth: dict[str, NDArray[np.float64]]


def brute_force(
    cloud: GaussianCloud, camera: Camera, values: NDArray[np.float32], pixels: NDArray[np.int64], antialiased: bool
) -> Truth:
    """Composite ``values`` ``(N, K)`` at ``pixels``, numbers row by row ``(M,)``."""
    rotation = camera.world_to_camera[:3, :3]
    local = (cloud.positions.astype(np.float64) - camera.position) @ rotation.T
    order = np.argsort(local[:, 2], kind="stable")
    order = order[local[order, 2] > NEAR]
    local, scales = local[order], cloud.scales[order].astype(np.float64)
    axes = rotation @ rotation_matrices(cloud.orientations[order])
    jacobian = _jacobians(local, camera)
    footprint = jacobian @ (axes * scales[:, None, :])
    sharp = footprint @ footprint.transpose(0, 2, 1)
    covariance = sharp + LOW_PASS * np.eye(2)
    opacity = cloud.opacities[order].astype(np.float64)
    if antialiased:
        opacity *= np.sqrt(np.linalg.det(sharp) / np.linalg.det(covariance))
    form = np.linalg.inv(covariance)
    middle = np.array([camera.center_x, camera.center_y])
    focal = np.array([camera.focal_x, camera.focal_y])
    centers = focal * local[:, :2] / local[:, 2:] + middle
    inverse = (axes / scales[:, None, :] ** 2) @ axes.transpose(0, 2, 1)
    # No further along x or y than this is alpha at the cut; splats that do not reach it have no extent.
    squared = 2.0 * np.log(np.maximum(opacity / ALPHA_CUT, 1.0))
    extents = np.sqrt(squared[:, None] * covariance[:, (0, 1), (0, 1)]) + 1e-6
    count = len(pixels)
    found = Truth(
        np.zeros((count, values.shape[1])),
        np.zeros(count),
        {kind: np.zeros(count) for kind in ("plane", "exact")},
        {kind: np.zeros(count) for kind in ("plane", "exact")},
    )
    for row, pixel in enumerate(pixels):
        position = np.array([pixel % camera.width, pixel // camera.width]) + 0.5
        near = np.flatnonzero((np.abs(position - centers) <= extents).all(axis=1))
        x, y = (position - centers[near]).T
        exponent = 0.5 * (form[near, 0, 0] * x * x + 2.0 * form[near, 0, 1] * x * y + form[near, 1, 1] * y * y)
        alpha = np.minimum(opacity[near] * np.exp(-exponent), ALPHA_CAP)
        counted = alpha >= ALPHA_CUT
        seen, alpha = near[counted], alpha[counted]
        if not len(seen):
            continue
        after = np.cumprod(1.0 - alpha)
        end = int(np.searchsorted(-after, -STOP, side="right")) + 1  # the splat that ends the pixel counts
        seen, alpha = seen[:end], alpha[:end]
        before = np.concatenate([[1.0], after[: len(seen) - 1]])
        weight = alpha * before
        found.values[row] = weight @ values[order[seen]]
        found.alpha[row] = weight.sum()
        ray = np.append((position - middle) / focal, 1.0)
        along = inverse[seen] @ ray
        toward = np.einsum("nk,nk->n", local[seen], along)  # c . Sigma^-1 ray
        with np.errstate(divide="ignore", invalid="ignore"):
            plane = np.einsum("ni,nij,nj->n", local[seen], inverse[seen], local[seen]) / toward
            exact = toward / (along @ ray)
        depth, reach = local[seen, 2], REACH * scales[seen].max(axis=1)
        for kind, z in (("plane", plane), ("exact", exact)):
            z = np.clip(np.where(toward > 0.0, z, np.inf), np.maximum(depth - reach, NEAR), depth + reach)
            found.depth[kind][row] = (weight @ z) / weight.sum()
            found.median_depth[kind][row] = z[np.flatnonzero(before > 0.5)[-1]]
    return found


def _jacobians(local: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """Return those of the pinhole ``(N, 2, 3)``, taken no further out than 15 % beyond the image."""
    found = np.zeros((len(local), 2, 3))
    sides = ((camera.focal_x, camera.center_x, camera.width), (camera.focal_y, camera.center_y, camera.height))
    for axis, (focal, center, side) in enumerate(sides):
        slope = np.clip(local[:, axis] / local[:, 2], (-center - 0.15 * side) / focal, (1.15 * side - center) / focal)
        found[:, axis, axis] = focal / local[:, 2]
        found[:, axis, 2] = -focal * slope / local[:, 2]
    return found
