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
    store           frames.store    one file a frame, under its key
    write           this module     asset, previews, report

The key of a frame covers everything it depends on: the version, the kind of device, the options, what the capture
states and shows of the frame, and, but for the first of a segment, the key of the frame before. Tracking always goes on
from what the file holds, never from what is in memory, so that a job that was stopped anywhere continues to the same
bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from beam_warp import converters
from beam_warp.capture import corrections, exposures, mask_corrections
from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.corrections import RigCorrection, read_corrections
from beam_warp.capture.cutouts import taken_in
from beam_warp.capture.exposures import RigExposures, read_exposures
from beam_warp.capture.findings import Finding
from beam_warp.capture.mask_corrections import MaskCorrections, read_mask_corrections
from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_choice, require_count, require_path
from beam_warp.converters.staging import require_writable
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import AssetFormatError, InvalidOptionError
from beam_warp.jobs.listeners import NotedProgress, no_progress
from beam_warp.jobs.report import REPORT_NAME, device_facts, versions, write_json, write_report
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.frames.model import model_frame, within
from beam_warp.reconstruction.frames.plan import FramePlan, plan_frames
from beam_warp.reconstruction.frames.protocols import FrameSteps
from beam_warp.reconstruction.frames.reader import FrameReader
from beam_warp.reconstruction.frames.report import frame_line, sequence_facts, warnings_of
from beam_warp.reconstruction.frames.store import FrameStore, common_inputs, key_of_frame, stored_cloud, stored_sequence
from beam_warp.reconstruction.preview import mesh_shadings, opposite_cameras, reconstruction_preview
from beam_warp.reconstruction.rig import FEWEST_CAMERAS
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import capture_frames_metadata

ASSET_NAME = "gaussians.usda"


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """Options of a reconstruction: its frames, where key frames are planned, and what of the capture is mended.

    Attributes:
        segment_length: Frames from one key frame to the next; 0 for a key frame at the start only.
        frames: Numbers of the frames, ascending; None for all of the split.
        cameras: ``"refine"`` corrects cameras that are beyond doubt wrong, the same in all frames; ``"keep"`` takes all
            as the capture states them.
        masks: ``"refine"`` moves masks of cut-outs that are beyond doubt wrong, those of a camera the same in all
            frames; ``"keep"`` takes all as they are.
        exposures: ``"match"`` undoes differences of exposure and white balance between cameras that are beyond doubt,
            the same in all frames; ``"keep"`` takes all colours as photographed.
    """

    segment_length: int = 0
    frames: tuple[int, ...] | None = None
    cameras: Literal["refine", "keep"] = "refine"
    masks: Literal["refine", "keep"] = "refine"
    exposures: Literal["match", "keep"] = "match"

    def __post_init__(self) -> None:
        """Check every field once."""
        require_count("segment_length", self.segment_length, low=0)
        for name in ("cameras", "masks"):
            require_choice(name, getattr(self, name), ("refine", "keep"))
        require_choice("exposures", self.exposures, ("match", "keep"))
        if self.frames is not None and list(self.frames) != sorted(set(self.frames)):
            raise InvalidOptionError(
                f"frames must be ascending and each there once, got {str(self.frames)[:60]}. Sort them."
            )


@dataclass(frozen=True)
class SegmentShare:
    """The segments that one of several processes works on: every ``count``-th, from the ``number``-th on.

    Attributes:
        number: Which share, from 1 on.
        count: Shares in all.

    Raises:
        InvalidOptionError: The number is not one of the shares.
    """

    number: int
    count: int

    def __post_init__(self) -> None:
        """Check both once."""
        if not 1 <= self.number <= self.count:
            raise InvalidOptionError(
                f"part must be I/N with 1 <= I <= N, got {self.number}/{self.count}. Count the parts from 1."
            )


@dataclass(frozen=True)
class Reconstruction:
    """A finished reconstruction.

    Attributes:
        asset: Root layer of the asset.
        sequence: The Gaussians, read lazily from the store; axes "rfu", scene-linear radiance.
        report: What was measured, JSON-able; also written to ``report.json``.
        capture: The capture with the cameras, masks and colours that the Gaussians were fitted with.
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
) -> Reconstruction:
    """Reconstruct a capture; write ``out/gaussians.usda``, its layers, ``out/report.json`` and ``out/previews``.

    Every finished frame is kept in ``out/frames``; a second call takes up where the first one, or calls of
    `reconstruct_part`, were stopped. Frames whose images, cameras or options changed, and all that were tracked from
    them, are made anew. At no time are images of more than two frames in memory.

    Args:
        capture: Images and cameras; its world is that of the Gaussians.
        out: Folder; made if it does not exist.
        steps: How the Gaussians of a frame are found.
        options: See `ReconstructOptions`.
        progress: Called with (stage, done, total, note).

    Raises:
        InvalidOptionError: The capture has no such frame.
        MissingFileError: Too few of the images are there.
        AssetFormatError: Nothing can be reconstructed from this capture: the message says why.
        OutputError: The folder cannot be made or written.
        BeamError: An image is damaged, or a step refuses its input.
    """
    started = time.perf_counter()
    folder, chosen = require_path("out", out), options or ReconstructOptions()
    job = _prepare(capture, folder, steps, chosen, progress)
    resumed = _reconstruct_segments(job, job.plan.segments)
    progress("write asset", 0, 1)
    asset, sequence = _write_asset(job, folder, capture.frames_per_second or 30.0)
    progress("write asset", 1, 1)
    report = {**_report(job, capture, chosen, resumed), "seconds": time.perf_counter() - started}
    write_report(folder, report)
    for found in (job.masks, job.rig, job.exposures):
        capture = capture if found is None else found.capture(capture)
    return Reconstruction(asset, sequence, report, capture)


def reconstruct_part(
    capture: Capture,
    out: str | Path,
    steps: FrameSteps,
    part: SegmentShare,
    options: ReconstructOptions | None = None,
    *,
    progress: NotedProgress = no_progress,
) -> tuple[int, ...]:
    """Reconstruct some segments into ``out/frames`` and ``out/previews``; `reconstruct` then finds them there.

    Parts may run at the same time, in processes of their own or on several machines that share the folder.

    Args:
        capture: As `reconstruct`.
        out: As `reconstruct`, and the same for all parts.
        steps: As `reconstruct`; the kind of device must be the same for all parts.
        part: Which segments.
        options: As `reconstruct`, and the same for all parts.
        progress: Called with (stage, done, total, note), of this part alone.

    Returns:
        The frames that are ready now.

    Raises:
        InvalidOptionError: There is one segment only; else as `reconstruct`.
        MissingFileError, OutputError, BeamError: As `reconstruct`.
    """
    chosen = options or ReconstructOptions()
    if chosen.segment_length == 0 and part.count > 1:
        raise InvalidOptionError(
            f"segment_length must be at least 1 to work in parts, got 0 with part {part.number}/{part.count}: there is "
            "one segment only. State the length of the segments."
        )
    job = _prepare(capture, require_path("out", out), steps, chosen, progress)
    segments = job.plan.segments[part.number - 1 :: part.count]
    _reconstruct_segments(job, segments)
    return tuple(frame for segment in segments for frame in segment)


@dataclass(frozen=True, eq=False)
class _Job:
    """The state that all frames of one call share."""

    plan: FramePlan
    steps: FrameSteps
    device: Any
    store: FrameStore
    common_inputs: str
    progress: NotedProgress
    masks: MaskCorrections = field(default_factory=MaskCorrections)
    rig: RigCorrection | None = None
    exposures: RigExposures | None = None


def _prepare(
    capture: Capture, out: Path, steps: FrameSteps, options: ReconstructOptions, progress: NotedProgress
) -> _Job:
    """Check everything, and then make the folders."""
    device = resolve_device(steps.device)
    for name in (ASSET_NAME, REPORT_NAME):
        require_writable(out / name, is_made=True)
    plan = plan_frames(capture, options.frames, options.segment_length)
    job = _Job(plan, steps, device, FrameStore(out), common_inputs(steps, device), progress)
    with FrameReader(plan.records, job.store.digests) as reader:
        read = cache(lambda: reader.views(next(iter(plan.records))))
        if options.masks == "refine" and (masks := _mended_masks(job, out, reader, read)) is not None:
            job = replace(job, masks=masks, plan=_corrected(job.plan, masks))
        else:
            (out / mask_corrections.FILE_NAME).unlink(missing_ok=True)
        if options.cameras == "refine" and (rig := _refined_rig(job, out, read)) is not None:
            job = replace(job, rig=rig, plan=_corrected(job.plan, rig))
        else:
            (out / corrections.FILE_NAME).unlink(missing_ok=True)
            kept = (_why_kept(plan.records),) if options.cameras == "refine" else ()
            job = replace(job, plan=replace(job.plan, findings=(*job.plan.findings, *kept)))
    if options.exposures == "match" and (found := _found_exposures(job, out)) is not None:
        return replace(job, exposures=found, plan=_corrected(job.plan, found))
    (out / exposures.FILE_NAME).unlink(missing_ok=True)
    return job


def _corrected(plan: FramePlan, found: MaskCorrections | RigCorrection | RigExposures) -> FramePlan:
    """Return a plan with corrected records, and what is to be said of that."""
    records = {frame: found.corrected(rows) for frame, rows in plan.records.items()}
    return replace(plan, records=records, findings=(*plan.findings, *found.findings()))


def _mended_masks(
    job: _Job, out: Path, reader: FrameReader, read: Callable[[], list[CapturedView]]
) -> MaskCorrections | None:
    """Find how far masks are off, or read what was found from the same images before; None for nothing to say."""
    frame, records = next(iter(job.plan.records.items()))
    names = [record.camera_name for record in records]
    if len(set(names)) < len(names):
        return None
    key = key_of_frame(job.common_inputs, frame, reader.digest(frame), "masks")
    known = None
    with suppress(AssetFormatError):  # what is damaged is found anew
        known = read_mask_corrections(out, key)
    if known is None:
        known = job.steps.mend_masks(names, read(), within(job.progress, "masks", frame))
        write_json(out / mask_corrections.FILE_NAME, {"key": key, **known.as_dict()})
    return known


def _refined_rig(job: _Job, out: Path, read: Callable[[], list[CapturedView]]) -> RigCorrection | None:
    """Find what is wrong with the cameras, or read what was found from the same images before; None for nothing."""
    frame, records = next(iter(job.plan.records.items()))
    if not _is_fixed_rig(job.plan.records):
        return None
    with FrameReader(job.plan.records, job.store.digests) as reader:
        key = key_of_frame(job.common_inputs, frame, reader.digest(frame), "cameras")
        known = None
        with suppress(AssetFormatError):  # what is damaged is found anew
            known = read_corrections(out, key)
        if known is None:
            names = [record.camera_name for record in records]
            views = [taken_in(view, record.mask_excess) for view, record in zip(read(), records, strict=True)]
            known = job.steps.refine_rig(names, views, within(job.progress, "cameras", frame))
            if known is not None:
                write_json(out / corrections.FILE_NAME, {"key": key, **known.as_dict()})
    return known


def _found_exposures(job: _Job, out: Path) -> RigExposures | None:
    """Find exposures and white balances, or read what was found from the same images before; None for nothing."""
    frame, records = next(iter(job.plan.records.items()))
    if not _is_fixed_rig(job.plan.records):
        return None
    with FrameReader(job.plan.records, job.store.digests) as reader:
        key = key_of_frame(job.common_inputs, frame, reader.digest(frame), "exposures")
        known = None
        with suppress(AssetFormatError):  # what is damaged is found anew
            known = read_exposures(out, key)
        if known is None:
            names = [record.camera_name for record in records]
            progress = within(job.progress, "exposures", frame)
            known = job.steps.find_exposures(names, reader.views(frame), progress)
            if known is not None:
                write_json(out / exposures.FILE_NAME, {"key": key, **known.as_dict()})
    return known


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


def _reconstruct_segments(job: _Job, segments: Sequence[Sequence[int]]) -> int:
    """Bring the frames of some segments into the store, those of each in their order; return how many were there."""
    order = [step for segment in segments for step in zip(segment, (None, *segment), strict=False)]
    job.progress("frames", 0, len(order))
    key, resumed = "", 0
    with FrameReader(job.plan.records, job.store.digests) as reader:
        for done, (frame, previous) in enumerate(order):
            key = key_of_frame(job.common_inputs, frame, reader.digest(frame), "" if previous is None else key)
            views, seconds = None, None
            if job.store.key(frame) == key:
                resumed += 1
            else:
                views = reader.views(frame)
                if done + 1 < len(order):
                    reader.expect(order[done + 1][0])
                seconds = _model_and_store(job, frame, key, views, previous)
            if not job.store.has_preview(frame, key):
                job.store.write_preview(frame, key, _preview(job, frame, views), seconds)
            job.progress("frames", done + 1, len(order), frame_line(job.store.report(frame)))
    return resumed


def _model_and_store(job: _Job, frame: int, key: str, views: Sequence[CapturedView], previous: int | None) -> float:
    """Fit or track a frame and store it; return how long that took [s]."""
    started = time.perf_counter()
    before = None
    if previous is not None:
        track = job.steps.restore(job.store.track_arrays(previous))
        before = track, int(job.store.report(previous)["segment"])
    job.store.write(frame, key, model_frame(job.steps, frame, views, before, job.progress))
    return time.perf_counter() - started


def _preview(job: _Job, frame: int, views: Sequence[CapturedView] | None) -> NDArray[np.uint8]:
    """Draw the preview of a stored frame; its images are read again where they are not at hand."""
    records, device, raster = job.plan.records[frame], str(job.device), job.steps.raster
    cloud, cameras = stored_cloud(job.store.path(frame)), [record.camera for record in records]
    chosen = opposite_cameras(cameras)
    return reconstruction_preview(
        cloud,
        [records[index].view() if views is None else views[index] for index in chosen],
        shadings=mesh_shadings(cloud, cameras, chosen, options=raster, device=device),
        options=raster,
        samples=int(job.store.report(frame).get("samples", 1)),
        device=device,
    )


def _write_asset(job: _Job, out: Path, frames_per_second: float) -> tuple[Path, GaussianSequence]:
    """Write the asset of all frames."""
    frames = tuple(job.plan.records)
    sequence = stored_sequence(
        [job.store.path(frame) for frame in frames],
        frames_per_second,
        {**(job.steps.raster or RasterOptions()).as_metadata(), **capture_frames_metadata(frames)},
    )
    converters.write(sequence, out / ASSET_NAME)
    return out / ASSET_NAME, sequence


def _report(job: _Job, capture: Capture, options: ReconstructOptions, resumed: int) -> dict[str, Any]:
    """Return what was done and found, JSON-able."""
    records, findings = job.plan.records, job.plan.findings
    frames = [{**job.store.report(frame), "seconds": job.store.seconds(frame)} for frame in records]
    return {
        "input": {
            "capture": str(capture.folder),
            "frames": len(frames),
            "cameras": len({record.camera_name for found in records.values() for record in found}),
        },
        "device": device_facts(job.device),
        "versions": versions(),
        "options": {
            **job.steps.options(),
            "segment_length": options.segment_length,
            "cameras": options.cameras,
            "masks": options.masks,
            "exposures": options.exposures,
        },
        "resumed_frames": resumed,
        "cameras": None if job.rig is None else job.rig.as_dict(),
        "masks": job.masks.as_dict()["cameras"],
        "exposures": None if job.exposures is None else job.exposures.as_dict(),
        **sequence_facts(frames),
        "findings": [vars(finding) for finding in findings],
        "warnings": [*job.store.notes, *(finding.what for finding in findings), *warnings_of(frames)],
    }
