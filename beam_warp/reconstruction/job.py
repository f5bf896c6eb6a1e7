"""The reconstruction job: a multi-view capture becomes a Gaussian sequence, frame by frame, resumable after any kill.

A job reads a frame's images, fits the Gaussians of a key frame from a start that those images give, tracks every
further frame of the segment from the one before, and writes the sequence as an asset. Segments do not depend on each
other: several processes may work on them, and what tracking loses, the next key frame finds again. A frame in which
tracking is lost becomes a key frame itself.

    plan            frames.plan     the records of each frame, and the segments
    masks           steps.mend_masks   how far cut-outs are off, from the first frame; corrected records
    cameras         steps.refine_rig   what is wrong with the rig, from its first frame; corrected records
    exposures       steps.find_exposures  exposures and white balances of the rig, likewise
    read            frames.reader   images and digests of a frame
    start, fit      steps.begin     a key frame, from its images alone
    track           steps.advance   a further frame, from the stored one before
    seam            steps.advance   likewise, beyond a segment's end: it is faded into the next one
    store           frames.store    one file a frame
    write           this module     asset, previews, report

Cameras, frames and previews are steps of a plan (`beam_warp.plan`), which knows what of them is done: the key of a
frame covers everything it depends on. Tracking always goes on from what the file holds, never from what is in memory,
so that a job that was stopped anywhere continues to the same bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, fields
from functools import cached_property, partial, reduce
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.corrections import RigCorrection
from beam_warp.capture.exposures import RigExposures
from beam_warp.capture.findings import Finding
from beam_warp.capture.mask_corrections import MaskCorrections
from beam_warp.capture.side_file import SideFile
from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_choice, require_count, require_path
from beam_warp.converters.clips import ClipWork
from beam_warp.converters.staging import require_writable
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidOptionError
from beam_warp.image.files import write_png
from beam_warp.jobs.listeners import NotedProgress, no_progress
from beam_warp.jobs.report import REPORT_NAME, device_facts, versions, write_json, write_report
from beam_warp.plan.carry import Counted, carry_out
from beam_warp.plan.steps import Plan, Rank, Receipt, Step, Task
from beam_warp.plan.workers import Crew, in_process
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.frames.model import model_frame, within
from beam_warp.reconstruction.frames.plan import FramePlan, plan_fades, plan_frames
from beam_warp.reconstruction.frames.protocols import FrameSteps
from beam_warp.reconstruction.frames.reader import FrameReader
from beam_warp.reconstruction.frames.report import frame_line, sequence_facts, warnings_of
from beam_warp.reconstruction.frames.store import FrameStore, common_inputs, stored_cloud, stored_sequence
from beam_warp.reconstruction.preview import mesh_shadings, opposite_cameras, reconstruction_preview
from beam_warp.reconstruction.rig import FEWEST_CAMERAS
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import capture_frames_metadata

ASSET_NAME = "gaussians.usda"
ASSET_STEM = Path(ASSET_NAME).stem


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """Options of a reconstruction: its frames, where key frames are planned, and what of the capture is mended.

    Attributes:
        segment_length: Frames from one key frame to the next; 0 for a key frame at the start only.
        seam_frames: Frames after a planned key frame in which the segment before is tracked on and faded out, so that
            no seam is seen; each costs the time of a tracked frame. 0 cuts.
        frames: Numbers of the frames, ascending; None for all of the split.
        cameras: ``"refine"`` corrects cameras that are beyond doubt wrong, the same in all frames; ``"keep"`` takes all
            as the capture states them.
        masks: ``"refine"`` moves masks of cut-outs that are beyond doubt wrong, those of a camera the same in all
            frames; ``"keep"`` takes all as they are.
        exposures: ``"match"`` undoes differences of exposure and white balance between cameras that are beyond doubt,
            the same in all frames; ``"keep"`` takes all colours as photographed.
    """

    segment_length: int = 0
    seam_frames: int = 2
    frames: tuple[int, ...] | None = None
    cameras: Literal["refine", "keep"] = "refine"
    masks: Literal["refine", "keep"] = "refine"
    exposures: Literal["match", "keep"] = "match"

    def __post_init__(self) -> None:
        """Check every field once."""
        for name in ("segment_length", "seam_frames"):
            require_count(name, getattr(self, name), low=0)
        for name in ("cameras", "masks"):
            require_choice(name, getattr(self, name), ("refine", "keep"))
        require_choice("exposures", self.exposures, ("match", "keep"))
        if self.frames is not None and list(self.frames) != sorted(set(self.frames)):
            raise InvalidOptionError(
                f"frames must be ascending and each there once, got {str(self.frames)[:60]}. Sort them."
            )


Records = Mapping[int, Sequence[CaptureRecord]]


class Mend(NamedTuple):
    """Something that is found wrong with a capture in its first frame, and is put right in all.

    Attributes:
        stage: Name of its step, of the option by which it is left out ("keep"), and of its entry in the report.
        kind: What is found, and its file.
        find: Called with the steps of a frame, names of the cameras, their views and progress; None for nothing.
        is_possible: Whether it can be found in records of these frames.
    """

    stage: str
    kind: type[SideFile]
    find: Callable[..., SideFile | None]
    is_possible: Callable[[Records], bool]


@dataclass(frozen=True)
class Reconstruction:
    """A finished reconstruction.

    Attributes:
        asset: Root layer of the asset.
        sequence: The Gaussians, read lazily from the store; axes "rfu", scene-linear radiance.
        report: What was measured, JSON-able; also written to ``report.json``.
        capture: The capture with the cameras, masks and colours that the Gaussians were fitted to.
    """

    asset: Path
    sequence: GaussianSequence
    report: dict[str, Any]
    capture: Capture


def reconstruct(
    capture: Capture,
    out: str | Path,
    steps: FrameSteps,
    options: ReconstructOptions | None = None,
    *,
    progress: NotedProgress = no_progress,
    crew: Crew = in_process,
) -> Reconstruction:
    """Reconstruct a capture; write ``out/gaussians.usda``, its layers, ``out/report.json`` and ``out/previews``.

    Every finished frame is kept in ``out/frames``; a second call takes up where the first one was stopped. Frames whose
    images, cameras or options changed, and all that were tracked from them, are made anew. At no time are images of
    more than two frames in the memory of a process.

    Args:
        capture: Images and cameras; its world is that of the Gaussians.
        out: Folder; made if it does not exist.
        steps: How the Gaussians of a frame are found.
        options: See `ReconstructOptions`.
        progress: Called with (stage, done, total, note).
        crew: Who does the work: this process, or those of `beam_warp.plan.crew`.

    Raises:
        InvalidOptionError: The capture has no such frame.
        MissingFileError: Too few of the images are there.
        AssetFormatError: Nothing can be reconstructed from this capture: the message says why.
        OutputError: The folder cannot be made or written.
        UnfinishedError: Several frames failed; the others are kept.
        BeamError: An image is damaged, or a step refuses its input.
    """
    started = time.perf_counter()
    work = ReconstructionWork.prepare(capture, require_path("out", out), steps, options)
    plan = work.plan()
    with closing(work):
        receipts = carry_out(plan, crew(plan, work.device_kind, progress), Counted(plan, {"frame": "frames"}, progress))
        return work.finish(receipts, started)


@dataclass(eq=False)
class ReconstructionWork:
    """Steps that find the Gaussians of every frame: those of `MENDS`, ``frame``, ``seam``, ``preview``, and the asset.

    Attributes:
        capture: Images and cameras.
        folder: Folder of the reconstruction.
        steps: How the Gaussians of a frame are found.
        options: Which frames, and in which segments.
        frames: Their records and segments, cameras as the capture states them.
        notes: What a killed call had left half written, and was removed.
    """

    later = ("trimesh",)  # of previews
    capture: Capture
    folder: Path
    steps: FrameSteps
    options: ReconstructOptions
    frames: FramePlan
    notes: list[str]
    _reader: FrameReader | None = None
    _latest: tuple[int, Sequence[CapturedView]] | None = None
    _mended: tuple[str, list[CapturedView]] | None = None

    @classmethod
    def prepare(
        cls, capture: Capture, out: Path, steps: FrameSteps, options: ReconstructOptions | None
    ) -> ReconstructionWork:
        """Check everything, and then make the folders."""
        chosen = options or ReconstructOptions()
        for name in (ASSET_NAME, REPORT_NAME):
            require_writable(out / name, is_made=True)
        with ThreadPoolExecutor(1) as beside:  # the driver of a GPU starts while images are looked at
            device = beside.submit(resolve_device, steps.device)
            frames = plan_frames(capture, chosen.frames, chosen.segment_length)
            device.result()
        store = FrameStore(out)
        return cls(capture, out, steps, chosen, frames, store.make_folders())

    def plan(self) -> Plan:
        """Return the steps; a frame follows the one before in its segment, and the first ones the cameras."""
        first: tuple[str, ...] = ()
        steps: list[Step] = []
        for mend in MENDS:
            if mend in self.mends:
                steps.append(Step(mend.stage, mend.stage, None, first, Rank.SHARED))
                first = (mend.stage,)
            else:
                (self.folder / mend.kind.FILE).unlink(missing_ok=True)
        for segment in self.frames.segments:
            for frame, previous in zip(segment, (None, *segment), strict=False):
                inputs = first if previous is None else (frame_step(previous),)
                rank = Rank.KEY_FRAME if previous is None else Rank.TRACKED_FRAME
                steps.append(Step(frame_step(frame), "frame", frame, inputs, rank))
                if frame in self.fades:
                    goes_on = frame_step(self._before(frame)) if previous is None else seam_step(previous)
                    steps.append(Step(seam_step(frame), "seam", frame, (goes_on,), Rank.TRACKED_FRAME))
                steps.append(Step(f"preview-{frame:06d}", "preview", frame, self.makers(frame), Rank.PREVIEW))
        clips = self.clips.plan()
        inputs = (
            *(name for frame in self.frames.records for name in self.makers(frame)),
            *(it.name for it in clips.steps),
        )
        steps.append(Step(ASSET_STEM, ASSET_STEM, None, inputs, Rank.KEY_FRAME))
        own = Plan(self.folder, tuple(steps), dict.fromkeys((step.stage for step in steps), self))
        return own.with_steps_of(clips)

    @property
    def may_be_constant(self) -> bool:
        """Whether there is one segment alone; in it, tracking may still be lost."""
        return len(self.frames.segments) == 1

    @cached_property
    def clips(self) -> ClipWork:
        """Steps that write the asset; of one segment alone, the topology is known when all frames are made."""
        numbers, read = tuple(self.frames.records), partial(self.sequence, is_constant=False)
        makers, shared = list(map(self.makers, numbers)), frozenset({"ids"}) if self.may_be_constant else None
        return ClipWork(self.folder, ASSET_STEM, read, makers, numbers, shared)

    def makers(self, frame: int) -> tuple[str, ...]:
        """Return the names of the steps that make the Gaussians of a frame."""
        return (frame_step(frame), seam_step(frame)) if frame in self.fades else (frame_step(frame),)

    @cached_property
    def fades(self) -> dict[int, float]:
        """Frames in which the segment before goes on, and its share."""
        return plan_fades(self.frames.segments, self.options.seam_frames)

    def _before(self, frame: int) -> int:
        order = tuple(self.frames.records)
        return order[order.index(frame) - 1]

    def _fading(self, frame: int) -> tuple[Path, float] | None:
        """Return what is laid over a frame; see `stored_cloud`."""
        return (self.seams.path(frame), self.fades[frame]) if frame in self.fades else None

    @property
    def device_kind(self) -> str:
        """Kind of device, "cuda" or "cpu"."""
        return "cuda" if resolve_device(self.steps.device).is_cuda else "cpu"

    @cached_property
    def store(self) -> FrameStore:
        """The files of frames and previews."""
        return FrameStore(self.folder)

    @cached_property
    def seams(self) -> FrameStore:
        """The files of frames as the segment before goes on to show them."""
        return FrameStore(self.folder, "seam")

    @cached_property
    def mends(self) -> tuple[Mend, ...]:
        """What is asked for and can be found."""
        asked = (mend for mend in MENDS if getattr(self.options, mend.stage) != "keep")
        return tuple(mend for mend in asked if mend.is_possible(self.frames.records))

    @cached_property
    def found(self) -> dict[str, Any]:
        """What was found wrong with the capture, by stage, when all of it has been sought."""
        read = {mend.stage: mend.kind.read(self.folder) for mend in self.mends}
        return {stage: found for stage, found in read.items() if found is not None}

    @cached_property
    def records(self) -> Records:
        """Records of each frame, with all that was found put right."""
        return _corrected(self.frames.records, self.found.values())

    def common(self) -> str:
        """Return all that every step depends on."""
        return self._common

    @cached_property
    def _common(self) -> str:
        return common_inputs(self.steps, self.device_kind)

    def digest(self, step: Step) -> str:
        """Return the digest of a frame's records and images, and of its share; a preview has those of its frame."""
        if step.stage == ASSET_STEM:
            return f"{self.clips.common()} {self.sequence(is_constant=False).metadata}"
        if step.frame is None:
            with FrameReader(self.frames.records, self.store.digests) as reader:
                return reader.digest(next(iter(self.frames.records)))
        if step.stage == "seam":
            return f"{self.fades[step.frame]} {self._images().digest(step.frame)}"
        return self._images().digest(step.frame) if step.stage == "frame" else ""

    def outputs(self, step: Step) -> tuple[Path, ...]:
        """Return the file of a step; there is none where nothing was found wrong."""
        if step.stage == ASSET_STEM:
            return self.clips.files()
        if step.frame is None:
            return tuple(
                path for mend in MENDS if mend.stage == step.stage and (path := self.folder / mend.kind.FILE).is_file()
            )
        kinds = {"frame": self.store.path, "seam": self.seams.path, "preview": self.store.preview_path}
        return (kinds[step.stage](step.frame),)

    def do(self, task: Task, progress: NotedProgress) -> Mapping[str, Any]:
        """Find what is wrong with the capture, model a frame, draw its preview, or write the asset."""
        step = task.step
        if step.stage == ASSET_STEM:
            said = dict(zip(step.inputs, task.facts, strict=True))
            self.clips.write(self.sequence(), self.folder / ASSET_NAME, said)
            return {}
        if step.frame is None:
            return self._mend(step.stage, progress)
        if step.stage == "preview":
            write_png(self.store.preview_path(step.frame), self._preview(step.frame))
            self._latest = None
            return {}
        self._latest = None
        views = self._views(self._images(), step.frame)
        self._latest = step.frame, views
        for following in task.following:
            if following.stage in ("frame", "seam") and following.frame is not None:
                self._images().expect(following.frame)
                break
        return self._model(step, views, progress)

    def close(self) -> None:
        """End the threads that read."""
        self._latest = self._mended = None
        if self._reader is not None:
            self._reader.__exit__()
            self._reader = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what other processes need: no threads, no images, nothing that was read."""
        kept = {field.name: vars(self)[field.name] for field in fields(self)}
        return kept | dict.fromkeys(("_reader", "_latest", "_mended"))

    def _images(self) -> FrameReader:
        if self._reader is None:
            self._reader = FrameReader(self.records, self.store.digests)
        return self._reader

    def _views(self, reader: FrameReader, frame: int) -> list[CapturedView]:
        """Return the images of a frame: those at which it was last looked for what is wrong, if they are the same."""
        kept, self._mended = self._mended, None  # not both in memory
        return kept[1] if kept is not None and kept[0] == reader.digest(frame) else reader.views(frame)

    def _mend(self, stage: str, progress: NotedProgress) -> dict[str, Any]:
        """Find something wrong with the capture, what was found before it put right."""
        place = [mend.stage for mend in self.mends].index(stage)
        mend, frame = self.mends[place], next(iter(self.frames.records))
        known = filter(None, (before.kind.read(self.folder) for before in self.mends[:place]))
        records = _corrected({frame: self.frames.records[frame]}, known)
        with FrameReader(records, self.store.digests) as reader:
            names = [record.camera_name for record in records[frame]]
            views = self._views(reader, frame)
            self._mended = reader.digest(frame), views
            found = mend.find(self.steps, names, views, within(progress, stage, frame))
        if found is None:
            (self.folder / mend.kind.FILE).unlink(missing_ok=True)
        else:
            write_json(self.folder / mend.kind.FILE, found.as_dict())
        return {}

    def _model(self, step: Step, views: Sequence[CapturedView], progress: NotedProgress) -> dict[str, Any]:
        """Fit or track a frame and store it; what is lost after a segment's end stays so."""
        assert step.frame is not None
        before, lost, is_seam = None, "", step.stage == "seam"
        if step.rank == Rank.TRACKED_FRAME:
            previous = self._before(step.frame)
            store = self.seams if seam_step(previous) in step.inputs else self.store
            said = store.report(previous)
            before = self.steps.restore(store.track_arrays(previous)), int(said["segment"])
            lost = said["lost"] if store is self.seams else ""
        model = model_frame(self.steps, step.frame, views, before, progress, is_refitted=not is_seam)
        if is_seam:
            model.report["lost"] = lost or model.report["lost"]
            self.seams.write(step.frame, model)
            return {"gaussians": 0 if model.report["lost"] else len(model.track.cloud)}
        self.store.write(step.frame, model)
        return {"line": frame_line(model.report), "report": model.report}

    def _preview(self, frame: int) -> NDArray[np.uint8]:
        """Draw the preview of a stored frame; its images are read again where they are not at hand."""
        records, raster = self.records[frame], self.steps.raster
        cloud = stored_cloud(self.store.path(frame), self._fading(frame))
        cameras = [record.camera for record in records]
        chosen, device = opposite_cameras(cameras), str(resolve_device(self.steps.device))
        views = self._latest[1] if self._latest is not None and self._latest[0] == frame else None
        return reconstruction_preview(
            cloud,
            [records[index].view() if views is None else views[index] for index in chosen],
            shadings=mesh_shadings(cloud, cameras, chosen, options=raster, device=device),
            options=raster,
            samples=int(self.store.report(frame).get("samples", 1)),
            device=device,
        )

    def sequence(self, *, is_constant: bool | None = None) -> GaussianSequence:
        """Return the stored frames; see `stored_sequence`. Several segments have no identities in common."""
        frames = tuple(self.frames.records)
        return stored_sequence(
            [self.store.path(frame) for frame in frames],
            self.capture.frames_per_second or 30.0,
            {**(self.steps.raster or RasterOptions()).as_metadata(), **capture_frames_metadata(frames)},
            is_constant if self.may_be_constant else False,
            {place: fading for place, frame in enumerate(frames) if (fading := self._fading(frame)) is not None},
        )

    def seen(self) -> Capture:
        """Return the capture with the cameras that the Gaussians are fitted with."""
        return reduce(lambda capture, found: found.capture(capture), self.found.values(), self.capture)

    def finish(self, receipts: Mapping[str, Receipt], started: float) -> Reconstruction:
        """Write the report of a plan that was carried out, begun at a time [s]."""
        report = {**self._report(receipts), "seconds": time.perf_counter() - started}
        write_report(self.folder, report)
        return Reconstruction(self.folder / ASSET_NAME, self.sequence(), report, self.seen())

    def _frame_report(self, frame: int, receipts: Mapping[str, Receipt]) -> dict[str, Any]:
        """Return what a frame's report says; Gaussians and seconds are those of both segments where one fades out."""
        own, *seams = (receipts[name] for name in self.makers(frame))
        report, fading = own.facts["report"], sum(seam.facts["gaussians"] for seam in seams)
        seconds = own.seconds + sum(seam.seconds for seam in seams)
        return {**report, "gaussians": report["gaussians"] + fading, "fading_gaussians": fading, "seconds": seconds}

    def _findings(self) -> list[Finding]:
        """Return what a user should know about the capture."""
        said = list(self.frames.findings)
        exposures = self.found.get("exposures")
        if isinstance(exposures, RigExposures) and not exposures.exposure_undone:
            # What cameras show of the same points outranks what inspection makes of the brightness of whole images.
            said = [finding for finding in said if finding.code != "camera-exposure"]
        for mend in MENDS:
            if mend.stage in self.found:
                said += self.found[mend.stage].findings()
            elif mend.stage == "cameras" and self.options.cameras == "refine":
                said.append(_why_kept(self.frames.records))
        return said

    def _report(self, receipts: Mapping[str, Receipt]) -> dict[str, Any]:
        """Return what was done and found, JSON-able."""
        records = self.records
        made = {frame: receipts[frame_step(frame)] for frame in records}
        frames = [self._frame_report(frame, receipts) for frame in records]
        findings = self._findings()
        return {
            "input": {
                "capture": str(self.capture.folder),
                "frames": len(frames),
                "cameras": len({record.camera_name for found in records.values() for record in found}),
            },
            "device": device_facts(resolve_device(self.steps.device)),
            "workers": sorted({receipt.worker for receipt in receipts.values()}),
            "versions": versions(),
            "options": {
                **self.steps.options(),
                "segment_length": self.options.segment_length,
                "seam_frames": self.options.seam_frames,
                **{mend.stage: getattr(self.options, mend.stage) for mend in MENDS},
            },
            "resumed_frames": sum(receipt.is_kept for receipt in made.values()),
            **{mend.stage: self.found[mend.stage].as_dict() if mend.stage in self.found else None for mend in MENDS},
            "masks": self.found["masks"].as_dict()["cameras"] if "masks" in self.found else {},
            **sequence_facts(frames),
            "findings": [vars(finding) for finding in findings],
            "warnings": [*self.notes, *(finding.what for finding in findings), *warnings_of(frames)],
        }


def frame_step(frame: int) -> str:
    """Return the name of the step that finds the Gaussians of a frame."""
    return f"frame-{frame:06d}"


def seam_step(frame: int) -> str:
    """Return the name of the step that tracks the segment before into a frame."""
    return f"seam-{frame:06d}"


def _why_kept(records: Mapping[int, Sequence[CaptureRecord]]) -> Finding:
    """Say why nothing is known about the cameras of a capture."""
    count = len(next(iter(records.values())))
    if not _is_fixed_rig(records):
        why = "they move, or several have one name"
    elif count < FEWEST_CAMERAS:
        why = (
            f"{FEWEST_CAMERAS} are needed to tell which one is wrong, and there {'is' if count == 1 else 'are'} {count}"
        )
    else:
        why = "images without masks do not tell where they look"
    return Finding("note", "cameras-kept", f"cameras are taken as they are stated: {why}")


def _is_fixed_rig(records: Mapping[int, Sequence[CaptureRecord]]) -> bool:
    """Tell whether each camera has a name of its own, and stands still in all frames."""
    cameras: dict[str, Camera] = {}
    for found in records.values():
        if len({record.camera_name for record in found}) < len(found):
            return False
        for record in found:
            first = cameras.setdefault(record.camera_name, record.camera)
            if not np.array_equal(first.camera_to_world, record.camera.camera_to_world):
                return False
    return True


MENDS = (
    Mend(
        "masks",
        MaskCorrections,
        lambda steps, *asked: steps.mend_masks(*asked),
        lambda records: _has_own_names(next(iter(records.values()))),
    ),
    Mend("cameras", RigCorrection, lambda steps, *asked: steps.refine_rig(*asked), _is_fixed_rig),
    Mend("exposures", RigExposures, lambda steps, *asked: steps.find_exposures(*asked), _is_fixed_rig),
)
"""What is put right, in this order: each step sees the capture as those before it left it."""


def _has_own_names(records: Sequence[CaptureRecord]) -> bool:
    return len({record.camera_name for record in records}) == len(records)


def _corrected(records: Records, found: Iterable[Any]) -> Records:
    """Return records with all that was found put right."""
    for one in found:
        records = {frame: one.corrected(rows) for frame, rows in records.items()}
    return records
