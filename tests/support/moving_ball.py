"""A painted ball in closed form: what every camera sees of it, wherever it is and however it is turned."""

import numpy as np
from scipy.spatial.transform import Rotation
from support.shapes import sphere_points

from beam_warp.capture.views import CapturedView
from beam_warp.image.color import LINEAR_REC709
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.quaternions import turns_from_z

RADIUS = 0.5

SAMPLES = 4
"""Side of the square of rays of a pixel."""


def rig(count=6, size=40, **changes):
    """Cameras around the origin, some from above, some from below."""
    options = {"width": size, "height": size, "vertical_fov": 32.0, **changes}
    return [Camera.orbit((0, 0, 0), 2.5, 360.0 * k / count, (15.0, -20.0)[k % 2], **options) for k in range(count)]


def paint(points):
    """Scene-linear colour of points of the unit sphere, (..., 3): broad waves, different in every direction."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = np.stack([np.sin(4.0 * x + 1.0), np.sin(5.0 * y - 0.5), np.sin(4.5 * z + 2.0 * x)], axis=-1)
    return 0.35 + 0.25 * waves


def ball_view(camera, center=(0.0, 0.0, 0.0), turn=None, *, with_alpha=True, name="view"):
    """The mean over each pixel's area of a ball on black, ``SAMPLES``^2 rays each."""
    fine = camera.supersampled(SAMPLES)
    rays, offset = fine.directions(), fine.position - np.asarray(center, float)
    along = rays @ offset
    square = along**2 - offset @ offset + RADIUS**2
    hit = square > 0.0
    distance = -along - np.sqrt(np.where(hit, square, 0.0))
    normals = (offset + distance[..., None] * rays) / RADIUS
    own = normals.reshape(-1, 3) @ (turn or Rotation.identity()).as_matrix()  # R^T n, row by row
    image = np.where(hit[..., None], paint(own.reshape(normals.shape)), 0.0)
    color, alpha = (block_means(array, SAMPLES) for array in (image, hit[..., None].astype(float)))
    return CapturedView(
        name=name,
        camera=camera,
        color=color.astype(np.float32),
        alpha=alpha[..., 0].astype(np.float32) if with_alpha else None,
    )


def ball_views(cameras, center=(0.0, 0.0, 0.0), turn=None, **options):
    return [ball_view(camera, center, turn, name=f"view {k}", **options) for k, camera in enumerate(cameras)]


def block_means(image, side):
    height, width = image.shape[0] // side, image.shape[1] // side
    return image.reshape(height, side, width, side, -1).mean(axis=(1, 3))


def ball_cloud(count=300, *, radius=RADIUS, painted=True):
    """Discs on the ball, evenly along a spiral, local z outward; grey unless they are painted."""
    normals, spacing = sphere_points(count)
    spacing *= radius
    color = paint(normals) if painted else np.full((count, 3), 0.35)
    return GaussianCloud(
        positions=radius * normals,
        orientations=turns_from_z(normals),
        scales=np.tile([0.7 * spacing, 0.7 * spacing, 0.15 * spacing], (count, 1)),
        opacities=np.full(count, 0.8),
        radiance=((color - 0.5) / SH_C0)[:, None, :],
        radiance_color_space=LINEAR_REC709,
        ids=np.arange(count),
    )
