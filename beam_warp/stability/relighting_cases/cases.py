"""A case on which relighting fails: its shots, and what must hold of their images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

from beam_warp.stability.relighting_cases.scenes import RelightStudio
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


Build = Callable[[RelightStudio], RelightStress]


@dataclass(frozen=True)
class RelightingCase:
    """A case, by name.

    Attributes:
        name: Name of the case, in words.
        fails: How a renderer without precautions fails.
        must: What is asked.
        build: Makes it.
        large: Whether it is run on request only.
    """

    name: str
    fails: str
    must: str
    build: Callable[[RelightStudio], RelightStress]
    large: bool = False


def relighting_case(name: str, fails: str, must: str, *, large: bool = False) -> Callable[[Build], RelightingCase]:
    """Make a case of the function that follows, which builds its shots."""

    def make(build: Build) -> RelightingCase:
        return RelightingCase(name, fails, must, build, large)

    return make
