"""What visibility costs and how wrong it is on given Gaussians and device: the tracing study of ``beam chart``."""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from beam_warp._version import __version__
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.image.metrics import root_mean_square
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.kernels.common.launching import thread_count
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.study.table import Axis, Interval, Metric, Row, Settings, Study, StudySubject
from beam_warp.study.tracing_plan import DEFAULT_PLAN, TracingPlan
from beam_warp.study.tracing_truth import References, find_references
from beam_warp.trace.incident import irradiance
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.rays import LIFT_IN_THICKNESSES
from beam_warp.trace.reference import visibility_reference
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import TraceOptions, visibility
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud

RAYS_PER_CALL = {False: 1 << 15, True: 1 << 23}
"""A timed call on a CPU or on CUDA traces at least so many rays, so that what is timed is rays and not launches."""

FLOAT64_GAUSSIANS = 50_000
FLOAT64_RAYS = 256
"""Up to so many Gaussians, the tracer is also checked ray by ray against the float64 twin: a few seconds."""


def tracing_study(
    cloud: GaussianCloud,
    environment: EnvironmentMap,
    plan: TracingPlan = DEFAULT_PLAN,
    *,
    name: str = "Gaussians",
    environment_name: str = "environment",
    device: str | None = None,
    references_file: Path | None = None,
    reference_seconds: float = np.inf,
    progress: StageProgress = no_progress,
) -> Study:
    """Prepare the tracing study: scenes, points, normals and references; measuring is left to `run_study`.

    Errors are over points. Each is against the truth of its own offset, so that it falls with rays to nothing: it is
    the estimator's. How far the truth of an offset lies from that of the finest one, which no number of rays mends, is
    a metric of its own.

    Args:
        cloud: Gaussians, axes "rfu" if the environment is to be upright; its normals are used if it has some.
        environment: Light for irradiance.
        plan: What to measure.
        name: What to call the Gaussians.
        environment_name: What to call the light.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        references_file: Where references are kept for another run; None keeps none.
        reference_seconds: Fewer points are taken where references would take longer.
        progress: Called with (stage, done, total) while references are traced.

    Raises:
        InvalidArrayError: Fewer than two Gaussians can be seen.
        DeviceError: There is no such device.
        OutputError: ``references_file`` cannot be written.
    """
    target = resolve_device(device)
    scene = Scene.from_gaussians(cloud, str(target))
    references = find_references(
        cloud, environment, plan, scene, file=references_file, seconds=reference_seconds, progress=progress
    )
    bench = _Bench(plan, references, scene, PreparedEnvironment(environment, target), len(cloud))
    subject = StudySubject(
        name="tracing",
        title=f"Error against time of traced visibility: {name}, {len(cloud):,} Gaussians, {device_name(target)}",
        axes=axes_of(plan.axes(), plan.rays, "Rays per point.", SENTENCES),
        metrics=bench.metrics(environment_name),
        cost=f"Time for all {len(cloud):,} Gaussians",
        cost_unit="s",
        ladder="rays",
        notes={
            "Points": f"{len(references.points):,} of {len(cloud):,} Gaussians, at random; normals "
            f"{'as given' if cloud.normals is not None else 'estimated'}; mean ambient occlusion "
            f"{references.occlusion[0].mean():.3f}",
            "References": f"{plan.reference_rays:,} Owen-scrambled rays a point, product acceptance",
            "Tracer against float64": check_against_float64(cloud, references, scene, plan.seed),
            "Light": environment_name,
            "Mean lift by offset": ", ".join(
                f"{offset}: {1e3 * references.lift_lengths(offset).mean():.3g} mm" for offset in plan.offsets
            ),
            "Time": f"median of {plan.repeats} calls of at least {RAYS_PER_CALL[target.is_cuda]:,} rays, bars from "
            "smallest to largest; without compilation and preparing scene and light; scaled to all Gaussians",
            "Error bars": "95 %, bootstrap over points",
            "Plan": _plan_note(plan),
            "Versions": f"beam-warp {__version__}, Warp {wp.__version__}",
        },
    )
    # Both estimates in turn, so that a budget cuts both
    lists = plan.occlusion_settings(), plan.irradiance_settings()
    curves = [settings[k] for k in range(max(map(len, lists))) for settings in lists if k < len(settings)]
    settings: list[Settings] = [{"rays": rays, **curve} for curve in curves for rays in plan.rays]
    # One cheap setting of every offset comes right after the default curves: it brings that offset's bias
    shifted = [each for each in settings if each["offset"] != plan.offsets[0] and each["rays"] == plan.rays[0]]
    begin = len(plan.rays) * 2
    ordered = settings[:begin] + shifted + [each for each in settings[begin:] if each not in shifted]
    return Study(subject, ordered, bench.measure, bench.work)


SENTENCES = {
    "acceptance": "product: transmittances multiply, exact. bernoulli: every hit blocks by chance, unbiased.",
    "sampler": "owen: scrambled Sobol' points. stratified: one random point a stratum. iid: independent points.",
    "density": "product: light times cosine. environment: light. cosine. mis: half cosine, half light, balanced.",
    "ratio": "ratio: exact unshadowed irradiance times a ratio of two estimates. plain: one estimate.",
    "offset": "Lift of ray origins: metres, or t, standard deviations of the local thickness; "
    f"auto is {LIFT_IN_THICKNESSES:g}t.",
}
"""What the levels of each factor mean."""


def axes_of(
    levels: Mapping[str, tuple[str, ...]], rays: tuple[int, ...], meaning: str, sentences: Mapping[str, str]
) -> tuple[Axis, ...]:
    """Return the factors of a study: its rays, which mean this, and all others in words."""
    named = (Axis(name, name.capitalize(), values, "", sentences[name]) for name, values in levels.items())
    return (Axis("rays", "Rays", rays, "rays", meaning), *named)


def _plan_note(plan: TracingPlan) -> str:
    """Say which part of the full product the plan is."""
    whole = replace(plan, crossing="full")
    planned, full = (
        len(plan.rays) * (len(each.occlusion_settings()) + len(each.irradiance_settings())) for each in (plan, whole)
    )
    if planned == full:
        return f"the full product, {full:,} settings"
    return (
        f"{planned:,} of the full product's {full:,} settings: one or two factors at a time around the defaults, the "
        "first level of each axis"
    )


def device_name(device: Any) -> str:
    """Return a device in words: the GPU's name, or the processor's and how many threads are used."""
    if device.is_cuda:
        return device.name
    name = platform.processor() or platform.machine() or "CPU"
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                name = line.partition(":")[2].strip()
                break
    except (OSError, UnicodeDecodeError):
        pass  # no such file outside Linux
    count = thread_count()
    return f"{name} ({count} thread{'s' if count > 1 else ''})"


def check_against_float64(cloud: GaussianCloud, references: References, scene: Scene, seed: int) -> str:
    """Return in words how far single rays are off the float64 twin."""
    if len(cloud) > FLOAT64_GAUSSIANS:
        return f"not checked, more than {FLOAT64_GAUSSIANS:,} Gaussians"
    report = scene.report
    if report.raised_scales or report.not_finite:
        return f"not checked, {report.raised_scales + report.not_finite:,} Gaussians were mended for tracing"
    generator = np.random.default_rng(seed)
    rows = generator.integers(len(references.points), size=FLOAT64_RAYS)
    normals = references.normals[rows]
    directions = generator.normal(size=(FLOAT64_RAYS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions *= np.where(np.einsum("nk,nk->n", directions, normals) < 0.0, -1.0, 1.0)[:, None]
    directions = directions.astype(np.float32)
    origins = references.points[rows] + normals * references.lift_lengths("auto")[rows, None]
    truth = visibility_reference(cloud, origins, directions)
    worst = np.abs(visibility(scene, origins, directions) - truth).max()
    return f"largest error of {FLOAT64_RAYS} rays: {worst:.1e}"


class _Bench:
    """Everything that settings are measured on."""

    def __init__(
        self, plan: TracingPlan, references: References, scene: Scene, light: PreparedEnvironment, count: int
    ) -> None:
        """Keep what is measured on; ``count`` is the number of Gaussians that times are scaled to."""
        self.plan, self.references, self.scene, self.light, self.count = plan, references, scene, light, count
        self.device = light.device
        self.truth = dict(zip(plan.offsets, references.occlusion.astype(np.float64), strict=True))
        self.finest = min(plan.offsets, key=lambda offset: float(references.lift_lengths(offset).mean()))
        self.mean_light = max(float(references.light.mean(dtype=np.float64)), 1e-30)

    def metrics(self, environment_name: str) -> tuple[Metric, ...]:
        """Return the errors of the study."""
        rays = f"{self.plan.reference_rays:,} rays"
        return (
            Metric(
                "occlusion_error",
                "RMS error of ambient occlusion",
                color="sampler",
                marker="acceptance",
                apart="offset",
                floor=root_mean_square(self.references.occlusion_error),
                sentence=f"Against {rays} from the same offset: noise, which more rays remove.",
            ),
            Metric(
                "irradiance_error",
                "RMS error of irradiance, relative to its mean",
                color="density",
                marker="ratio",
                line="acceptance",
                floor=root_mean_square(self.references.light_error) / self.mean_light,
                sentence=f"Against {rays} from the same offset, over points and channels; light: {environment_name}.",
            ),
            Metric(
                "offset_bias",
                f"RMS shift of ambient occlusion by the offset, against {self.finest}",
                by="offset",
                sentence=f"How far each offset's own truth lies from that of the finest, {self.finest}; rays do not "
                "remove it. Too small an offset shades itself, too large a one leaks light: neither is the truth.",
            ),
        )

    def _copies(self, settings: Settings) -> int:
        """Return how often the points are repeated in a call; each copy has samples of its own."""
        rays = len(self.references.points) * int(settings["rays"])
        return max(1, -(-RAYS_PER_CALL[self.device.is_cuda] // rays))

    def work(self, settings: Settings) -> int:
        """Return the number of rays that a setting's measurement traces."""
        return len(self.references.points) * int(settings["rays"]) * self._copies(settings) * self.plan.repeats

    def measure(self, settings: Settings) -> Row:
        """Time a setting, and compare what it gives with the references."""
        copies, offset = self._copies(settings), str(settings["offset"])
        at, lift = self.references.lifted(offset)
        points, normals = (
            upload(np.tile(array, (copies, 1)), wp.vec3, self.device) for array in (at, self.references.normals)
        )
        scene = self.scene
        common: dict[str, Any] = {
            "sample_count": settings["rays"],
            "sampler": settings["sampler"],
            "offset": lift,
            "options": TraceOptions(acceptance=settings["acceptance"]),  # type: ignore[arg-type]
        }
        is_light = "density" in settings
        if is_light:
            common |= {"density": settings["density"], "ratio": settings["ratio"] == "ratio"}
            truth = self.references.light.astype(np.float64) / self.mean_light
        else:
            truth = self.truth[offset][:, None]

        def estimate(at: wp.array, up: wp.array, seed: int) -> wp.array:
            if is_light:
                return irradiance(scene, at, up, self.light, seed=seed, **common).value
            return ambient_occlusion(scene, at, up, seed=seed, **common).visibility

        estimate(points[:1], normals[:1], 0)  # compiles what is not compiled yet
        seconds, squares = [], np.zeros(len(at))
        for repeat in range(self.plan.repeats):
            wp.synchronize_device(self.device)
            started = time.perf_counter()
            result = estimate(points, normals, repeat)
            wp.synchronize_device(self.device)
            seconds.append((time.perf_counter() - started) / len(points) * self.count)
            found = result.numpy().astype(np.float64).reshape(copies, len(at), -1)
            found /= self.mean_light if is_light else 1.0
            squares += np.square(found - truth).mean(axis=(0, 2)) / self.plan.repeats
        errors = {"irradiance_error" if is_light else "occlusion_error": Interval.of_root_mean_square(squares)}
        if not is_light:
            errors["offset_bias"] = Interval.of_root_mean_square(
                np.square(self.truth[offset] - self.truth[self.finest])
            )
        return Row(settings, Interval.of_median(seconds), errors)
