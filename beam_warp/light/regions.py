"""An environment cut into regions of little blur: few directions that stand for it where shadows are cast.

A region's shadows are as soft as the region is wide. Its blur is its power times the standard deviation of its
directions; cuts make the sum of blurs small. A cut for equal power (Debevec 2005) spends most regions on a sun, where
all see the same; one for little variance (Viriyothai and Debevec 2009) leaves the sky around a sun with it, whose
shadows are then too soft.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_count
from beam_warp.image.color import LUMINANCE
from beam_warp.world.environment import EnvironmentMap

Box = tuple[slice, slice]
"""Rows and columns of a map."""

LARGEST_HEIGHT = 256
"""Taller maps are reduced to this height, energy kept, before they are cut: a texel is then 0.7 degrees."""

MOST_REGIONS = 256
WIDEST = np.radians(75.0)
"""Largest half angle of a region's disc."""

ALIKE = 1e-6
"""Difference of two cuts' gains that is rounding, as a share of the map's power."""


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
        """Cut an environment where its blur falls most, one cut at a time.

        Args:
            environment: The light; a black one is cut evenly.
            count: K, at most `MOST_REGIONS`.

        Raises:
            InvalidOptionError: The count is out of range.
        """
        require_count("count", count, 1, MOST_REGIONS)
        height = min(environment.height, LARGEST_HEIGHT)
        source = environment if height == environment.height else environment.resized(height, 2 * height)
        angles = source.solid_angles()
        power = (source.radiance @ LUMINANCE) * angles
        if not power.sum() > 0.0:
            power = np.array(angles)
        directions = source.directions()
        flux = source.radiance.astype(np.float64) * angles[..., None]
        rows = [_summed(*(part[box] for part in (directions, power, flux))) for box in _cut(power, directions, count)]
        middles, halves, moments = zip(*rows, strict=True)
        return cls(np.array(middles), np.array(halves), np.array(moments).transpose(1, 0, 2))

    def turned(self, degrees: float) -> EnvironmentRegions:
        """Return the regions of the environment turned about z, counter-clockwise from above."""
        angle = np.radians(degrees)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        moments = self.moments.copy()
        moments[..., :3] = self.moments[..., :3] @ turn.T
        return EnvironmentRegions(self.directions @ turn.T, self.half_angles, moments)


def disc_half_angle(mean_cosine: float) -> float:
    """Return the half angle [rad] of the disc of even radiance whose directions have a mean cosine with its middle.

    That of a disc is (1 + cos half angle) / 2.
    """
    return float(np.arccos(np.clip(2.0 * mean_cosine - 1.0, -1.0, 1.0)))


def _cut(power: NDArray[np.float64], directions: NDArray[np.float64], count: int) -> list[Box]:
    """Cut a map into boxes; the cut that takes most of the blur away is made first."""
    share = (power / power.sum())[..., None]
    light = share * np.concatenate([np.ones_like(directions[..., :1]), directions], axis=2)
    boxes = [(slice(0, power.shape[0]), slice(0, power.shape[1]))]
    cuts = [_best_cut(light, boxes[0])]
    while len(boxes) < count:
        most = _first_best([gain for gain, _ in cuts])
        _, halves = cuts[most]
        boxes[most : most + 1] = halves
        cuts[most : most + 1] = [_best_cut(light, half) for half in halves]
    return boxes


def _best_cut(light: NDArray[np.float64], box: Box) -> tuple[float, tuple[Box, Box]]:
    """Return what the best cut of a box takes off its blur, and its halves.

    A box of a single texel is not cut: it stays, beside an empty one, at a gain below all others.

    Args:
        light: Share of the power of every texel, and its direction times that, ``(R, C, 4)``.
        box: Rows and columns.
    """
    rows, columns = box
    found = []
    for axis in range(2):
        sums = np.cumsum(light[box].sum(axis=1 - axis), axis=0)
        for place, gain in enumerate(_blur(sums[-1:]) - _blur(sums[:-1]) - _blur(sums[-1:] - sums[:-1])):
            found.append((float(gain), axis, place + 1))
    if not found:
        return -1.0, (box, (slice(rows.stop, rows.stop), columns))
    gain, axis, place = found[_first_best([gain for gain, _, _ in found])]
    at = box[axis].start + place
    sides = slice(box[axis].start, at), slice(at, box[axis].stop)
    first, second = ((side, columns) if axis == 0 else (rows, side) for side in sides)
    return gain, (first, second)


def _first_best(gains: Sequence[float]) -> int:
    """Return the place of the first of the largest gains: mirror images gain alike, whatever their rounding."""
    return int(np.argmax(np.asarray(gains) >= max(gains) - ALIKE))


def _blur(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return power times the standard deviation of directions, ``(...)``.

    Args:
        sums: Of powers, and of directions times power, ``(..., 4)``.
    """
    return np.sqrt(np.maximum(np.square(sums[..., 0]) - np.square(sums[..., 1:]).sum(axis=-1), 0.0))


def _summed(
    directions: NDArray[np.float64], power: NDArray[np.float64], flux: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Return a box's mean direction, its half angle and its moments; an empty one sheds no light from above."""
    weight = power if power.sum() > 0.0 else np.ones_like(power)
    mean = (weight[..., None] * directions).sum(axis=(0, 1))
    length = float(np.linalg.norm(mean))
    direction = mean / length if length > 1e-9 * max(weight.sum(), 1e-300) else np.array([0.0, 0.0, 1.0])
    cosine = float((weight * (directions @ direction)).sum() / weight.sum()) if weight.size else 1.0
    half_angle = min(disc_half_angle(cosine), WIDEST)
    sums = np.einsum("rcx,rck->kx", directions, flux)
    lengths = np.linalg.norm(sums, axis=1)
    spread = np.maximum(1.0 - lengths / np.maximum(flux.sum(axis=(0, 1)), 1e-300), 0.0)
    return direction, half_angle, np.concatenate([sums, (lengths * np.sqrt(3.0 * spread))[:, None]], axis=1)
