"""Fitting of key frames: Gaussians that look like the photographs of a moment, with the geometry that these imply.

Steps look at one view each. The discs of a visual hull are moved until renders agree with the photographs in colour,
structure and coverage, and the Gaussians' normals with those of the depth that they draw. Every so many steps those
that no view sees are dropped, and those of largest position gradients are split into their places: the number of
Gaussians stays within a budget.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.capture.quality import noise_of_views
from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_choice, require_count, require_number
from beam_warp.device.arrays import resolve_device
from beam_warp.device.graphs import StepGraphs
from beam_warp.jobs.listeners import no_progress
from beam_warp.kernels.reconstruction.gradient_sums import launch_add_gradient_lengths
from beam_warp.raster.adam import Adam
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import disc_spacing
from beam_warp.reconstruction.densify import hidden, refine, with_more_rows
from beam_warp.reconstruction.frames.protocols import StepProgress
from beam_warp.reconstruction.parameters import GaussianParameters, require_something
from beam_warp.reconstruction.sampling_limits import SamplingLimits
from beam_warp.reconstruction.targets import LossWeights, TargetSet, ViewTargets, chosen_samples, shuffled_views
from beam_warp.reconstruction.temporal import TemporalTerms
from beam_warp.reconstruction.total_variation import RadianceVariation, chosen_variation
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud

PRESETS = ("fast", "draft", "paper", "rade")

FIT_RASTER = RasterOptions(antialiased=True, low_pass=0.1)
"""Raster options of splats while they are fitted, and afterwards: the pixel filter's variance is about that of a
pixel's area, 1/12, and what is smaller than a pixel keeps its light."""

NO_PSNR = 120.0
"""PSNR that is reported where no view shows the subject [dB]."""

PROGRESS_EVERY = 50
"""Steps between two reports of progress, and between two changes of the learning rates."""

RENEW_EVERY = 250
"""Most steps between two updates of the room for splats and of the sampling filter."""

LEAST_GAIN = 0.15
"""Least gain of PSNR for which the number of Gaussians is doubled again [dB]."""

FEWEST_GAUSSIANS = 2_000
"""Fewest Gaussians with which a fit to a target PSNR begins."""

EARLY_DROPOUT = 0.1
"""Part of the Gaussians that steps leave out in their first half, if a pixel has twice as many as `NEEDED`: what lies
behind others is seen at times then, and can become the surface."""

DROPOUT_OF_NOISE = 2.0
"""Part of the Gaussians that a step leaves out, over the variance of the photographs' noise and the number of Gaussians
that a pixel of the subject has beyond `NEEDED`. Dropout acts like a ridge (Wager et al. 2013), whose weight is to be as
the noise's variance."""

NEEDED = 2.0
"""Gaussians for a pixel of the subject: one before, one behind. Where there are no more, none can stand in for another,
and what is left out is missed."""

LEAST_DROPOUT, MOST_DROPOUT = 0.005, 0.2
"""Below the first, nothing is left out, as if photographs were clean. The second is the largest part that was tried."""

BANDS_BESIDE = 0.1
"""Rate of what depends on the direction beside reflections, over its rate without: light from elsewhere and what hides
the environment are left to it."""

OF_FEW_STEPS: Mapping[str, Any] = MappingProxyType({"dropout": 0.0, "total_variation": 0.0, "reflect_until": 0.0})
"""Options of `FitOptions` for fits whose steps are too few to learn noise, or how rough what reflects is."""

PLENTY = 24
"""Photographs from which on each Gaussian is seen by as many as on the captures that the schedule was chosen on."""

RESET_OPACITY = 0.1
"""Most opacity after a reset: that with which points begin that may be wrong, see `initial.BALL_OPACITY`."""

RESET_AFTER = 1.0 / 6.0
"""Part of all steps after which opacities are reset: colours are found by then, and most of the time is left."""

RESET_STEPS = 1_000
"""Fewest steps of a fit whose opacities are reset: it takes some 150 to be opaque again, and drafts lose by it."""


@dataclass(frozen=True)
class LearningRates:
    """Sizes of steps, each in the units of what is moved.

    Attributes:
        positions: Rate of positions, in distances of the cameras from the subject.
        orientations: Rate of quaternions.
        scales: Rate of the logarithms of scales.
        opacities: Rate of the logits of opacities.
        color: Rate of the spherical harmonics' band 0.
        bands: Rate of all other bands.
        final_positions: Part of the positions' rate that is left at the end; it falls by the same factor every step.
        final_others: Part of all other rates that is left at the end, likewise.
        gloss: Rate of the logits of roughness and of the open part of lobes, where a light is known.

    Raises:
        InvalidOptionError: A rate is negative or no number.
    """

    positions: float = 5e-4
    orientations: float = 2e-3
    scales: float = 1e-2
    opacities: float = 3e-2
    color: float = 1e-2
    bands: float = 5e-4
    final_positions: float = 0.01
    final_others: float = 0.3
    gloss: float = 2e-2

    def __post_init__(self) -> None:
        """Check every rate once: the last of the positions is not reached before many steps are taken."""
        for rate in fields(self):
            require_number(rate.name, getattr(self, rate.name), 0.0)


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Options of fitting Gaussians to the photographs of one moment.

    Attributes:
        gaussian_count: Most Gaussians there may be.
        target_psnr: Begin with few Gaussians and double them until the views are met so well [dB], or doubling gains
            less than `LEAST_GAIN`, or there are as many as allowed; None for all of them at once.
        color_iterations: Steps without the term of normals.
        normal_iterations: Steps with the term of normals, after those.
        weights: Weights of the terms.
        rates: Sizes of steps.
        sh_degree: Degree of the captured radiance.
        samples: Side of the square of samples that a pixel is the mean of; ``"auto"``: see
            `beam_warp.raster.resolution.sample_side`.
        raster: How splats are drawn.
        sampling_filter: Whether Gaussians are kept as wide as what the views can show (Mip-Splatting's 3D filter).
        temporal: Weight of changes against the start, for the frames after the first (E_temp).
        refine_every: Steps from one refinement to the next; 0 for none.
        refine_until: Part of all steps after which there is none.
        split_fraction: Most of the Gaussians that one refinement splits.
        hidden_share: A refinement drops the Gaussians that show least, which together hold this part of the weights of
            all: about a third of all Gaussians, which sank behind others and which no gradient pulls back.
        dead_opacity: Gaussians below it are dropped.
        dropout: Part of the Gaussians that a step leaves out, others each time, so that none of them learns the noise
            of a photograph; ``"auto"``: see `chosen_dropout`.
        total_variation: Weight of how much radiance differs among neighbours; ``"auto"``: see `chosen_variation`.
        reset_below: With fewer photographs, of known coverage, the refinement after `RESET_AFTER` of `RESET_STEPS` or
            more lowers all opacities to `RESET_OPACITY` (Kerbl et al. 2023): a layer that few of them agree on hides
            others no more, and must earn its opacity again.
        reflect_until: Part of all steps in which Gaussians reflect the light, if it is known; then harmonics stand for
            what they reflect. 0: harmonics from the start.
        seed: Same seed, same device, same result.

    Raises:
        InvalidOptionError: An option is out of range.
    """

    gaussian_count: int = 100_000
    target_psnr: float | None = None
    color_iterations: int = 1_000
    normal_iterations: int = 2_000
    weights: LossWeights = field(default_factory=lambda: LossWeights(normal=5.0, normal_tolerance=0.02))
    rates: LearningRates = field(default_factory=LearningRates)
    sh_degree: int = 2
    samples: int | Literal["auto"] = "auto"
    raster: RasterOptions = FIT_RASTER
    sampling_filter: bool = True
    temporal: float = 0.0
    refine_every: int = 250
    refine_until: float = 0.6
    split_fraction: float = 0.2
    hidden_share: float = 0.01
    dead_opacity: float = 0.02
    dropout: float | Literal["auto"] = "auto"
    total_variation: float | Literal["auto"] = "auto"
    reset_below: int = PLENTY
    reflect_until: float = 0.85
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every option once."""
        require_count("gaussian_count", self.gaussian_count, 1, 2**24)
        if self.target_psnr is not None:
            require_number("target_psnr", self.target_psnr, 1.0, 120.0)
        for name in ("color_iterations", "normal_iterations", "refine_every", "reset_below", "seed"):
            require_count(name, getattr(self, name), 0)
        require_count("sh_degree", self.sh_degree, 0, 4)
        if self.samples != "auto":
            require_count("samples", self.samples, 1, 8)
        for name in ("refine_until", "split_fraction", "hidden_share", "dead_opacity", "reflect_until"):
            require_number(name, getattr(self, name), 0.0, 1.0)
        require_number("temporal", self.temporal, 0.0)
        if self.dropout != "auto":
            require_number("dropout", self.dropout, 0.0, MOST_DROPOUT)
        if self.total_variation != "auto":
            require_number("total_variation", self.total_variation, 0.0)

    @classmethod
    def of_preset(cls, preset: str, **changes: Any) -> FitOptions:
        """Return the options of a preset, some of them changed.

        ``fast`` is ours, ``draft`` a seventh of its steps, larger ones: for a first look, and for a CPU. They are too
        few to learn noise, so nothing is left out of them, nor held even; nor do Gaussians reflect in them. ``paper``
        is BEAM's schedule: 7,000 steps for colour, then 5,000 with normals at a weight of 0.03, the rates of 3DGS, no
        term of coverage. ``rade`` is that of RaDe-GS scaled to as many steps: no low-pass on the image but the 3D
        filter, normals at 0.05 for the second half. The latter two draw one sample a pixel.

        Raises:
            InvalidOptionError: There is no such preset, or an option is out of range.
        """
        require_choice("preset", preset, PRESETS)
        rates = LearningRates(1.6e-4, 1e-3, 5e-3, 5e-2, 2.5e-3, 1.25e-4, final_others=1.0)
        common: dict[str, Any] = {"rates": rates, "samples": 1, "sh_degree": 3, "split_fraction": 0.05}
        common |= {**OF_FEW_STEPS, "reset_below": 0}
        options: dict[str, dict[str, Any]] = {
            "fast": {},
            "draft": {
                "color_iterations": 150,
                "normal_iterations": 300,
                "refine_every": 100,
                "rates": LearningRates(positions=8e-4, scales=2e-2, opacities=6e-2, bands=1e-3, final_others=1.0),
                **OF_FEW_STEPS,
            },
            "paper": {
                **common,
                "color_iterations": 7_000,
                "normal_iterations": 5_000,
                "weights": LossWeights(alpha=0.0, normal=0.03),
                "hidden_share": 0.0,
                "raster": RasterOptions(),
                "sampling_filter": False,
            },
            "rade": {
                **common,
                "color_iterations": 6_000,
                "normal_iterations": 6_000,
                "weights": LossWeights(alpha=0.0, normal=0.05),
                "hidden_share": 0.0,
                "raster": RasterOptions(low_pass=1e-4),
            },
        }
        return cls(**{**options[preset], **changes})


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit.

    Attributes:
        cloud: Gaussians with scene-linear radiance and ids.
        report: JSON-able record: ``psnr`` of the training views' crops [dB], lowest ``view_psnr``, ``gaussians``,
            ``iterations``, ``samples``, ``dropout`` in the first half of the steps and afterwards, the weight
            ``total_variation``, ``seconds``; ``growth`` with a target.
    """

    cloud: GaussianCloud
    report: dict[str, Any] = field(default_factory=dict)


def mean_psnr(psnr: NDArray[np.float64]) -> float:
    """Return the mean over views that show the subject; `NO_PSNR` if none does."""
    known = psnr[np.isfinite(psnr)]
    return float(known.mean()) if len(known) else NO_PSNR


def chosen_dropout(
    dropout: float | Literal["auto"], count: int, pixels: NDArray[np.int64], noise: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the parts of the Gaussians that a step leaves out: in the first half of all steps, and afterwards.

    Args:
        dropout: Both; ``"auto"``: what the photographs' noise asks for, in the median, see `DROPOUT_OF_NOISE`, and in
            the first half `EARLY_DROPOUT` at least. None where a pixel has no more Gaussians than `NEEDED`.
        count: Number of Gaussians.
        pixels: How many pixels of each photograph show the subject, ``(V,)``.
        noise: Standard deviation of their noise, as a part of the value, ``(V,)``; NaN where it is not known.
    """
    if dropout != "auto":
        return float(dropout), float(dropout)
    spare = np.maximum(count / np.maximum(pixels, 1) - NEEDED, 0.0)
    wanted = (DROPOUT_OF_NOISE * noise**2 * spare)[np.isfinite(noise)]
    early = EARLY_DROPOUT * min(float(np.median(spare)) / NEEDED, 1.0)
    always = min(float(np.median(wanted)), MOST_DROPOUT) if len(wanted) else 0.0
    first, then = (part if part >= LEAST_DROPOUT else 0.0 for part in (max(early, always), always))
    return first, then


def fit_gaussians(
    views: Sequence[CapturedView],
    start: GaussianCloud,
    options: FitOptions | None = None,
    *,
    environment: EnvironmentMap | None = None,
    device: str | None = None,
    progress: StepProgress = no_progress,
) -> Fit:
    """Fit Gaussians to the photographs of one moment.

    Args:
        views: The photographs, at least one.
        start: Where steps begin, with scene-linear radiance, such as `initial_gaussians` gives; some of them, evenly
            chosen, where there are more than may be.
        options: See `FitOptions`.
        environment: The light of the photographs, which Gaussians reflect while they are fitted; not with a target
            PSNR. None if it is not known.
        device: Warp device; None takes the first CUDA device, or the CPU.
        progress: Called with (done, total, facts).

    Raises:
        InvalidArrayError: There is no view or no Gaussian, or the start has no radiance in scene-linear Rec.709.
        DeviceError: There is no such device.

    Source: Kerbl et al. 2023, 3DGS; BEAM §3.1 for the normals; what differs is in `docs/reconstruction.md`.
    """
    chosen = options or FitOptions()
    require_something("start", start, views)
    if len(start) > chosen.gaussian_count:
        start = start.select(np.linspace(0, len(start) - 1, chosen.gaussian_count).astype(int))
    target = resolve_device(device)
    began = time.perf_counter()
    if chosen.target_psnr is None:
        fitter = Fitter(views, start, chosen, target, environment=environment)
        fitter.run(progress)
        report = fitter.report()
    else:
        fitter, report = _grow(views, start, chosen, target, progress)
    report["seconds"] = time.perf_counter() - began
    return Fit(fitter.parameters.cloud(), report)


def _grow(
    views: Sequence[CapturedView], start: GaussianCloud, options: FitOptions, device: Any, progress: StepProgress
) -> tuple[Fitter, dict[str, Any]]:
    """Fit few Gaussians, and twice as many from there, until more do not pay."""
    wanted = options.target_psnr
    assert wanted is not None
    count = min(max(FEWEST_GAUSSIANS, options.gaussian_count // 16), len(start))
    cloud = start.select(np.linspace(0, len(start) - 1, count).astype(int))
    cloud = cloud.with_arrays(scales=cloud.scales * np.sqrt(len(start) / count))
    growth: list[dict[str, float]] = []
    iterations = 0
    while True:
        fitter = Fitter(views, cloud, replace(options, gaussian_count=count), device)
        fitter.run(progress)
        report = fitter.report()
        iterations += report["iterations"]
        growth.append({"gaussians": report["gaussians"], "psnr": report["psnr"]})
        gain = growth[-1]["psnr"] - growth[-2]["psnr"] if len(growth) > 1 else np.inf
        if growth[-1]["psnr"] >= wanted or gain < LEAST_GAIN or count >= options.gaussian_count:
            return fitter, {**report, "iterations": iterations, "growth": growth}
        count = min(2 * count, options.gaussian_count)
        cloud = fitter.doubled(count)
        # What is there is good already: half the steps do for its halves.
        options = replace(
            options,
            color_iterations=0,
            reset_below=0,
            normal_iterations=max(1, (options.color_iterations + options.normal_iterations) // 2)
            if len(growth) == 1
            else options.normal_iterations,
        )


class Fitter:
    """The steps of one fit, on a device.

    Attributes:
        parameters: The Gaussians.
        samples: Side of the square of samples of a pixel.
        dropout: Parts of the Gaussians that steps leave out, see `chosen_dropout`.
        total_variation: Weight of how much radiance differs among neighbours, see `chosen_variation`.
    """

    def __init__(
        self,
        views: Sequence[CapturedView],
        start: GaussianCloud,
        options: FitOptions,
        device: Any,
        targets: TargetSet | None = None,
        *,
        environment: EnvironmentMap | None = None,
    ) -> None:
        """Bring everything to the device, but for ``targets`` that are there already; see `fit_gaussians`."""
        self.options = options
        self.device = device
        count = max(options.gaussian_count, len(start)) if options.refine_every else len(start)
        light = environment if options.reflect_until > 0.0 else None
        self.parameters = GaussianParameters(
            start, device, row_count=count, sh_degree=options.sh_degree, environment=light
        )
        self.samples = chosen_samples(options.samples, start, views)
        asked = "auto" in (options.dropout, options.total_variation)
        pixels, noise = noise_of_views(views if asked else ())
        self.dropout = chosen_dropout(options.dropout, count, pixels, noise)
        self.total_variation = chosen_variation(options.total_variation, noise)
        self._targets = targets or TargetSet(views, count, options.raster, self.samples, device)
        center = np.median(start.positions, axis=0)
        extent = float(np.mean([np.linalg.norm(view.camera.position - center) for view in views]))
        self._limits = SamplingLimits([view.camera for view in views], device=device)
        rates = options.rates
        self._rates = {
            "positions": rates.positions * extent,
            "orientations": rates.orientations,
            "log_scales": rates.scales,
            "logits": rates.opacities,
            "color": rates.color,
            "bands": rates.bands if light is None else BANDS_BESIDE * rates.bands,
            **({} if light is None else {"gloss": rates.gloss}),
        }
        self._adam: Adam = self.parameters.optimizer(self._rates)
        self._gradient_sums = wp.zeros(count, dtype=float, device=device)
        self._gradient_counts = wp.zeros(count, dtype=float, device=device)
        self._temporal = TemporalTerms(self.parameters, disc_spacing(start)) if options.temporal > 0.0 else None
        self._variation = RadianceVariation(self.parameters) if self.total_variation > 0.0 else None
        self._graphs = StepGraphs(device)
        self._weights = options.weights
        self._left_out = self.dropout[0]
        is_long = options.color_iterations + options.normal_iterations >= RESET_STEPS
        is_sparse = len(views) < options.reset_below and all(view.alpha is not None for view in views)
        self._awaits_reset = is_long and is_sparse
        self._taken = 0

    def run(self, progress: StepProgress = no_progress) -> None:
        """Take all steps."""
        chosen = self.options
        total = chosen.color_iterations + chosen.normal_iterations
        order = shuffled_views(np.random.default_rng(chosen.seed), len(self._targets), total)
        facts: dict[str, float] = {"gaussians": float(self.parameters.alive().sum())}
        self._weights = replace(chosen.weights, normal=0.0)
        self._graphs.clear()
        self._renew()
        for iteration in range(total):
            if iteration == chosen.color_iterations:
                self._weights = chosen.weights
                self._graphs.clear()
            if iteration == total // 2:
                self._left_out = self.dropout[1]
                self._graphs.clear()
            if iteration == round(chosen.reflect_until * total):
                self._settle_reflections()
            if iteration % PROGRESS_EVERY == 0:
                self._set_rates(iteration / max(total - 1, 1))
                progress(iteration, total, facts)
            group, index = self._targets[int(order[iteration])]
            group.select(index)
            self._graphs.run(group.kind(index), partial(self._step, group, index))
            self._taken += 1
            is_due = bool(chosen.refine_every) and self._taken % chosen.refine_every == 0
            if is_due and self._taken <= chosen.refine_until * total:
                self._refine(is_late=self._taken >= RESET_AFTER * total)
            if is_due or self._taken % RENEW_EVERY == 0:
                facts = {"gaussians": float(self.parameters.alive().sum()), "psnr": self._renew()}
        self._settle_reflections()
        facts["psnr"] = self._renew()
        progress(total, total, facts)

    def report(self) -> dict[str, Any]:
        """Return what was done, and the PSNR of the views, JSON-able."""
        psnr = self.psnr()
        return {
            "psnr": mean_psnr(psnr),
            "view_psnr": float(np.nanmin(psnr, initial=NO_PSNR)),
            "gaussians": int(self.parameters.alive().sum()),
            "iterations": self._taken,
            "samples": self.samples,
            "dropout": self.dropout,
            "total_variation": self.total_variation,
        }

    def psnr(self) -> NDArray[np.float64]:
        """Return the PSNR of every view's crop [dB]."""
        self.parameters.activate()
        return self._targets.make_room(self.parameters.drawn)[0]

    def gaps(self) -> NDArray[np.float64]:
        """Return the largest uncovered part of the subject in every view; see `TargetSet.gaps`."""
        self.parameters.activate()
        return self._targets.gaps(self.parameters.drawn)

    def doubled(self, count: int) -> GaussianCloud:
        """Return what was fitted with the Gaussians of largest gradients split, ``count`` in all."""
        alive = self.parameters.alive()
        rows = {name: array[alive] for name, array in self.parameters.rows().items()}
        grown = with_more_rows(rows, self._mean_gradients()[alive], count)
        return GaussianCloud(
            positions=grown["positions"],
            orientations=grown["orientations"] / np.linalg.norm(grown["orientations"], axis=1, keepdims=True),
            scales=np.exp(grown["log_scales"]),
            opacities=(1.0 / (1.0 + np.exp(-grown["logits"]))).astype(np.float32),
            radiance=grown["radiance"],
            radiance_color_space=self.parameters.cloud().radiance_color_space,
            ids=np.arange(len(grown["positions"])),
        )

    def _mean_gradients(self) -> NDArray[np.float32]:
        """Return the mean length of each row's position gradients since the last refinement, ``(N,)``."""
        return self._gradient_sums.numpy() / np.maximum(self._gradient_counts.numpy(), 1.0)

    def _set_rates(self, part: float) -> None:
        """Let steps shrink: ``part`` of them have been taken."""
        rates = self.options.rates
        for name in self._adam.parameters:
            final = rates.final_positions if name == "positions" else rates.final_others
            self._adam.set_learning_rate(name, self._rates[name] * final**part)

    def _renew(self) -> float:
        """Bring the sampling filter and the room for pairs up to date; return the mean PSNR of the views [dB]."""
        if self.options.sampling_filter:
            self._limits.write(self.parameters.positions, self.parameters.filters)
        self.parameters.activate()
        psnr, is_new = self._targets.make_room(self.parameters.drawn)
        if is_new:
            self._graphs.clear()
        return mean_psnr(psnr)

    def _step(self, group: ViewTargets, index: int) -> None:
        """Draw the view that was selected, compare, and move the Gaussians."""
        parameters = self.parameters
        parameters.activate()
        if self._left_out > 0.0:
            parameters.drop_out(self._left_out, self.options.seed)
        group.rasterizer.redraw()
        group.add_losses(index, self._weights, values=False)
        drawn = group.rasterizer.backward()
        launch_add_gradient_lengths(drawn.positions, self._gradient_sums, self._gradient_counts, self.device)
        parameters.zero_gradients()
        parameters.add_gradients(drawn)
        if self._temporal is not None:
            self._temporal.add_gradients(self.options.temporal)
        if self._variation is not None:  # as photographs' differences count: for each pixel of the view
            self._variation.add_gradients(self.total_variation / (group.height * group.width))
        self._adam.step()

    def _settle_reflections(self) -> None:
        """Let harmonics stand for reflections, if these were drawn until now."""
        if self.parameters.reflections is None:
            return
        self.parameters.activate()  # the last step may have left some out
        self.parameters.settle_reflections(self._targets.seen_directions(self.parameters.drawn))
        self._rates["bands"] = self.options.rates.bands
        self._graphs.clear()
        self._renew()

    def _refine(self, *, is_late: bool) -> None:
        """Drop Gaussians that are not seen, split those of large gradients into their rows, reset opacities once."""
        chosen = self.options
        rows, alive = self.parameters.rows(), self.parameters.alive()
        opacity = 1.0 / (1.0 + np.exp(-rows["logits"].astype(np.float64)))
        unwanted = alive & ~(opacity >= chosen.dead_opacity)
        if chosen.hidden_share > 0.0:
            self.parameters.activate()  # the last step may have left some out
            unwanted |= alive & hidden(self._targets.shares(self.parameters.drawn), chosen.hidden_share)
        if is_late and self._awaits_reset:
            logit = np.float32(np.log(RESET_OPACITY / (1.0 - RESET_OPACITY)))
            rows["logits"][alive] = np.minimum(rows["logits"][alive], logit)
            self._awaits_reset = False
        changed = refine(rows, alive, unwanted, self._mean_gradients(), chosen.split_fraction)
        self.parameters.set_rows(rows)
        self._adam.restart(changed)
        if self._temporal is not None:
            self._temporal.hold(changed)
        if self._variation is not None:
            self._variation.find_neighbors()
        self._gradient_sums.zero_()
        self._gradient_counts.zero_()
