"""An environment cut into regions of equal power: few directions that stand for it where shadows are cast.

Source: Debevec 2005, A Median Cut Algorithm for Light Probe Sampling.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_count
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import LUMINANCE
from beam_warp.world.environment import EnvironmentMap

LARGEST_HEIGHT = 256
"""Taller maps are reduced to this height, energy kept, before they are cut: a texel is then 0.7 degrees."""

MOST_REGIONS = 256
WIDEST = np.radians(75.0)
"""Largest half angle of a region's disc."""


@dataclass(frozen=True, eq=False)
class EnvironmentRegions:
    """Regions of an environment.

    Attributes:
        directions: Unit, where each region's power comes from in the mean, ``(K, 3)`` float64.
        half_angles: Half angle of the disc of even radiance whose directions spread as the region's do [rad], ``(K,)``
            float64.
        moments: Radiance times direction summed over each region, by channel [W/m^2], and half the width that
            `beam_warp.kernels.trace.incident_light.above_horizon` takes, ``(3, K, 4)`` float64.
    """

    directions: NDArray[np.float64]
    half_angles: NDArray[np.float64]
    moments: NDArray[np.float64]

    def __len__(self) -> int:
        """Return K."""
        return len(self.directions)

    @classmethod
    def of(cls, environment: EnvironmentMap, count: int) -> EnvironmentRegions:
        """Cut an environment.

        Args:
            environment: The light; a black one is cut evenly.
            count: K, a power of two, at most `MOST_REGIONS`.

        Raises:
            InvalidOptionError: The count is none of them.
        """
        require_count("count", count, 1, MOST_REGIONS)
        if count & (count - 1):
            raise InvalidOptionError(
                f"count must be a power of two, got {count}. Choose {2 ** (count.bit_length() - 1)}."
            )
        height = min(environment.height, LARGEST_HEIGHT)
        source = environment if height == environment.height else environment.resized(height, 2 * height)
        angles = source.solid_angles()
        power = (source.radiance @ LUMINANCE) * angles
        if not power.sum() > 0.0:
            power = np.array(angles)
        directions = source.directions()
        flux = source.radiance.astype(np.float64) * angles[..., None]
        rows = [_summed(*(part[box] for part in (directions, power, flux))) for box in _cut(power, count)]
        middles, halves, moments = zip(*rows, strict=True)
        return cls(np.array(middles), np.array(halves), np.array(moments).transpose(1, 0, 2))

    def turned(self, degrees: float) -> EnvironmentRegions:
        """Return the regions of the environment turned about z, counter-clockwise from above."""
        angle = np.radians(degrees)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        moments = self.moments.copy()
        moments[..., :3] = self.moments[..., :3] @ turn.T
        return EnvironmentRegions(self.directions @ turn.T, self.half_angles, moments)


def _cut(power: NDArray[np.float64], count: int) -> list[tuple[slice, slice]]:
    """Halve the map's power again and again, each time across its longer side on the sphere."""
    height, width = power.shape
    boxes = [(slice(0, height), slice(0, width))]
    while len(boxes) < count:
        boxes = [half for box in boxes for half in _halves(power, box)]
    return boxes


def _halves(power: NDArray[np.float64], box: tuple[slice, slice]) -> list[tuple[slice, slice]]:
    """Cut a box where half of its power is on either side; one of a single texel stays, beside an empty one."""
    rows, columns = box
    middle = np.pi * 0.5 * (rows.start + rows.stop) / len(power)
    tall, wide = rows.stop - rows.start, columns.stop - columns.start
    across = wide * np.sin(middle) > tall
    if (wide if across else tall) < 2:
        across = wide > tall
    sums = np.cumsum(power[box].sum(axis=0 if across else 1))
    if len(sums) < 2:
        return [box, (slice(rows.stop, rows.stop), columns)]
    place = int(np.argmin(np.abs(sums[:-1] - 0.5 * sums[-1]))) + 1
    if across:
        cut = columns.start + place
        return [(rows, slice(columns.start, cut)), (rows, slice(cut, columns.stop))]
    cut = rows.start + place
    return [(slice(rows.start, cut), columns), (slice(cut, rows.stop), columns)]


def _summed(
    directions: NDArray[np.float64], power: NDArray[np.float64], flux: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Return a box's mean direction, its half angle and its moments; an empty one sheds no light from above."""
    weight = power if power.sum() > 0.0 else np.ones_like(power)
    mean = (weight[..., None] * directions).sum(axis=(0, 1))
    length = float(np.linalg.norm(mean))
    direction = mean / length if length > 1e-9 * max(weight.sum(), 1e-300) else np.array([0.0, 0.0, 1.0])
    # of a disc of directions the mean cosine with its middle is (1 + cos half angle) / 2
    cosine = float((weight * (directions @ direction)).sum() / weight.sum()) if weight.size else 1.0
    half_angle = float(np.arccos(np.clip(2.0 * cosine - 1.0, np.cos(WIDEST), 1.0)))
    sums = np.einsum("rcx,rck->kx", directions, flux)
    lengths = np.linalg.norm(sums, axis=1)
    spread = np.maximum(1.0 - lengths / np.maximum(flux.sum(axis=(0, 1)), 1e-300), 0.0)
    return direction, half_angle, np.concatenate([sums, (lengths * np.sqrt(3.0 * spread))[:, None]], axis=1)
