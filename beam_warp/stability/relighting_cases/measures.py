"""Measures of images, and closed forms that they are compared with."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.kernels.light.brdf import ALPHA_FLOOR
from beam_warp.light.ggx import DIELECTRIC_F0, ggx_distribution, schlick_weight, smith_lambda, specular_albedo
from beam_warp.stability.relighting_cases.scenes import FIELD, GRAZING, WALL, RelightStudio
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap, texel_directions
from beam_warp.world.shot import RenderedImage

FURNACE = 0.01
"""Part by which a white surface under even light may be off what it reflects: the plan's."""

WRONG_PART = 0.01
"""Part of the lit, or shadowed, pixels that may be wrong: of 1024 pixels ten, few enough to be seen one by one."""

ROUNDING = 1e-4
"""Relative: a thousand roundings of float32."""

EDGE = 1
"""Pixels around the edge of a shadow that are not judged: the nearest pixel is as near as an image tells."""


def scattered(normal: ArrayLike, view: ArrayLike, lights: ArrayLike, roughness: float) -> NDArray[np.float64]:
    """Return the dielectric GGX lobe times n·l in float64, for unit directions ``(..., 3)`` of light; 0 from below."""
    n, v, d = (np.asarray(a, np.float64) for a in (normal, view, lights))
    half = v + d
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    alpha, above = max(roughness**2, float(ALPHA_FLOOR)), np.maximum(d @ n, 1e-12)
    shadowing = 1.0 / (1.0 + smith_lambda(above, alpha) + smith_lambda(n @ v, alpha))
    fresnel = DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * schlick_weight(half @ v)
    lobe = ggx_distribution(half @ n, alpha) * shadowing * fresnel / (4.0 * (n @ v))
    return np.where(d @ n > 0.0, lobe, 0.0)


def diffuse(view: ArrayLike, base_color: float, roughness: float) -> float:
    """Return the Lambert lobe of a plane z = 0 [1/sr], seen from a unit direction."""
    return float(base_color * (1.0 - specular_albedo(np.asarray(view, np.float64)[2], roughness)) / np.pi)


def disc_directions(middle: ArrayLike, degrees: float, count: int = 20_000) -> NDArray[np.float64]:
    """Return directions spread evenly over the solid angle of a disc of so many degrees around a unit direction."""
    axis = np.asarray(middle, np.float64)
    k = np.arange(count) + 0.5
    z = 1.0 - (1.0 - np.cos(np.radians(degrees / 2.0))) * k / count
    around = np.pi * (3.0 - np.sqrt(5.0)) * k
    side = np.cross(axis, (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side), axis])
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(around), ring * np.sin(around), z], axis=-1) @ frame


def brightness(image: RenderedImage) -> float:
    """Return the mean radiance of what is covered."""
    return float(image.rgb.mean(dtype=np.float64) / max(float(image.alpha.mean(dtype=np.float64)), 1e-12))


def largest_difference(one: RenderedImage, other: RenderedImage) -> float:
    """Return by how much two images differ at most, of the largest value of the other; alpha in its own unit."""
    scale = max(float(other.rgb.max(initial=0.0)), 1e-12)
    color = np.abs(one.rgb - other.rgb).max(initial=0.0) / scale
    return float(max(color, np.abs(one.alpha - other.alpha).max(initial=0.0)))


def wrong_parts(dark: NDArray[np.bool_], expected: NDArray[np.bool_], judged: NDArray[np.bool_]) -> tuple[float, float]:
    """Return which part of the lit pixels is shadowed, and of the shadowed ones lit; `EDGE` pixels apart from edges."""
    height, width = expected.shape
    padded = np.pad(expected, EDGE, mode="edge")
    steps = range(2 * EDGE + 1)
    around = np.stack([padded[i : i + height, j : j + width] for i in steps for j in steps])
    lit, shadowed = judged & ~around.any(axis=0), judged & around.all(axis=0)
    return float(dark[lit].mean()) if lit.any() else 0.0, float((~dark)[shadowed].mean()) if shadowed.any() else 0.0


def arriving_part(shaded: RenderedImage, free: RenderedImage) -> NDArray[np.float64]:
    """Return what a shadow leaves of the light of every pixel."""
    rgb, full = (image.rgb.sum(axis=-1, dtype=np.float64) for image in (shaded, free))
    return np.divide(rgb, full, out=np.ones_like(rgb), where=full > 0.0)


def in_wall_shadow(points: NDArray[np.float64], degrees: float) -> NDArray[np.bool_]:
    """Tell which points of the floor the wall hides from the middle of the sun."""
    place, height, half = WALL
    x, y = points[..., 0], points[..., 1]
    return (x > place) & (x < place + height / np.tan(np.radians(degrees))) & (np.abs(y) < half)


def floor_points(camera: Camera) -> NDArray[np.float64]:
    """Return where the middles of pixels see z = 0, ``(H, W, 3)``."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack(
        [(column - camera.center_x) / camera.focal_x, (row - camera.center_y) / camera.focal_y, np.ones_like(row)],
        axis=-1,
    )
    directions = local @ camera.camera_to_world[:3, :3].T
    return camera.position - directions * (camera.position[2] / directions[..., 2:])


def wall_shadow(studio: RelightStudio, camera: Camera, around: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where the floor is in the wall's shadow, and where that is known.

    It is not where tiles end softly, and not so far around the wall that it is the wall that is seen there.
    """
    place, height, half = WALL
    points = floor_points(camera)
    slope = 1.0 / np.tan(np.radians(GRAZING))
    reach = 0.5 * studio.spacing  # of the wall's own tiles, which are half as wide as the floor's, beyond its edges
    x, y = points[..., 0], points[..., 1]
    soft = np.abs(x - (place + height * slope)) < reach * slope
    soft |= (np.abs(np.abs(y) - half) < reach) & (x > place)
    soft |= (np.abs(x - place) < around) & (np.abs(y) < half + around)
    return in_wall_shadow(points, GRAZING), ~soft & (np.abs(points[..., :2]) < 0.8).all(axis=-1)


def wall_seen(studio: RelightStudio) -> float:
    """Return how far beside the wall it is itself that is seen from above [m].

    Splats are widened by 0.3 px², which makes two pixels of opaque wall of a stack of them.
    """
    return studio.spacing + 2.0 * FIELD / studio.size


def sky_closed_form(light: EnvironmentMap, view: ArrayLike, roughness: float) -> tuple[float, float]:
    """Return what a white plane z = 0 sends to a viewer under an open sky: diffusely, and specularly."""
    fine = 16
    height, width = light.radiance.shape[:2]
    radiance = light.radiance[..., 0].astype(np.float64).repeat(fine, 0).repeat(fine, 1)
    directions = texel_directions(fine * height, fine * width)
    edges = np.cos(np.arange(fine * height + 1) * (np.pi / (fine * height)))
    solid = (edges[:-1] - edges[1:])[:, None] * (2.0 * np.pi / (fine * width)) * radiance
    up = np.array([0.0, 0.0, 1.0])
    cosine = np.maximum(directions[..., 2], 0.0)
    return (
        float(diffuse(view, 1.0, roughness) * (cosine * solid).sum()),
        float((scattered(up, view, directions, roughness) * solid).sum()),
    )
