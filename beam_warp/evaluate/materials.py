"""Evaluation of an asset's materials against the exact channels of a capture: every view, and over time.

read      `beam_warp.evaluate.compared`     frames, records with truth, lights
draw      `beam_warp.evaluate.views`        channels and relit images of every view, and their scores
scale     here                              base colour once more, times the factor that fits it best
follow    `beam_warp.evaluate.steadiness`   base colour and occlusion over time
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture
from beam_warp.capture.matching import match_frames, scored_frames
from beam_warp.checks import require_choice, require_count
from beam_warp.errors import InvalidOptionError
from beam_warp.evaluate.compared import ComparedAsset
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.evaluate.relighters import RELIGHTERS, Relighter
from beam_warp.evaluate.scores import MaterialScores, MaterialViewScores, Scales, as_triple
from beam_warp.evaluate.steadiness import TemporalScores, gaussian_deviation, surface_scores
from beam_warp.evaluate.views import ScoredView, ViewScorer
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import samples_of_images
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

LEAST_OVERLAP = 0.5
"""Coverage of asset and truth in common, over what either covers, below which they are not of the same thing. Measured
with a walking person of 320 x 320 pixels: .98 as it should be, .86 when 2 cm aside, .82 one frame and .59 five frames
off, .45 turned by a quarter, .03 lying."""

GOOD_OVERLAP = 0.8
"""Coverage in common below which a note says so."""

Observer = Callable[[ScoredView], None]


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Options of `score_materials` and `beam_warp.evaluate.asset.evaluate_asset`.

    Attributes:
        frames: The capture's number of every frame of the asset; None takes what the asset's metadata states, else
            0, 1, 2, ….
        split: Which records of the capture.
        raster: How splats are drawn; None draws them as the asset's metadata states.
        samples: Side of the square of samples of a pixel; None takes as many as the Gaussians need to look as they did
            when they were fitted (`beam_warp.raster.resolution.samples_of_images`).
        relighters: Names in `beam_warp.evaluate.relighters.RELIGHTERS`.
        scaled_relighting: Also relight with base colour scaled, as is the custom where the capture's light is unknown.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        InvalidOptionError: There is no such relighter, or the samples are out of range.
    """

    frames: tuple[int, ...] | None = None
    split: str = "test"
    raster: RasterOptions | None = None
    samples: int | None = None
    relighters: tuple[str, ...] = ("deferred",)
    scaled_relighting: bool = False
    device: str | None = None

    def __post_init__(self) -> None:
        """Check names and samples."""
        if self.samples is not None:
            require_count("samples", self.samples, 1, 64)
        for name in self.relighters:
            require_choice("relight", name, tuple(RELIGHTERS))


def score_materials(
    sequence: GaussianSequence,
    capture: Capture,
    options: EvaluateOptions | None = None,
    *,
    relighters: Mapping[str, Relighter] | None = None,
    metrics: PerceptualMetrics | None = None,
    observe: Observer | None = None,
    progress: StageProgress = no_progress,
) -> MaterialScores:
    """Score an asset against the views of a capture whose truth is known.

    A pixel is the mean of a square of samples, taken before anything is encoded. Colours are compared unscaled first,
    encoded as sRGB; then base colour once more, times one factor per channel for the whole sequence, cut at 1.

    Args:
        sequence: Relightable, in any axes, in the capture's world.
        capture: Its records of the split have ``truth``, and ``relit`` if relighting is to be scored; the light NAME is
            ``truth/NAME.exr``.
        options: See `EvaluateOptions`.
        relighters: Ways to relight by name, in place of those that the options name.
        metrics: Perceptual differences; None takes what is installed.
        observe: Given every view when it is scored; nothing is kept after that.
        progress: Called with (stage, done, total).

    Raises:
        InvalidOptionError: The asset is not relightable, shows no frame whose truth is known, or does not stand where
            the capture shows its subject.
        MissingFileError: A file of the truth is not there.
        AssetFormatError: One is damaged.
        DeviceError: There is no such device.

    Source: BEAM §4 (bounding box, black background); Stanford-ORB, Kuang et al. 2023 (scale by least squares).
    """
    chosen = options or EvaluateOptions()
    matched = match_frames(sequence, chosen.frames)
    asset = ComparedAsset(sequence, capture, matched, chosen.split)
    drawn = chosen.raster or RasterOptions.from_metadata(sequence.metadata)
    made = {name: RELIGHTERS[name] for name in chosen.relighters} if relighters is None else relighters
    shown = scored_frames(capture, matched, split=chosen.split)
    samples = chosen.samples
    if samples is None:
        cameras = [record.camera for record in asset.records(shown[0])]
        samples = samples_of_images(asset.cloud(shown[0]), cameras, drawn)
    scorer = ViewScorer(
        raster=drawn,
        samples=samples,
        renderers={name: make(drawn, samples, chosen.device) for name, make in made.items()},
        metrics=metrics or PerceptualMetrics.installed(),
        device=chosen.device,
    )
    lights = asset.lights(shown) if scorer.renderers else {}
    _require_overlap(asset, scorer, shown[0])
    views, color_sums = _score_views(asset, scorer, shown, lights, observe, progress)
    scale = _scale_of(np.sum(list(color_sums.values()), axis=0)) if color_sums else None
    if scale is not None:
        views = _with_scale(asset, scorer, views, scale, lights if chosen.scaled_relighting else {}, progress)
    return MaterialScores(
        views=tuple(views),
        base_color_scale=scale,
        frame_scales={frame: _scale_of(sums) for frame, sums in color_sums.items()},
        temporal=_temporal(asset, scorer, progress),
        conditions={"frames": list(shown), "split": chosen.split, **scorer.conditions()},
        absent=_absent(scorer, views, lights),
        notes=_notes(asset, shown, views),
    )


def _scale_of(sums: NDArray[np.float64]) -> Scales:
    """Return the factors that best carry base colour to its truth, by `ScoredView.color_sums`; 1 where all is black."""
    products, squares = sums
    return as_triple(np.divide(products, squares, out=np.ones(3), where=squares > 0.0))


def _require_overlap(asset: ComparedAsset, scorer: ViewScorer, frame: int) -> None:
    """Refuse an asset that stands elsewhere than the subject, before much is done with it."""
    overlap = scorer.coverage_overlap(asset.cloud(frame), asset.records(frame))
    if not overlap >= LEAST_OVERLAP:
        raise InvalidOptionError(
            f"asset must stand where the capture shows its subject, got {overlap:.0%} of their coverage in common "
            f"in frame {frame}. Check the axes (--source-axes of a PLY), the units, and which frames it shows "
            "(--capture-frames)."
        )


def _score_views(
    asset: ComparedAsset,
    scorer: ViewScorer,
    frames: Sequence[int],
    lights: Mapping[str, EnvironmentMap],
    observe: Observer | None,
    progress: StageProgress,
) -> tuple[list[MaterialViewScores], dict[int, NDArray[np.float64]]]:
    """Draw, relight and score the views of all frames, one at a time; return also color sums by frame."""
    views: list[MaterialViewScores] = []
    color_sums: dict[int, NDArray[np.float64]] = {}
    total = sum(len(asset.records(frame)) for frame in frames)
    for frame in frames:
        cloud, records = asset.cloud(frame), asset.records(frame)
        for record, relit in zip(records, scorer.relit(cloud, records, lights), strict=True):
            scored = scorer.score(cloud, record, relit)
            sums = scored.color_sums()
            if sums is not None:
                color_sums[frame] = color_sums.get(frame, np.zeros((2, 3))) + sums
            views.append(scored.scores)
            if observe is not None:
                observe(scored)
            progress("score views", len(views), total)
    return views, color_sums


def _with_scale(
    asset: ComparedAsset,
    scorer: ViewScorer,
    views: Sequence[MaterialViewScores],
    scale: Scales,
    lights: Mapping[str, EnvironmentMap],
    progress: StageProgress,
) -> list[MaterialViewScores]:
    """Score base colour once more, scaled, and relighting with it if lights are given."""
    by_name = {view.name: view for view in views}
    done = 0
    for frame in dict.fromkeys(view.frame for view in views):
        cloud, records = asset.cloud(frame), asset.records(frame)
        scaled_color = np.clip(cloud.base_color * np.asarray(scale, np.float32), 0.0, 1.0)  # type: ignore[operator]
        recolored = cloud.with_arrays(base_color=scaled_color)
        relit = scorer.relit(recolored, records, lights) if lights else [{}] * len(records)
        for record, images in zip(records, relit, strict=True):
            truth, view = record.truth(), by_name[record.name]
            by_name[record.name] = replace(
                view,
                channels={**view.channels, **scorer.score_scaled_color(cloud, record, truth, scale)},
                relit_scaled=scorer.score_relit(record, truth.channels["A"], images),
            )
            done += 1
            progress("score views, scaled", done, len(views))
    return list(by_name.values())


def _temporal(asset: ComparedAsset, scorer: ViewScorer, progress: StageProgress) -> TemporalScores:
    """Measure how steady base colour and ambient occlusion are."""
    numbers = [number for number, _ in sorted(asset.matched.items(), key=lambda pair: pair[1])]
    surface = surface_scores(
        asset,
        raster=scorer.raster,
        samples=scorer.samples,
        device=scorer.device,
        progress=lambda done, total: progress("score over time", done, total),
    )
    found = {
        "gaussians": gaussian_deviation(asset.sequence, numbers),
        "surface": surface["base_color"],
        "occlusion_gaussians": gaussian_deviation(asset.sequence, numbers, "ambient_occlusion"),
        "occlusion_surface": surface["ambient_occlusion"],
    }
    absent = {name: entry for name, entry in found.items() if isinstance(entry, str)}
    return TemporalScores(**{name: None if name in absent else entry for name, entry in found.items()}, absent=absent)


def _absent(
    scorer: ViewScorer, views: Sequence[MaterialViewScores], lights: Mapping[str, EnvironmentMap]
) -> dict[str, str]:
    """Return what was not measured, and why."""
    absent = dict(scorer.metrics.absent)
    if not any("novel_view" in view.channels for view in views):
        absent["novel_view"] = "the asset has no captured radiance"
    if not lights:
        absent["relit"] = "no relighter was chosen" if not scorer.renderers else "the capture has no relit images"
    return absent


def _notes(asset: ComparedAsset, frames: Sequence[int], views: Sequence[MaterialViewScores]) -> tuple[str, ...]:
    """Return what a reader should know, in sentences."""
    notes = []
    known = {record.frame for record in asset.capture.select(split=asset.split) if record.truth_path is not None}
    if left := sorted(known - set(frames)):
        notes.append(f"the asset does not show frames whose truth is known: {', '.join(map(str, left))}")
    overlap = float(np.mean([view.overlap for view in views]))
    if overlap < GOOD_OVERLAP:
        notes.append(f"only {overlap:.0%} of the coverage of asset and truth is in common: check axes and frames")
    return tuple(notes)
