"""The materials study of ``beam chart``: the cost and error of decomposing a given capture on a given device."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp._version import __version__
from beam_warp.capture.capture import Capture
from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.image.color import LINEAR_REC709
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.base_color import fill_from_neighbors, solve_base_color
from beam_warp.materials.direct import measure_materials
from beam_warp.materials.evidence import ViewEvidence, view_evidence
from beam_warp.materials.images import ImagePathOptions, decompose_by_images
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.normals import SurfacePoints
from beam_warp.raster.records import RasterOptions
from beam_warp.study.materials_plan import MaterialsPlan
from beam_warp.study.materials_truth import COLOR, OCCLUSION, ManyRays, Reference, TrueViews
from beam_warp.study.table import Interval, Metric, Row, Settings, Study, StudySubject
from beam_warp.study.tracing import SENTENCES, axes_of, device_name
from beam_warp.study.tracing_plan import parse_offset
from beam_warp.study.true_surface import SHARP, surface_of_capture
from beam_warp.trace.scene import Scene
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0

GAUSSIANS = {False: 4000, True: 60_000}
"""Number of Gaussians on the true surface of a capture that comes without a reconstruction, by whether on CUDA."""

ROUGHNESS = 0.5
"""Roughness of Gaussians that have none."""

BAKING_RAYS = 64
"""Rays a pixel that take about as long as drawing and baking."""

REFERENCE_SEED = 1 << 31
"""References draw other samples than every measurement, whose seeds count up from 0."""


@dataclass(frozen=True, eq=False)
class MaterialsSubject:
    """The frame of a capture that is decomposed.

    Attributes:
        cloud: Gaussians with captured radiance, axes "rfu".
        views: Photographs, scene-linear.
        environment: The light of the capture.
        raster: Options under which the Gaussians were fitted.
        capture: The capture, which may have truth.
        frame: Number of the frame in the capture.
        name: Name of the subject in the chart's title.
        ceiling: Largest value that the images can hold.
    """

    cloud: GaussianCloud
    views: Sequence[CapturedView]
    environment: EnvironmentMap
    raster: RasterOptions
    capture: Capture
    frame: int
    name: str
    ceiling: float = float("inf")

    @classmethod
    def on_true_surface(
        cls, capture: Capture, environment: EnvironmentMap, frame: int, name: str, device: str | None
    ) -> MaterialsSubject:
        """Take Gaussians on the true surface of a capture's frame, with colours solved from its images.

        Raises:
            MissingFileError: The capture has no true surface.
        """
        count = GAUSSIANS[resolve_device(device).is_cuda]
        cloud, views = surface_of_capture(capture, frame, count, options=SHARP, device=device)
        return cls(cloud, views, environment, SHARP, capture, frame, name)


def materials_study(
    subject: MaterialsSubject, plan: MaterialsPlan | None = None, *, device: str | None = None
) -> Study:
    """Prepare the materials study: scene, light, what views show, and the reference of its errors.

    With exact channels in the capture's test views, errors are against the truth: noise, what the method leaves out,
    and the error of the reconstruction together. Without, they are against many rays with the default settings.

    Args:
        subject: What is decomposed.
        plan: Settings to measure; None takes all.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        DeviceError: There is no such device.
        InvalidArrayError: The Gaussians have no radiance, or the truth shows no subject.
    """
    chosen, target = plan or MaterialsPlan(), resolve_device(device)
    bench = _Bench(subject, chosen, target)
    rays = "Rays a Gaussian; a pixel's for occlusion, and twice for light."
    described = StudySubject(
        name="materials",
        title=f"Error against time of materials: {subject.name}, {len(subject.cloud):,} Gaussians",
        axes=axes_of(chosen.axes(), chosen.rays, rays, _SENTENCES),
        metrics=(
            Metric(
                OCCLUSION,
                "RMS error of ambient occlusion",
                color="offset",
                marker="path",
                line="sampler",
                sentence=f"Against {bench.reference.note}.",
            ),
            Metric(
                COLOR,
                "RMS error of base colour, sRGB-encoded",
                color="density",
                marker="path",
                line="bounce",
                sentence=f"Against {bench.reference.note}; unscaled.",
            ),
        ),
        cost=f"Time of a frame of {len(subject.views)} views, {len(subject.cloud):,} Gaussians",
        cost_unit="s",
        ladder="rays",
        notes={
            "Reference": bench.reference.note,
            "Time": f"fastest to slowest of {chosen.repeats} calls, from images and Gaussians in memory to materials; "
            "without compilation and preparing the light",
            "Device": device_name(target),
            "Error bars": "95 %, bootstrap over blocks of pixels or Gaussians",
            "Plan": "one factor at a time around the defaults, the first level of each axis; density and ratio crossed",
            "Versions": f"beam-warp {__version__}, Warp {wp.__version__}",
        },
    )
    curves = chosen.settings()
    return Study(described, [{"rays": n, **curve} for curve in curves for n in chosen.rays], bench.measure, bench.work)


_SENTENCES = {
    **SENTENCES,
    "path": "direct: rays from every Gaussian. images: rays from every pixel of every view, baked.",
    "offset": "Lift of ray origins: auto, none among Gaussians that face the ray, or metres.",
    "ratio": "ratio: exact unshadowed light times a ratio of two estimates. plain: one estimate.",
    "bounce": "Light from other surfaces, by their captured radiance.",
    "weight": "What the specular lobe leaves for diffusion.",
    "fit": "together: as pixels blend all Gaussians; robust: each by itself, views that disagree count little.",
    "observed": "difference: fitted radiance plus what images show beside it. images: images spread back.",
    "denoiser": "Of the path by images; auto is Open Image Denoise where it is installed.",
}


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Evidence and points that settings of one offset and kind of observation share, and the time to make them [s]."""

    evidence: ViewEvidence
    points: SurfacePoints
    seconds: float


class _Bench:
    """The subject, light and reference on which settings are measured."""

    def __init__(self, subject: MaterialsSubject, plan: MaterialsPlan, device: Any) -> None:
        """Prepare the light and the reference."""
        self.subject, self.plan, self.device = subject, plan, device
        self.light = PreparedEnvironment(subject.environment, device)
        self._compiled: set[str] = set()
        rough = subject.cloud.roughness
        self.roughness = np.full(len(subject.cloud), ROUGHNESS, np.float32) if rough is None else rough
        self._prepared: dict[tuple[str, str], _Prepared] = {}
        self.reference = self._find_reference()

    def _find_reference(self) -> Reference:
        subject = self.subject
        test = subject.capture.select(split="test", frames={subject.frame})
        true = [record for record in test if record.truth_path is not None]
        if true:
            return TrueViews(subject.cloud, true, subject.raster, device=str(self.device))
        default = MaterialsPlan().settings()[0]
        found = self._direct({**default, "rays": self.plan.reference_rays}, REFERENCE_SEED)
        prepared = self._prepare("difference", "auto")
        return ManyRays(*found, prepared.points.seen, self.plan.reference_rays)

    def work(self, settings: Settings) -> int:
        """Return about how many rays a setting's measurement traces."""
        rays = int(settings["rays"])
        if settings["path"] == "direct":
            return 2 * rays * len(self.subject.cloud) * self.plan.repeats
        pixels = sum(
            view.camera.width * view.camera.height if view.alpha is None else int((view.alpha > 0.5).sum())
            for view in self.subject.views
        )
        return 3 * (rays + BAKING_RAYS) * pixels * self.plan.repeats

    def measure(self, settings: Settings) -> Row:
        """Time a setting, and compare what it gives with the reference."""
        direct = settings["path"] == "direct"
        run = self._direct if direct else self._by_images
        key = str({name: level for name, level in settings.items() if name not in ("rays", "offset")})
        if key not in self._compiled:
            run({**settings, "rays": 4}, 0)  # compiles what is not compiled yet
            self._compiled.add(key)
        common = self._prepare(str(settings["observed"]), str(settings["offset"])).seconds if direct else 0.0
        seconds: list[float] = []
        squares: dict[str, list[NDArray[np.float64]]] = {}
        for repeat in range(self.plan.repeats):
            wp.synchronize_device(self.device)
            started = time.perf_counter()
            color, openness = run(settings, repeat)
            wp.synchronize_device(self.device)
            seconds.append(common + time.perf_counter() - started)
            for name, part in self.reference.squares(color, openness).items():
                squares.setdefault(name, []).append(part)
        errors = {name: Interval.of_root_mean_square(*np.mean(parts, axis=0).T) for name, parts in squares.items()}
        if not self._changes_occlusion(settings):
            del errors[OCCLUSION]
        return Row(settings, Interval.of_median(seconds), errors)

    def _changes_occlusion(self, settings: Settings) -> bool:
        """Return whether ambient occlusion is not that of a setting that is measured anyway."""
        axes = self.plan.axes()
        other = ("density", "ratio", "bounce", "weight", "fit", "observed")
        return all(settings[name] == axes[name][0] for name in other if name in settings)

    def _prepare(self, observed: str, offset: str) -> _Prepared:
        """Return what views show, made once and timed the second time: the first compiles."""
        key = observed, offset
        if key not in self._prepared:
            self._show(observed, offset)
            started = time.perf_counter()
            evidence, points = self._show(observed, offset)
            wp.synchronize_device(self.device)
            self._prepared[key] = _Prepared(evidence, points, time.perf_counter() - started)
        return self._prepared[key]

    def _show(self, observed: str, offset: str) -> tuple[ViewEvidence, SurfacePoints]:
        """Return what views show of the Gaussians, and the points that light is measured at."""
        subject, device = self.subject, str(self.device)
        kind, metres = parse_offset(offset)
        scene = Scene.from_gaussians(subject.cloud, device)
        evidence = view_evidence(
            without_color(subject.cloud) if observed == "images" else subject.cloud,
            [view.camera for view in subject.views],
            subject.views,
            options=subject.raster,
            ceiling=subject.ceiling,
            device=device,
        )
        lift: Any = "auto" if kind == "auto" else metres
        return evidence, SurfacePoints.seen_by(subject.cloud, evidence, scene, lift)

    def _direct(self, settings: Settings, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return base colour and ambient occlusion by the direct path."""
        cloud = self.subject.cloud
        prepared = self._prepare(str(settings["observed"]), str(settings["offset"]))
        options: dict[str, Any] = {
            "sample_count": settings["rays"],
            "light_error": 0.0,
            "sampler": settings["sampler"],
            "density": settings["density"],
            "ratio": settings["ratio"] == "ratio",
            "bounce": settings["bounce"] == "one",
            "diffuse_weight": settings["weight"],
            "robust": settings["fit"] != "plain",
            "blended": settings["fit"] == "together",
            "seed": seed,
        }
        measured = measure_materials(
            cloud,
            Scene.from_gaussians(cloud, str(self.device)),
            prepared.points,
            self.roughness,
            self.light,
            options=MaterialOptions(**options),
            views=prepared.evidence,
        )
        known = cloud.with_arrays(normals=_upright(prepared.points), normal_confidence=prepared.points.confidence)
        solved = solve_base_color(known, measured.evidence, self.light.mean_irradiance)
        openness, _ = fill_from_neighbors(
            cloud.positions,
            measured.ambient_occlusion[:, None],
            measured.ambient_occlusion_error[:, None],
            ~prepared.points.seen,
        )
        return solved.base_color, openness[:, 0].astype(np.float32)

    def _by_images(self, settings: Settings, seed: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return base colour and ambient occlusion by the image path."""
        subject = self.subject
        rays: Any = settings["rays"]
        denoiser: Any = settings["denoiser"]
        found = decompose_by_images(
            subject.cloud,
            Scene.from_gaussians(subject.cloud, str(self.device)),
            subject.views,
            self.roughness,
            self.light,
            ImagePathOptions(
                occlusion_samples=rays,
                light_samples=2 * rays,
                offset=parse_offset(str(settings["offset"]))[1],
                denoiser=denoiser,
                seed=seed,
            ),
            raster_options=subject.raster,
        )
        return found.base_color, found.ambient_occlusion


def without_color(cloud: GaussianCloud) -> GaussianCloud:
    """Return Gaussians that send out nothing: what is spread back of the difference is then the image itself."""
    black = np.full((len(cloud), 1, 3), -0.5 / SH_C0, np.float32)
    return cloud.with_arrays(radiance=black, radiance_color_space=LINEAR_REC709)


def _upright(points: SurfacePoints) -> NDArray[np.float32]:
    """Return unit normals, +z where there are none."""
    return np.where(points.seen[:, None], points.normals.numpy(), (0.0, 0.0, 1.0)).astype(np.float32)
