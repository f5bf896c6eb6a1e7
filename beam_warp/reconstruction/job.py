"""From a multi-view capture to a Gaussian sequence: frame by frame, in segments, resumable after any kill.

A segment starts with a key frame, which is fitted from nothing but its images; every further frame is tracked from the
one before. So segments depend on nothing of each other and may be worked on by several processes, and what tracking
loses, the next key frame finds again. A frame in which tracking says that it is lost becomes a key frame itself.

Each finished frame is one file of the store, with its Gaussians and all that the next frame needs, under a key that
covers everything it depends on: the version, the kind of device, the options, what the capture states and shows of the
frame, and, but for the first of a segment, the key of the frame before. Tracking always goes on from what the file
holds, never from what is in memory, so that a job that was stopped anywhere continues to the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from beam_warp import converters
from beam_warp._version import __version__
from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.digests import CaptureDigests, require_files
from beam_warp.capture.inspect import SPLIT, require_reconstructable
from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_count
from beam_warp.device.arrays import resolve_device
from beam_warp.digests import code_digest
from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.image.files import write_png
from beam_warp.jobs.report import device_facts, versions, write_json, write_report
from beam_warp.jobs.store import frame_key, frame_names, make_folders, read_frame, write_frame
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.preview import mesh_shadings, opposite_cameras, reconstruction_preview
from beam_warp.world.gaussians import ATTRIBUTES, WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.metadata import capture_frames_metadata

ASSET_NAME = "gaussians.usda"

ID_BITS = 32
"""Identities of a segment start at the number of its first frame times 2 to this power: no two segments share one."""

DRIFT_WARNING = 3.0
"""PSNR that a tracked frame may lie below its key frame before it is said [dB]."""

LOADING_THREADS = 8
"""Images decoded at a time."""

HEADER, TRACK = "header", "track_"


class Progress(Protocol):
    """Hears how far a stage is."""

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Take ``done`` of ``total`` steps of a stage, and words about the latest one."""


class StepProgress(Protocol):
    """Hears how far a frame is."""

    def __call__(self, done: int, total: int, facts: Mapping[str, float] = MappingProxyType({})) -> None:
        """Take ``done`` of ``total`` iterations; of the facts, ``psnr`` and ``gaussians`` are shown."""


class FrameTrack(Protocol):
    """What the next frame needs of this one."""

    @property
    def cloud(self) -> GaussianCloud:
        """This frame's Gaussians: axes "rfu", scene-linear radiance, ids in [0, 2^32) that persist in a segment."""
        ...

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything, so that `FrameSteps.restore` gives the same track again."""
        ...


class FrameSteps(Protocol):
    """How the Gaussians of a frame are found; the same input gives the same bits.

    Reports are JSON-able. Their ``psnr`` and ``gaussians`` are shown and summed up; ``lost``, of a tracked frame, says
    why tracking is lost, empty if it is not; ``findings`` are what is to be said of the frame, each the fields of a
    `beam_warp.capture.findings.Finding`. All of them must be repeatable but ``seconds``, which is not kept.
    """

    @property
    def device(self) -> str | None:
        """Warp device; None takes the first CUDA device, or the CPU."""
        ...

    @property
    def raster(self) -> RasterOptions | None:
        """How splats are drawn; None for the defaults."""
        ...

    def options(self) -> Mapping[str, Any]:
        """Return all that results depend on, but for the device; JSON-able."""
        ...

    def begin(self, views: Sequence[CapturedView], progress: StepProgress) -> tuple[FrameTrack, dict[str, Any]]:
        """Fit a key frame from its images alone."""
        ...

    def advance(
        self, track: Any, views: Sequence[CapturedView], progress: StepProgress
    ) -> tuple[FrameTrack, dict[str, Any]]:
        """Track the frame after."""
        ...

    def restore(self, arrays: dict[str, NDArray[Any]]) -> FrameTrack:
        """Return the track whose `FrameTrack.arrays` these are."""
        ...


def no_progress(stage: str, done: int, total: int, note: str = "") -> None:
    """Report to nobody."""


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """Which frames are reconstructed, and where key frames are planned.

    Attributes:
        segment_length: Frames from one key frame to the next; 0 for a key frame at the start only.
        frames: Numbers of the frames, ascending; None for all of the split.
    """

    segment_length: int = 0
    frames: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        """Check every field once."""
        require_count("segment_length", self.segment_length, low=0)
        if self.frames is not None and list(self.frames) != sorted(set(self.frames)):
            raise InvalidOptionError(
                f"frames must be ascending and each there once, got {str(self.frames)[:60]}. Sort them."
            )


@dataclass(frozen=True)
class Part:
    """Every ``count``-th segment, from the ``number``-th on; numbers start at 1.

    Raises:
        InvalidOptionError: The number is not one of the parts.
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
    """Where things are, and what was found.

    Attributes:
        asset: Root layer of the asset.
        sequence: The Gaussians, read lazily from the store; axes "rfu", scene-linear radiance.
        report: What was measured, JSON-able; also written to ``report.json``.
    """

    asset: Path
    sequence: GaussianSequence
    report: dict[str, Any]


def reconstruct(
    capture: Capture,
    out: str | Path,
    steps: FrameSteps,
    options: ReconstructOptions | None = None,
    *,
    progress: Progress = no_progress,
) -> Reconstruction:
    """Reconstruct a capture; write ``out/gaussians.usda``, its layers, ``out/report.json`` and ``out/previews``.

    Every finished frame is kept in ``out/frames``; a second call takes up where the first one, or calls of
    `reconstruct_part`, were stopped. Frames whose images, cameras or options changed, and all that were tracked from
    them, are made anew. At no time are images of more than two frames in memory.

    Args:
        capture: Images and cameras; its world is that of the Gaussians.
        out: Folder; made if its parent exists.
        steps: How the Gaussians of a frame are found.
        options: See `ReconstructOptions`.
        progress: Called with (stage, done, total, note).

    Raises:
        InvalidOptionError: The capture has no such frame.
        MissingFileError: Images are not there, and what is left does not do.
        AssetFormatError: Nothing can be reconstructed from this capture: the message says why.
        OutputError: The folder cannot be made or written.
        BeamError: An image is damaged, or a step refuses its input.
    """
    started = time.perf_counter()
    job = _Job(capture, Path(out), steps, options or ReconstructOptions(), progress)
    job.reconstruct(job.segments)
    progress("write asset", 0, 1)
    _remove_leftovers(Path(out))
    sequence = stored_sequence(
        [job.path(frame) for frame in job.frames],
        capture.frames_per_second or 30.0,
        {**(steps.raster or RasterOptions()).as_metadata(), **capture_frames_metadata(job.frames)},
    )
    asset = Path(out) / ASSET_NAME
    converters.write(sequence, asset)
    progress("write asset", 1, 1)
    report = job.report()
    report["seconds"] = time.perf_counter() - started
    write_report(Path(out), report)
    return Reconstruction(asset, sequence, report)


def reconstruct_part(
    capture: Capture,
    out: str | Path,
    steps: FrameSteps,
    part: Part,
    options: ReconstructOptions | None = None,
    *,
    progress: Progress = no_progress,
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
    job = _Job(capture, Path(out), steps, chosen, progress)
    segments = job.segments[part.number - 1 :: part.count]
    job.reconstruct(segments)
    return tuple(frame for segment in segments for frame in segment)


def plan_segments(frames: Sequence[int], length: int) -> tuple[tuple[int, ...], ...]:
    """Return the frames in segments of a length, the last one perhaps shorter; length 0 makes one segment."""
    step = length or len(frames)
    return tuple(tuple(frames[start : start + step]) for start in range(0, len(frames), step))


def stored_sequence(
    paths: Sequence[Path], frames_per_second: float, stated: Mapping[str, str] = MappingProxyType({})
) -> GaussianSequence:
    """Return frames of the store as a sequence; they are read when they are asked for.

    Its topology is constant where every frame has the same identities, in the same rows.

    Args:
        paths: The frames' files, in order.
        frames_per_second: Playback rate [1/s].
        stated: What its metadata say besides: how the Gaussians were drawn, which frames of the capture they show
            (see `beam_warp.world.metadata`).
    """
    ids = read_frame(paths[0], ("ids",))["ids"]
    constant = all(np.array_equal(read_frame(path, ("ids",))["ids"], ids) for path in paths[1:])
    return GaussianSequence(
        frame_count=len(paths),
        read_frame=lambda frame: stored_cloud(paths[frame]),
        frames_per_second=frames_per_second,
        constant=frozenset({"ids"}) if constant else frozenset(),
        topology="constant" if constant else "perFrame",
        metadata={
            "generator": f"beam-warp {__version__}",
            "radiance_meaning": "captured",
            "source_axes": WORLD_AXES,
            **stated,
        },
    )


def stored_cloud(path: Path) -> GaussianCloud:
    """Read the Gaussians of a frame of the store."""
    names = tuple(name for name in frame_names(path) if name in ATTRIBUTES)
    return GaussianCloud(**read_frame(path, names), axes=WORLD_AXES, radiance_color_space=LINEAR_REC709)


class _Images:
    """Images and digests, a frame at a time, and those of the next while the present ones are worked on."""

    def __init__(
        self, records: Mapping[int, Sequence[CaptureRecord]], digests: CaptureDigests, pool: ThreadPoolExecutor
    ) -> None:
        self._records = records
        self._digests = digests
        self._pool = pool
        self._ahead = ThreadPoolExecutor(1)
        self._expected: tuple[int, Future[list[CapturedView]]] | None = None

    def close(self) -> None:
        self._ahead.shutdown(wait=True, cancel_futures=True)

    def expect(self, frame: int) -> None:
        """Begin to read a frame that is likely to be asked for next."""
        self._expected = (frame, self._ahead.submit(self._prepare, frame))

    def digest(self, frame: int) -> str:
        return self._digests.of(frame, self._records[frame], self._pool)

    def views(self, frame: int) -> list[CapturedView]:
        expected, self._expected = self._expected, None
        if expected is not None and expected[0] == frame:
            return expected[1].result()
        return self._read(frame)

    def _prepare(self, frame: int) -> list[CapturedView]:
        self.digest(frame)  # is remembered
        return self._read(frame)

    def _read(self, frame: int) -> list[CapturedView]:
        return list(self._pool.map(lambda record: record.view(), self._records[frame]))  # kinds of records differ


class _Job:
    """One call: what it was given, where its store is, and how far it is."""

    def __init__(
        self, capture: Capture, out: Path, steps: FrameSteps, options: ReconstructOptions, progress: Progress
    ) -> None:
        self._device = resolve_device(steps.device)  # before a folder is made that would then stay empty
        self._capture = capture
        self._steps = steps
        self._options = options
        self._progress = progress
        ready = require_reconstructable(_selected(capture, options))
        self._findings = [finding for finding in ready.fallbacks if finding.severity == "warning"]
        self._records = _by_frame(ready.capture.select(split=SPLIT))
        require_files(record for records in self._records.values() for record in records)
        self._folders = make_folders(out, "frames", "previews", "digests")
        self._folder, self._previews, digests = self._folders
        self._digests = CaptureDigests(digests)
        self._resumed = 0
        self._seconds: dict[int, float] = {}
        self._base = json.dumps(
            {
                "code": code_digest(),
                "device": "cuda" if self._device.is_cuda else "cpu",
                "options": steps.options(),
            },
            sort_keys=True,
        )
        self.frames = tuple(self._records)
        self.segments = plan_segments(self.frames, options.segment_length)

    def path(self, frame: int) -> Path:
        return self._folder / f"frame_{frame:06d}.h5"

    def reconstruct(self, segments: Sequence[Sequence[int]]) -> None:
        """Bring the frames of some segments into the store, those of each in their order."""
        order = [step for segment in segments for step in zip(segment, (None, *segment), strict=False)]
        self._clear({frame for frame, _ in order})
        self._progress("frames", 0, len(order))
        key = ""
        with self._reading() as images:
            for done, (frame, previous) in enumerate(order):
                key = self._key(frame, images.digest(frame), "" if previous is None else key)
                if frame_key(self.path(frame)) == key:
                    self._resumed += 1
                    views = None
                else:
                    views = images.views(frame)
                    if done + 1 < len(order):
                        images.expect(order[done + 1][0])
                    self._model(frame, key, views, previous)
                self._complete(frame, key, views)
                self._progress("frames", done + 1, len(order), _words(self.header(frame)["report"]))

    def _clear(self, frames: Collection[int]) -> None:
        """Remove what a killed call left half written of these frames, which no other call may be working on."""
        names = {f"frame_{frame:06d}" for frame in frames}
        for path in [path for folder in self._folders for path in folder.glob(".frame_*.tmp*")]:
            if path.name.split(".")[1] in names:
                path.unlink(missing_ok=True)

    @contextmanager
    def _reading(self) -> Iterator[_Images]:
        with ThreadPoolExecutor(min(LOADING_THREADS, os.cpu_count() or 1)) as pool:
            images = _Images(self._records, self._digests, pool)
            try:
                yield images
            finally:
                images.close()

    def _key(self, frame: int, digest: str, previous: str) -> str:
        """Return the key of a frame whose predecessor in its segment has the key ``previous``, empty for the first."""
        text = f"{self._base}\n{frame}\n{digest}\n{previous}"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def header(self, frame: int) -> dict[str, Any]:
        """Read what the store says about a frame."""
        return json.loads(read_frame(self.path(frame), (HEADER,))[HEADER].tobytes())

    def _model(self, frame: int, key: str, views: Sequence[CapturedView], previous: int | None) -> None:
        """Find the Gaussians of a frame and store them, whole."""
        started = time.perf_counter()
        lost = ""
        track, report, segment = None, {}, frame
        said: list[Any] = []
        if previous is not None:
            track, report = self._steps.advance(self._stored_track(previous), views, self._within("track", frame))
            lost = str(report.get("lost", ""))
            said = list(report.get("findings", []))
            segment = int(self.header(previous)["report"]["segment"])
        if track is None or lost:
            track, report = self._steps.begin(views, self._within("fit", frame))
            said += [finding for finding in report.get("findings", []) if finding not in said]
            segment = frame
        report = {
            **_plain({name: value for name, value in report.items() if name != "seconds"}),
            "frame": frame,
            "kind": "key" if segment == frame else "tracked",
            "segment": segment,
            "lost": lost,
            "gaussians": len(track.cloud),
            "findings": _plain(said),
        }
        write_frame(self.path(frame), key, _stored_arrays(track, report))
        self._seconds[frame] = time.perf_counter() - started

    def _stored_track(self, frame: int) -> FrameTrack:
        stored = read_frame(self.path(frame))
        shared = json.loads(stored[HEADER].tobytes())["shared"]
        own = {name.removeprefix(TRACK): array for name, array in stored.items() if name.startswith(TRACK)}
        return self._steps.restore(own | {name: stored[name] for name in shared})

    def _complete(self, frame: int, key: str, views: Sequence[CapturedView] | None) -> None:
        """Draw the preview and note the time, unless both are there; the note comes last and so vouches for both."""
        note = self.path(frame).with_suffix(".json")
        picture = self._previews / f"frame_{frame:06d}.png"
        if self._note(frame).get("key") == key and picture.is_file():
            return
        cameras = [record.camera for record in self._records[frame]]
        chosen = opposite_cameras(cameras)
        shown = [views[index] if views is not None else self._records[frame][index].view() for index in chosen]
        cloud = stored_cloud(self.path(frame))
        options, device = self._steps.raster, str(self._device)
        drawn = reconstruction_preview(
            cloud,
            shown,
            shadings=mesh_shadings(cloud, cameras, chosen, options=options, device=device),
            options=options,
            samples=int(self.header(frame)["report"].get("samples", 1)),
            device=device,
        )
        write_png(picture, drawn)
        write_json(note, {"key": key, "seconds": self._seconds.get(frame)})

    def _note(self, frame: int) -> dict[str, Any]:
        try:
            return dict(json.loads(self.path(frame).with_suffix(".json").read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return {}

    def _within(self, stage: str, frame: int) -> StepProgress:
        """Return a reporter of progress inside a frame."""

        def report(done: int, total: int, facts: Mapping[str, float] = MappingProxyType({})) -> None:
            words = (f"frame {frame}", _numbers(facts))
            self._progress(stage, done, total, ", ".join(word for word in words if word))

        return report

    def report(self) -> dict[str, Any]:
        """Return what was done, found and spent; JSON-able."""
        frames = [
            {**self.header(frame)["report"], "seconds": self._note(frame).get("seconds")} for frame in self.frames
        ]
        measured = [entry for entry in frames if entry.get("psnr") is not None]
        lowest = min(measured, key=lambda entry: entry["psnr"], default=None)
        return {
            "input": {
                "capture": str(self._capture.folder),
                "frames": len(frames),
                "cameras": len({record.camera_name for records in self._records.values() for record in records}),
            },
            "device": device_facts(self._device),
            "versions": versions(),
            "options": {**self._steps.options(), "segment_length": self._options.segment_length},
            "resumed_frames": self._resumed,
            "segments": sorted({entry["segment"] for entry in frames}),
            "mean_psnr": float(np.mean([entry["psnr"] for entry in measured])) if measured else None,
            "lowest_psnr": None if lowest is None else {"frame": lowest["frame"], "psnr": lowest["psnr"]},
            "frames": frames,
            "findings": [vars(finding) for finding in self._findings],
            "warnings": [*(finding.what for finding in self._findings), *_warnings(frames)],
        }


def _selected(capture: Capture, options: ReconstructOptions) -> Capture:
    """Return the capture with no other training records than those of the frames that are asked for."""
    there = sorted({record.frame for record in capture.select(split=SPLIT)})
    if not there:
        raise InvalidOptionError(
            f"capture must have records of the split {SPLIT}, got {', '.join(capture.splits)}. Call them so."
        )
    frames = there if options.frames is None else options.frames
    absent = sorted(set(frames) - set(there))
    if absent or not frames:
        raise InvalidOptionError(
            f"frames must be some of the capture's {len(there)} from {there[0]} to {there[-1]}, got "
            f"{absent[0] if absent else 'none'}. Choose among them."
        )
    return Capture(**{**vars(capture), "records": capture.select(split=SPLIT, frames=set(frames))})


def _by_frame(records: Sequence[CaptureRecord]) -> dict[int, tuple[CaptureRecord, ...]]:
    """Return the records of each frame, frames ascending, cameras in file order."""
    grouped: dict[int, list[CaptureRecord]] = {}
    for record in sorted(records, key=lambda record: record.frame):
        grouped.setdefault(record.frame, []).append(record)
    return {frame: tuple(found) for frame, found in grouped.items()}


def _remove_leftovers(out: Path) -> None:
    """Remove what a killed call left half written of the asset and the report."""
    for path in [*out.glob(f".{Path(ASSET_NAME).stem}.*"), *out.glob(".report.json.*.tmp")]:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _stored_arrays(track: FrameTrack, report: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Return what a frame's file holds: the Gaussians, the track without what it shares with them, and a header."""
    cloud = track.cloud
    own = np.arange(len(cloud)) if cloud.ids is None else cloud.ids
    stored: dict[str, NDArray[Any]] = {**cloud.arrays(), "ids": own + (np.int64(report["segment"]) << ID_BITS)}
    shared = []
    for name, array in track.arrays().items():
        if name in stored and array.dtype == stored[name].dtype and np.array_equal(array, stored[name]):
            shared.append(name)
        else:
            stored[TRACK + name] = array
    text = json.dumps({"report": report, "shared": sorted(shared)}, sort_keys=True, allow_nan=False)
    return {**stored, HEADER: np.frombuffer(text.encode(), np.uint8)}


def _plain(value: Any) -> Any:
    """Return a report's value as JSON holds it: None for a number that is not finite."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _numbers(facts: Mapping[str, Any]) -> str:
    """Return PSNR and the number of Gaussians in words, as far as they are known."""
    psnr, count = facts.get("psnr"), facts.get("gaussians")
    return ", ".join(
        ([] if psnr is None else [f"{psnr:.2f} dB"]) + ([] if count is None else [f"{int(count):,} Gaussians"])
    )


def _words(report: Mapping[str, Any]) -> str:
    """Return what a frame's report says, in a few words."""
    kind = f"lost ({report['lost']}), fitted anew" if report["lost"] else f"{report['kind']} frame"
    return f"frame {report['frame']}: {kind}, {_numbers(report)}"


def _warnings(frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what a user should know."""
    found = [
        f"tracking was lost at frame {entry['frame']} ({entry['lost']}): it is a key frame of a new segment, and "
        "identities do not persist across it"
        for entry in frames
        if entry["lost"]
    ]
    found += _summed_up(frames)
    key_psnr = {entry["segment"]: entry.get("psnr") for entry in frames if entry["kind"] == "key"}
    falls = [
        (key_psnr[entry["segment"]] - entry["psnr"], entry["frame"])
        for entry in frames
        if entry.get("psnr") is not None and key_psnr.get(entry["segment"]) is not None
    ]
    fall, frame = max(falls, default=(0.0, 0))
    if fall > DRIFT_WARNING:
        found.append(
            f"frame {frame} is {fall:.1f} dB below its key frame, the most of {len(frames)} frames: shorter segments "
            "bound the drift; see --segment-length"
        )
    return found


def _summed_up(frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what steps said of frames, once for each kind; that tracking was lost is said already."""
    by_code: dict[str, list[tuple[int, Mapping[str, Any]]]] = {}
    for entry in frames:
        for finding in entry["findings"]:
            if not entry["lost"] or finding["what"] != f"tracking is lost: {entry['lost']}":
                by_code.setdefault(finding["code"], []).append((entry["frame"], finding))
    return [
        f"frame {rows[0][0]}: {rows[0][1]['what']}"
        + (f" ({rows[0][1]['where']})" if rows[0][1]["where"] else "")
        + (f"; so in {len({frame for frame, _ in rows})} of {len(frames)} frames" if len(rows) > 1 else "")
        for rows in by_code.values()
    ]
