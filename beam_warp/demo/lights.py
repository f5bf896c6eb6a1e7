"""Three procedural lights for the demo: a studio to capture in, a sunset and a stage to relight with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.world.environment import EnvironmentMap, texel_directions

HEIGHT = 64

BRIGHTEST_WHITE = 1.1
"""Radiance of the white diffuser that gets most light. The figure's base colour ends at 0.8, so that even there
diffuse light stays below 0.9 and little but highlights reaches display white."""


@dataclass(frozen=True)
class SoftBox:
    """A light with soft edges.

    Attributes:
        azimuth: Where it is, counter-clockwise from +x seen from above [degree].
        elevation: Height above the horizon [degree].
        width: Half its angle across [degree].
        height: Half its angle along [degree].
        color: Radiance, scene-linear Rec.709, before exposure.
    """

    azimuth: float
    elevation: float
    width: float
    height: float
    color: tuple[float, float, float]


def _lit(background: NDArray[np.float64], boxes: tuple[SoftBox, ...], softness: float) -> EnvironmentMap:
    """Add lights to a background and expose the whole by `BRIGHTEST_WHITE`."""
    directions = texel_directions(HEIGHT, 2 * HEIGHT)
    radiance = background.copy()
    for box in boxes:
        azimuth, elevation = np.radians([box.azimuth, box.elevation])
        aim = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        across = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        along = np.cross(aim, across)
        depth = directions @ aim
        x = np.degrees(np.arctan2(np.abs(directions @ across), depth)) - box.width
        y = np.degrees(np.arctan2(np.abs(directions @ along), depth)) - box.height
        edge = np.clip(0.5 - np.stack([x, y], axis=-1) / softness, 0.0, 1.0)
        inside = (edge * edge * (3.0 - 2.0 * edge)).prod(axis=-1) * (depth > 0.0)
        radiance += inside[..., None] * np.asarray(box.color)
    light = EnvironmentMap(radiance.astype(np.float32))
    return light.scaled(BRIGHTEST_WHITE * np.pi / float(light.irradiance_map(32, 64).max()))


def _gradient(stops: tuple[tuple[float, tuple[float, float, float]], ...]) -> NDArray[np.float64]:
    """Return radiance by elevation: (degrees, colour) stops from low to high, linear in between."""
    elevation = np.degrees(np.arcsin(texel_directions(HEIGHT, 2 * HEIGHT)[..., 2]))
    heights = [stop[0] for stop in stops]
    return np.stack([np.interp(elevation, heights, [stop[1][c] for stop in stops]) for c in range(3)], axis=-1)


def studio() -> EnvironmentMap:
    """A photo studio: a large warm key to the figure's left front, a cool fill, two rim lights, a grey room."""
    room = _gradient(
        ((-90, (0.16, 0.15, 0.14)), (-5, (0.22, 0.21, 0.21)), (40, (0.34, 0.35, 0.37)), (90, (0.55, 0.55, 0.55)))
    )
    return _lit(
        room,
        (
            SoftBox(-48.0, 38.0, 22.0, 22.0, (5.6, 5.2, 4.7)),
            SoftBox(-150.0, 22.0, 26.0, 26.0, (1.3, 1.5, 1.8)),
            SoftBox(60.0, 30.0, 9.0, 30.0, (3.6, 3.8, 4.2)),
            SoftBox(140.0, 25.0, 9.0, 30.0, (3.4, 3.2, 3.0)),
        ),
        12.0,
    )


def sunset() -> EnvironmentMap:
    """A low warm sun to the figure's right, an orange horizon under a violet sky, dark ground."""
    sky = _gradient(
        (
            (-90, (0.10, 0.07, 0.06)),
            (-4, (0.22, 0.13, 0.09)),
            (2, (1.15, 0.50, 0.22)),
            (14, (0.75, 0.40, 0.36)),
            (40, (0.28, 0.27, 0.48)),
            (90, (0.13, 0.18, 0.42)),
        )
    )
    glow = SoftBox(-165.0, 12.0, 30.0, 16.0, (0.9, 0.42, 0.14))
    sun = SoftBox(-150.0, 17.0, 5.5, 5.5, (62.0, 33.0, 13.0))
    return _lit(sky, (glow, sun), 5.0)


def stage() -> EnvironmentMap:
    """A dark stage between a magenta and a cyan light, with a faint warm one from above."""
    dark = _gradient(((-90, (0.03, 0.03, 0.05)), (0, (0.05, 0.05, 0.09)), (90, (0.04, 0.04, 0.08))))
    return _lit(
        dark,
        (
            SoftBox(-10.0, 20.0, 18.0, 26.0, (3.6, 0.35, 2.3)),
            SoftBox(-165.0, 20.0, 18.0, 26.0, (0.25, 2.2, 3.6)),
            SoftBox(-90.0, 65.0, 16.0, 16.0, (2.0, 1.5, 0.9)),
        ),
        14.0,
    )


def demo_environments() -> dict[str, EnvironmentMap]:
    """Return the demo's lights by name: ``studio`` to capture in, ``sunset`` and ``stage`` to relight with.

    Each is exposed so that the white diffuser that gets most light has the radiance `BRIGHTEST_WHITE`.
    """
    return {"studio": studio(), "sunset": sunset(), "stage": stage()}
