"""Scores of single views: what is drawn and relit for a camera, against the exact channels of its record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import CaptureRecord
from beam_warp.evaluate.drawn import DrawnMaterials, draw_materials, true_channel
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.evaluate.scores import ImageScore, MaterialViewScores, Scales, as_triple
from beam_warp.image.files import Image
from beam_warp.image.metrics import SOLID_ALPHA, angles_between, as_compared, least_squares_scale
from beam_warp.raster.records import RasterOptions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.shot import RenderedImage, Renderer, Shot

RelitViews = Mapping[str, Mapping[str, RenderedImage]]
"""Images of one view, by relighter, then by light."""


@dataclass(frozen=True, eq=False)
class ScoredView:
    """A view's images and the scores that were made of them, unscaled.

    Attributes:
        record: Record of the capture.
        truth: Its exact channels.
        drawn: Channels of the asset.
        relit: Images of the asset, by relighter, then by light.
        scores: Their scores, without those that need the scale of the sequence.
    """

    record: CaptureRecord
    truth: Image
    drawn: DrawnMaterials
    relit: RelitViews
    scores: MaterialViewScores

    def color_sums(self) -> NDArray[np.float64] | None:
        """Return, over solid pixels, the sums of base colour times its truth and of its square, ``(2, 3)``.

        None without true base colour.
        """
        known = true_channel(self.truth, "base_color")
        if known is None:
            return None
        solid = self.truth.channels["A"] > SOLID_ALPHA
        a, b = (np.asarray(colors[solid], np.float64) for colors in (self.drawn.channels["base_color"], known))
        return np.stack([(a * b).sum(axis=0), (a * a).sum(axis=0)])


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewScorer:
    """Draws, relights and scores views, all in one way.

    Attributes:
        raster: How splats are drawn.
        samples: Side of the square of samples of a pixel.
        renderers: Ways to relight, by name.
        metrics: Perceptual differences.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
    """

    raster: RasterOptions
    samples: int
    renderers: Mapping[str, Renderer]
    metrics: PerceptualMetrics
    device: str | None

    def relit(
        self, cloud: GaussianCloud, records: Sequence[CaptureRecord], lights: Mapping[str, EnvironmentMap]
    ) -> list[RelitViews]:
        """Relight a cloud in every way for every record, under those lights that the record is known under."""
        images = {
            name: {
                light: [
                    renderer.draw(Shot(cloud=cloud, camera=record.camera, environment=environment))
                    for record in records
                ]
                for light, environment in lights.items()
            }
            for name, renderer in self.renderers.items()
        }
        return [
            {
                name: {light: views[index] for light, views in by_light.items() if light in record.relit_paths}
                for name, by_light in images.items()
            }
            for index, record in enumerate(records)
        ]

    def score(self, cloud: GaussianCloud, record: CaptureRecord, relit: RelitViews) -> ScoredView:
        """Draw a cloud for a record, and score its channels and its relit images."""
        drawn = self._draw(cloud, record, radiance=cloud.radiance is not None)
        truth = record.truth()
        truth_alpha = truth.channels["A"]
        solid = truth_alpha > SOLID_ALPHA
        channels: dict[str, ImageScore] = {}
        scale = None
        for name in ("ambient_occlusion", "base_color", "roughness"):
            known = true_channel(truth, name)
            if known is None:
                continue
            channels[name] = self._compare(drawn.channels[name], known, drawn.alpha, truth_alpha, premultiplied=False)
            if known.ndim == 3:
                scale = as_triple(least_squares_scale(drawn.channels[name], known, solid))
        if drawn.radiance is not None:
            image = record.image().linear_rgba()[..., :3]
            channels["novel_view"] = self._compare(drawn.radiance, image, drawn.alpha, truth_alpha)
        normals, depth = true_channel(truth, "normals"), true_channel(truth, "depth")
        angles = None if normals is None else angles_between(drawn.channels["normals"][solid], normals[solid])
        depth_error = None
        if depth is not None:
            depth_error = 1e3 * float(np.median(np.abs(drawn.depth[solid].astype(np.float64) - depth[solid])))
        scores = MaterialViewScores(
            name=record.name,
            frame=record.frame,
            channels=channels,
            relit=self.score_relit(record, truth_alpha, relit),
            relit_scaled={},
            base_color_scale=scale,
            normals_median_degrees=None if angles is None else float(np.median(angles)),
            normals_mean_degrees=None if angles is None else float(angles.mean()),
            depth_median_mm=depth_error,
            overlap=overlap(drawn.alpha, truth_alpha),
        )
        return ScoredView(record, truth, drawn, relit, scores)

    def score_relit(
        self, record: CaptureRecord, truth_alpha: NDArray[np.float32], relit: RelitViews
    ) -> dict[str, dict[str, ImageScore]]:
        """Score the images of one view under every light, by relighter and light."""
        lights = dict.fromkeys(light for by_light in relit.values() for light in by_light)
        known = {light: record.relit(light).linear_rgba()[..., :3] for light in lights}
        return {
            name: {
                light: self._compare(image.rgb, known[light], image.alpha, truth_alpha)
                for light, image in by_light.items()
            }
            for name, by_light in relit.items()
        }

    def score_scaled_color(
        self, cloud: GaussianCloud, record: CaptureRecord, truth: Image, scale: Scales
    ) -> dict[str, ImageScore]:
        """Score base colour times a factor per channel, cut at 1, as ``base_color_scaled``; nothing without truth."""
        known = true_channel(truth, "base_color")
        if known is None:
            return {}
        drawn = self._draw(cloud, record, channels=("base_color",))
        color = drawn.channels["base_color"] * np.asarray(scale)
        score = self._compare(color, known, drawn.alpha, truth.channels["A"], premultiplied=False)
        return {"base_color_scaled": score}

    def coverage_overlap(self, cloud: GaussianCloud, records: Sequence[CaptureRecord]) -> float:
        """Return the coverage that a cloud shares with the truth of some records, mean over them, in [0, 1]."""
        overlaps = []
        for record in records:
            drawn = self._draw(cloud, record, channels=(), samples=1)
            overlaps.append(overlap(drawn.alpha, record.truth().channels["A"]))
        return float(np.mean(overlaps))

    def _compare(
        self,
        image: NDArray[Any],
        truth: NDArray[Any],
        alpha: NDArray[np.float32],
        truth_alpha: NDArray[np.float32],
        *,
        premultiplied: bool = True,
    ) -> ImageScore:
        """Score one channel, ``(H, W)``, or colour, ``(H, W, 3)``."""
        how = {"is_color": image.ndim == 3, "premultiplied": premultiplied}
        compared = as_compared(image, truth, alpha=alpha, truth_alpha=truth_alpha, **how)
        return ImageScore.of(compared, self.metrics)

    def _draw(self, cloud: GaussianCloud, record: CaptureRecord, **how: Any) -> DrawnMaterials:
        """Draw a cloud for a record."""
        how = {"raster": self.raster, "samples": self.samples, "device": self.device} | how
        return draw_materials(cloud, record.camera, **how)

    def conditions(self) -> dict[str, Any]:
        """Return how views are drawn and compared, JSON-able."""
        return {
            "samples_per_pixel": self.samples**2,
            "antialiased": self.raster.antialiased,
            "low_pass": self.raster.low_pass,
            "relighters": list(self.renderers),
            "background": "black",
            "region": "bounding box of the truth's alpha above 0.5; solid: alpha above 0.999",
            "color_encoding": "sRGB, cut to [0, 1]",
        }


def overlap(one: NDArray[np.float32], two: NDArray[np.float32]) -> float:
    """Return the coverage that two images share, over what either covers, in [0, 1]."""
    covered = float(np.maximum(one, two).sum())
    return float(np.minimum(one, two).sum()) / covered if covered > 0.0 else 0.0
