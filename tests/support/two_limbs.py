"""A body with an arm in closed form, two painted capsules: what cameras see of it, however far the arm is turned."""

import numpy as np
from scipy.spatial.transform import Rotation
from support.moving_ball import block_means, paint

from beam_warp.capture.views import CapturedView
from beam_warp.image.color import LINEAR_REC709
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.quaternions import turns_from_z

BODY = np.array([[0.0, 0.0, -0.3], [0.0, 0.0, 0.35]]), 0.18
ARM = np.array([[0.12, 0.0, 0.33], [0.34, 0.0, -0.2]]), 0.07
"""Ends of the axes and radii [m]; the arm turns about its first end, which is inside the body."""

SAMPLES = 2
"""Side of the square of rays of a pixel."""


def turn_of(degrees):
    """The turn of the arm: forwards, about the axis from side to side."""
    return Rotation.from_rotvec([np.radians(degrees), 0.0, 0.0])


def arm_at(points, degrees):
    """Where points of the arm at rest are when it is turned."""
    return ARM[0][0] + turn_of(degrees).apply(points - ARM[0][0])


def distance(points, axis, radius):
    """Signed distance to a capsule, ``(N,)``."""
    along = axis[1] - axis[0]
    part = np.clip((points - axis[0]) @ along / (along @ along), 0.0, 1.0)
    return np.linalg.norm(points - axis[0] - part[:, None] * along, axis=1) - radius


def capsule_points(axis, radius, spacing):
    """Points and normals, evenly spread: as on a sphere, a capsule has the same area for each step along its axis."""
    length = np.linalg.norm(axis[1] - axis[0])
    count = int(2.0 * np.pi * radius * (length + 2.0 * radius) / spacing**2)
    along = (np.arange(count) + 0.5) / count * (length + 2.0 * radius) - radius
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    lean = np.where(along < 0.0, along, np.maximum(along - length, 0.0)) / radius
    around = np.sqrt(1.0 - lean**2)
    normals = np.stack([around * np.cos(angle), around * np.sin(angle), lean], axis=1)
    points = np.stack([radius * normals[:, 0], radius * normals[:, 1], along], axis=1)
    turn, _ = Rotation.align_vectors([(axis[1] - axis[0]) / length], [[0.0, 0.0, 1.0]])
    return axis[0] + turn.apply(points), turn.apply(normals)


def surface(spacing, degrees=0.0):
    """Points and normals of what shows, with the arm turned, and which are the arm's."""
    (body, body_normals), (arm, arm_normals) = (capsule_points(*limb, spacing) for limb in (BODY, ARM))
    arm, arm_normals = arm_at(arm, degrees), turn_of(degrees).apply(arm_normals)
    shown, out = distance(arm, *BODY) > 0.0, distance(body, arm_at(ARM[0], degrees), ARM[1]) > 0.0
    is_arm = np.repeat([False, True], [out.sum(), shown.sum()])
    return np.vstack([body[out], arm[shown]]), np.vstack([body_normals[out], arm_normals[shown]]), is_arm


def limb_cloud(spacing, degrees):
    """Discs on the figure with its arm turned, painted, and which are the arm's."""
    points, normals, is_arm = surface(spacing, degrees)
    own = np.where(is_arm[:, None], arm_at(points, -degrees), points)
    count = len(points)
    return GaussianCloud(
        positions=points,
        orientations=turns_from_z(normals),
        scales=np.tile([0.7 * spacing, 0.7 * spacing, 0.15 * spacing], (count, 1)),
        opacities=np.full(count, 0.8),
        radiance=((paint(own) - 0.5) / SH_C0)[:, None, :],
        radiance_color_space=LINEAR_REC709,
        ids=np.arange(count),
    ), is_arm


def limb_views(cameras, degrees=0.0):
    """Photographs of the figure with its arm turned, on black."""
    return [_view(camera, degrees, f"view {k}") for k, camera in enumerate(cameras)]


def _view(camera, degrees, name):
    fine = camera.supersampled(SAMPLES)
    rays = fine.directions()
    directions, points = rays.reshape(-1, 3), np.tile(fine.position, (rays.size // 3, 1))
    arm = arm_at(ARM[0], degrees)
    for _ in range(40):  # sphere tracing: no step passes a surface
        away = np.minimum(distance(points, *BODY), distance(points, arm, ARM[1]))
        points = points + away[:, None] * directions
    on_arm = distance(points, arm, ARM[1]) < distance(points, *BODY)
    own = np.where(on_arm[:, None], arm_at(points, -degrees), points)
    hit = np.abs(away) < 1e-3
    colors = np.where(hit[:, None], paint(np.where(hit[:, None], own, 0.0)), 0.0)
    color, alpha = (block_means(image.reshape(*rays.shape[:2], -1), SAMPLES) for image in (colors, hit.astype(float)))
    return CapturedView(
        name=name, camera=camera, color=color.astype(np.float32), alpha=alpha[..., 0].astype(np.float32)
    )
