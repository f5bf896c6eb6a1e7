"""A case on which relighting fails: its shots, and what must hold of their images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from beam_warp.stability.relighting_cases.measures import WRONG_PART, wrong_parts
from beam_warp.world.shot import RenderedImage, Shot

DEFERRED, PATH = "deferred", "path"
RENDERERS = (DEFERRED, PATH)

Images = Sequence[RenderedImage]


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a renderer made of the shots of a case.

    Attributes:
        images: One a shot, drawn one after the other by one renderer.
        draw_alone: Draws one a shot, each by a renderer that drew nothing before.
        draw_reference: Draws one a shot by path tracing, with many samples of another seed.
    """

    images: Images
    draw_alone: Callable[[], Images]
    draw_reference: Callable[[], Images]

    @cached_property
    def alone(self) -> Images:
        """Images by a renderer each."""
        return self.draw_alone()

    @cached_property
    def reference(self) -> Images:
        """Images by many samples."""
        return self.draw_reference()


@dataclass(frozen=True, eq=False, kw_only=True)
class Demand:
    """A number measured on images, and its bounds.

    Attributes:
        what: Name of the number, in words.
        measure: Computes the number from the images.
        low: Lower bound.
        high: Upper bound.
        because: Where the bounds come from.
        of: Renderers that must meet the bounds.
    """

    what: str
    measure: Callable[[Drawn], float]
    low: float = 0.0
    high: float
    because: str
    of: tuple[str, ...] = RENDERERS


@dataclass(frozen=True, eq=False, kw_only=True)
class RelightStress:
    """Shots, and what must hold of them; that images are finite, with alpha in [0, 1], is asked of all.

    Attributes:
        shots: Drawn in this order by one renderer.
        demands: What must hold.
        noisy: Whether what is asked has noise; if it has none, one seed tells.
        done: What happened to the input before, in words.
    """

    shots: tuple[Shot, ...]
    demands: tuple[Demand, ...]
    noisy: bool = True
    done: str = "nothing"


def shadow_demands(
    dark: Callable[[Drawn], NDArray[np.bool_]], expected: NDArray[np.bool_], judged: NDArray[np.bool_]
) -> tuple[Demand, Demand]:
    """Return that few pixels may be falsely shadowed, and few falsely lit, where the wall's shadow is known.

    Args:
        dark: Returns which pixels are in shadow, ``(H, W)``.
        expected: Pixels that must be, ``(H, W)``.
        judged: Pixels of which that is known, ``(H, W)``.
    """
    shadowed, lit = (
        Demand(
            what=what,
            measure=lambda drawn, part=part: wrong_parts(dark(drawn), expected, judged)[part],
            high=WRONG_PART,
            because="height / tan 10° long: closed form, 1 px and half a Gaussian from edges",
        )
        for part, what in enumerate(("falsely shadowed", "falsely lit"))
    )
    return shadowed, lit
