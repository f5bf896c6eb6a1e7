"""Lights on a device."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from beam_warp.device.arrays import upload
from beam_warp.kernels.light.lights import DIRECTIONAL, POINT, SPOT, Lights
from beam_warp.world.lights import DirectionalLight, Light, PointLight, SpotLight, light_entry

Numbers: TypeAlias = tuple[float, ...]


class LightRow(NamedTuple):
    """A light as `Lights` lays it out; what a type does not have is left at its default."""

    kind: int
    power: Numbers
    size: float
    position: Numbers = (0.0, 0.0, 0.0)
    direction: Numbers = (0.0, 0.0, 0.0)
    cone: Numbers = (1.0, 0.0)


def _directional_row(light: DirectionalLight) -> LightRow:
    sine = float(np.sin(np.radians(light.angular_diameter) / 2.0))
    return LightRow(int(DIRECTIONAL), light.irradiance, sine, direction=light.direction)


def _point_row(light: PointLight) -> LightRow:
    return LightRow(int(POINT), light.intensity, light.radius, light.position)


def _spot_row(light: SpotLight) -> LightRow:
    cone = tuple(np.cos(np.radians((light.inner_angle, light.outer_angle))).tolist())
    return LightRow(int(SPOT), light.intensity, light.radius, light.position, light.direction, cone)


ROWS: Mapping[type[Light], Callable[[Any], LightRow]] = {
    DirectionalLight: _directional_row,
    PointLight: _point_row,
    SpotLight: _spot_row,
}
"""How each type of light is laid out for kernels."""

NOTHING = LightRow(int(POINT), (0.0, 0.0, 0.0), 0.0)
"""The row of arrays without lights."""


def upload_lights(lights: Sequence[Light], device: Any, origin: ArrayLike = (0.0, 0.0, 0.0)) -> Lights:
    """Return the struct that kernels take; without lights it has one row of nothing and a count of 0.

    Args:
        lights: Any number of lights.
        device: A Warp device.
        origin: World position that the struct's positions are relative to [m].

    Raises:
        InvalidOptionError: One of them is no light.
    """
    rows = [light_entry(ROWS, light)(light) for light in lights] or [NOTHING]
    shadowed = [light.casts_shadows for light in lights] or [False]
    kinds, powers, sizes, positions, directions, cones = zip(*rows, strict=True)
    arrays = Lights()
    arrays.kinds = upload(np.array(kinds, np.int32), int, device)
    arrays.positions = upload(
        (np.array(positions) - np.asarray(origin, np.float64)).astype(np.float32), wp.vec3, device
    )
    arrays.directions = upload(np.array(directions, np.float32), wp.vec3, device)
    arrays.powers = upload(np.array(powers, np.float32), wp.vec3, device)
    arrays.sizes = upload(np.array(sizes, np.float32), float, device)
    arrays.cones = upload(np.array(cones, np.float32), wp.vec2, device)
    arrays.shadowed = upload(np.array(shadowed, np.int32), int, device)
    arrays.count = len(lights)
    return arrays
