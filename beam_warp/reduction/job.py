"""The reduction of an asset: a search for the fewest Gaussians within a target, and a certificate of what was found."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from beam_warp import converters
from beam_warp.checks import require_count, require_number
from beam_warp.converters.formats import format_of
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.evaluate.certificate import MOST_PAIRS, Certificate, certify, least_bound
from beam_warp.evaluate.relit import ASSET_PSNR, RelitComparison, require_flip, world
from beam_warp.evaluate.trials import RelitTrials, Trial
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.raster.records import RasterOptions
from beam_warp.reduction.changes import changed
from beam_warp.reduction.merging import MergeOrder
from beam_warp.reduction.pilot import fast_enough, images_a_second, steps_within
from beam_warp.reduction.refit import refit
from beam_warp.reduction.sensitivity import Sensitivity, measure_sensitivity
from beam_warp.schema.clips import CLIP_FRAMES
from beam_warp.world.clusters import Clusters
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

SHARE = 0.95
"""Share of all lights, cameras and frames that a bound is certified for."""

TRIED = 40
"""Draws of the search on which a candidate is judged: its worst is then beyond 98 % of all, as a rule."""

GPU_STEPS, CPU_STEPS = 8640, 600
GPU_VIEWS, CPU_VIEWS = 288, 144
"""Steps and views of a refit that is not told how many: on a GPU every view is seen thirty times."""

SAMPLE_FRAMES = 4
"""Frames, evenly over a sequence, that sensitivities are measured in."""

ROUNDS, CLOSE = 6, 0.04
"""Candidates of a search at most, and how near to each other two numbers of Gaussians end it."""

TRIES, MORE = 4, 1.15
"""Certificates that are tried at most, and how many times more Gaussians the next one gets."""

FEWEST = 16
"""Gaussians below which no search goes."""

SCALES, SIZED_SCALES = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25), (4.0, 1.0)
"""Factors of the bounds of delivery and of keys, coarsest first: those tried within a bound, and within a size."""

FINEST = 0.03
"""Factor of the bounds of delivery of a last try: what does not keep a bound with it cannot be delivered within it."""

FOR_GAUSSIANS = 0.85
"""Share of a bound that having fewer Gaussians may use up where delivery or keys take the rest. Keys are used where
they save as large a share of the bytes as they take of the bound."""

HEADROOM = 1.1
"""Bound that is certified where none was asked for, over the worst error of the search."""

STEEPNESS = 1.1
"""Errors fall about with this power of the number of Gaussians, between 5 % and 50 % of them."""


DRAWN = 8
"""Draws of the search by which the time of an image is told."""

TARGETS = ("max_loss", "max_flip", "target_error", "size", "gaussians", "target_fps")
BOUNDS = {"max_loss": "loss", "max_flip": "flip", "target_error": "error"}
"""Targets that bound an error, and its measure."""


@dataclass(frozen=True, kw_only=True)
class ReduceOptions:
    """A target, and over what errors are measured. Exactly one target is given.

    Attributes:
        max_loss: Most loss against the truth by errors of the reduction [dB], see `beam_warp.evaluate.relit.loss_of`.
        max_flip: Most mean FLIP against the original, in (0, 1].
        target_error: Largest root mean square error of display values against the original, in (0, 1].
        size: Most bytes of what is written.
        gaussians: Number of Gaussians.
        target_fps: As many Gaussians as this device draws so often a second, under lights and cameras that change.
        asset_psnr: PSNR of the asset's relit images against the truth [dB], which ``max_loss`` is counted from.
        height: Side of the images that are compared [pixel]: the size at which the asset will be seen.
        pairs: Draws of a light, a camera and a frame that the certificate is made on.
        confidence: Of the certificate, in (0, 1).
        views: Views on which sensitivities are measured, and which are refitted: with few, these are learnt by heart.
            None takes `GPU_VIEWS` or `CPU_VIEWS`.
        steps: Steps of a refit; None takes `GPU_STEPS` or `CPU_STEPS`.
        target_seconds: Longest time of the call [s], with ``gaussians``: refits take as many steps as it leaves.
        spent: Part of that time that was spent before the call [s].
        seed: Same seed, same device: same result.
        raster: How splats are drawn; as the asset states without.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        InvalidOptionError: There is no target or more than one, or a number is out of range.
    """

    max_loss: float | None = None
    max_flip: float | None = None
    target_error: float | None = None
    size: int | None = None
    gaussians: int | None = None
    target_fps: float | None = None
    asset_psnr: float = ASSET_PSNR
    height: int = 256
    pairs: int = 200
    confidence: float = 0.95
    views: int | None = None
    steps: int | None = None
    target_seconds: float | None = None
    spent: float = 0.0
    seed: int = 0
    raster: RasterOptions | None = None
    device: Any = None

    def __post_init__(self) -> None:
        """Check every option once."""
        given = [name for name in TARGETS if getattr(self, name) is not None]
        if len(given) != 1:
            raise InvalidOptionError(
                f"target must be one of {', '.join(TARGETS).replace('_', '-')}, got {len(given)}. Give one of them."
            )
        for name, most in (("max_loss", 60.0), ("max_flip", 1.0), ("target_error", 1.0), ("target_fps", 1e6)):
            if getattr(self, name) is not None:
                require_number(name, getattr(self, name), 1e-6, most)
        for name in ("size", "gaussians"):
            if getattr(self, name) is not None:
                require_count(name, getattr(self, name), 1, 2**40)
        if self.target_seconds is not None:
            require_number("target_seconds", self.target_seconds, 1e-9, 1e9)
            if self.gaussians is None:
                raise InvalidOptionError(
                    f"target-seconds must go with gaussians, got {self.target.replace('_', '-')}, whose search "
                    "takes as long as it needs. Ask for a number of Gaussians."
                )
        require_number("asset_psnr", self.asset_psnr, 5.0, 100.0)
        require_count("pairs", self.pairs, 2, MOST_PAIRS)
        require_number("confidence", self.confidence, 0.5, 0.9999)
        if self.views is not None:
            require_count("views", self.views, 1, 1024)
        if self.steps is not None:
            require_count("steps", self.steps, 0, 100_000)
        if self.bound is not None and not least_pairs(self.confidence) <= self.pairs:
            raise InvalidOptionError(
                f"pairs must be at least {least_pairs(self.confidence)} for a bound that {SHARE:.0%} keep with "
                f"confidence {self.confidence:g}, got {self.pairs}. Measure more."
            )

    @property
    def measure(self) -> str:
        """Which error is bounded."""
        return BOUNDS.get(self.target, "loss")

    @property
    def target(self) -> str:
        """Name of the target."""
        return next(name for name in TARGETS if getattr(self, name) is not None)

    @property
    def bound(self) -> float | None:
        """The bound on the error; None if the target is another one."""
        return getattr(self, self.target) if self.target in BOUNDS else None


def least_pairs(confidence: float) -> int:
    """Return how many draws, all within the bound, are enough for `SHARE` in the last try."""
    return int(np.ceil(np.log(1.0 - _confidence(confidence, TRIES - 1)) / np.log(SHARE)))


def _confidence(stated: float, attempt: int) -> float:
    """Return the confidence that a try needs: each has half of the chance of error that is left."""
    return 1.0 - (1.0 - stated) * 0.5 ** (attempt + 1)


@dataclass(frozen=True, eq=False)
class Reduction:
    """What a reduction found.

    Attributes:
        count: Gaussians of the reduced asset.
        certificate: What is known of its errors.
        paths: The files written.
        original_count: Gaussians of the original.
        candidates: Numbers of Gaussians that were tried, and their errors on the search's half.
        error_scale: Factor of the bounds of delivery, or of an asset's keys; None where every frame is exact.
        steps: Steps of its refit.
        fps: Images a second that were drawn of what is written; None unless they were asked for.
    """

    count: int
    certificate: Certificate
    paths: tuple[Path, ...]
    original_count: int
    candidates: tuple[tuple[int, float], ...]
    error_scale: float | None
    steps: int
    fps: float | None = None


class Reducer:
    """Makes the reduced asset of any number of Gaussians; sensitivities are measured once.

    Attributes:
        original: The asset.
        options: What is asked.
        steps: Steps of a refit.
        raster: How splats are drawn.
        trials: The distribution of lights, cameras and frames.
        sensitivity: What images depend on.
    """

    def __init__(
        self,
        original: GaussianSequence,
        environments: Sequence[EnvironmentMap],
        options: ReduceOptions,
        progress: StageProgress = no_progress,
    ) -> None:
        """Measure what relit images of an asset depend on.

        Args:
            original: Relightable; several frames have a constant topology.
            environments: Lights of the distribution, 1 to 4.
            options: See `ReduceOptions`.
            progress: Called with (stage, done, total).

        Raises:
            InvalidArrayError: Frames differ in number, the asset is empty or cannot be relit.
            InvalidOptionError: A light is black, or there are too few or too many.
        """
        self.options, self._progress = options, progress
        self._device = resolve_device(options.device)
        steps, count = (GPU_STEPS, GPU_VIEWS) if self._device.is_cuda else (CPU_STEPS, CPU_VIEWS)
        self.steps = steps if options.steps is None else options.steps
        self.views = count if options.views is None else options.views
        count = len(original)
        self._frames = sorted({int(frame) for frame in np.linspace(0, count - 1, SAMPLE_FRAMES).round()})
        self.original = original
        clouds = [world(original, frame) for frame in self._frames]
        _require_reducible(original, clouds, self._frames)
        self._reference, self._clouds = clouds[0], clouds
        self.raster = options.raster or RasterOptions.from_metadata(original.metadata)
        self.trials = RelitTrials(environments, height=options.height, seed=options.seed, device=self._device)
        views = self.trials.draw("search", range(self.views), self._frames)
        lights = self.trials.draw("search", range(self.views, 3 * self.views), self._frames)
        how = {"raster": self.raster, "device": self._device, "progress": progress}
        self.sensitivity: Sensitivity = measure_sensitivity(original, self.trials, views, lights, **how)
        self._order = MergeOrder(clouds, self.sensitivity, self._device)

    def __len__(self) -> int:
        """Return the number of Gaussians of the original."""
        return len(self._reference)

    def reduced(self, count: int, *, steps: int | None = None) -> GaussianSequence:
        """Return the asset of a number of Gaussians; frames are made as they are read.

        Args:
            count: At most the original's; then it is the original, in the world's axes.
            steps: Steps of the refit; as `steps` says without.
        """
        if count >= len(self):
            return replace(self.original, read_frame=lambda frame: world(self.original, frame))
        clusters = Clusters(self._reference, self._order.labels(count), self.sensitivity.visible)
        merged = {
            frame: (clusters.cloud(cloud), clusters.motion(cloud)[0])
            for frame, cloud in zip(self._frames, self._clouds, strict=True)
        }
        number = self.steps if steps is None else steps
        how = {"raster": self.raster, "device": self._device, "progress": self._progress}
        changes = refit(merged, self.sensitivity, steps=number, **how)

        @lru_cache(SAMPLE_FRAMES)
        def read(frame: int) -> GaussianCloud:
            cloud = world(self.original, frame)
            return changed(clusters.cloud(cloud), clusters.motion(cloud)[0], changes)

        constant = self.original.constant if len(self.original) > 1 else frozenset()
        return replace(self.original, read_frame=read, constant=constant)


def reduce_asset(
    original: GaussianSequence,
    environments: Sequence[EnvironmentMap],
    options: ReduceOptions,
    out: Path,
    *,
    progress: StageProgress = no_progress,
) -> Reduction:
    """Reduce an asset to a target, certify it, and write it.

    The search sees draws of the distribution's one half alone. The certificate is made on the other half, of what is
    stored. Where a certificate fails, more Gaussians are taken and fresh draws; the chance of error is halved each
    time, so that the stated confidence holds over all tries. The last try takes all Gaussians, as exactly as they can
    be stored: a refusal names the bound that it would have kept, which is met when it is asked for.

    Args:
        original: See `Reducer`.
        environments: See `Reducer`.
        options: See `ReduceOptions`.
        out: File to write: USD or b4d.
        progress: Called with (stage, done, total).

    Raises:
        InvalidOptionError: The suffix is another one, or the target cannot be attained; else as `Reducer`.
        InvalidArrayError: As `Reducer`.
        MissingPackageError: FLIP is bounded and cannot be measured here.
        OutputError: The file cannot be written.
    """
    if format_of(out).name not in ("USD", "b4d"):
        raise InvalidOptionError(f"out must be a file of USD or b4d, got {out.name}. Only these hold a certificate.")
    if options.measure == "flip":
        require_flip()
    started = time.perf_counter()
    reducer = Reducer(original, environments, options, progress)
    how = {"raster": reducer.raster, "measure": options.measure, "device": options.device}
    how["asset_psnr"] = options.asset_psnr
    comparison = RelitComparison(original, reducer.trials, **how)
    with tempfile.TemporaryDirectory(prefix="beam_reduce_") as folder:
        search = _Search(reducer, comparison, Path(folder) / f"stored{out.suffix}")
        count, scale = search.target()
        if options.target_seconds is not None:
            spent, draws = options.spent + time.perf_counter() - started, TRIED + options.pairs
            how = (comparison, search.timed, search.candidate, count, draws)
            search.steps = steps_within(options.target_seconds, spent, *how)
        for attempt in range(TRIES):
            progress("certify", attempt, TRIES)
            stored = search.stored(count, scale)[0]
            made = _certified(comparison, stored, options, attempt, search)
            if options.bound is None or made.share >= SHARE:
                break
            count, scale = search.more(count, scale, last=attempt == TRIES - 2)
        else:
            raise InvalidOptionError(
                f"{options.target} must be at least {_least_bound(comparison, stored, made):g} for this asset as "
                f"{format_of(out).name}, got {options.bound:g}: {made}. Allow that, or write USD."
            )
        final = replace(search.candidate(count), metadata={**original.metadata, **made.as_metadata()})
        paths = converters.write(final, out, _written_as(scale))
        fps = None if options.target_fps is None else images_a_second(comparison, stored, search.timed)
    return Reduction(count, made, tuple(paths), len(reducer), tuple(search.tried), scale, search.steps, fps)


def _certified(
    comparison: RelitComparison, stored: GaussianSequence, options: ReduceOptions, attempt: int, search: _Search
) -> Certificate:
    """Return the certificate of one try; without a bound, of what the search found."""
    return certify(
        comparison,
        stored,
        measure=options.measure,
        bound=HEADROOM * search.error(stored) if options.bound is None else options.bound,
        pairs=options.pairs,
        first=attempt * options.pairs,
        confidence=options.confidence if options.bound is None else _confidence(options.confidence, attempt),
        stated=options.confidence,
    )


def _least_bound(comparison: RelitComparison, stored: GaussianSequence, failed: Certificate) -> float:
    """Return the least bound that a certificate on the same draws would have been of, to three digits."""
    numbers = range(failed.first, failed.first + failed.pairs)
    draws = comparison.trials.draw("certificate", numbers, range(len(stored)))
    errors = comparison.errors(stored, draws).values(failed.measure)
    bound = least_bound(errors, SHARE, _confidence(failed.confidence, TRIES - 1))
    digit = 10.0 ** (np.floor(np.log10(bound)) - 2)
    return float(np.ceil(bound / digit) * digit)


class _Search:
    """Candidates of a reduction: how large, how exact."""

    def __init__(self, reducer: Reducer, comparison: RelitComparison, place: Path) -> None:
        self._reducer, self._comparison, self._place, self._options = reducer, comparison, place, reducer.options
        self.steps = reducer.steps
        self.tried: list[tuple[int, float]] = []
        self._stored = 0
        self._made: dict[tuple[int, int], GaussianSequence] = {}
        self._draws = self._drawn_from(len(reducer.original))
        self.timed = self._draws[:DRAWN]
        self._delivers = format_of(place).name == "b4d"
        self._scaled = self._delivers or self._keys_pay(reducer.original)

    def _drawn_from(self, frames: int) -> list[Trial]:
        """Return the draws that the search sees, of the first so many frames."""
        start = 3 * self._reducer.views
        return self._reducer.trials.draw("search", range(start, start + TRIED), range(frames))

    def _keys_pay(self, original: GaussianSequence) -> bool:
        """Return whether keys save more than they cost, by the first clip of the original.

        They are as far apart as what is left of a bound lets them be; without a bound, by those of delivery.
        """
        if len(original) < 2:
            return False
        some = replace(original, frame_count=min(len(original), CLIP_FRAMES), metadata={})
        whole = self._written(some, None)[1]
        if self._options.bound is None:
            return self._written(some, 1.0)[1] < FOR_GAUSSIANS * whole
        left, draws = (1.0 - FOR_GAUSSIANS) * self._options.bound, self._drawn_from(len(some))
        for scale in SCALES:
            keyed, size = self._written(some, scale)
            if size >= FOR_GAUSSIANS * whole:  # and finer ones take more
                return False
            if self.error(keyed, draws) <= left:
                return True
        return False

    def candidate(self, count: int, steps: int | None = None) -> GaussianSequence:
        """Return the reduced asset of a number of Gaussians, made once."""
        key = count, self.steps if steps is None else steps
        if key not in self._made:
            self._made[key] = self._reducer.reduced(count, steps=key[1])
        return self._made[key]

    def error(self, sequence: GaussianSequence, draws: Sequence[Trial] | None = None) -> float:
        """Return the worst error of an asset on draws, those of the search if none are given."""
        errors = self._comparison.errors(sequence, draws or self._draws, keep=True)
        return float(errors.values(self._options.measure).max())

    def stored(self, count: int, scale: float | None, steps: int | None = None) -> tuple[GaussianSequence, int]:
        """Return a candidate as it reads once it is stored, and its size [byte]."""
        return self._written(self.candidate(count, steps), scale)

    def _written(self, sequence: GaussianSequence, scale: float | None) -> tuple[GaussianSequence, int]:
        """Return what a stored asset reads as, and its size [byte]."""
        self._stored += 1  # files that were read are not replaced
        place = self._place.with_stem(f"{self._place.stem}{self._stored}")
        paths = converters.write(sequence, place, _written_as(scale))
        return converters.read(place), sum(path.stat().st_size for path in paths)

    def more(self, count: int, scale: float | None, *, last: bool) -> tuple[int, float | None]:
        """Return what to try after a candidate that failed: the most there is if it is the last try."""
        if last:
            return len(self._reducer), FINEST if self._delivers else None
        return min(len(self._reducer), int(np.ceil(MORE * count))), None if scale is None else 0.5 * scale

    def target(self) -> tuple[int, float | None]:
        """Return how many Gaussians meet the target, and how exactly they are stored, None for every frame as it is."""
        options = self._options
        if options.gaussians is not None:
            return min(options.gaussians, len(self._reducer)), 1.0 if self._scaled else None
        if options.size is not None:
            return self._within_size(options.size)
        if options.target_fps is not None:
            how = (self._comparison, self.timed, self.candidate, len(self._reducer))
            return fast_enough(options.target_fps, *how), 1.0 if self._scaled else None
        assert options.bound is not None
        if not self._scaled:
            return self._fewest(options.bound), None
        count = self._fewest(FOR_GAUSSIANS * options.bound)
        within = (scale for scale in SCALES if self.error(self.stored(count, scale)[0]) <= options.bound)
        return count, next(within, SCALES[-1])

    def _fewest(self, bound: float) -> int:
        """Return the fewest Gaussians whose error on the search's draws is within a bound."""
        low, high = min(FEWEST, len(self._reducer)), len(self._reducer)
        guess = max(low, high // 5)
        for _ in range(ROUNDS):
            if high <= (1.0 + CLOSE) * low + 1:
                break
            error = self.error(self.candidate(guess))
            self.tried.append((guess, error))
            low, high = (low, guess) if error <= bound else (guess, high)
            wanted = guess * (error / bound) ** (1.0 / STEEPNESS)
            narrow = (high / low) ** 0.1
            guess = int(np.clip(wanted, max(low + 1, low * narrow), min(high - 1, high / narrow)))
        return high

    def _within_size(self, size: int) -> tuple[int, float | None]:
        """Return the number of Gaussians and the exactness of delivery that err least in so many bytes."""
        found: list[tuple[float, int, float | None]] = []
        for scale in SIZED_SCALES if self._scaled else (None,):
            count = self._fitting(size, scale)
            if count:
                found.append((self.error(self.stored(count, scale)[0]), count, scale))
                self.tried.append((count, found[-1][0]))
        if not found:
            least = self.stored(min(FEWEST, len(self._reducer)), SIZED_SCALES[0] if self._scaled else None, 0)[1]
            raise InvalidOptionError(f"size must be at least {least} bytes for this asset, got {size}. Allow more.")
        return min(found, key=lambda each: each[0])[1:]

    def _fitting(self, size: int, scale: float | None) -> int:
        """Return the most Gaussians that fit into so many bytes, 0 if `FEWEST` do not; bytes grow about linearly."""
        most = len(self._reducer)
        low, high = min(FEWEST, most), most
        first, last = (self.stored(count, scale, 0)[1] for count in (low, high))
        if last <= size:
            return most
        while first <= size and high > low + 1:
            count = int(np.clip(low + (high - low) * (size - first) / max(last - first, 1), low + 1, high - 1))
            bytes_ = self.stored(count, scale)[1]
            if bytes_ <= size:
                low, first = count, bytes_
                if size - bytes_ <= CLOSE * size:
                    break
            else:
                high, last = count, bytes_
        return low if first <= size else 0


def _written_as(scale: float | None) -> converters.WriteOptions:
    return converters.WriteOptions() if scale is None else converters.WriteOptions(keyed=True, error_scale=scale)


def _require_reducible(original: GaussianSequence, clouds: Sequence[GaussianCloud], frames: Sequence[int]) -> None:
    """Refuse what cannot be relit or merged."""
    if not clouds[0].is_relightable:
        raise InvalidArrayError("asset must have all materials to be relit, got one without. Decompose it first.")
    if not len(clouds[0]):
        raise InvalidArrayError("asset must have a Gaussian, got none. Give one that shows something.")
    for frame, cloud in zip(frames, clouds, strict=True):
        if len(cloud) != len(clouds[0]):
            raise InvalidArrayError(
                f"asset must have the same Gaussians in every frame, got {len(clouds[0])} in frame {frames[0]} and "
                f"{len(cloud)} in frame {frame}. Track it first."
            )
    if len(original) > 1 and original.topology != "constant":
        raise InvalidArrayError(
            "asset must have a constant topology, got frames whose Gaussians are not the same ones. Track it first."
        )
