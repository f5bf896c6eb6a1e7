"""Evaluation of an asset's materials against the exact channels of a capture: every view, and over time.

read      `beam_warp.evaluate.compared`     frames, records with truth, lights
draw      `beam_warp.evaluate.views`        channels and relit images of every view, and their scores
scale     here                              base colour once more, times the factor that fits it best
follow    `beam_warp.evaluate.steadiness`   base colour over time
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture
from beam_warp.capture.matching import match_frames, scored_frames
from beam_warp.checks import require_count
from beam_warp.errors import InvalidOptionError
from beam_warp.evaluate.compared import ComparedAsset
from beam_warp.evaluate.drawn import SAMPLES
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.evaluate.relighters import RELIGHTERS, Relighter
from beam_warp.evaluate.scores import MaterialScores, MaterialViewScores, Scales, as_triple
from beam_warp.evaluate.steadiness import TemporalScores, gaussian_deviation, surface_scores
from beam_warp.evaluate.views import ScoredView, ViewScorer
from beam_warp.jobs.progress import Progress, no_progress
from beam_warp.raster.records import RasterOptions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

LEAST_OVERLAP = 0.5
"""Coverage of asset and truth in common, over what either covers, below which they are not of the same thing. Measured
with a walking person of 320 x 320 pixels: .98 as it should be, .86 when 2 cm aside, .82 one frame and .59 five frames
off, .45 turned by a quarter, .03 lying."""

GOOD_OVERLAP = 0.8
"""Coverage in common below which a note says so."""

Observer = Callable[[ScoredView], None]


def score_materials(
    sequence: GaussianSequence,
    capture: Capture,
    *,
    frames: Sequence[int] | None = None,
    split: str = "test",
    raster: RasterOptions | None = None,
    samples: int = SAMPLES,
    relighters: Mapping[str, Relighter] | None = None,
    scaled_relighting: bool = False,
    metrics: PerceptualMetrics | None = None,
    device: str | None = None,
    observe: Observer | None = None,
    progress: Progress = no_progress,
) -> MaterialScores:
    """Score an asset against the views of a capture whose truth is known.

    A pixel is the mean of a square of samples, taken before anything is encoded. Colours are compared unscaled first,
    encoded as sRGB; then base colour once more, times one factor per channel for the whole sequence, cut at 1.

    Args:
        sequence: Relightable, in any axes, in the capture's world.
        capture: Its records of the split have ``truth``, and ``relit`` if relighting is to be scored; the light NAME is
            ``truth/NAME.exr``.
        frames: The capture's number of every frame of the asset; None takes what the asset's metadata states, else
            0, 1, 2, ….
        split: Which records.
        raster: How splats are drawn; None draws them as the asset's metadata states.
        samples: Side of the square of samples of a pixel.
        relighters: By name; None takes the deferred one.
        scaled_relighting: Also relight with base colour scaled, as is the custom where the capture's light is unknown.
        metrics: Perceptual differences; None takes what is installed.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
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
    require_count("samples", samples, 1, 64)
    matched = match_frames(sequence, frames)
    asset = ComparedAsset(sequence, capture, matched, split)
    drawn = raster or RasterOptions.from_metadata(sequence.metadata)
    made = {"deferred": RELIGHTERS["deferred"]} if relighters is None else relighters
    scorer = ViewScorer(
        raster=drawn,
        samples=samples,
        renderers={name: make(drawn, samples, device) for name, make in made.items()},
        metrics=metrics or PerceptualMetrics.installed(),
        device=device,
    )
    shown = scored_frames(capture, matched, split=split)
    lights = asset.lights(shown) if scorer.renderers else {}
    _require_overlap(asset, scorer, shown[0])
    views, scales = _score_views(asset, scorer, shown, lights, observe, progress)
    scale = scales.of_all()
    if scale is not None:
        views = _with_scale(asset, scorer, views, scale, lights if scaled_relighting else {}, progress)
    return MaterialScores(
        views=tuple(views),
        base_color_scale=scale,
        frame_scales=scales.of_frames(),
        temporal=_temporal(asset, scorer, progress),
        conditions={"frames": list(shown), "split": split, **scorer.conditions()},
        absent=_absent(scorer, views, lights),
        notes=_notes(asset, shown, views),
    )


class _ColorScales:
    """Factors that best carry base colour to its truth, by least squares over the solid pixels of views."""

    def __init__(self) -> None:
        self._sums: dict[int, NDArray[np.float64]] = {}

    def add(self, view: ScoredView) -> None:
        """Count the solid pixels of a view; one without true base colour counts nothing."""
        pair = view.solid_base_color()
        if pair is not None:
            a, b = (np.asarray(colors, np.float64) for colors in pair)
            sums = self._sums.setdefault(view.record.frame, np.zeros((2, 3)))
            sums += np.stack([(a * b).sum(axis=0), (a * a).sum(axis=0)])

    def of_all(self) -> Scales | None:
        """Return the factors of all frames together; None without truth."""
        return _scale_of(np.sum(list(self._sums.values()), axis=0)) if self._sums else None

    def of_frames(self) -> dict[int, Scales]:
        """Return the factors of every frame by itself."""
        return {frame: _scale_of(sums) for frame, sums in self._sums.items()}


def _scale_of(sums: NDArray[np.float64]) -> Scales:
    """Return sums of products over sums of squares; 1 where all is black."""
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
    progress: Progress,
) -> tuple[list[MaterialViewScores], _ColorScales]:
    """Draw, relight and score the views of all frames, one frame at a time."""
    views: list[MaterialViewScores] = []
    scales = _ColorScales()
    total = sum(len(asset.records(frame)) for frame in frames)
    for frame in frames:
        cloud, records = asset.cloud(frame), asset.records(frame)
        for record, relit in zip(records, scorer.relit(cloud, records, lights), strict=True):
            scored = scorer.score(cloud, record, relit)
            scales.add(scored)
            views.append(scored.scores)
            if observe is not None:
                observe(scored)
            progress("score views", len(views), total)
    return views, scales


def _with_scale(
    asset: ComparedAsset,
    scorer: ViewScorer,
    views: Sequence[MaterialViewScores],
    scale: Scales,
    lights: Mapping[str, EnvironmentMap],
    progress: Progress,
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
            color = scorer.score_scaled_color(cloud, record, truth, scale)
            by_name[record.name] = replace(
                view,
                channels={**view.channels, "base_color_scaled": color},
                relit_scaled=scorer.score_relit(record, truth.channels["A"], images),
            )
            done += 1
            progress("score views, scaled", done, len(views))
    return list(by_name.values())


def _temporal(asset: ComparedAsset, scorer: ViewScorer, progress: Progress) -> TemporalScores:
    """Measure how steady base colour is."""
    numbers = [number for number, _ in sorted(asset.matched.items(), key=lambda pair: pair[1])]
    gaussians = gaussian_deviation(asset.sequence, numbers)
    surface = surface_scores(
        asset.sequence,
        asset.capture,
        asset.matched,
        split=asset.split,
        raster=scorer.raster,
        samples=scorer.samples,
        device=scorer.device,
        progress=lambda done, total: progress("score over time", done, total),
    )
    absent = {name: found for name, found in (("gaussians", gaussians), ("surface", surface)) if isinstance(found, str)}
    return TemporalScores(
        None if isinstance(gaussians, str) else gaussians, None if isinstance(surface, str) else surface, absent
    )


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
