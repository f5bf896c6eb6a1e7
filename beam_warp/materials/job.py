"""The main job: Gaussians with captured radiance in, a relightable asset out, frame by frame and resumable."""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp import converters
from beam_warp._version import __version__
from beam_warp.capture.capture import Capture
from beam_warp.capture.digests import CaptureDigests
from beam_warp.checks import require_number
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import write_png
from beam_warp.jobs.report import device_facts, versions, write_json, write_report
from beam_warp.jobs.store import frame_key, make_folders, read_frame, write_frame
from beam_warp.light.prepared import MaterialLight
from beam_warp.materials.base_color import BaseColor, solve_base_color
from beam_warp.materials.changes import ChangeTest, with_changes
from beam_warp.materials.direct import ColorEvidence, MaterialOptions, measure_materials
from beam_warp.materials.exposure import estimate_exposure
from beam_warp.materials.frame import CaptureImages, FrameInputs, RoughnessTexture, filled_occlusion
from beam_warp.materials.images import ImagePathOptions, decompose_by_images
from beam_warp.materials.roughness import measure_roughness_profile, solve_roughness
from beam_warp.materials.tally import Tally, warnings_about
from beam_warp.raster.records import RasterOptions
from beam_warp.render.sheet import Relighting, contact_sheet
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.framing import bulk
from beam_warp.world.gaussians import ATTRIBUTES, WORLD_AXES, GaussianCloud, GaussianSequence, Observability

Progress = Callable[[str, int, int], None]
"""Called with (stage, done, total)."""

ASSET_NAME = "asset.usda"
EVIDENCE = "evidence_"
ESTIMATE = "estimate"

ROUGHNESS_FRAMES = 8
"""Frames of persistent Gaussians that roughness is found from, evenly spread: more add little that is new."""

EXPOSURE_ROUGHNESS = 0.5
"""Assumed while the exposure of the light is looked for, where roughness is yet to be found."""
UNMEASURED = Observability.UNSEEN | Observability.FILLED


def no_progress(stage: str, done: int, total: int) -> None:
    """Report to nobody."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What the main job is asked for.

    Attributes:
        materials: Rays, offset, bounce, seed of the direct path.
        images: Take the image path, the paper's, with these options; None takes the direct one.
        roughness: Perceptual roughness of everything, a texture, or ``"estimate"``: found from the specular residue
            over views and frames.
        exposure: Stops by which the environment is brightened before use; ``"auto"`` finds them where the captured
            colour is display-referred, whose scale is unknown, and takes 0 where it is scene-linear. With a capture,
            its images decide, because they are what is explained.
        persistent: State that row i is the same Gaussian in every frame, so that base colour is fitted over all
            frames at once; sequences that carry ids state it themselves.
        device: Warp device; None takes the first CUDA device, or the CPU.

    Raises:
        InvalidOptionError: The exposure is out of range.
    """

    materials: MaterialOptions = field(default_factory=MaterialOptions)
    images: ImagePathOptions | None = None
    roughness: float | RoughnessTexture | Literal["estimate"] = 0.5
    exposure: float | Literal["auto"] = "auto"
    persistent: bool = False
    device: str | None = None

    def __post_init__(self) -> None:
        """Check what is not checked where it is stated."""
        if self.exposure != "auto":
            require_number("exposure", self.exposure, -32.0, 32.0)


@dataclass(frozen=True, kw_only=True)
class OverviewOptions:
    """What the contact sheet shows.

    Attributes:
        second_light: Shown beside the light of the capture; that light turned by 180 degrees if None.
        azimuth: Camera angle; 0 looks along +y [degree].
        elevation: Camera angle above the horizon [degree].
        height: Height of a panel [pixel].
    """

    second_light: Relighting | None = None
    azimuth: float = 0.0
    elevation: float = 5.0
    height: int = 640


@dataclass(frozen=True)
class RunResult:
    """Where things are, and what was done.

    Attributes:
        asset: Root layer of the asset.
        overview: The contact sheet.
        sequence: The relightable sequence, read lazily from the store, axes "rfu".
        environment: The light as used: the given one times the exposure.
        report: What was measured, JSON-able; also written to ``report.json``.
    """

    asset: Path
    overview: Path
    sequence: GaussianSequence
    environment: EnvironmentMap
    report: dict[str, Any]


def run(
    sequence: GaussianSequence,
    environment: EnvironmentMap,
    out: str | Path,
    options: RunOptions | None = None,
    *,
    capture: Capture | None = None,
    overview: OverviewOptions | None = None,
    progress: Progress = no_progress,
) -> RunResult:
    """Decompose a sequence; write ``out/asset.usda``, its layers, ``out/report.json`` and ``out/overview.png``.

    Every finished frame is kept in ``out/frames``; a second call with the same input and options takes up where the
    first was stopped, and one with other input or options starts over.

    Args:
        sequence: Frames with captured radiance, in any axes.
        environment: The light of the capture, in the world "rfu".
        out: Folder; made if its parent exists.
        options: See `RunOptions`.
        capture: The images that the Gaussians were reconstructed from: light is gathered where they show the surface,
            and base colour explains what they show. None takes the Gaussians' own colour for it.
        overview: See `OverviewOptions`.
        progress: Called with (stage, done, total).

    Raises:
        InvalidArrayError: A frame has no captured radiance.
        InvalidOptionError: The capture lacks a frame of the sequence, or there is none for the image path.
        OutputError: The folder cannot be made or written.
        BeamError: An input or option breaks its contract.

    Source: BEAM §3.2, by the direct path (see `beam_warp.materials.direct`).
    """
    started = time.perf_counter()
    chosen = options or RunOptions()
    resolve_device(chosen.device)  # before a folder is made that would then stay empty
    folder = Path(out)
    images = None if capture is None else CaptureImages(capture, sequence)
    if chosen.images is not None and images is None:
        raise InvalidOptionError(
            "capture must be given for the image path, got none: it works on images. Pass one, or leave images out."
        )
    frames, digests = make_folders(folder, "frames", "digests")
    job = _Job(sequence, environment, frames, chosen, images, CaptureDigests(digests), progress)
    job.check()
    total = len(sequence)
    for frame in range(total):
        job.measure(frame)
        progress("decompose", frame + 1, total)
    with job.timer("solve"):
        relightable = job.solve()
    with job.timer("write asset"):
        asset = folder / ASSET_NAME
        converters.write(relightable, asset)
    picture = folder / "overview.png"
    with job.timer("overview"):
        progress("overview", 0, 1)
        _draw_overview(job, relightable, picture, overview or OverviewOptions())
        progress("overview", 1, 1)
    report = job.report()
    report["seconds"]["total"] = time.perf_counter() - started
    write_report(folder, report)
    return RunResult(asset, picture, relightable, job.lit, report)


def _draw_overview(job: _Job, sequence: GaussianSequence, path: Path, options: OverviewOptions) -> None:
    """Draw the middle frame; panels are as wide as the subject needs."""
    cloud = sequence[len(sequence) // 2]
    extent = np.ptp(bulk(cloud.positions, cloud.opacities), axis=0)
    aspect = float(np.clip(np.hypot(extent[0], extent[1]) / max(extent[2], 1e-9), 0.5, 1.8))
    camera = Camera.frame_cloud(
        cloud.positions,
        cloud.opacities,
        azimuth=options.azimuth,
        elevation=options.elevation,
        width=round(options.height * aspect),
        height=options.height,
    )
    lights = [
        Relighting("relit by the light of the capture", job.light.blurred),
        options.second_light or Relighting("relit by that light turned by 180°", job.light.blurred.turned_around()),
    ]
    raster = RasterOptions.from_metadata(sequence.metadata)
    write_png(path, contact_sheet(cloud, camera, lights, options=raster, device=str(job.device)))


class _Timer:
    """Seconds by stage; waits for the device, so that work is charged to the stage that asked for it."""

    def __init__(self, device: Any) -> None:
        self.seconds: dict[str, float] = {}
        self._device = device

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        wp.synchronize_device(self._device)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


class _Job:
    """One call of `run`: what it was given, where its store is, and what it has found out so far."""

    def __init__(
        self,
        sequence: GaussianSequence,
        environment: EnvironmentMap,
        folder: Path,
        options: RunOptions,
        images: CaptureImages | None,
        digests: CaptureDigests,
        progress: Progress,
    ) -> None:
        self._progress = progress
        self._images = images
        self._digests = digests
        self.sequence = sequence
        self.folder = folder
        self.options = options
        self.device = resolve_device(options.device)
        self.timer = _Timer(self.device)
        self.persistent = options.persistent or sequence.topology == "constant"
        self.resumed = 0
        self.first = self._inputs(0)
        with self.timer("prepare light"):
            given = MaterialLight.from_environment(environment, self.device)
        self.exposure = self._find_exposure(environment, given)
        self.lit = environment.scaled(2.0**self.exposure)
        self.light = given.scaled(2.0**self.exposure)
        self.key = _digest(self._described(), self.lit.radiance)
        self._statistics: dict[str, Any] = {}
        self._notes: dict[str, None] = {}
        self._findings: list[dict[str, Any]] = []
        self._roughness_paths: set[Path] = set()
        self._roughness_report: dict[str, Any] = {}

    def _inputs(self, number: int) -> FrameInputs:
        """Return what a frame brings."""
        return FrameInputs(
            number,
            self.sequence[number],
            self._images,
            device=str(self.device),
            offset=self.options.materials.offset,
            seed=self.options.materials.seed,
            timer=self.timer,
            progress=lambda stage, done, total: self.within(stage, number)(done, total),
        )

    def _described(self) -> str:
        """Everything but the input and the light that a stored measurement depends on."""
        source = self.options.roughness
        files = [source.texture, source.mesh] if isinstance(source, RoughnessTexture) else []
        return json.dumps(
            {
                "version": __version__,
                "device": "cuda" if self.device.is_cuda else "cpu",
                "options": options_as_dict(self.options),
                "raster": None if self._images is None else asdict(self._images.raster),
                "evidence": ColorEvidence.ARRAYS,
                "files": [hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() for path in files],
            },
            sort_keys=True,
        )

    def _find_exposure(self, environment: EnvironmentMap, light: MaterialLight) -> float:
        """Return the stops; an automatic exposure is kept beside the frames, so that a resumed job has it at once."""
        if self.options.exposure != "auto":
            return float(self.options.exposure)
        display = self.first.cloud.radiance_color_space == DISPLAY_SRGB
        if self._images is not None:
            display = self._images.is_display_referred(0)
        if not display:
            return 0.0
        path = self.folder / "exposure.h5"
        described = f"{self._described()} {self._digest_of_images(0)}"
        key = _digest(described, environment.radiance, *self.first.cloud.arrays().values())
        if frame_key(path) != key:
            first = self.first
            scene, points = first.scene, first.points
            # Highlights cannot be told from the light before its exposure is known.
            stated = EXPOSURE_ROUGHNESS if self.options.roughness == ESTIMATE else self.options.roughness
            roughness = first.roughness(stated)
            with self.timer("exposure"):
                factor = estimate_exposure(first.cloud, scene, points, roughness, light, options=self.options.materials)
            write_frame(path, key, {"stops": np.array([np.log2(factor)])})
        return float(read_frame(path)["stops"][0])

    def within(self, stage: str, frame: int) -> Callable[[int, int], None]:
        """Return a reporter of progress inside a frame, in Gaussians of all frames."""
        frames = len(self.sequence)
        return lambda done, total: self._progress(stage, frame * total + done, frames * total)

    def path(self, frame: int) -> Path:
        return self.folder / f"frame_{frame:06d}.h5"

    def _roughness(self, frame: FrameInputs) -> dict[str, NDArray[np.float32]]:
        """Return the roughness of a frame's Gaussians, ``(N,)``, and its standard error where it is estimated."""
        if self.options.roughness != ESTIMATE:
            return {"roughness": frame.roughness(self.options.roughness)}
        path = self.folder / f"roughness_{0 if self.persistent else frame.number:06d}.h5"
        asked = [frame.number]
        if self.persistent:
            count = min(len(self.sequence), ROUGHNESS_FRAMES)
            asked = sorted({round(place) for place in np.linspace(0, len(self.sequence) - 1, count)})
        if path not in self._roughness_paths:
            self._estimate_roughness(path, frame, asked)
            self._roughness_paths.add(path)
        return read_frame(path, ("roughness", "roughness_error"))

    def _estimate_roughness(self, path: Path, frame: FrameInputs, asked: list[int]) -> None:
        """Find roughness from what the views of some frames show, into the store, unless it is there already."""
        frames = {n: frame if n == frame.number else self.first if n == 0 else None for n in asked}
        key = _digest(self.key, *(np.frombuffer(self._frame_key(n, f).encode(), np.uint8) for n, f in frames.items()))
        if frame_key(path) == key:
            return
        total = None
        for number in asked:
            inputs = frames[number] or self._inputs(number)
            scene, points, views = inputs.scene, inputs.points, inputs.views
            with self.timer("roughness"):
                found = measure_roughness_profile(
                    inputs.cloud,
                    scene,
                    points,
                    self.light,
                    views,
                    options=self.options.materials,
                    frame=number,
                    progress=self.within("roughness", number),
                )
            total = found if total is None else total + found
        assert total is not None
        with self.timer("roughness"):
            estimate = solve_roughness(frame.cloud.positions, total)
        self._roughness_report = estimate.report
        write_frame(path, key, {"roughness": estimate.roughness, "roughness_error": estimate.standard_error})

    def _frame_key(self, number: int, frame: FrameInputs | None) -> str:
        """Return what a frame's measurements depend on, as one word."""
        cloud = (frame or self._inputs(number)).cloud
        seen = "" if self._images is None else self._images.digest(number, self._digests)
        return _digest(f"{self.key} {number} {cloud.radiance_color_space} {seen}", *cloud.arrays().values())

    def check(self) -> None:
        """Look at the light and the images of the first frame; what was found is kept beside the frames."""
        path = self.folder / "findings.json"
        key = self._frame_key(0, self.first)
        # Whatever is wrong with what was kept, it is found again.
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
            known = json.loads(path.read_text(encoding="utf-8"))
            if known["key"] == key:
                self._findings = list(known["findings"])
                return
        with self.timer("check"):
            self._findings = [vars(finding) for finding in self.first.check(self.lit)]
        write_json(path, {"key": key, "findings": self._findings})

    def measure(self, number: int) -> None:
        """Measure a frame into the store, unless it is there already."""
        frame = self.first if number == 0 else self._inputs(number)
        key = self._frame_key(number, frame)
        if self._follows(number):
            key = _digest(f"{key} {frame_key(self.path(number - 1))}")
        if frame_key(self.path(number)) == key:
            self.resumed += 1
            return
        found = self._by_rays(frame) if self.options.images is None else self._by_images(frame)
        arrays = {
            **frame.cloud.arrays(),
            "normals": frame.surface.normals,
            "normal_confidence": frame.surface.confidence,
            **found,
            "from_shape": frame.surface.from_shape,
            "report": np.array(
                [frame.scene.report.traced, frame.scene.report.dropped, frame.scene.report.raised_scales]
            ),
        }
        with self.timer("store"):
            write_frame(self.path(number), key, arrays)
        frame.forget()

    def _digest_of_images(self, number: int) -> str:
        """Return what the images of a frame are, as one word."""
        return "" if self._images is None else self._images.digest(number, self._digests)

    def _follows(self, number: int) -> bool:
        """Return whether what is found of a frame depends on what was found of the one before."""
        return self.options.images is not None and self.persistent and number > 0

    def _by_rays(self, frame: FrameInputs) -> dict[str, NDArray[Any]]:
        """Measure a frame by rays from its Gaussians: occlusion, and evidence on base colour."""
        scene, points, views = frame.scene, frame.points, frame.views
        roughness = self._roughness(frame)
        with self.timer("materials"):
            measured = measure_materials(
                frame.cloud,
                scene,
                points,
                roughness["roughness"],
                self.light,
                options=self.options.materials,
                views=views,
                frame=frame.number,
                progress=self.within("materials", frame.number),
            )
        with self.timer("fill"):
            occlusion, occlusion_error = filled_occlusion(
                frame, measured.ambient_occlusion, measured.ambient_occlusion_error
            )
        return {
            "ambient_occlusion": occlusion,
            "ambient_occlusion_error": occlusion_error,
            **roughness,
            **{EVIDENCE + name: getattr(measured.evidence, name) for name in ColorEvidence.ARRAYS},
        }

    def _by_images(self, frame: FrameInputs) -> dict[str, NDArray[Any]]:
        """Measure a frame by rays from the pixels of its views, baked into its Gaussians: all materials at once."""
        assert self.options.images is not None
        assert self._images is not None
        previous = None
        if self._follows(frame.number):
            previous = read_frame(self.path(frame.number - 1), ("base_color",))["base_color"]
        scene, roughness = frame.scene, self._roughness(frame)
        with self.timer("read images"):
            views = self._images.views(frame.number)
        with self.timer("materials"):
            found = decompose_by_images(
                frame.cloud,
                scene,
                views,
                roughness["roughness"],
                self.light.sampled,
                self.options.images,
                raster_options=self._images.raster,
                previous=previous,
                frame=frame.number,
                progress=self.within("materials", frame.number),
            )
        self._notes.update(dict.fromkeys(found.notes))
        return {
            "ambient_occlusion": found.ambient_occlusion,
            **roughness,
            "base_color": found.base_color,
            "observability": np.where(found.filled.any(axis=1), np.uint8(UNMEASURED), np.uint8(0)),
        }

    def stored_cloud(self, frame: int) -> GaussianCloud:
        """Return what is known of a frame before base colour is solved."""
        stored = read_frame(self.path(frame))
        return GaussianCloud(
            **{name: array for name, array in stored.items() if name in ATTRIBUTES},
            axes=WORLD_AXES,
            radiance_color_space=self.first.cloud.radiance_color_space,
        )

    def evidence(self, frame: int) -> ColorEvidence:
        names = tuple(EVIDENCE + name for name in ColorEvidence.ARRAYS)
        stored = read_frame(self.path(frame), names)
        return ColorEvidence.from_arrays({name.removeprefix(EVIDENCE): array for name, array in stored.items()})

    def solve(self) -> GaussianSequence:
        """Solve base colour, over all frames at once or each by itself, and return the relightable sequence."""
        total = len(self.sequence)
        tally = Tally()
        if self.options.images is not None:
            varying = True
            for frame in range(total):
                tally.add(self.stored_cloud(frame), read_frame(self.path(frame), ("from_shape", "report")))
        else:
            varying = self._solve_constant(tally) if self.persistent else self._solve_each(tally)
        self._statistics = tally.summary()

        def read(frame: int) -> GaussianCloud:
            cloud = self.stored_cloud(frame)
            return cloud if self.options.images is not None else self._solved(cloud, frame if varying else 0)

        solution_names = {"base_color", "base_color_error", "observability"}
        roughness_names = {"roughness", "roughness_error"} if self.options.roughness == ESTIMATE else {"roughness"}
        return GaussianSequence(
            frame_count=total,
            read_frame=read,
            frames_per_second=self.sequence.frames_per_second,
            constant=frozenset(self.sequence.constant & set(ATTRIBUTES)) - {"normals"}
            | (set() if varying else solution_names)
            | (roughness_names if self.persistent else set()),
            topology="constant" if self.persistent else "perFrame",
            metadata={
                **self.sequence.metadata,
                "generator": f"beam-warp {__version__}",
                "normal_source": "shortestAxis" if self._statistics["normals_from_shape"] > 0.5 else "authored",
                "roughness_source": _roughness_source(self.options.roughness),
                "radiance_meaning": "captured",
                "source_axes": self.first.original.axes,
                "exposure_stops": f"{self.exposure:.4f}",
            },
        )

    def _solve_constant(self, tally: Tally) -> bool:
        """Solve one base colour for all frames, and more where they disagree; return whether any Gaussian needs it."""
        total = len(self.sequence)
        joint, test = self.evidence(0), ChangeTest()
        test.add(joint)
        for frame in range(1, total):
            evidence = self.evidence(frame)
            test.add(evidence)
            joint = joint + evidence
        change = test.result()
        constant = solve_base_color(
            self.stored_cloud(0), joint, self.light.mean_irradiance, dispersion=change.dispersion
        )
        varying = bool(change.changing.any())
        for frame in range(total if varying else 1):
            self._store_solution(frame, with_changes(constant, change, self.evidence(frame)))
        tally.add(
            self._solved(self.stored_cloud(0), 0),
            read_frame(self.path(0), ("from_shape", "report")),
            constant.clipped_part,
        )
        tally.count_changes(change)
        return varying

    def _solve_each(self, tally: Tally) -> bool:
        """Solve every frame by itself: its Gaussians are those of no other."""
        for frame in range(len(self.sequence)):
            solved = solve_base_color(self.stored_cloud(frame), self.evidence(frame), self.light.mean_irradiance)
            self._store_solution(frame, solved)
            tally.add(
                self._solved(self.stored_cloud(frame), frame),
                read_frame(self.path(frame), ("from_shape", "report")),
                solved.clipped_part,
            )
        return True

    def _solved(self, cloud: GaussianCloud, frame: int) -> GaussianCloud:
        """Return a stored cloud with a stored solution."""
        return cloud.with_arrays(**read_frame(self.folder / f"solution_{frame:06d}.h5"))

    def _store_solution(self, frame: int, solved: BaseColor) -> None:
        write_frame(
            self.folder / f"solution_{frame:06d}.h5",
            self.key,
            {
                "base_color": solved.base_color,
                "base_color_error": solved.standard_error,
                "observability": solved.observability,
            },
        )

    def _said(self, severity: str) -> list[str]:
        """Return the findings of a severity as lines for people."""
        lines = []
        for finding in self._findings:
            place = f" ({finding['where']})" if finding["where"] else ""
            if finding["severity"] == severity:
                lines.append(f"{finding['what']}{place}. {finding['remedy']}".strip())
        return lines

    def report(self) -> dict[str, Any]:
        """Return what was done, found and spent; JSON-able."""
        measured = len(self.sequence) - self.resumed
        samples = self.options.materials.sample_count
        seconds = self.timer.seconds.get("materials", 0.0)
        rays = measured * len(self.first.cloud) * samples * 2
        notes = [*self.sequence.metadata.get("notes", "").splitlines(), *self._notes, *self._said("note")]
        return {
            "input": {"frames": len(self.sequence), "gaussians": len(self.first.cloud), "notes": notes},
            "device": device_facts(self.device),
            "versions": versions(),
            "options": options_as_dict(self.options),
            "exposure_stops": self.exposure,
            "resumed_frames": self.resumed,
            "persistent": self.persistent,
            "materials": self._statistics,
            "roughness": self._roughness_report,
            "seconds": dict(self.timer.seconds),
            "light_and_occlusion_rays_per_second": rays / seconds if seconds > 0.0 and measured else None,
            "findings": self._findings,
            "warnings": [*self._said("warning"), *warnings_about(self._statistics)],
        }


def _roughness_source(source: float | RoughnessTexture | str) -> str:
    """Return the asset's word for where roughness comes from."""
    if isinstance(source, RoughnessTexture):
        return "texture"
    return "estimated" if source == ESTIMATE else "constant"


def options_as_dict(options: RunOptions) -> dict[str, Any]:
    """Return the options as JSON-able values; the device is not one, because it is reported by its name."""
    described = asdict(options)
    described.pop("device")
    if isinstance(options.roughness, RoughnessTexture):
        described["roughness"] = {key: str(value) for key, value in described["roughness"].items()}
    return described


def _digest(text: str, *arrays: NDArray[Any]) -> str:
    digest = hashlib.blake2b(text.encode(), digest_size=16)
    for array in arrays:
        digest.update(str((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
