"""Scores of the materials of an asset: of one channel, of one view, and of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.evaluate.steadiness import TemporalScores
from beam_warp.image.metrics import Compared

Scales = tuple[float, float, float]

GEOMETRY = ("normals_median_degrees", "normals_mean_degrees", "depth_median_mm", "overlap")
"""Scores of a view's normals, depth and coverage."""


@dataclass(frozen=True)
class ImageScore:
    """One channel of one view, or the mean of several.

    Attributes:
        psnr: Inside the subject's bounding box, composited on black [dB].
        ssim: There.
        solid_psnr: Where the truth's alpha is above `SOLID_ALPHA` [dB].
        perceptual: There, in the box: ``flip`` and ``lpips``, as far as they could be measured.
    """

    psnr: float
    ssim: float
    solid_psnr: float
    perceptual: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, compared: Compared, metrics: PerceptualMetrics) -> ImageScore:
        """Score one channel."""
        score = compared.score()
        return cls(score.psnr, score.ssim, score.solid_psnr, metrics.differences(compared.image, compared.truth))

    @classmethod
    def mean(cls, scores: Sequence[ImageScore]) -> ImageScore:
        """Return the mean of some, at least one; of a perceptual difference, of those that have it."""
        names = sorted({name for score in scores for name in score.perceptual})
        return cls(
            float(np.mean([score.psnr for score in scores])),
            float(np.mean([score.ssim for score in scores])),
            float(np.mean([score.solid_psnr for score in scores])),
            {
                name: float(np.mean([score.perceptual[name] for score in scores if name in score.perceptual]))
                for name in names
            },
        )

    def as_dict(self) -> dict[str, float]:
        """Return a JSON-able record."""
        return {"psnr": self.psnr, "ssim": self.ssim, "solid_psnr": self.solid_psnr, **self.perceptual}


@dataclass(frozen=True)
class MaterialViewScores:
    """One view.

    Attributes:
        name: Of its record.
        frame: Of the capture.
        channels: By name: ``ambient_occlusion``, ``base_color``, ``roughness``, ``novel_view``, as far as both sides
            have them; ``base_color_scaled`` with `MaterialScores.base_color_scale`.
        relit: By relighter, then by light.
        relit_scaled: The same with base colour scaled; empty unless it was asked for.
        base_color_scale: Factor per channel that best carries this view's base colour to its truth; None without truth.
        normals_median_degrees: Median angle between normals and the truth's, where the truth is solid.
        normals_mean_degrees: Its mean.
        depth_median_mm: Median of the absolute error of mean depth there [mm].
        overlap: Coverage that asset and truth share, over what either covers, in [0, 1].
    """

    name: str
    frame: int
    channels: Mapping[str, ImageScore]
    relit: Mapping[str, Mapping[str, ImageScore]]
    relit_scaled: Mapping[str, Mapping[str, ImageScore]]
    base_color_scale: Scales | None
    normals_median_degrees: float | None
    normals_mean_degrees: float | None
    depth_median_mm: float | None
    overlap: float

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record."""
        return {
            "name": self.name,
            "frame": self.frame,
            **{name: score.as_dict() for name, score in self.channels.items()},
            "relit": _as_records(self.relit),
            "relit_scaled": _as_records(self.relit_scaled),
            "base_color_scale": self.base_color_scale,
            **{name: getattr(self, name) for name in GEOMETRY},
        }


@dataclass(frozen=True)
class MaterialScores:
    """Scores of an asset against a capture with truth.

    Attributes:
        views: One by one, in the order of frames.
        base_color_scale: Factor per channel that best carries base colour to the truth, by least squares over the
            solid pixels of all views and frames; None without truth.
        frame_scales: The same for every frame by itself; a frame whose true base colour is not known has none.
        temporal: How steady base colour and ambient occlusion are.
        conditions: How it was measured, JSON-able.
        absent: What could not be measured, by name, and why.
        notes: What a reader should know, each a sentence.
    """

    views: tuple[MaterialViewScores, ...]
    base_color_scale: Scales | None
    frame_scales: Mapping[int, Scales]
    temporal: TemporalScores
    conditions: Mapping[str, Any]
    absent: Mapping[str, str]
    notes: tuple[str, ...]

    def mean_channels(self) -> dict[str, ImageScore]:
        """Return the mean over views of every channel."""
        return _means([view.channels for view in self.views])

    def mean_relit(self, *, scaled: bool = False) -> dict[str, dict[str, ImageScore]]:
        """Return by relighter and light the mean over views."""
        relit = [view.relit_scaled if scaled else view.relit for view in self.views]
        names = list(dict.fromkeys(name for view in relit for name in view))
        return {name: _means([view[name] for view in relit if name in view]) for name in names}

    def mean(self, name: str) -> float | None:
        """Return the mean over views of an attribute of `MaterialViewScores`; None where no view has it."""
        values = [value for view in self.views if (value := getattr(view, name)) is not None]
        return float(np.mean(values)) if values else None

    @property
    def mean_view_scale(self) -> Scales | None:
        """The mean over views of each view's own scale."""
        scales = [view.base_color_scale for view in self.views if view.base_color_scale is not None]
        return as_triple(np.mean(scales, axis=0)) if scales else None

    @property
    def scale_deviation(self) -> Scales | None:
        """Standard deviation of the scale over frames: flicker of the whole; None with fewer than two frames."""
        if len(self.frame_scales) < 2:
            return None
        return as_triple(np.std(list(self.frame_scales.values()), axis=0))

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record."""
        relit = self.mean_relit()
        mean: dict[str, Any] = {
            **{name: score.as_dict() for name, score in self.mean_channels().items()},
            "relit": _as_records(relit),
            "relit_mean": {
                name: ImageScore.mean(list(lights.values())).as_dict() for name, lights in relit.items() if lights
            },
            "relit_scaled": _as_records(self.mean_relit(scaled=True)),
            "base_color_scale": self.mean_view_scale,
            **{name: self.mean(name) for name in GEOMETRY},
        }
        return {
            "mean": mean,
            "base_color_scale": self.base_color_scale,
            "frame_scales": {str(frame): scale for frame, scale in self.frame_scales.items()},
            "scale_deviation": self.scale_deviation,
            "temporal": self.temporal.as_dict(),
            "views": [view.as_dict() for view in self.views],
            "conditions": dict(self.conditions),
            "absent": dict(self.absent),
            "notes": list(self.notes),
        }


def as_triple(values: NDArray[np.floating[Any]]) -> Scales:
    """Return three numbers as a tuple."""
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _means(views: Sequence[Mapping[str, ImageScore]]) -> dict[str, ImageScore]:
    """Return by name the mean of the scores of that name."""
    names = dict.fromkeys(name for view in views for name in view)
    return {name: ImageScore.mean([view[name] for view in views if name in view]) for name in names}


def _as_records(scores: Mapping[str, Mapping[str, ImageScore]]) -> dict[str, dict[str, dict[str, float]]]:
    return {name: {light: score.as_dict() for light, score in lights.items()} for name, lights in scores.items()}
