"""Checks that a sequence, a capture and a light go together, before materials are measured from them.

A combination that cannot work is refused with an error; one that gives worse materials than it could is a finding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.findings import Finding, count_of, names_of
from beam_warp.capture.records import CaptureContents
from beam_warp.capture.views import CapturedView
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.materials.light import looks_like_ldr
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.world.axes import AXIS_CODES, change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.metadata import numbers_of_frames, stated_capture_frames

MATCH_VIEWS = 6
MATCH_SIDE = 160
"""Views, evenly among those given, and their largest side [pixel] at which silhouettes are compared."""

SEARCH_VIEWS = 3
SEARCH_SIDE = 48
SEARCH_GAUSSIANS = 8192
"""Sizes at which other axes and units are tried."""

SOLID = 0.5
"""Coverage from which on a pixel belongs to a silhouette."""

LEAST_OVERLAP = 0.5
GOOD_OVERLAP = 0.9
"""Intersection over union of silhouettes, median over views, below which sequence and capture do not match, and below
which they may not.

Measured on two reconstructed figures, walking and running: 0.95 and 0.96 with the views of the same frame; 0.77 and
0.85 with those of the next; 0.02 to 0.37 turned by a quarter or half, but 0.67 turned about the up axis by the one
quarter at which that figure looks most alike."""

CLEARLY_MORE = 0.1
"""Overlap that other axes or units must gain to be proposed."""

UNITS = {"centimetres": 0.01, "millimetres": 0.001, "hundreds of metres": 100.0}
"""Units that a sequence may have been written in by mistake, in metres."""

CUT_PART = 0.01
"""Part of the subject's pixels at the ceiling from which on a view is reported: highlights alone are less."""

SAME = 1e-3
"""Values this near to an image's largest, relatively, are as large."""


@dataclass(frozen=True)
class SilhouetteMatch:
    """Agreement of the coverage that a sequence has in views with their masks.

    Attributes:
        overlap: Intersection over union, median over the views that know their coverage; NaN if none does.
        view_count: Compared views that know their coverage.
        finding: A mismatch, or None.
    """

    overlap: float
    view_count: int
    finding: Finding | None


def judge_environment(environment: EnvironmentMap) -> list[Finding]:
    """Find what is wrong with a light by itself.

    Raises:
        InvalidOptionError: It is black.
    """
    if not environment.radiance.any():
        raise InvalidOptionError(
            "environment must shed light, got black everywhere. Check the file and --exposure; materials cannot be "
            "measured without light."
        )
    finding = looks_like_ldr(environment)
    return [] if finding is None else [finding]


def matched_frames(sequence: GaussianSequence, capture: CaptureContents, split: str = "train") -> tuple[int, ...]:
    """Return the capture's number of every frame of a sequence.

    Args:
        sequence: States its frames in its metadata, or is taken to start at frame 0.
        capture: What must have them.
        split: Views of which every frame must have at least one.

    Raises:
        InvalidOptionError: The capture lacks a frame, or its views of that split.
    """
    count = len(sequence)
    frames = numbers_of_frames(sequence.metadata, count)
    has = {record.frame for record in capture.select(split=split)}
    absent = [frame for frame in frames if frame not in has]
    if absent:
        stated = stated_capture_frames(sequence.metadata, count) is not None
        raise InvalidOptionError(
            f"capture must have {split} views of each of {count_of(count, 'frame')} of the sequence, got none of "
            f"{'frame' if len(absent) == 1 else 'frames'} {names_of(absent)} at {capture.folder} (frames "
            f"{names_of(sorted(has)) or 'none'}). "
            + (
                "Give the capture that the sequence was reconstructed from."
                if stated
                else "State which frames the sequence shows as capture_frames in its metadata."
            )
        )
    return frames


def match_silhouettes(
    cloud: GaussianCloud,
    views: Sequence[CapturedView],
    *,
    options: RasterOptions | None = None,
    device: str | None = None,
) -> SilhouetteMatch:
    """Compare what Gaussians cover in views with the coverage in the images.

    Args:
        cloud: Gaussians of one frame, in the internal world.
        views: Of the same frame; those without coverage tell nothing.
        options: How splats are drawn.
        device: Warp device; None takes the first CUDA device, or the CPU.
    """
    known = [view for view in views if view.alpha is not None]
    small = _small(known, MATCH_VIEWS, MATCH_SIDE)
    if not small:
        return SilhouetteMatch(float("nan"), 0, None)
    overlap = _overlap(cloud, small, options, device)
    finding = None
    if not overlap >= GOOD_OVERLAP:
        finding = Finding(
            "warning" if overlap >= LEAST_OVERLAP else "error",
            "capture-mismatch",
            f"capture and sequence {'may' if overlap >= LEAST_OVERLAP else 'do'} not match: silhouettes overlap by "
            f"{overlap:.0%} in {count_of(len(small), 'view')}",
            remedy=_way_out(cloud, small, options, device, overlap),
        )
    return SilhouetteMatch(overlap, len(small), finding)


def require_match(match: SilhouetteMatch) -> None:
    """Refuse a sequence that is not what a capture shows.

    Raises:
        InvalidOptionError: Silhouettes hardly overlap.
    """
    if match.finding is not None and match.finding.severity == "error":
        raise InvalidOptionError(
            f"sequence must show what the capture shows, got silhouettes that overlap by {match.overlap:.0%} in "
            f"{count_of(match.view_count, 'view')}. {match.finding.remedy}"
        )


def largest_value(views: Sequence[CapturedView], color_space: str | None) -> float:
    """Return the largest scene-linear value that images can hold; infinite where nothing limits it.

    Display-referred files end at white. Scene-linear ones that were made from such, or by a sensor that saturated, show
    it by many pixels of several views at exactly the same largest value.

    Args:
        views: What images show.
        color_space: Of the image files.
    """
    if color_space == DISPLAY_SRGB:
        return 1.0
    shown = [_largest_channel(view)[_subject(view)] for view in views]
    shown = [values for values in shown if len(values)]
    largest = max((float(values.max()) for values in shown), default=0.0)
    cut = sum(float((values == largest).mean()) >= CUT_PART for values in shown)
    return largest if largest > 0.0 and cut >= min(2, len(shown)) else float("inf")


def judge_clipping(views: Sequence[CapturedView], ceiling: float) -> list[Finding]:
    """Find views whose subject is cut at the largest value that images can hold.

    Args:
        views: What images show.
        ceiling: That value, scene-linear; see `largest_value`.
    """
    parts = {}
    for view in views:
        subject = _subject(view)
        if subject.any() and np.isfinite(ceiling):
            parts[view.name] = float((_largest_channel(view)[subject] >= ceiling * (1.0 - SAME)).mean())
    cut = {name: part for name, part in parts.items() if part >= CUT_PART}
    if not cut:
        return []
    worst = sorted(cut, key=lambda name: -cut[name])
    return [
        Finding(
            "warning",
            "clipped-images",
            f"{count_of(len(cut), 'image')} of {len(views)} {'is' if len(cut) == 1 else 'are'} cut at {ceiling:g} in "
            f"{CUT_PART:.0%} of the subject or more, {max(cut.values()):.0%} at most",
            names_of(f"{name} {cut[name]:.0%}" for name in worst),
            "Cut pixels count for nothing, and surfaces that no other view shows are flagged as saturated. Expose "
            "images lower, or give scene-linear ones.",
        )
    ]


def _largest_channel(view: CapturedView) -> NDArray[np.float32]:
    """Return the largest channel of every pixel, ``(H, W)``; NumPy's own search along so short an axis is slow."""
    red, green, blue = np.moveaxis(view.color, -1, 0)
    return np.maximum(np.maximum(red, green), blue)


def _subject(view: CapturedView) -> NDArray[np.bool_]:
    """Return which pixels show the subject alone, ``(H, W)``; all where that is not known."""
    return np.ones(view.color.shape[:2], bool) if view.alpha is None else view.alpha > 0.99


def _overlap(
    cloud: GaussianCloud, views: Sequence[CapturedView], options: RasterOptions | None, device: str | None
) -> float:
    """Return the median intersection over union of silhouettes."""
    drawn = rasterize(cloud, [view.camera for view in views], channels=(), options=options, device=device)
    parts = []
    for view, image in zip(views, drawn, strict=True):
        assert view.alpha is not None
        ours, theirs = image.alpha > SOLID, view.alpha > SOLID
        union = (ours | theirs).sum()
        parts.append(float((ours & theirs).sum() / union) if union else 1.0)
    return float(np.median(parts))


def _small(views: Sequence[CapturedView], most: int, side: int) -> list[CapturedView]:
    """Return some views, evenly among those given, at about a size."""
    rows = np.unique(np.linspace(0, len(views) - 1, min(len(views), most)).astype(int))
    return [
        view.reduced(max(1, max(view.camera.width, view.camera.height) // side)) for view in (views[i] for i in rows)
    ]


def _way_out(
    cloud: GaussianCloud,
    views: Sequence[CapturedView],
    options: RasterOptions | None,
    device: str | None,
    overlap: float,
) -> str:
    """Return a remedy: the axes or units in which the sequence would match, if any do."""
    few, small = _shape(cloud, max(1, -(-len(cloud) // SEARCH_GAUSSIANS))), _small(views, SEARCH_VIEWS, SEARCH_SIDE)

    def turned(shape: GaussianCloud, code: str) -> GaussianCloud:
        return change_axes(replace(shape, axes=code), cloud.axes)

    def resized(shape: GaussianCloud, unit: str) -> GaussianCloud:
        metres = np.float32(UNITS[unit])
        return shape.with_arrays(positions=shape.positions * metres, scales=shape.scales * metres)

    readings = [(turned, code, f"its axes, {cloud.axes} as it was read, were {code}") for code in AXIS_CODES]
    readings += [(resized, unit, f"its units were {unit}") for unit in UNITS]
    tried = [_overlap(change(few, name), small, options, device) for change, name, _ in readings]
    change, name, how = readings[int(np.argmax(tried))]
    best = _overlap(change(_shape(cloud), name), views, options, device)
    if best >= max(LEAST_OVERLAP, overlap + CLEARLY_MORE):
        return f"It would match by {best:.0%} if {how}: import it again, with the axes and units it was written in."
    return "Check axes and units of the sequence, that its frames are those of the capture, and the masks."


def _shape(cloud: GaussianCloud, step: int = 1) -> GaussianCloud:
    """Return the shape, all that a silhouette shows, of every ``step``-th Gaussian, enlarged to cover as much."""
    return GaussianCloud(
        positions=cloud.positions[::step],
        orientations=cloud.orientations[::step],
        scales=cloud.scales[::step] * np.float32(np.sqrt(step)),
        opacities=cloud.opacities[::step],
        axes=cloud.axes,
    )
