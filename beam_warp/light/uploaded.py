"""Lights on a device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from beam_warp.device.arrays import upload
from beam_warp.kernels.light.lights import DIRECTIONAL, POINT, SPOT, Lights
from beam_warp.world.lights import DirectionalLight, Light, PointLight, SpotLight


def upload_lights(lights: Sequence[Light], device: Any, origin: ArrayLike = (0.0, 0.0, 0.0)) -> Lights:
    """Return the struct that kernels take; an empty one has rows of nothing and a count of 0.

    Args:
        lights: Any number of lights.
        device: A Warp device.
        origin: World position that the struct's positions are relative to [m].
    """
    rows = [_row(light) for light in lights] or [_row(PointLight(position=(0, 0, 0), intensity=(0, 0, 0)))]
    kinds, positions, directions, powers, sizes, cones, shadowed = zip(*rows, strict=True)
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


def _row(light: Light) -> tuple[Any, ...]:
    """Return kind, position, direction, power, size, cone and whether there is a shadow."""
    nowhere, whole = (0.0, 0.0, 0.0), (1.0, 0.0)
    if isinstance(light, DirectionalLight):
        sine = np.sin(np.radians(light.angular_diameter) / 2.0)
        return int(DIRECTIONAL), nowhere, light.direction, light.irradiance, sine, whole, int(light.casts_shadows)
    if isinstance(light, SpotLight):
        cone = tuple(np.cos(np.radians((light.inner_angle, light.outer_angle))).tolist())
        kind, direction = int(SPOT), light.direction
    else:
        cone, kind, direction = whole, int(POINT), nowhere
    return kind, light.position, direction, light.intensity, light.radius, cone, int(light.casts_shadows)
