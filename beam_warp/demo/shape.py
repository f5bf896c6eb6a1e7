"""The demo figure at rest as a signed-distance function: a wanderer with hat, scarf, flared dress and boots.

About 1.7 m tall, z up, looking along -y, its left side at +x, standing on z = 0 with arms held out. Every part knows
which bone carries it and what it is made of. The dress and the sleeves are hollow, so that light and rays have
real cavities to get lost in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LEFT, RIGHT = 1.0, -1.0
SIDES = {"left": LEFT, "right": RIGHT}


@dataclass(frozen=True, eq=False)
class BodyPart:
    """One piece of the figure.

    Attributes:
        name: Name of the piece.
        bone: Name of the bone that carries it.
        material: Name of its material in `beam_warp.demo.paint`.
        distance: Signed distance of points ``(N, 3)`` [m], exact or a good approximation near the surface.
        low: Lower corner of a box around the piece [m].
        high: Upper corner of that box [m].
        blend: Width over which the piece melts into those before it [m].
    """

    name: str
    bone: str
    material: str
    distance: Callable[[FloatArray], FloatArray]
    low: FloatArray
    high: FloatArray
    blend: float


def smooth_minimum(a: FloatArray, b: FloatArray, width: float) -> FloatArray:
    """Return the smaller of two distances, rounded where they differ by less than ``width`` (Quilez 2013)."""
    overlap = np.maximum(width - np.abs(a - b), 0.0)
    return np.minimum(a, b) - overlap * overlap / (4.0 * width)


def round_cone(points: FloatArray, a: FloatArray, b: FloatArray, radius_a: float, radius_b: float) -> FloatArray:
    """Distance to the convex hull of two balls, neither inside the other (Quilez 2018)."""
    axis = b - a
    squared = float(axis @ axis)
    narrowing = radius_a - radius_b
    side = squared - narrowing * narrowing
    along = (points - a) @ axis
    across = squared * ((points - a) ** 2).sum(-1) - along * along
    beyond = along - squared
    turn = np.sign(narrowing) * narrowing * narrowing * across
    end_b = np.sign(beyond) * side * beyond * beyond > turn
    end_a = np.sign(along) * side * along * along < turn
    across = np.maximum(across, 0.0)
    to_b = np.sqrt(across + beyond * beyond) / np.sqrt(squared) - radius_b
    to_a = np.sqrt(across + along * along) / np.sqrt(squared) - radius_a
    between = (np.sqrt(across * side) + along * narrowing) / squared - radius_a
    return np.where(end_b, to_b, np.where(end_a, to_a, between))


def ellipsoid(points: FloatArray, center: FloatArray, radii: FloatArray) -> FloatArray:
    """Distance to an ellipsoid, to first order near its surface."""
    scaled = (points - center) / radii
    length = np.linalg.norm(scaled, axis=-1)
    return length * (length - 1.0) / np.maximum(np.linalg.norm(scaled / radii, axis=-1), 1e-9)


def ring(points: FloatArray, center: FloatArray, radii: FloatArray, thickness: float) -> FloatArray:
    """Distance to a torus around z whose circle is stretched to ``radii`` (x, y), about right near its surface."""
    local = points - center
    scaled = local[..., :2] / radii
    length = np.maximum(np.linalg.norm(scaled, axis=-1), 1e-9)
    around = length * (length - 1.0) / np.maximum(np.linalg.norm(scaled / radii, axis=-1), 1e-9)
    return np.hypot(around, local[..., 2]) - thickness


DRESS_TOP, DRESS_HEM = 0.985, 0.55


def dress(points: FloatArray) -> FloatArray:
    """A skirt with eight folds, 3 cm thick and hollow from below."""
    radius = np.hypot(points[..., 0], points[..., 1] * 1.12)
    azimuth = np.arctan2(points[..., 1], points[..., 0])
    fall = np.clip((DRESS_TOP - points[..., 2]) / (DRESS_TOP - DRESS_HEM), 0.0, 1.1)
    outline = 0.115 + 0.185 * fall**1.25 + 0.020 * fall * fall * np.cos(8.0 * azimuth)
    slope = 0.87  # cosine of the flare's angle: turns a radial distance into a normal one
    outside = (radius - outline) * slope
    ends = np.maximum(DRESS_HEM - points[..., 2], points[..., 2] - DRESS_TOP)
    solid = -smooth_minimum(-outside, -ends, 0.02)
    hollow = np.maximum((radius - outline) * slope + 0.03, points[..., 2] - 0.82)
    return -smooth_minimum(-solid, hollow, 0.012)


def sleeve(points: FloatArray, elbow: FloatArray, wrist: FloatArray) -> FloatArray:
    """A forearm's sleeve that widens and is open at the wrist."""
    along = wrist - elbow
    outer = round_cone(points, elbow, elbow + 0.92 * along, 0.046, 0.074)
    mouth = (points - (elbow + 0.97 * along)) @ (along / np.linalg.norm(along))
    inner = round_cone(points, elbow + 0.55 * along, elbow + 1.15 * along, 0.024, 0.056)
    solid = -smooth_minimum(-outer, -mouth, 0.012)
    return -smooth_minimum(-solid, inner, 0.010)


def brim(points: FloatArray) -> FloatArray:
    """A hat's brim: a disc, raised at the sides and above the face."""
    x, y = points[..., 0], points[..., 1] - 0.01
    radius = np.hypot(x, y)
    middle = 1.545 - 0.10 * y + 0.75 * x * x - 0.35 * y * y
    beside, above = radius - 0.235, np.abs(points[..., 2] - middle) * 0.95 - 0.004
    outside = np.hypot(np.maximum(beside, 0.0), np.maximum(above, 0.0))
    return outside + np.minimum(np.maximum(beside, above), 0.0) - 0.011


SHOULDER = np.array([0.150, 0.0, 1.225])
ELBOW = np.array([0.335, 0.005, 1.055])
WRIST = np.array([0.505, -0.010, 0.905])
HIP = np.array([0.085, 0.0, 0.830])
KNEE = np.array([0.095, -0.008, 0.470])
ANKLE = np.array([0.098, 0.012, 0.095])
SCARF_TAIL = np.array([[-0.04, 0.085, 1.27], [-0.15, 0.17, 1.235], [-0.27, 0.215, 1.25], [-0.39, 0.25, 1.19]])
BRAID = np.array(
    [[0.0, 0.125, 1.415], [0.01, 0.185, 1.355], [0.02, 0.215, 1.285], [0.03, 0.225, 1.225], [0.035, 0.220, 1.175]]
)


def mirrored(point: FloatArray, side: float) -> FloatArray:
    """Return a point of the left side on the given side."""
    return point * (side, 1.0, 1.0)


def _cone(
    name: str, bone: str, material: str, a: object, b: object, radii: tuple[float, float], blend: float
) -> BodyPart:
    start, end = np.asarray(a, np.float64), np.asarray(b, np.float64)
    corners = np.stack([start - radii[0], start + radii[0], end - radii[1], end + radii[1]])
    distance = partial(round_cone, a=start, b=end, radius_a=radii[0], radius_b=radii[1])
    return BodyPart(name, bone, material, distance, corners.min(0), corners.max(0), blend)


def _ball(name: str, bone: str, material: str, center: object, radii: object, blend: float) -> BodyPart:
    middle, half = np.asarray(center, np.float64), np.asarray(radii, np.float64)
    return BodyPart(
        name, bone, material, partial(ellipsoid, center=middle, radii=half), middle - half, middle + half, blend
    )


def _ring(
    name: str, bone: str, material: str, center: object, radii: object, thickness: float, blend: float
) -> BodyPart:
    middle, half = np.asarray(center, np.float64), np.asarray(radii, np.float64)
    reach = np.array([*(half + thickness), thickness])
    distance = partial(ring, center=middle, radii=half, thickness=thickness)
    return BodyPart(name, bone, material, distance, middle - reach, middle + reach, blend)


def _body() -> list[BodyPart]:
    parts = [
        _ball("hips", "pelvis", "leggings", (0, 0, 0.86), (0.135, 0.105, 0.12), 0.02),
        _ball("waist", "spine", "dress", (0, 0, 0.99), (0.115, 0.092, 0.13), 0.04),
        _ball("chest", "chest", "dress", (0, 0, 1.145), (0.140, 0.105, 0.135), 0.05),
        _cone("neck", "chest", "skin", (0, 0, 1.23), (0, 0, 1.36), (0.055, 0.048), 0.03),
        BodyPart("dress", "dress", "dress", dress, np.array([-0.35, -0.32, 0.53]), np.array([0.35, 0.32, 1.0]), 0.02),
        _ring("belt", "spine", "belt", (0, 0, 0.975), (0.118, 0.098), 0.017, 0.006),
        _ball("pouch", "spine", "leather", (0.10, -0.085, 0.925), (0.042, 0.036, 0.048), 0.006),
    ]
    for name, side in SIDES.items():
        shoulder, elbow, wrist = (mirrored(p, side) for p in (SHOULDER, ELBOW, WRIST))
        hip, knee, ankle = (mirrored(p, side) for p in (HIP, KNEE, ANKLE))
        forearm, hand, shin, foot = (f"{name} {bone}" for bone in ("forearm", "hand", "shin", "foot"))
        along = (wrist - elbow) / np.linalg.norm(wrist - elbow)
        reach = np.stack([elbow - 0.09, elbow + 0.09, wrist - 0.09, wrist + 0.09])
        around = partial(sleeve, elbow=elbow, wrist=wrist)
        palm = wrist + 0.055 * along
        thumb = mirrored(np.array([-0.030, -0.050, -0.005]), side)
        shaft = ankle + np.array((0, 0, -0.01)), ankle + np.array((-0.001 * side, -0.01, 0.185))
        cuff = ankle + np.array((-0.001 * side, -0.01, 0.215))
        boot = ankle + np.array((0, 0.015, -0.037)), ankle + np.array((0.012 * side, -0.115, -0.043))
        parts += [
            _cone(f"{name} shoulder", "chest", "shirt", (0.06 * side, 0, 1.20), shoulder, (0.075, 0.062), 0.04),
            _cone(f"{name} upper arm", f"{name} arm", "shirt", shoulder, elbow, (0.060, 0.047), 0.03),
            _cone(f"{name} wrist", forearm, "skin", elbow + 0.05 * along, wrist, (0.030, 0.027), 0.01),
            BodyPart(f"{name} sleeve", forearm, "shirt", around, reach.min(0), reach.max(0), 0.02),
            _ball(f"{name} palm", hand, "skin", palm, (0.040, 0.034, 0.046), 0.025),
            _cone(f"{name} fingers", hand, "skin", palm, palm + 0.055 * along, (0.034, 0.025), 0.02),
            _cone(f"{name} thumb", hand, "skin", palm, palm + thumb, (0.022, 0.016), 0.015),
            _cone(f"{name} thigh", f"{name} thigh", "leggings", hip, knee, (0.083, 0.058), 0.03),
            _cone(f"{name} calf", shin, "leggings", knee, ankle, (0.056, 0.046), 0.02),
            _cone(f"{name} shaft", shin, "boots", *shaft, (0.058, 0.070), 0.015),
            _ring(f"{name} cuff", shin, "cuff", cuff, (0.066, 0.066), 0.021, 0.01),
            _cone(f"{name} boot", foot, "boots", *boot, (0.058, 0.052), 0.03),
        ]
    return parts


def _head() -> list[BodyPart]:
    parts = [
        _ball("head", "head", "face", (0, -0.008, 1.455), (0.116, 0.118, 0.135), 0.02),
        _ball("chin", "head", "face", (0, -0.040, 1.398), (0.075, 0.075, 0.066), 0.05),
        _ball("nose", "head", "face", (0, -0.128, 1.432), (0.017, 0.022, 0.018), 0.02),
        _ball("hair", "head", "hair", (0, 0.030, 1.470), (0.134, 0.118, 0.150), 0.008),
        BodyPart("brim", "head", "hat", brim, np.array([-0.27, -0.26, 1.48]), np.array([0.27, 0.28, 1.64]), 0.008),
        _cone("crown", "head", "hat", (0, 0.012, 1.555), (0, 0.040, 1.652), (0.118, 0.082), 0.015),
        _ring("hat band", "head", "band", (0, 0.014, 1.578), (0.116, 0.116), 0.013, 0.006),
        _cone("feather", "head", "feather", (0.108, 0.02, 1.575), (0.165, 0.115, 1.735), (0.022, 0.014), 0.006),
    ]
    for name, side in SIDES.items():
        lock = (0.112 * side, -0.030, 1.48), (0.110 * side, -0.045, 1.355)
        parts.append(_cone(f"{name} lock", "head", "hair", *lock, (0.036, 0.022), 0.012))
    radii = (0.048, 0.046, 0.043, 0.030, 0.034)
    for index, (center, radius) in enumerate(zip(BRAID, radii, strict=True)):
        bone = "braid" if index < 3 else "braid end"
        material = "ribbon" if index == 3 else "hair"
        size = 0.030 if index == 3 else radius
        parts.append(_ball(f"braid {index}", bone, material, center, (size, size, radius), 0.012))
    return parts


def _scarf() -> list[BodyPart]:
    parts = [
        _ring("scarf", "chest", "scarf", (0, 0.002, 1.292), (0.078, 0.076), 0.042, 0.006),
        _cone("scarf knot", "chest", "scarf", (0.055, -0.095, 1.265), (0.085, -0.118, 1.155), (0.036, 0.028), 0.015),
    ]
    for index, radii in enumerate(((0.034, 0.036), (0.036, 0.038), (0.038, 0.030))):
        bone = "scarf" if index < 2 else "scarf end"
        parts.append(
            _cone(f"scarf tail {index}", bone, "scarf", SCARF_TAIL[index], SCARF_TAIL[index + 1], radii, 0.015)
        )
    return parts


PARTS: tuple[BodyPart, ...] = (*_body(), *_head(), *_scarf())
"""Every part, in the order in which they are joined."""

FAR = 1.0
"""Distance that stands for outside a part's neighbourhood [m]."""


def rest_field(low: FloatArray, counts: NDArray[np.integer[Any]], spacing: float) -> FloatArray:
    """Sample the figure's signed distance on a grid, each part only near itself.

    Args:
        low: Lower corner [m].
        counts: Samples along x, y and z.
        spacing: Distance of samples [m].

    Returns:
        ``counts`` float64: negative inside; near the surface a distance, elsewhere only its sign counts.
    """
    field = np.full(tuple(counts), FAR)
    axes = [float(low[axis]) + spacing * np.arange(int(counts[axis]), dtype=np.float64) for axis in range(3)]
    for part in PARTS:
        reach = part.blend + 2.0 * spacing
        spans = [
            slice(*np.searchsorted(axes[axis], (part.low[axis] - reach, part.high[axis] + reach))) for axis in range(3)
        ]
        grid = np.stack(np.meshgrid(*(axes[axis][spans[axis]] for axis in range(3)), indexing="ij"), axis=-1)
        block = field[tuple(spans)]
        field[tuple(spans)] = smooth_minimum(block, part.distance(grid), part.blend)
    return field


def part_distances(points: FloatArray) -> FloatArray:
    """Return the distance of points ``(N, 3)`` to every part, ``(N, len(PARTS))``."""
    return np.stack([part.distance(points) for part in PARTS], axis=-1)


def rest_distance(points: FloatArray) -> FloatArray:
    """Return the figure's signed distance at points ``(N, 3)``, ``(N,)``."""
    value = np.full(len(points), FAR)
    for part in PARTS:
        value = smooth_minimum(value, part.distance(points), part.blend)
    return value
