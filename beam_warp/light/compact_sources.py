"""Suns and lamps of an environment, told apart from what is around them: as lights, they are shaded exactly.

What a lobe sees of an environment is looked up in maps that are blurred beforehand, by lobes that are nearly its own.
Under a source smaller than the lobe, what they are off by shows most. A light of the same power and size needs no such
maps, and has a shadow of its own.

A source is what a disc has beyond the median of the ring around it: a sun leaves the sky that it stands in. What is
taken is taken texel by texel, so that no light is lost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beam_warp.image.color import LUMINANCE
from beam_warp.light.regions import disc_half_angle
from beam_warp.world.environment import EnvironmentMap, texel_directions
from beam_warp.world.lights import MOST_POWER, DirectionalLight

MOST_SOURCES = 4
"""Most sources that are told apart: each costs a shadow map and a light of every pixel."""

LEAST_SHARE = 0.03
"""Part of an environment's power from which on a source is worth that: half of what one of 16 regions has."""

RADII = np.radians((8.0, 4.0, 2.0, 1.0))
"""Discs in which a source is looked for, the widest first."""

MOST_OF_IT = 0.9
"""Part of a source's power that a narrower disc must hold to be taken instead: glare would make a sun larger."""

WIDEST = np.radians(4.0)
"""Largest half angle of a source: lobes of roughness 0.3 and more hardly show its shape."""

CELL_ROWS = 90
"""Rows of the cells among which the one of most power is looked at next, 2 degrees high."""

CENTERINGS = 3
"""Times that a disc is moved to the middle of its source."""


class SplitEnvironment(NamedTuple):
    """An environment in two parts that add up to it.

    Attributes:
        rest: What is left; the same object where nothing is taken.
        sources: What was taken.
    """

    rest: EnvironmentMap
    sources: tuple[DirectionalLight, ...]


def split_sources(environment: EnvironmentMap) -> SplitEnvironment:
    """Tell the small sources of an environment apart that have `LEAST_SHARE` of its power, at most `MOST_SOURCES`.

    A source becomes the disc of even radiance whose directions spread as the source's do, the extent of its texels
    included: maps of large texels have none. What no light can state, for its power, stays in the map.
    """
    rest, sources = environment, []
    least = LEAST_SHARE * 4.0 * np.pi * float(environment.mean_radiance() @ LUMINANCE)
    while len(sources) < MOST_SOURCES:
        found = _find_source(rest, least)
        if found is None:
            break
        sources.append(found.light)
        radiance = rest.radiance.copy()
        radiance[found.texels] = np.minimum(radiance[found.texels], found.around)
        rest = EnvironmentMap(radiance)
    return SplitEnvironment(rest, tuple(sources))


class _Source(NamedTuple):
    """A source, and where it is in the map.

    Attributes:
        light: The source.
        texels: Rows and columns of its disc.
        around: Radiance of what it stands in, ``(3,)``.
    """

    light: DirectionalLight
    texels: tuple[NDArray[np.intp], NDArray[np.intp]]
    around: NDArray[np.float32]


class _Disc(NamedTuple):
    """What a disc of a map has beyond the ring around it.

    Attributes:
        inside: The disc's texels, ``(R, W)``.
        around: Radiance of the ring, the median, ``(3,)``.
        flux: Radiance beyond it times solid angle [W/m^2], of the texels inside, ``(T, 3)``.
        middle: Where this light comes from in the mean, a unit vector.
    """

    inside: NDArray[np.bool_]
    around: NDArray[np.float32]
    flux: NDArray[np.float64]
    middle: NDArray[np.float64]


def _find_source(environment: EnvironmentMap, least: float) -> _Source | None:
    """Return the source about the cell of most power: the narrowest disc that holds `MOST_OF_IT`; None for none."""
    middle = _strongest_direction(environment)
    polar = np.arccos(np.clip(middle[2], -1.0, 1.0)) + np.array((-3.0, 3.0)) * RADII[0]  # a ring, and how far it moves
    first, end = np.clip(np.round(polar / np.pi * environment.height).astype(int), 0, environment.height)
    directions = texel_directions(environment.height, environment.width, slice(first, end))
    radiance, angles = environment.radiance[first:end], environment.solid_angles()[first:end]
    found, power = None, least
    for radius in RADII:
        disc = _centered_disc(directions, radiance, angles, middle, radius)
        if disc is None:
            break
        middle = disc.middle
        cosines, weights = directions[disc.inside] @ middle, disc.flux @ LUMINANCE
        spread = disc_half_angle(float(weights @ cosines) / float(weights.sum()))
        half_angle = float(np.hypot(spread, 0.5 * np.pi / environment.height))
        irradiance = cosines @ disc.flux
        is_light = half_angle <= min(WIDEST, 0.5 * radius) and irradiance.max() <= MOST_POWER
        if is_light and weights.sum() >= power:
            light = DirectionalLight(
                direction=tuple((-middle).tolist()),
                irradiance=tuple(irradiance.tolist()),
                angular_diameter=2.0 * float(np.degrees(half_angle)),
            )
            rows, columns = np.nonzero(disc.inside)
            found = _Source(light, (rows + first, columns), disc.around)
            power = max(power, MOST_OF_IT * float(weights.sum()))
    return found


def _centered_disc(
    directions: NDArray[np.float64],
    radiance: NDArray[np.float32],
    angles: NDArray[np.float64],
    middle: NDArray[np.float64],
    radius: float,
) -> _Disc | None:
    """Move a disc to the middle of what it has beyond its ring; None where that is nothing.

    Args:
        directions: Of the texels, ``(R, W, 3)``.
        radiance: Of the same, ``(R, W, 3)``.
        angles: Their solid angles [sr], ``(R, W)``.
        middle: Where to begin.
        radius: Of the disc; half of the ring's [rad].
    """
    disc = None
    for _ in range(CENTERINGS):
        cosine = directions @ middle
        inside = cosine > np.cos(radius)
        ring = ~inside & (cosine > np.cos(2.0 * radius))
        if not (inside.any() and ring.any()):
            return None
        around = np.median(radiance[ring], axis=0)
        flux = np.maximum(radiance[inside] - around, 0.0) * angles[inside][:, None]
        moment = (flux @ LUMINANCE) @ directions[inside]
        length = float(np.linalg.norm(moment))
        if not length > 0.0:
            return None
        middle = moment / length
        disc = _Disc(inside, around, flux, middle)
    return disc


def _strongest_direction(environment: EnvironmentMap) -> NDArray[np.float64]:
    """Return the direction of the cell of most power."""
    rows = min(CELL_ROWS, environment.height)
    cells = environment if rows == environment.height else environment.resized(rows, 2 * rows)
    power = (cells.radiance @ LUMINANCE) * cells.solid_angles()
    return cells.directions().reshape(-1, 3)[int(np.argmax(power))]
