"""Distant light on a stage: a map, and how it turns."""

from __future__ import annotations

from dataclasses import dataclass

from beam_warp.checks import require_number
from beam_warp.world.environment import EnvironmentMap


@dataclass(frozen=True, eq=False, kw_only=True)
class StageEnvironment:
    """Light from all around, turning about the vertical.

    Attributes:
        map: Radiance, exposed as it is used.
        rotate: How far it is turned at time 0, counter-clockwise from above [degree].
        degrees_per_second: How fast it turns.

    Raises:
        InvalidOptionError: An angle is out of range.
    """

    map: EnvironmentMap
    rotate: float = 0.0
    degrees_per_second: float = 0.0

    def __post_init__(self) -> None:
        """Check the angles."""
        require_number("rotate", self.rotate, -1e6, 1e6)
        require_number("degrees_per_second", self.degrees_per_second, -36_000.0, 36_000.0)

    def rotation_at(self, time: float) -> float:
        """Return how far it is turned at a time [s], within one turn [degree]."""
        return float((self.rotate + self.degrees_per_second * time) % 360.0)
