"""How good the materials of an asset are, against the exact channels of a capture: every view, and over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.matching import match_frames, scored_frames
from beam_warp.checks import require_count
from beam_warp.errors import InvalidOptionError, MissingFileError
from beam_warp.evaluate.drawn import SAMPLES, DrawnMaterials, draw_materials
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.evaluate.relighters import RELIGHTERS, Relighter
from beam_warp.evaluate.steadiness import TemporalScores, gaussian_deviation, surface_scores
from beam_warp.image.files import Image
from beam_warp.image.metrics import SOLID_ALPHA, Compared, angles_between, as_compared, least_squares_scale
from beam_warp.raster.channels import MATERIAL_CHANNELS
from beam_warp.raster.records import RasterOptions
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.shot import RenderedImage, Renderer, Shot

LEAST_OVERLAP = 0.5
"""Coverage of asset and truth in common, over what either covers, below which they are not of the same thing. Measured
with a walking person of 320 x 320 pixels: .98 as it should be, .86 when 2 cm aside, .82 one frame and .59 five frames
off, .45 turned by a quarter, .03 lying."""

GOOD_OVERLAP = 0.8
"""Below this overlap something is said."""

Progress = Callable[[str, int, int], None]
"""Called with (stage, done, total)."""

Scales = tuple[float, float, float]


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
class ViewScores:
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
            "normals_median_degrees": self.normals_median_degrees,
            "normals_mean_degrees": self.normals_mean_degrees,
            "depth_median_mm": self.depth_median_mm,
            "overlap": self.overlap,
        }


@dataclass(frozen=True)
class MaterialScores:
    """How good an asset is.

    Attributes:
        views: One by one, in the order of frames.
        base_color_scale: Factor per channel that best carries base colour to the truth, by least squares over the
            solid pixels of all views and frames; None without truth.
        frame_scales: The same for every frame by itself.
        temporal: How steady base colour is.
        conditions: How it was measured, JSON-able.
        absent: What could not be measured, by name, and why.
        notes: What a reader should know, each a sentence.
    """

    views: tuple[ViewScores, ...]
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
        """Return the mean over views of an attribute of `ViewScores`; None where no view has it."""
        values = [value for view in self.views if (value := getattr(view, name)) is not None]
        return float(np.mean(values)) if values else None

    @property
    def mean_view_scale(self) -> Scales | None:
        """The mean over views of each view's own scale."""
        scales = [view.base_color_scale for view in self.views if view.base_color_scale is not None]
        return _triple(np.mean(scales, axis=0)) if scales else None

    @property
    def scale_deviation(self) -> Scales | None:
        """Standard deviation of the scale over frames: flicker of the whole; None with fewer than two frames."""
        if len(self.frame_scales) < 2:
            return None
        return _triple(np.std(list(self.frame_scales.values()), axis=0))

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
            **{
                name: self.mean(name)
                for name in ("normals_median_degrees", "normals_mean_degrees", "depth_median_mm", "overlap")
            },
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


@dataclass(frozen=True, eq=False)
class ScoredView:
    """What a view's scores were made of, unscaled.

    Attributes:
        record: Of the capture.
        truth: Its exact channels.
        drawn: Ours.
        relit: By relighter, then by light: ours.
        scores: What came of it, without those that need the scale.
    """

    record: CaptureRecord
    truth: Image
    drawn: DrawnMaterials
    relit: Mapping[str, Mapping[str, RenderedImage]]
    scores: ViewScores


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
    progress: Progress | None = None,
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
    drawn = raster or stated_raster(sequence.metadata)
    made = {"deferred": RELIGHTERS["deferred"]} if relighters is None else relighters
    job = _Job(
        sequence=sequence,
        capture=capture,
        matched=match_frames(sequence, frames),
        split=split,
        raster=drawn,
        samples=samples,
        renderers={name: make(drawn, samples, device) for name, make in made.items()},
        metrics=metrics or PerceptualMetrics.installed(),
        device=device,
        progress=progress or _quiet,
    )
    return job.run(scaled_relighting, observe or _ignore)


def stated_raster(metadata: Mapping[str, str]) -> RasterOptions:
    """Return how an asset says that its Gaussians are to be drawn; the defaults where it says nothing.

    Raises:
        InvalidOptionError: It says something else than a filter.
    """
    antialiased, low_pass = metadata.get("raster_antialiased", "false"), metadata.get("raster_low_pass", "0.3")
    try:
        return RasterOptions(antialiased={"true": True, "false": False}[antialiased], low_pass=float(low_pass))
    except (KeyError, ValueError) as error:
        raise InvalidOptionError(
            f"raster_antialiased and raster_low_pass must be true or false and a number, got {antialiased!r} and "
            f"{low_pass!r} in the asset's metadata. State them anew."
        ) from error


class _ScaleSums:
    """Sums for the factor that best carries base colour to its truth."""

    def __init__(self) -> None:
        self._products, self._squares = np.zeros(3), np.zeros(3)

    def add(self, image: NDArray[np.floating[Any]], truth: NDArray[np.floating[Any]]) -> None:
        """Take colours ``(N, 3)``."""
        a, b = np.asarray(image, np.float64), np.asarray(truth, np.float64)
        self._products += (a * b).sum(axis=0)
        self._squares += (a * a).sum(axis=0)

    def join(self, other: _ScaleSums) -> None:
        """Take what another one has."""
        self._products += other._products
        self._squares += other._squares

    def scale(self) -> Scales:
        """Return the factors; 1 where all is black."""
        return _triple(np.divide(self._products, self._squares, out=np.ones(3), where=self._squares > 0.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Job:
    """One call of `score_materials`."""

    sequence: GaussianSequence
    capture: Capture
    matched: Mapping[int, int]
    split: str
    raster: RasterOptions
    samples: int
    renderers: Mapping[str, Renderer]
    metrics: PerceptualMetrics
    device: str | None
    progress: Progress

    def run(self, scaled_relighting: bool, observe: Observer) -> MaterialScores:
        """Score every view, then once more with the scale, then over time."""
        frames = scored_frames(self.capture, self.matched, split=self.split)
        records = [record for frame in frames for record in self._records(frame)]
        lights = self._lights(records)
        self._require_overlap(frames[0])
        views: list[ViewScores] = []
        total, by_frame = _ScaleSums(), {}
        for frame in frames:
            sums = _ScaleSums()
            for scored in self._frame(frame, lights, sums):
                views.append(scored.scores)
                observe(scored)
                self.progress("score views", len(views), len(records))
            by_frame[frame] = sums
            total.join(sums)
        colored = any(view.base_color_scale is not None for view in views)
        scale = total.scale() if colored else None
        if scale is not None:
            views = self._with_scale(views, scale, lights if scaled_relighting else {})
        return MaterialScores(
            views=tuple(views),
            base_color_scale=scale,
            frame_scales={frame: sums.scale() for frame, sums in by_frame.items()} if colored else {},
            temporal=self._temporal(),
            conditions=self._conditions(frames),
            absent=self._absent(views, lights),
            notes=self._notes(frames, views),
        )

    def _records(self, frame: int) -> list[CaptureRecord]:
        selected = self.capture.select(split=self.split, frames={frame})
        return [record for record in selected if record.truth_path is not None]

    def _lights(self, records: Sequence[CaptureRecord]) -> dict[str, EnvironmentMap]:
        """Read every light that a record is known under."""
        if not self.renderers:
            return {}
        names = dict.fromkeys(name for record in records for name in record.relit_paths)
        paths = {name: self.capture.folder / "truth" / f"{name}.exr" for name in names}
        for name, path in paths.items():
            if not path.is_file():
                raise MissingFileError(
                    f"light must be a file, got none at {path}, though {name!r} is among the capture's relit images. "
                    "Put it there."
                )
        return {name: EnvironmentMap.read(path) for name, path in paths.items()}

    def _cloud(self, frame: int) -> GaussianCloud:
        """Read the frame of the asset that shows one of the capture's."""
        cloud = self.sequence[self.matched[frame]]
        missing = [name for name in MATERIAL_CHANNELS if getattr(cloud, name) is None]
        if missing:
            raise InvalidOptionError(
                f"asset must be relightable, got one without {', '.join(missing)} in frame {self.matched[frame]}. "
                "Estimate its materials with beam run."
            )
        return change_axes(cloud, WORLD_AXES)

    def _frame(self, frame: int, lights: Mapping[str, EnvironmentMap], sums: _ScaleSums) -> Iterator[ScoredView]:
        """Draw, relight and score the views of a frame."""
        cloud, records = self._cloud(frame), self._records(frame)
        relit = self._relit(cloud, records, lights)
        for index, record in enumerate(records):
            drawn = draw_materials(
                cloud,
                record.camera,
                radiance=cloud.radiance is not None,
                raster=self.raster,
                samples=self.samples,
                device=self.device,
            )
            images = {
                name: {light: views[index] for light, views in by_light.items() if light in record.relit_paths}
                for name, by_light in relit.items()
            }
            truth = record.truth()
            yield ScoredView(record, truth, drawn, images, self._score(record, truth, drawn, images, sums))

    def _relit(
        self, cloud: GaussianCloud, records: Sequence[CaptureRecord], lights: Mapping[str, EnvironmentMap]
    ) -> dict[str, dict[str, list[RenderedImage]]]:
        """Relight a cloud in every way, under every light, for every record."""
        return {
            name: {
                light: [
                    renderer.draw(Shot(cloud=cloud, camera=record.camera, environment=environment))
                    for record in records
                ]
                for light, environment in lights.items()
            }
            for name, renderer in self.renderers.items()
        }

    def _score(
        self,
        record: CaptureRecord,
        truth: Image,
        drawn: DrawnMaterials,
        relit: Mapping[str, Mapping[str, RenderedImage]],
        sums: _ScaleSums,
    ) -> ViewScores:
        """Score one view, and take its base colour into the sums of its frame."""
        truth_alpha = truth.channels["A"]
        solid = truth_alpha > SOLID_ALPHA
        both = {"alpha": drawn.alpha, "truth_alpha": truth_alpha}
        channels: dict[str, ImageScore] = {}
        scale = None
        for name in ("ambient_occlusion", "base_color", "roughness"):
            known = true_channel(truth, name)
            if known is None:
                continue
            is_color = known.ndim == 3
            compared = as_compared(drawn.channels[name], known, is_color=is_color, premultiplied=False, **both)
            channels[name] = ImageScore.of(compared, self.metrics)
            if is_color:
                scale = _triple(least_squares_scale(drawn.channels[name], known, solid))
                sums.add(drawn.channels[name][solid], known[solid])
        if drawn.radiance is not None:
            image = record.image().linear_rgba()[..., :3]
            channels["novel_view"] = ImageScore.of(
                as_compared(drawn.radiance, image, is_color=True, premultiplied=True, **both), self.metrics
            )
        normals, depth = true_channel(truth, "normals"), true_channel(truth, "depth")
        angles = None if normals is None else angles_between(drawn.channels["normals"][solid], normals[solid])
        return ViewScores(
            name=record.name,
            frame=record.frame,
            channels=channels,
            relit=self._score_relit(record, truth_alpha, relit),
            relit_scaled={},
            base_color_scale=scale,
            normals_median_degrees=None if angles is None else float(np.median(angles)),
            normals_mean_degrees=None if angles is None else float(angles.mean()),
            depth_median_mm=None
            if depth is None
            else 1e3 * float(np.median(np.abs(drawn.depth[solid].astype(np.float64) - depth[solid]))),
            overlap=_overlap(drawn.alpha, truth_alpha),
        )

    def _score_relit(
        self,
        record: CaptureRecord,
        truth_alpha: NDArray[np.float32],
        relit: Mapping[str, Mapping[str, RenderedImage]],
    ) -> dict[str, dict[str, ImageScore]]:
        """Score one view under every light."""
        lights = dict.fromkeys(light for by_light in relit.values() for light in by_light)
        known = {light: record.relit(light).linear_rgba()[..., :3] for light in lights}
        return {
            name: {
                light: ImageScore.of(
                    as_compared(
                        image.rgb,
                        known[light],
                        alpha=image.alpha,
                        truth_alpha=truth_alpha,
                        is_color=True,
                        premultiplied=True,
                    ),
                    self.metrics,
                )
                for light, image in by_light.items()
            }
            for name, by_light in relit.items()
        }

    def _require_overlap(self, frame: int) -> None:
        """Refuse an asset that stands elsewhere than the subject, before much is done with it."""
        cloud = self._cloud(frame)
        overlaps = []
        for record in self._records(frame):
            drawn = draw_materials(cloud, record.camera, channels=(), raster=self.raster, samples=1, device=self.device)
            overlaps.append(_overlap(drawn.alpha, record.truth().channels["A"]))
        overlap = float(np.mean(overlaps))
        if not overlap >= LEAST_OVERLAP:
            raise InvalidOptionError(
                f"asset must stand where the capture shows its subject, got {overlap:.0%} of their coverage in common "
                f"in frame {frame}. Check the axes (--source-axes of a PLY), the units, and which frames it shows "
                "(--capture-frames)."
            )

    def _with_scale(
        self, views: Sequence[ViewScores], scale: Scales, lights: Mapping[str, EnvironmentMap]
    ) -> list[ViewScores]:
        """Score base colour once more, scaled, and relighting with it if lights are given."""
        found: dict[str, tuple[ImageScore, dict[str, dict[str, ImageScore]]]] = {}
        for frame in dict.fromkeys(view.frame for view in views):
            cloud, records = self._cloud(frame), self._records(frame)
            scaled_color = np.clip(cloud.base_color * np.asarray(scale, np.float32), 0.0, 1.0)  # type: ignore[operator]
            relit = self._relit(cloud.with_arrays(base_color=scaled_color), records, lights) if lights else {}
            for index, record in enumerate(records):
                drawn = draw_materials(
                    cloud,
                    record.camera,
                    channels=("base_color",),
                    raster=self.raster,
                    samples=self.samples,
                    device=self.device,
                )
                truth = record.truth()
                compared = as_compared(
                    drawn.channels["base_color"] * np.asarray(scale),
                    true_channel(truth, "base_color"),  # type: ignore[arg-type]  # a scale was found from it
                    alpha=drawn.alpha,
                    truth_alpha=truth.channels["A"],
                    is_color=True,
                    premultiplied=False,
                )
                images = {
                    name: {light: shown[index] for light, shown in by_light.items() if light in record.relit_paths}
                    for name, by_light in relit.items()
                }
                found[record.name] = (
                    ImageScore.of(compared, self.metrics),
                    self._score_relit(record, truth.channels["A"], images),
                )
                self.progress("score views, scaled", len(found), len(views))
        return [_scaled(view, *found[view.name]) for view in views]

    def _temporal(self) -> TemporalScores:
        """Measure how steady base colour is."""
        numbers = [number for number, _ in sorted(self.matched.items(), key=lambda pair: pair[1])]
        gaussians = gaussian_deviation(self.sequence, numbers)
        surface = surface_scores(
            self.sequence,
            self.capture,
            self.matched,
            split=self.split,
            raster=self.raster,
            samples=self.samples,
            device=self.device,
            progress=lambda done, total: self.progress("score over time", done, total),
        )
        absent = {
            name: found for name, found in (("gaussians", gaussians), ("surface", surface)) if isinstance(found, str)
        }
        return TemporalScores(
            None if isinstance(gaussians, str) else gaussians, None if isinstance(surface, str) else surface, absent
        )

    def _conditions(self, frames: Sequence[int]) -> dict[str, Any]:
        return {
            "frames": list(frames),
            "split": self.split,
            "samples_per_pixel": self.samples**2,
            "antialiased": self.raster.antialiased,
            "low_pass": self.raster.low_pass,
            "relighters": list(self.renderers),
            "background": "black",
            "region": "bounding box of the truth's alpha above 0.5; solid: alpha above 0.999",
            "color_encoding": "sRGB, cut to [0, 1]",
        }

    def _absent(self, views: Sequence[ViewScores], lights: Mapping[str, EnvironmentMap]) -> dict[str, str]:
        """Say what was not measured."""
        absent = dict(self.metrics.absent)
        if not any("novel_view" in view.channels for view in views):
            absent["novel_view"] = "the asset has no captured radiance"
        if not lights:
            absent["relit"] = "no relighter was chosen" if not self.renderers else "the capture has no relit images"
        return absent

    def _notes(self, frames: Sequence[int], views: Sequence[ViewScores]) -> tuple[str, ...]:
        """Say what a reader should know."""
        notes = []
        known = {record.frame for record in self.capture.select(split=self.split) if record.truth_path is not None}
        if left := sorted(known - set(frames)):
            notes.append(f"the asset does not show frames whose truth is known: {', '.join(map(str, left))}")
        overlap = float(np.mean([view.overlap for view in views]))
        if overlap < GOOD_OVERLAP:
            notes.append(f"only {overlap:.0%} of the coverage of asset and truth is in common: check axes and frames")
        return tuple(notes)


def true_channel(truth: Image, name: str) -> NDArray[np.float32] | None:
    """Return an exact channel by the name of a cloud's array, or ``depth``; None where the file lacks it."""
    layers = {
        "base_color": ("base_color.R", "base_color.G", "base_color.B"),
        "normals": ("normal.X", "normal.Y", "normal.Z"),
    }.get(name, (name,))
    if any(layer not in truth.channels for layer in layers):
        return None
    return truth.stack(*layers) if len(layers) > 1 else truth.channels[name]


def _overlap(one: NDArray[np.float32], two: NDArray[np.float32]) -> float:
    """Return the coverage that two images share, over what either covers."""
    covered = float(np.maximum(one, two).sum())
    return float(np.minimum(one, two).sum()) / covered if covered > 0.0 else 0.0


def _scaled(view: ViewScores, base_color: ImageScore, relit: Mapping[str, Mapping[str, ImageScore]]) -> ViewScores:
    return replace(view, channels={**view.channels, "base_color_scaled": base_color}, relit_scaled=relit)


def _triple(values: NDArray[np.floating[Any]]) -> Scales:
    red, green, blue = (float(value) for value in values)
    return red, green, blue


def _means(views: Sequence[Mapping[str, ImageScore]]) -> dict[str, ImageScore]:
    """Return by name the mean of the scores of that name."""
    names = dict.fromkeys(name for view in views for name in view)
    return {name: ImageScore.mean([view[name] for view in views if name in view]) for name in names}


def _as_records(scores: Mapping[str, Mapping[str, ImageScore]]) -> dict[str, dict[str, dict[str, float]]]:
    return {name: {light: score.as_dict() for light, score in lights.items()} for name, lights in scores.items()}


def _quiet(stage: str, done: int, total: int) -> None:
    """Report to nobody."""


def _ignore(view: ScoredView) -> None:
    """Keep nothing."""
