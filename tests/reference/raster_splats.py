"""What one Gaussian is on one pixel, in float64 and as the papers write it: covariances and explicit inverses.

Everything here is smooth: decisions come in from outside, and arrays may be complex.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

REACH = 3.0  # depth stays within this many of the largest standard deviation
LEAST_SCALE = 1e-12  # a disc without thickness has a normal, but no inverse
LEAST_AHEAD = 1e-6  # l of exact depth: below 0 the ray leaves the plane behind


@dataclass(frozen=True)
class RasterScene:
    """What is drawn: arrays as the code under test takes them, cast to float64 here."""

    positions: Any  # (N, 3)
    orientations: Any  # (N, 4) xyzw, of any length but 0
    scales: Any  # (N, 3)
    opacities: Any  # (N,)
    camera: Any
    values: Any = None  # (N, K)
    radiance: Any = None  # (N, (degree + 1)^2, 3); the colour towards the camera is drawn after the values
    antialiased: bool = False
    low_pass: float = 0.3
    near: float = 0.01
    depth_mode: str = "plane"  # or "exact"
    move: Any = (0.0,) * 12  # of the camera: turn, shift, focal lengths, principal point, radial terms of a lens

    def __post_init__(self):
        object.__setattr__(self, "move", np.asarray(self.move))
        for name, array in self.arrays().items():
            object.__setattr__(self, name, np.asarray(array, complex if np.iscomplexobj(array) else np.float64))

    def arrays(self):
        """What may be differenced, by name."""
        names = ("positions", "orientations", "scales", "opacities", "values", "radiance")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    @property
    def focal(self):
        return np.array([self.camera.focal_x, self.camera.focal_y]) + self.move[6:8]

    @property
    def middle(self):
        return np.array([self.camera.center_x, self.camera.center_y]) + self.move[8:10]

    @property
    def to_camera(self):
        """World to camera, to first order in the turn, which is all that a complex step sees."""
        return (np.eye(3) + np.cross(np.eye(3), self.move[:3])) @ np.linalg.inv(self.camera.camera_to_world[:3, :3])

    @property
    def eye(self):
        """Where the camera is: the point that goes to the origin of its axes."""
        return self.camera.position - np.linalg.inv(self.to_camera) @ self.move[3:6]


@dataclass(frozen=True)
class SplatDecisions:
    """Which side of every branch a splat is on."""

    visible: Any  # (N,)
    slope_side: Any  # (N, 2) of the Jacobian's clamp: -1, 0, 1
    floored: Any  # (N, 3) scales raised to the least
    largest: Any  # (N,) index of the largest scale
    near_side: Any  # (N,) the near plane, not its size, limits its depth
    positive: Any  # (N, 3) colours not clamped at 0


@dataclass(frozen=True)
class Splats:
    """Gaussians seen from a camera; first axis N."""

    center: Any  # pixel
    depth: Any
    conic: Any
    opacity: Any
    whitening: Any  # W in camera axes: Sigma^-1 = W^T W
    ray: Any  # of the centre, z = 1
    to_ray: Any  # (N, 2, 2): the way from the centre to a pixel, on the plane z = 1
    nearest: Any  # the inverse depths that clamp
    farthest: Any
    normal: Any  # world axes
    channels: Any  # values, then colours


def local_positions(scene):
    return (scene.positions - scene.eye) @ scene.to_camera.T


def slope_range(scene):
    """Least and greatest x/z and y/z of the Jacobian: 15 % of the image beyond its edges."""
    side = np.array([scene.camera.width, scene.camera.height])
    return (-scene.middle - 0.15 * side) / scene.focal, (1.15 * side - scene.middle) / scene.focal


def see(scene, decisions):
    """See all Gaussians from the camera."""
    p = np.where(decisions.visible[:, None], local_positions(scene), (0.0, 0.0, 1.0))
    z = p[:, 2]
    ray = p / z[:, None]
    low, high = slope_range(scene)
    slope = np.where(decisions.slope_side > 0, high, np.where(decisions.slope_side < 0, low, ray[:, :2]))
    jacobian = np.zeros((len(p), 2, 3), p.dtype)
    for axis in range(2):
        jacobian[:, axis, axis] = scene.focal[axis] / z
        jacobian[:, axis, 2] = -scene.focal[axis] * slope[:, axis] / z
    lens = lens_jacobians(slope, scene.move[10:])
    jacobian = scene.focal[:, None] * (lens @ (jacobian / scene.focal[:, None]))
    axes = scene.to_camera @ rotations(scene.orientations)
    sigma = np.einsum("nij,nj,nkj->nik", axes, scene.scales**2, axes)
    sharp = jacobian @ sigma @ jacobian.swapaxes(1, 2)
    covariance = sharp + scene.low_pass * np.eye(2)
    opacity = scene.opacities
    if scene.antialiased:
        area = np.linalg.det(sharp)
        opacity = opacity * np.sqrt(np.where(area.real > 0.0, area, 0.0) / np.linalg.det(covariance))
    whitening = axes.swapaxes(1, 2) / np.where(decisions.floored, LEAST_SCALE, scene.scales)[:, :, None]
    m = np.einsum("nij,nik,nk->nj", whitening, whitening, ray)  # Sigma^-1 ray
    reach = REACH * np.take_along_axis(scene.scales, decisions.largest[:, None], axis=1)[:, 0]
    return Splats(
        center=scene.focal * ray[:, :2] * lens_growth(slope, scene.move[10:])[:, None] + scene.middle,
        depth=z,
        conic=np.linalg.inv(covariance),
        opacity=opacity,
        whitening=whitening,
        ray=ray,
        to_ray=np.linalg.inv(scene.focal[:, None] * lens),
        nearest=1.0 / np.where(decisions.near_side, scene.near, z - reach),
        farthest=1.0 / (z + reach),
        normal=-m / length(m) @ scene.to_camera,
        channels=channels(scene, decisions),
    )


def lens_growth(rays, radial):
    """How many times farther from the axis a lens shows a ray, (N,)."""
    square = dot(rays, rays)
    return 1.0 + radial[0] * square + radial[1] * square**2


def lens_jacobians(rays, radial):
    """Jacobians of the map that a lens is of the plane z = 1, (N, 2, 2)."""
    square = dot(rays, rays)
    outer = rays[:, :, None] * rays[:, None, :]
    slope = 2.0 * radial[0] + 4.0 * radial[1] * square
    return lens_growth(rays, radial)[:, None, None] * np.eye(2) + slope[:, None, None] * outer


def channels(scene, decisions):
    """Values, then colours, (N, K)."""
    parts = [np.zeros((len(scene.positions), 0))]
    if scene.values is not None:
        parts.append(scene.values)
    if scene.radiance is not None:
        parts.append(np.where(decisions.positive, shifted_color(scene, decisions.visible), 0.0))
    return np.concatenate(parts, axis=1)


def shifted_color(scene, visible):
    """Captured colour towards the camera before it is clamped at 0, (N, 3)."""
    toward = np.where(visible[:, None], scene.positions - scene.eye, (0.0, 0.0, 1.0))
    degree = round(np.sqrt(scene.radiance.shape[1])) - 1
    return 0.5 + np.einsum("nk,nkc->nc", harmonics(toward / length(toward), degree), scene.radiance)


def response(splats, i, pixels):
    """Alpha before its cap; ``i`` is one splat or one for each pixel."""
    offset = pixels - splats.center[i]
    square = np.einsum("...i,...ij,...j->...", offset, splats.conic[i], offset)
    return splats.opacity[i] * np.exp(-0.5 * square)


def ray_forms(scene, splats, i, pixels):
    """l = r.A.c / c.A.c and r.A.r / c.A.c of the pixel's ray r and the centre's ray c, with A = Sigma^-1.

    The plane through the centre with normal A c has inverse depth l / z on r.
    """
    way = np.einsum("...ij,...j->...i", splats.to_ray[i], pixels - splats.center[i])
    r = splats.ray[i] + np.concatenate([way, np.zeros((len(pixels), 1))], axis=1)
    white_r = np.einsum("...ij,...j->...i", splats.whitening[i], r)
    white_c = np.einsum("...ij,...j->...i", splats.whitening, splats.ray)[i]
    facing = dot(white_c, white_c)
    return dot(white_r, white_c) / facing, dot(white_r, white_r) / facing


def inverse_depth(scene, splats, i, forms, behind):
    """Inverse depth of the plane (Zhang et al. 2024), or of the largest response on the ray, z* = z r.A.c / r.A.r."""
    along, square = forms
    if scene.depth_mode == "plane":
        return along / splats.depth[i]
    ahead = np.where(behind, LEAST_AHEAD, along)
    return (ahead + (square - along * along) / ahead) / splats.depth[i]


def dot(some, others):
    return np.einsum("...i,...i->...", some, others)


def length(vectors):
    return np.sqrt(dot(vectors, vectors))[..., None]


def rotations(orientations):
    """Matrices of quaternions xyzw, which are normalised."""
    x, y, z, w = (orientations / length(orientations)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def harmonics(directions, degree):
    """Real spherical harmonics with the Condon-Shortley phase, orders -l ... l of each band, by recurrence."""
    x, y, z = directions.T
    legendre, cosine, sine = {}, [np.ones_like(x)], [np.zeros_like(x)]
    for m in range(degree + 1):  # P_l^m without its factor sin^m(theta), which cosine and sine hold
        if m:
            cosine, sine = [*cosine, x * cosine[-1] - y * sine[-1]], [*sine, x * sine[-1] + y * cosine[-1]]
        legendre[m, m] = (-1.0) ** m * np.prod(np.arange(1.0, 2 * m, 2)) * np.ones_like(x)
        for band in range(m + 1, degree + 1):
            below = legendre.get((band - 2, m), 0.0)
            legendre[band, m] = ((2 * band - 1) * z * legendre[band - 1, m] - (band + m - 1) * below) / (band - m)
    terms = []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            order = abs(m)
            falling = np.prod(np.arange(band - order + 1.0, band + order + 1.0))  # (l + |m|)! / (l - |m|)!
            norm = np.sqrt((2 * band + 1) / (4 * np.pi * falling) * (2.0 if m else 1.0))
            terms.append(norm * legendre[band, order] * (sine[order] if m < 0 else cosine[order]))
    return np.stack(terms, axis=-1)
