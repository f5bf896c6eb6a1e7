"""Which ways to trace the tracing study compares: levels of each factor, and which of them are crossed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

from beam_warp.checks import require_choice, require_count
from beam_warp.errors import InvalidOptionError
from beam_warp.study.table import Settings
from beam_warp.trace.incident import DENSITIES
from beam_warp.trace.sampling import SAMPLERS
from beam_warp.trace.transmittance import ACCEPTANCES

RATIOS = ("ratio", "plain")


@dataclass(frozen=True)
class TracingPlan:
    """Which settings to measure, and how well.

    Attributes:
        acceptances: How hits add up; the first of each of these lists is its default.
        samplers: Sample sets.
        offsets: Lifts of ray origins: ``auto``, metres such as ``0.02``, or multiples of the local thickness such as
            ``2t``, from the local surface.
        densities: What irradiance draws its directions from.
        ratios: Irradiance as a ratio of estimates (``ratio``) or as one estimate (``plain``).
        rays: Rays per point, rising.
        crossing: ``star`` varies one or two factors around the defaults, ``full`` crosses all.
        points: Points at which errors are measured; None takes 128 on a CPU, 4096 on CUDA.
        reference_rays: Rays per point of the references.
        repeats: Timed calls a setting, each with samples of its own.
        seed: Chooses the points.

    Raises:
        InvalidOptionError: A value is none of its choices, out of range or given twice.
    """

    acceptances: tuple[str, ...] = ACCEPTANCES
    samplers: tuple[str, ...] = SAMPLERS
    offsets: tuple[str, ...] = ("auto", "2t", "8t", "0.02")
    densities: tuple[str, ...] = ("product", "environment", "cosine", "mis")
    ratios: tuple[str, ...] = RATIOS
    rays: tuple[int, ...] = (4, 16, 64, 256, 1024)
    crossing: Literal["star", "full"] = "star"
    points: int | None = None
    reference_rays: int = 16384
    repeats: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every option once."""
        choices = {"acceptances": ACCEPTANCES, "samplers": SAMPLERS, "densities": DENSITIES, "ratios": RATIOS}
        check_levels(self, choices, most_rays=1 << 16)
        require_choice("crossing", self.crossing, ("star", "full"))
        if self.points is not None:
            require_count("points", self.points, 2, 1 << 20)
        require_count("reference_rays", self.reference_rays, 4, 1 << 20)
        require_count("seed", self.seed, 0, 2**31 - 1)

    def axes(self) -> dict[str, tuple[str, ...]]:
        """Return the levels of every factor but rays, by its name."""
        return {
            "acceptance": self.acceptances,
            "sampler": self.samplers,
            "density": self.densities,
            "ratio": self.ratios,
            "offset": self.offsets,
        }

    def occlusion_settings(self) -> list[Settings]:
        """Return the settings of ambient occlusion without rays, the most telling first."""
        axes = {name: self.axes()[name] for name in ("acceptance", "sampler", "offset")}
        return _crossed(axes, self.crossing, ({"acceptance", "sampler"}, {"offset"}))

    def irradiance_settings(self) -> list[Settings]:
        """Return the settings of irradiance without rays; the offset stays at its default."""
        axes = self.axes() | {"offset": self.offsets[:1]}
        return _crossed(axes, self.crossing, ({"density", "ratio"}, {"sampler"}, {"acceptance"}))


def check_levels(plan: Any, choices: Mapping[str, tuple[str, ...]], *, most_rays: int) -> None:
    """Check the levels of a plan, name its offsets as charts do, and sort its rays.

    Args:
        plan: A frozen dataclass, whose tuples are the levels of its factors.
        choices: What the levels of some factors are chosen from, by the factor's name.
        most_rays: Most rays of a level.

    Raises:
        InvalidOptionError: A level is none of its choices, out of range or given twice.
    """
    for name, known in choices.items():
        for value in getattr(plan, name):
            require_choice(name, value, known)
    object.__setattr__(plan, "offsets", tuple(map(offset_label, plan.offsets)))
    for count in plan.rays:
        # Fewest that every estimator takes: half of the rays of mis come from either density, and pair up
        require_count("rays", count, 4, most_rays)
    for name, values in vars(plan).items():
        if isinstance(values, tuple) and (not values or len(set(values)) < len(values)):
            raise InvalidOptionError(f"{name} must be one or more different values, got {values}. Name each once.")
    object.__setattr__(plan, "rays", tuple(sorted(plan.rays)))
    require_count("repeats", plan.repeats, 1, 100)


def parse_offset(text: str) -> tuple[Literal["auto", "metres", "thicknesses"], float]:
    """Return the kind of an offset and its number: ``auto``, ``0.02`` or ``0.02 m``, ``2t`` (local thicknesses).

    Raises:
        InvalidOptionError: It is none of these, or not a number of at least 0.
    """
    if text == "auto":
        return "auto", 0.0
    try:
        number = float(text.removesuffix("t" if text.endswith("t") else "m"))
    except ValueError:
        number = -1.0
    if not (0.0 <= number < 1e6):
        raise InvalidOptionError(
            f"offsets must be auto, metres such as 0.02, or thicknesses such as 2t, got {text!r}. Choose one of them."
        )
    return ("thicknesses" if text.endswith("t") else "metres"), number


def offset_label(text: str) -> str:
    """Return an offset as charts name it, one name for each: ``auto``, ``0.02 m``, ``2t``."""
    kind, number = parse_offset(text)
    return {"auto": "auto", "metres": f"{number:g} m", "thicknesses": f"{number:g}t"}[kind]


def _crossed(axes: dict[str, tuple[Any, ...]], crossing: str, groups: Sequence[set[str]]) -> list[Settings]:
    """Return settings: each group of factors crossed around the defaults, then, if full, everything that is left."""
    found: dict[tuple[Any, ...], Settings] = {}
    for group in [*groups, *([set(axes)] if crossing == "full" else [])]:
        for levels in product(*(values if name in group else values[:1] for name, values in axes.items())):
            found.setdefault(levels, dict(zip(axes, levels, strict=True)))
    return list(found.values())


DEFAULT_PLAN = TracingPlan()
"""Everything there is, a few steps of rays, one or two factors at a time."""
