"""Both renderers on the cases on which relighting fails: measured numbers, and whether they hold.

The path tracer draws every case with several seeds: a measured number is the mean over them, with its standard error
from their spread. A bound is missed if the mean is beyond it by more than chance explains; if chance explains more than
the bounds leave room for, nothing was shown, and that is a fault too.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import numpy as np
import warp as wp

from beam_warp.device.arrays import device_label, resolve_device
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.stability.relighting_cases.cases import DEFERRED, PATH, RENDERERS, Demand, Drawn, RelightStress
from beam_warp.stability.relighting_cases.scenes import RelightStudio
from beam_warp.stability.suite import CaseOutcome, StabilityCase, attempt
from beam_warp.world.shot import RenderedImage, Renderer, Shot

SEEDS = 8
"""Images of the path tracer by which its noise is told."""

LARGEST_T = 7.06
"""Standard errors, estimated from `SEEDS` values, that chance explains: Student's t of 7 degrees of freedom exceeds it
either way with a probability of 2e-4."""

REFERENCE_SEED = 1000
REFERENCE_TIMES = 4
"""How many times the samples of an image a reference takes."""

BOUNCES = 4


@dataclass(frozen=True)
class Held:
    """What was measured for one demand.

    Attributes:
        what: Name of the measured number.
        value: Mean of the number over seeds.
        error: Standard error of the mean; 0 for a renderer without noise.
        low: Lower bound.
        high: Upper bound.
        because: Where the bounds come from.
    """

    what: str
    value: float
    error: float
    low: float
    high: float
    because: str

    @property
    def fault(self) -> str:
        """What is wrong; empty if nothing is. NaN is."""
        chance = LARGEST_T * self.error
        if not self.low - chance <= self.value <= self.high + chance:
            return f"{self.what} must be {self.asked}, got {self.measured}"
        if not chance <= max(self.high - self.low, 0.0):
            return f"{self.what} must be {self.asked}, got {self.measured}, too noisy to tell"
        return ""

    @property
    def asked(self) -> str:
        """The bounds, for a table."""
        if self.low == self.high:
            return f"{self.high:.4g}"
        return f"at most {self.high:.4g}" if self.low == 0.0 else f"{self.low:.4g} … {self.high:.4g}"

    @property
    def measured(self) -> str:
        """The value, for a table."""
        return f"{self.value:.4g}" + (f" ± {self.error:.1g}" if self.error > 0.0 else "")


@dataclass(frozen=True, kw_only=True)
class RelightingOutcome(CaseOutcome):
    """What one renderer made of one case.

    Attributes:
        renderer: ``"deferred"`` or ``"path"``.
        gaussians: Number of Gaussians in the largest shot.
        size: Columns and rows of the images.
        samples: Samples of a pixel, for each seed; 1 for the deferred renderer.
        done: What happened to the input.
        held: What was measured.
        seconds: Time of the first images, compilation included.
    """

    renderer: str
    gaussians: int
    size: tuple[int, int]
    samples: int
    done: str = "nothing"
    held: tuple[Held, ...] = ()

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> RelightingOutcome:
        """Return what `as_dict` gave."""
        return super().from_dict({**record, "held": tuple(Held(**row) for row in record["held"])})


@dataclass(frozen=True, eq=False)
class RelightingBench:
    """Where cases are drawn.

    Attributes:
        studio: Where they come from.
        device: Warp device; None takes the first CUDA device, or the CPU.
        deferred: How the deferred renderer draws.
        seeds: Images of the path tracer.
    """

    studio: RelightStudio = field(default_factory=RelightStudio)
    device: str | None = None
    deferred: DeferredOptions = field(default_factory=DeferredOptions)
    seeds: int = SEEDS

    def renderer(self, name: str, seed: int = 0, *, times: int = 1) -> Renderer:
        """Return a renderer that drew nothing yet, with so many times the samples."""
        if name == DEFERRED:
            return DeferredRenderer(self.deferred, device=self.device)
        options = PathOptions(samples=times * self.studio.samples, bounces=BOUNCES, seed=seed)
        return PathRenderer(options, device=resolve_device(self.device))

    def draw(self, shots: Sequence[Shot], name: str, seed: int = 0, *, times: int = 1) -> list[RenderedImage]:
        """Draw shots with one renderer."""
        renderer = self.renderer(name, seed, times=times)
        return [renderer.draw(shot) for shot in shots]


def run_both_renderers(bench: RelightingBench, case: StabilityCase[RelightStress]) -> Iterator[RelightingOutcome]:
    """Draw one case of `RELIGHTING_CASES` with every renderer."""
    stress = case.build(bench.studio)
    for name in RENDERERS:
        yield run_relighting_case(bench, case.name, stress, name)


def run_relighting_case(bench: RelightingBench, case: str, stress: RelightStress, renderer: str) -> RelightingOutcome:
    """Draw one case with one renderer and judge it."""
    camera = stress.shots[0].camera
    demands = [demand for demand in stress.demands if renderer in demand.of]
    tried = attempt(lambda: _measure(bench, stress, demands, renderer))
    values, faults, seconds = tried.result or ([], tried.faults, tried.seconds)
    held = tuple(hold(demand, of_seeds) for demand, of_seeds in zip(demands, np.transpose(values), strict=False))
    return RelightingOutcome(
        case=case,
        renderer=renderer,
        device=device_label(wp.get_device(resolve_device(bench.device))),
        gaussians=max(len(shot.cloud) for shot in stress.shots),
        size=(camera.width, camera.height),
        samples=1 if renderer == DEFERRED else bench.studio.samples,
        done=stress.done,
        held=held,
        faults=(*faults, *(row.fault for row in held if row.fault)),
        seconds=seconds,
    )


def _measure(
    bench: RelightingBench, stress: RelightStress, demands: Sequence[Demand], renderer: str
) -> tuple[list[list[float]], list[str], float]:
    """Return what demands measure with each seed, faults of the images, and the time of the first images."""
    start, seconds, values, faults = time.perf_counter(), 0.0, [], []
    reference = cache(lambda: bench.draw(stress.shots, PATH, REFERENCE_SEED, times=REFERENCE_TIMES))
    for seed in range(bench.seeds if renderer == PATH and stress.noisy else 1):
        images = bench.draw(stress.shots, renderer, seed)
        seconds = seconds or time.perf_counter() - start
        faults += [fault for fault in image_faults(images) if fault not in faults]
        drawn = Drawn(images, partial(_draw_alone, bench, stress, renderer, seed), reference)
        values.append([demand.measure(drawn) for demand in demands])
    return values, faults, seconds


def _draw_alone(bench: RelightingBench, stress: RelightStress, renderer: str, seed: int) -> list[RenderedImage]:
    """Draw every shot with a renderer of its own."""
    return [bench.draw([shot], renderer, seed)[0] for shot in stress.shots]


def hold(demand: Demand, values: Sequence[float]) -> Held:
    """Return what was measured over seeds, in the demand's bounds."""
    found = np.asarray(values, np.float64)
    error = float(found.std(ddof=1) / np.sqrt(len(found))) if len(found) > 1 else 0.0
    return Held(demand.what, float(found.mean()), error, demand.low, demand.high, demand.because)


def image_faults(images: Sequence[RenderedImage]) -> list[str]:
    """Return faults that no image may have, in words."""
    faults = []
    for image in images:
        for name, array in {"rgb": image.rgb, "alpha": image.alpha, **image.layers}.items():
            if not np.isfinite(array).all():
                faults.append(f"{name} is not finite in {(~np.isfinite(array)).sum()} values")
        if not ((image.alpha >= 0.0) & (image.alpha <= 1.0)).all():
            faults.append(f"alpha must be in [0, 1], got {image.alpha.min():g} … {image.alpha.max():g}")
        if not (image.rgb >= 0.0).all():
            faults.append(f"radiance must not be negative, got {image.rgb.min():g}")
    return faults


TITLES = ("case", "a renderer without precautions", "must", "renderer", "measured", "asked", "verdict")


def cells(outcome: RelightingOutcome) -> tuple[str, ...]:
    """Return what a table says of a case, from *renderer* on."""
    measured = "; ".join(f"{row.what}: {row.measured}" for row in outcome.held) or "–"
    if outcome.done != "nothing":
        measured = f"{outcome.done}; {measured}"
    return (
        outcome.renderer,
        measured,
        "; ".join(f"{row.asked} ({row.because})" for row in outcome.held) or "–",
        "; ".join(outcome.faults) or "ok",
    )
