"""What visibility costs and how wrong it is on given Gaussians and device: the tracing study of ``beam chart``."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp._version import __version__
from beam_warp.assets import GaussianCloud
from beam_warp.charts import Axis, Interval, Metric, Row, Settings, Study, Subject
from beam_warp.checks import require_choice, require_count
from beam_warp.devices import resolve_device, upload
from beam_warp.environment_sampling import SampledEnvironment
from beam_warp.environments import EnvironmentMap
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.irradiance import DENSITIES, irradiance
from beam_warp.kernels.ambient_occlusion import launch_local_surface
from beam_warp.kernels.launching import thread_count
from beam_warp.lighting import LIFT_IN_THICKNESSES, ambient_occlusion
from beam_warp.reference import visibility_reference
from beam_warp.sampling import SAMPLERS
from beam_warp.scene import BACKENDS, Scene
from beam_warp.surfaces import estimate_normals
from beam_warp.tracing import ACCEPTANCES, TraceOptions, visibility

RATIOS = ("ratio", "plain")

POINTS = {"cpu": 128, "cuda": 4096}
"""Points by kind of device. The interval of an error narrows with their root; 128 give about ± 10 %."""

RAYS_PER_CALL = {"cpu": 1 << 15, "cuda": 1 << 23}
"""A timed call traces at least so many rays, so that what is timed is rays and not launches."""

REPEATS = 3

REFERENCE_SEED = 1 << 31
"""References draw other samples than every measurement, whose seeds count up from 0."""

FLOAT64_GAUSSIANS = 50_000
FLOAT64_RAYS = 256
"""Up to so many Gaussians, the tracer is also checked ray by ray against the float64 twin: a few seconds."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class TracingPlan:
    """Which settings to measure, and how well.

    Attributes:
        backends: Hierarchies; the first of each of these lists is its default.
        acceptances: How hits add up.
        samplers: Sample sets.
        offsets: Lifts of ray origins: ``auto``, metres such as ``0.02``, or multiples of the local thickness such as
            ``2t``, from the local surface.
        densities: What irradiance draws its directions from.
        ratios: Irradiance as a ratio of estimates (``ratio``) or as one estimate (``plain``).
        rays: Rays per point, rising.
        crossing: ``star`` varies one or two factors around the defaults, ``full`` crosses all.
        points: Points at which errors are measured; None takes `POINTS`.
        reference_rays: Rays per point of the references.
        repeats: Timed calls a setting, each with samples of its own.
        seed: Chooses the points.

    Raises:
        InvalidOptionError: A value is none of its choices, out of range or given twice.
    """

    backends: tuple[str, ...] = BACKENDS
    acceptances: tuple[str, ...] = ACCEPTANCES
    samplers: tuple[str, ...] = SAMPLERS
    offsets: tuple[str, ...] = ("auto", "2t", "8t", "0.02")
    densities: tuple[str, ...] = ("product", "environment", "cosine", "mis")
    ratios: tuple[str, ...] = RATIOS
    rays: tuple[int, ...] = (4, 16, 64, 256, 1024)
    crossing: Literal["star", "full"] = "star"
    points: int | None = None
    reference_rays: int = 16384
    repeats: int = REPEATS
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every option once."""
        for name, choices in (
            ("backends", BACKENDS),
            ("acceptances", ACCEPTANCES),
            ("samplers", SAMPLERS),
            ("densities", DENSITIES),
            ("ratios", RATIOS),
        ):
            for value in getattr(self, name):
                require_choice(name, value, choices)
        object.__setattr__(self, "offsets", tuple(map(offset_label, self.offsets)))
        for count in self.rays:
            # Fewest that every estimator takes: half of the rays of mis come from either density, and pair up
            require_count("rays", count, 4, 1 << 16)
        for name in ("backends", "acceptances", "samplers", "offsets", "densities", "ratios", "rays"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise InvalidOptionError(f"{name} must be one or more different values, got {values}. Name each once.")
        object.__setattr__(self, "rays", tuple(sorted(self.rays)))
        require_choice("crossing", self.crossing, ("star", "full"))
        if self.points is not None:
            require_count("points", self.points, 2, 1 << 20)
        require_count("reference_rays", self.reference_rays, 4, 1 << 20)
        require_count("repeats", self.repeats, 1, 100)
        require_count("seed", self.seed, 0, 2**31 - 1)

    def occlusion_settings(self) -> list[Settings]:
        """Return the settings of ambient occlusion without rays, the most telling first."""
        axes = {
            "backend": self.backends,
            "acceptance": self.acceptances,
            "sampler": self.samplers,
            "offset": self.offsets,
        }
        return _crossed(axes, self.crossing, ({"backend", "acceptance"}, {"acceptance", "sampler"}, {"offset"}))

    def irradiance_settings(self) -> list[Settings]:
        """Return the settings of irradiance without rays; the offset stays at its default."""
        axes = {
            "backend": self.backends,
            "acceptance": self.acceptances,
            "sampler": self.samplers,
            "offset": self.offsets[:1],
            "density": self.densities,
            "ratio": self.ratios,
        }
        return _crossed(axes, self.crossing, ({"density", "ratio"}, {"sampler"}, {"acceptance"}, {"backend"}))


def parse_offset(text: str) -> tuple[Literal["auto", "metres", "thicknesses"], float]:
    """Return the kind of an offset and its number: ``auto``, ``0.02`` or ``0.02 m``, ``2t`` (local thicknesses).

    Raises:
        InvalidOptionError: It is none of these, or not a number of at least 0.
    """
    if text == "auto":
        return "auto", 0.0
    try:
        number = float(text.removesuffix("t" if text.endswith("t") else "m"))
    except ValueError:
        number = -1.0
    if not (0.0 <= number < 1e6):
        raise InvalidOptionError(
            f"offsets must be auto, metres such as 0.02, or thicknesses such as 2t, got {text!r}. Choose one of them."
        )
    return ("thicknesses" if text.endswith("t") else "metres"), number


def offset_label(text: str) -> str:
    """Return an offset as charts name it, one name for each: ``auto``, ``0.02 m``, ``2t``."""
    kind, number = parse_offset(text)
    return {"auto": "auto", "metres": f"{number:g} m", "thicknesses": f"{number:g}t"}[kind]


def _crossed(axes: dict[str, tuple[Any, ...]], crossing: str, groups: Sequence[set[str]]) -> list[Settings]:
    """Return settings: each group of factors crossed around the defaults, then, if full, everything that is left."""
    found: dict[tuple[Any, ...], Settings] = {}
    for group in [*groups, *([set(axes)] if crossing == "full" else [])]:
        for levels in product(*(values if name in group else values[:1] for name, values in axes.items())):
            found.setdefault(levels, dict(zip(axes, levels, strict=True)))
    return list(found.values())


def tracing_study(
    cloud: GaussianCloud,
    environment: EnvironmentMap,
    plan: TracingPlan = TracingPlan(),
    *,
    name: str = "Gaussians",
    environment_name: str = "environment",
    device: str | None = None,
    progress: Progress | None = None,
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
        progress: Called with (stage, done, total) while references are traced.

    Raises:
        InvalidArrayError: No Gaussian of the cloud can be seen.
        DeviceError: There is no such device.
    """
    bench = _Bench(cloud, environment, plan, device, progress)
    subject = Subject(
        name="tracing",
        title=f"Error against time of traced visibility: {name}, {len(cloud):,} Gaussians, {bench.device_name}",
        axes=(
            Axis("rays", "Rays per point", plan.rays, "rays"),
            Axis("backend", "Backend", plan.backends, "", "wide: own 4-wide tree. warp: wp.Bvh."),
            Axis(
                "acceptance",
                "Acceptance",
                plan.acceptances,
                "",
                "product: transmittances multiply, exact. bernoulli: every hit blocks by chance, unbiased.",
            ),
            Axis(
                "sampler",
                "Sampler",
                plan.samplers,
                "",
                "owen: scrambled Sobol' points. stratified: one random point a stratum. iid: independent points.",
            ),
            Axis(
                "density",
                "Density",
                plan.densities,
                "",
                "product: light times cosine. environment: light. cosine. mis: half cosine, half light, balanced.",
            ),
            Axis(
                "ratio",
                "Ratio",
                plan.ratios,
                "",
                "ratio: exact unoccluded irradiance times a ratio of two estimates. plain: one estimate.",
            ),
            Axis(
                "offset",
                "Offset",
                plan.offsets,
                "",
                "Lift of ray origins: metres, or t, standard deviations of the local thickness; "
                f"auto is {LIFT_IN_THICKNESSES:g}t.",
            ),
        ),
        metrics=(
            Metric(
                "occlusion_error",
                "RMS error of ambient occlusion",
                color="sampler",
                marker="acceptance",
                line="backend",
                apart="offset",
                floor=bench.occlusion_floor,
                sentence=f"Against {plan.reference_rays:,} rays from the same offset: noise, which more rays remove.",
            ),
            Metric(
                "irradiance_error",
                "RMS error of irradiance, relative to its mean",
                color="density",
                marker="ratio",
                line="acceptance",
                floor=bench.irradiance_floor,
                sentence=f"Against {plan.reference_rays:,} rays; light: {environment_name}.",
            ),
            Metric(
                "offset_bias",
                f"RMS shift of ambient occlusion by the offset, against {bench.finest}",
                by="offset",
                sentence=(
                    f"How far each offset's own truth lies from that of the finest, {bench.finest}; rays do not "
                    "remove it. Too small an offset shades itself, too large a one leaks light: neither is the truth."
                ),
            ),
        ),
        cost=f"Time for all {len(cloud):,} Gaussians",
        cost_unit="s",
        ladder="rays",
        notes=bench.notes(environment_name),
    )
    settings = [{"rays": rays, **curve} for curve in _alternating(plan) for rays in plan.rays]
    return Study(subject, settings, bench.measure, bench.work)


def _alternating(plan: TracingPlan) -> list[Settings]:
    """Return both estimates' settings in turn, so that a budget cuts both."""
    lists = plan.occlusion_settings(), plan.irradiance_settings()
    longest = max(map(len, lists))
    return [settings[k] for k in range(longest) for settings in lists if k < len(settings)]


def processor_name() -> str:
    """Return the CPU as its maker calls it, as far as the system tells."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except (OSError, UnicodeDecodeError):
        pass  # no such file outside Linux
    return platform.processor() or platform.machine() or "CPU"


class _Bench:
    """Everything that is measured on: scenes by backend, points, normals, lifts and references."""

    def __init__(
        self,
        cloud: GaussianCloud,
        environment: EnvironmentMap,
        plan: TracingPlan,
        device: str | None,
        progress: Progress | None,
    ) -> None:
        """Build scenes, choose points, trace references."""
        self.plan, self.count = plan, len(cloud)
        self.progress: Progress = progress or (lambda stage, done, total: None)
        self.device = resolve_device(device)
        self.environment = SampledEnvironment.from_environment(environment, self.device)
        self.kind = "cuda" if self.device.is_cuda else "cpu"
        self.scenes = {
            backend: Scene.from_gaussians(cloud, str(self.device), backend=backend)  # type: ignore[arg-type]
            for backend in plan.backends
        }
        # References come from the tree that is not ours, whichever are measured
        self.exact = self.scenes.get("warp") or Scene.from_gaussians(cloud, str(self.device), backend="warp")
        seen = np.flatnonzero(cloud.opacities > 1.0 / 255.0)
        if len(seen) < 2:
            raise InvalidArrayError(
                f"scene must hold at least 2 Gaussians of opacity above 1/255, got {len(seen)}. Give another file."
            )
        normals = cloud.normals
        self.normals_from = "the file"
        if normals is None:
            self.normals_from = "estimate_normals"
            normals = estimate_normals(
                cloud, self.exact, progress=lambda done, total: self.progress("normals", done, total)
            ).normals
        number = min(plan.points or POINTS[self.kind], len(seen))
        chosen = np.sort(np.random.default_rng(plan.seed).choice(seen, number, replace=False))
        self.points, self.normals = cloud.positions[chosen], normals[chosen]
        self.float64_check = self._check_against_float64(cloud)
        self._trace_references()

    def _check_against_float64(self, cloud: GaussianCloud) -> str:
        """Return how far single rays of each backend are off the float64 twin."""
        report = self.exact.report
        if len(cloud) > FLOAT64_GAUSSIANS or report.raised_scales or report.not_finite:
            return (
                f"skipped: more than {FLOAT64_GAUSSIANS:,} Gaussians"
                if len(cloud) > FLOAT64_GAUSSIANS
                else (f"skipped: {report.raised_scales + report.not_finite:,} Gaussians were mended for tracing")
            )
        generator = np.random.default_rng(self.plan.seed)
        rows = generator.integers(len(self.points), size=FLOAT64_RAYS)
        directions = generator.normal(size=(FLOAT64_RAYS, 3))
        directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
        directions *= np.where(np.einsum("nk,nk->n", directions, self.normals[rows]) < 0.0, -1.0, 1.0)[:, None]
        origins = self.points[rows] + np.float32(0.05) * self.normals[rows]
        truth = visibility_reference(cloud, origins, directions)
        worst = {
            backend: float(np.abs(visibility(scene, origins, directions) - truth).max())
            for backend, scene in {**self.scenes, "warp": self.exact}.items()
        }
        return f"largest error of a ray, of {FLOAT64_RAYS}: " + ", ".join(
            f"{backend} {value:.1e}" for backend, value in worst.items()
        )

    def _trace_references(self) -> None:
        """Trace every offset's occlusion and the default offset's irradiance with many rays."""
        plan = self.plan
        surface = wp.empty(len(self.points), dtype=wp.vec2, device=self.device)
        up = upload(self.normals, wp.vec3, self.device)
        launch_local_surface(self.exact.occluders, upload(self.points, wp.vec3, self.device), up, surface, self.device)
        self.height, self.thickness = surface.numpy().T
        stages = len(plan.offsets) + 1
        total = stages * len(self.points) * plan.reference_rays
        self.occlusion: dict[str, NDArray[np.float64]] = {}
        errors = []
        for stage, offset in enumerate(plan.offsets):

            def report(done: int, of: int, before: int = stage) -> None:
                self.progress("references [rays]", (before * of + done) * plan.reference_rays, total)

            at, lift = self._lifted(offset)
            found = ambient_occlusion(
                self.exact,
                at,
                self.normals,
                sample_count=plan.reference_rays,
                offset=lift,
                seed=REFERENCE_SEED,
                progress=report,
            )
            self.occlusion[offset] = found.visibility.astype(np.float64)
            errors.append(float(np.square(found.standard_error, dtype=np.float64).mean()))
        self.occlusion_floor = float(np.sqrt(max(errors)))
        self.finest = min(plan.offsets, key=lambda offset: float(self._lift_lengths(offset).mean()))
        at, lift = self._lifted(plan.offsets[0])
        light = irradiance(
            self.exact,
            at,
            self.normals,
            self.environment,
            sample_count=plan.reference_rays,
            offset=lift,
            ratio=False,  # the ratio's small bias would be in every error
            seed=REFERENCE_SEED,
        )
        self.light = light.value.astype(np.float64)
        self.mean_light = max(float(self.light.mean()), 1e-30)
        self.irradiance_floor = (
            float(np.sqrt(np.square(light.standard_error, dtype=np.float64).mean())) / self.mean_light
        )
        self.progress("references [rays]", total, total)

    def _lifted(self, offset: str) -> tuple[NDArray[np.float32], float | Literal["auto"]]:
        """Return points and the offset to pass on: multiples of the thickness are applied to the points here."""
        kind, number = parse_offset(offset)
        if kind == "auto":
            return self.points, "auto"
        if kind == "metres":
            return self.points, number
        return (self.points + self.normals * self._lift_lengths(offset)[:, None]).astype(np.float32), 0.0

    def _lift_lengths(self, offset: str) -> NDArray[np.float32]:
        """Return how far above its Gaussian's centre each ray starts [m]."""
        kind, number = parse_offset(offset)
        if kind == "metres":
            return np.full(len(self.points), number, np.float32)
        return self.height + (LIFT_IN_THICKNESSES if kind == "auto" else number) * self.thickness

    def _copies(self, settings: Settings) -> int:
        """Return how often the points are repeated in a call; each copy has samples of its own."""
        return max(1, -(-RAYS_PER_CALL[self.kind] // (len(self.points) * int(settings["rays"]))))

    def work(self, settings: Settings) -> int:
        """Return the number of rays that a setting's measurement traces."""
        return len(self.points) * int(settings["rays"]) * self._copies(settings) * self.plan.repeats

    def measure(self, settings: Settings) -> Row:
        """Time a setting, and compare what it gives with the reference."""
        copies = self._copies(settings)
        at, lift = self._lifted(str(settings["offset"]))
        points, normals = (upload(np.tile(array, (copies, 1)), wp.vec3, self.device) for array in (at, self.normals))
        scene = self.scenes[str(settings["backend"])]
        common = {
            "sample_count": int(settings["rays"]),
            "sampler": settings["sampler"],
            "offset": lift,
            "options": TraceOptions(acceptance=settings["acceptance"]),  # type: ignore[arg-type]
        }
        lit = "density" in settings
        if lit:
            common |= {"density": settings["density"], "ratio": settings["ratio"] == "ratio"}

        def estimate(at: wp.array, up: wp.array, seed: int) -> wp.array:
            if lit:
                return irradiance(scene, at, up, self.environment, seed=seed, **common).value
            return ambient_occlusion(scene, at, up, seed=seed, **common).visibility

        estimate(points[:1], normals[:1], 0)  # compiles what is not compiled yet
        seconds, squares = [], np.zeros(len(self.points))
        for repeat in range(self.plan.repeats):
            wp.synchronize_device(self.device)
            started = time.perf_counter()
            result = estimate(points, normals, repeat)
            wp.synchronize_device(self.device)
            seconds.append((time.perf_counter() - started) / len(points) * self.count)
            found = result.numpy().astype(np.float64).reshape(copies, len(self.points), -1)
            truth = self.light / self.mean_light if lit else self.occlusion[str(settings["offset"])][:, None]
            if lit:
                found /= self.mean_light
            squares += np.square(found - truth).mean(axis=(0, 2)) / self.plan.repeats
        errors = {"irradiance_error" if lit else "occlusion_error": Interval.of_root_mean_square(squares)}
        if not lit:
            shift = self.occlusion[str(settings["offset"])] - self.occlusion[self.finest]
            errors["offset_bias"] = Interval.of_root_mean_square(np.square(shift))
        return Row(settings, Interval.of_median(seconds), errors)

    @property
    def device_name(self) -> str:
        """The device in words."""
        if self.device.is_cuda:
            return self.device.name
        count = thread_count()
        return f"{processor_name()} ({count} thread{'s' if count > 1 else ''})"

    def notes(self, environment_name: str) -> dict[str, str]:
        """Return what a reader of the chart needs to know."""
        plan = self.plan
        lifts = ", ".join(
            f"{offset}: {1e3 * float(self._lift_lengths(offset).mean()):.3g} mm" for offset in plan.offsets
        )
        crossed = len(plan.occlusion_settings()) + len(plan.irradiance_settings())
        whole = replace(plan, crossing="full")
        full = len(whole.occlusion_settings()) + len(whole.irradiance_settings())
        return {
            "Points": f"{len(self.points):,} of {self.count:,}, at random; normals from {self.normals_from}; "
            f"mean ambient occlusion {float(self.occlusion[plan.offsets[0]].mean()):.3f}",
            "Reference": f"{plan.reference_rays:,} Owen-scrambled rays a point, product acceptance, wp.Bvh",
            "Float64 check": self.float64_check,
            "Light": environment_name,
            "Mean lift": lifts,
            "Time": f"median of {plan.repeats} calls of at least {RAYS_PER_CALL[self.kind]:,} rays, bars smallest to "
            "largest; compilation excluded; scaled from the points to all Gaussians",
            "Error bars": "95 %, bootstrap over points",
            "Plan": f"{crossed * len(plan.rays):,} settings of {full * len(plan.rays):,} in the full product: one or "
            "two factors at a time around the defaults (the first of each axis)"
            if crossed < full
            else "full product",
            "Versions": f"beam-warp {__version__}, Warp {wp.__version__}",
        }
