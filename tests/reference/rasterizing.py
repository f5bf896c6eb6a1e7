"""The rasteriser in float64 NumPy, as the papers write it: covariances, an explicit inverse, every pixel, no tiles."""

import numpy as np
from scipy.spatial.transform import Rotation


def rasterize(cloud, camera, values, *, antialiased=False):
    """Composite ``values`` (N, K); returns alpha, and the sums of depth and of values weighted by visibility."""
    rotation = np.linalg.inv(camera.camera_to_world[:3, :3])
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack(
        [(x - camera.center_x) / camera.focal_x, (y - camera.center_y) / camera.focal_y, np.ones_like(x)], axis=-1
    )
    alpha_sum, depth_sum = np.zeros(x.shape), np.zeros(x.shape)
    value_sum = np.zeros((*x.shape, values.shape[1]))
    transmittance = np.ones(x.shape)
    local = (cloud.positions.astype(np.float64) - camera.position) @ rotation.T
    for i in np.argsort(local[:, 2], kind="stable"):
        p = local[i]
        if not p[2] > 0.01:
            continue
        scales = cloud.scales[i].astype(np.float64)
        axes = rotation @ Rotation.from_quat(cloud.orientations[i]).as_matrix()
        sigma = axes @ np.diag(scales**2) @ axes.T
        covariance = project_covariance(sigma, p, camera)
        filtered = covariance + 0.3 * np.eye(2)
        opacity = float(cloud.opacities[i])
        if antialiased:
            opacity *= np.sqrt(max(np.linalg.det(covariance), 0.0) / np.linalg.det(filtered))
        offset = np.stack(
            [
                x - (camera.focal_x * p[0] / p[2] + camera.center_x),
                y - (camera.focal_y * p[1] / p[2] + camera.center_y),
            ],
            axis=-1,
        )
        exponent = 0.5 * np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(filtered), offset)
        alpha = np.minimum(opacity * np.exp(-exponent), 0.99)
        alpha[(alpha < 1.0 / 255.0) | (transmittance < 1e-4)] = 0.0
        weight = alpha * transmittance
        transmittance = transmittance * (1.0 - alpha)
        alpha_sum += weight
        value_sum += weight[..., None] * values[i]
        depth_sum += weight * plane_depth(sigma, scales, p, rays)
    return alpha_sum, depth_sum, value_sum


def project_covariance(sigma, p, camera):
    """J Sigma J^T with the Jacobian of the pinhole, taken no further out than 15 % beyond the image."""
    focal, center = (camera.focal_x, camera.focal_y), (camera.center_x, camera.center_y)
    jacobian = np.zeros((2, 3))
    for axis, side in enumerate((camera.width, camera.height)):
        slope = np.clip(
            p[axis] / p[2], (-center[axis] - 0.15 * side) / focal[axis], (1.15 * side - center[axis]) / focal[axis]
        )
        jacobian[axis, axis] = focal[axis] / p[2]
        jacobian[axis, 2] = -focal[axis] * slope / p[2]
    return jacobian @ sigma @ jacobian.T


def plane_depth(sigma, scales, p, rays):
    """Where rays (with z = 1) meet the plane through p with normal Sigma^-1 p, kept where the Gaussian is."""
    normal = np.linalg.inv(sigma) @ p
    along = rays @ normal
    with np.errstate(divide="ignore"):
        depth = np.where(along > 0.0, (p @ normal) / along, np.inf)
    reach = 3.0 * scales.max()
    return np.clip(depth, max(p[2] - reach, 0.01), p[2] + reach)
