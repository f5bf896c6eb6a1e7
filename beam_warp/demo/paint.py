"""Materials of the demo figure: base colour and roughness as band-limited functions of the rest position.

Base colour stays in [0.05, 0.8] (scene-linear Rec.709) and roughness in [0.3, 0.9], as cloth, skin and leather do.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beam_warp.demo.shape import DRESS_HEM, ELBOW, PARTS, FloatArray, part_distances

SEAM = 0.003
"""Distance over which one material turns into the next [m]."""

LOWEST_COLOR, HIGHEST_COLOR = 0.05, 0.8
LOWEST_ROUGHNESS, HIGHEST_ROUGHNESS = 0.3, 0.9


def ramp(value: FloatArray, width: float) -> FloatArray:
    """Return a smooth step from 0 to 1 that is centred at 0 and ``width`` wide."""
    t = np.clip(value / width + 0.5, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def mix(a: object, b: object, share: FloatArray) -> FloatArray:
    """Blend two colours, or a colour array and a colour: 0 is ``a``, 1 is ``b``."""
    return np.asarray(a, np.float64) * (1.0 - share[:, None]) + np.asarray(b, np.float64) * share[:, None]


def stripes(coordinate: FloatArray, period: float, edge: float) -> FloatArray:
    """Return bands of 0 and 1 of equal width with soft edges, all lengths in metres."""
    triangle = np.abs((coordinate / period) % 1.0 - 0.5) * 2.0 - 0.5
    return ramp(triangle * period / 2.0, edge)


def mottle(points: FloatArray) -> FloatArray:
    """Return a gentle noise in [-1, 1]: seven plane waves of 7 to 20 cm."""
    rng = np.random.default_rng(7)
    directions = rng.normal(size=(7, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    waves = directions * (2.0 * np.pi / rng.uniform(0.07, 0.20, 7))[:, None]
    return np.sin(points @ waves.T + rng.uniform(0.0, 2.0 * np.pi, 7)).mean(axis=1)


CREAM, TEAL, DEEP_TEAL = (0.76, 0.66, 0.47), (0.06, 0.36, 0.37), (0.05, 0.20, 0.26)
CORAL, MUSTARD, PLUM, ROSE = (0.72, 0.13, 0.08), (0.72, 0.42, 0.08), (0.22, 0.06, 0.20), (0.66, 0.22, 0.30)
SKIN, LIPS, AUBURN, LEATHER, SOLE = (
    (0.68, 0.39, 0.26),
    (0.52, 0.12, 0.10),
    (0.34, 0.11, 0.05),
    (0.30, 0.13, 0.06),
    (0.07,) * 3,
)

Material = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def _plain(color: tuple[float, float, float], roughness: float, variation: float = 0.1) -> Material:
    def material(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        noise = mottle(points)
        return np.asarray(color) * (1.0 + variation * noise)[:, None], roughness + 0.05 * noise

    return material


def _dress(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    x, y, z = points.T
    azimuth = np.arctan2(y, x)
    color = mix(TEAL, DEEP_TEAL, ramp(z - 1.0, 0.35))
    # Dots in rows that shift by half a step; their number around is whole, so that no seam shows.
    row = (z - 0.60) / 0.085
    around = azimuth / (2.0 * np.pi) * 14.0 + 0.5 * np.floor(row)
    girth = np.maximum(np.hypot(x, y), 0.05) * 2.0 * np.pi / 14.0
    dot = np.hypot((around % 1.0 - 0.5) * girth, (row % 1.0 - 0.5) * 0.085)
    color = mix(color, CREAM, ramp(0.021 - dot, 0.014) * ramp(z - 0.645, 0.01))
    zigzag = z - (DRESS_HEM + 0.045) - 0.016 * (2.0 * np.abs(azimuth / (2.0 * np.pi) * 16.0 % 1.0 - 0.5) * 2.0 - 1.0)
    color = mix(color, CORAL, ramp(-zigzag, 0.012))
    color = mix(color, MUSTARD, ramp(0.011 - np.abs(zigzag - 0.012), 0.010))
    return color, 0.78 + 0.08 * mottle(points)


def _shirt(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    along = np.abs(points[:, 0]) * 0.74 - points[:, 2] * 0.67
    cuff = ramp(np.abs(points[:, 0]) - ELBOW[0] - 0.105, 0.012)
    color = mix(CREAM, ROSE, stripes(along, 0.075, 0.016) * 0.85)
    return mix(color, CORAL, cuff), 0.82 + 0.06 * mottle(points)


def _scarf(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    along = points[:, 0] * 0.9 + 0.4 * points[:, 1] + 0.6 * points[:, 2]
    return mix(CORAL, MUSTARD, stripes(along, 0.085, 0.018)), 0.86 + 0.04 * mottle(points)


def _leggings(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    return mix(PLUM, ROSE, stripes(points[:, 2], 0.070, 0.018)), 0.66 + 0.08 * mottle(points)


def _hat(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    radius = np.hypot(points[:, 0], points[:, 1] - 0.02)
    rings = np.sin(2.0 * np.pi * (radius + 0.8 * np.maximum(points[:, 2] - 1.56, 0.0)) / 0.050)
    return mix(MUSTARD, (0.50, 0.24, 0.05), 0.5 + 0.3 * rings), 0.70 + 0.08 * rings


def _hair(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    strands = np.sin(2.0 * np.pi * (np.arctan2(points[:, 0], points[:, 1] + 0.02) * 5.0 + points[:, 2] * 3.0))
    return mix(AUBURN, (0.50, 0.19, 0.07), 0.4 + 0.35 * strands), 0.42 + 0.06 * strands


def _boots(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    color = mix(np.asarray(LEATHER) * (1.0 + 0.2 * mottle(points))[:, None], SOLE, ramp(0.022 - points[:, 2], 0.010))
    return color, 0.38 + 0.06 * mottle(points)


def _face(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    x, y, z = points.T
    front = ramp(-y - 0.02, 0.02)
    side = np.abs(x)
    color = np.broadcast_to(np.asarray(SKIN), points.shape)
    cheek = np.hypot(side - 0.062, (z - 1.408) * 1.15)
    color = mix(color, (0.74, 0.20, 0.15), 0.75 * ramp(0.022 - cheek, 0.030) * front)
    eye = np.hypot(side - 0.044, (z - 1.452) * 0.72)
    color = mix(color, (0.05, 0.055, 0.06), ramp(0.0165 - eye, 0.009) * front)
    glint = np.hypot(x - 0.006 - 0.044 * np.sign(x), z - 1.460)
    color = mix(color, (0.75, 0.75, 0.75), 0.8 * ramp(0.006 - glint, 0.008) * front)
    smile = np.abs(z - (1.377 + 5.0 * x * x)) + 0.6 * np.maximum(side - 0.034, 0.0)
    color = mix(color, LIPS, ramp(0.0075 - smile, 0.010) * ramp(0.046 - side, 0.010) * front)
    return color, 0.50 + 0.05 * mottle(points)


MATERIALS: dict[str, Material] = {
    "skin": _plain(SKIN, 0.50),
    "face": _face,
    "hair": _hair,
    "hat": _hat,
    "band": _plain(PLUM, 0.45),
    "feather": _plain((0.10, 0.45, 0.50), 0.55),
    "ribbon": _plain(CORAL, 0.50),
    "scarf": _scarf,
    "shirt": _shirt,
    "dress": _dress,
    "belt": _plain(MUSTARD, 0.34),
    "leather": _plain(LEATHER, 0.42),
    "leggings": _leggings,
    "boots": _boots,
    "cuff": _plain(CREAM, 0.80),
}


def paint(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return base colour ``(N, 3)`` and roughness ``(N,)`` at rest positions ``(N, 3)`` on the surface."""
    distances = part_distances(points)
    nearness = np.exp((distances.min(axis=1, keepdims=True) - distances) / SEAM)
    color, roughness, total = np.zeros((len(points), 3)), np.zeros(len(points)), np.zeros(len(points))
    for name, material in MATERIALS.items():
        share = nearness[:, [part.material == name for part in PARTS]].sum(axis=1)
        there = share > 1e-4
        shade, sheen = material(points[there])
        color[there] += share[there, None] * shade
        roughness[there] += share[there] * sheen
        total[there] += share[there]
    return (
        np.clip(color / total[:, None], LOWEST_COLOR, HIGHEST_COLOR),
        np.clip(roughness / total, LOWEST_ROUGHNESS, HIGHEST_ROUGHNESS),
    )
