"""Inspection of a capture before hours are spent on it: cameras, files, coverage, exposure.

Cameras are judged by their poses and intrinsics, files by their headers. Images are read of evenly spaced frames up to
a limit, each at a fraction of its resolution; the report says how many.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.cameras import MIN_CAMERAS, Volume, judge_cameras
from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.findings import Finding, Findings, Severity, are, count_of, names_of
from beam_warp.capture.images import Glimpse, glimpse_of, judge_images
from beam_warp.capture.rigs import up_direction
from beam_warp.checks import require_count
from beam_warp.errors import AssetFormatError, BeamError, MissingFileError
from beam_warp.image.files import image_size
from beam_warp.image.film import film_of, is_film
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.world.camera import Camera

SPLIT = "train"
"""Split of the records that are reconstructed from."""

MAX_IMAGES = 96
"""Most images read by default."""

QUICK_IMAGES = 48
"""Most images read by default where reconstruction waits for the answer."""

MAX_READERS = 8
PIXELS_AT_A_TIME = 2**24
"""Most pixels in memory at a time, over all images that are being read, one a thread; a pixel takes up to 100 bytes."""

MAX_HEADERS = 8192
"""Most files whose presence and size are checked; of more files, an even selection is checked."""


@dataclass(frozen=True, eq=False)
class CaptureReport:
    """Result of an inspection.

    Attributes:
        capture: The capture that was inspected.
        findings: All findings, errors first.
        cameras: One camera of each name, as in its first frame.
        glimpses: Small copies of the images that were read.
        volume: The box that most training cameras see [m]; None if there is none.
        up: Mean upward direction of the cameras.
        left_out: Names of training records that cannot be used; reconstruction does without them.
    """

    capture: Capture
    findings: tuple[Finding, ...]
    cameras: dict[str, Camera]
    glimpses: tuple[Glimpse, ...]
    volume: Volume | None
    up: NDArray[np.float64]
    left_out: frozenset[str]

    def of(self, severity: Severity) -> tuple[Finding, ...]:
        """Return the findings of one severity."""
        return tuple(finding for finding in self.findings if finding.severity == severity)

    @property
    def is_reconstructable(self) -> bool:
        """True without errors."""
        return not self.of("error")

    def as_dict(self) -> dict[str, Any]:
        """Return the report, JSON-able."""
        return {
            "folder": str(self.capture.folder),
            "images": len(self.capture.records),
            "cameras": len(self.cameras),
            "frames": len(self.capture.frames),
            "splits": {split: len(self.capture.select(split=split)) for split in self.capture.splits},
            "images_read": len(self.glimpses),
            "frames_read": sorted({glimpse.record.frame for glimpse in self.glimpses}),
            "volume": None if self.volume is None else [corner.tolist() for corner in self.volume],
            "up": self.up.tolist(),
            "left_out": sorted(self.left_out),
            "is_reconstructable": self.is_reconstructable,
            "findings": [vars(finding) for finding in self.findings],
            "views": {
                glimpse.record.name: {"exposure_stops": glimpse.exposure, "coverage": glimpse.coverage}
                for glimpse in self.glimpses
            },
        }


@dataclass(frozen=True, eq=False)
class Readiness:
    """A capture that can be reconstructed.

    Attributes:
        capture: The capture without the training records that cannot be used.
        volume: The box that most training cameras see [m].
        fallbacks: Warnings and notes, which the user should see.
    """

    capture: Capture
    volume: Volume
    fallbacks: tuple[Finding, ...]


def require_reconstructable(capture: Capture, *, max_images: int = QUICK_IMAGES) -> Readiness:
    """Refuse a capture that cannot be reconstructed; for any other, return what is left out or assumed.

    Args:
        capture: The capture, whose training records are to be reconstructed from.
        max_images: Most images read for the inspection.

    Raises:
        MissingFileError: So many images are missing that a frame has fewer than `MIN_CAMERAS` cameras.
        AssetFormatError: Anything else of severity ``error``; see `inspect_capture`.
    """
    report = inspect_capture(capture, max_images=max_images)
    errors = report.of("error")
    if errors or report.volume is None:
        first = errors[0]
        more = f" There are {len(errors) - 1} more errors: run beam inspect." if len(errors) > 1 else ""
        place = f" at {first.where}" if first.where else ""
        kind = MissingFileError if first.code in ("missing-image", "frame-without-images") else AssetFormatError
        raise kind(f"capture must be fit for reconstruction, got {first.what}{place}. {first.remedy}{more}")
    kept = tuple(record for record in capture.records if record.name not in report.left_out)
    return Readiness(replace(capture, records=kept), report.volume, (*report.of("warning"), *report.of("note")))


def inspect_capture(
    capture: Capture, *, max_images: int = MAX_IMAGES, progress: StageProgress = no_progress
) -> CaptureReport:
    """Inspect a capture.

    Args:
        capture: The capture. Its training records are judged; of other records, only the files.
        max_images: Most images read, of evenly spaced frames with the first and the last among them.
        progress: Called with (stage, done, total).

    Raises:
        InvalidOptionError: ``max_images`` is out of range.
    """
    require_count("max_images", max_images, 1, 10**6)
    findings = Findings(Finding("note", "assumed", note) for note in capture.notes)
    training = capture.select(split=SPLIT)
    cameras = {record.camera_name: record.camera for record in reversed(capture.records)}
    cameras = {name: cameras[name] for name in sorted(cameras)}
    trained = {record.camera_name for record in training}
    rig = {name: camera for name, camera in cameras.items() if name in trained}
    sample = _sample(capture, max_images)
    glimpses, damaged = [], []
    with ThreadPoolExecutor(_reader_count(sample)) as readers:
        looked_at = readers.map(_glimpse_or_error, sample)  # while cameras and files are judged
        volume, blind = judge_cameras(rig, SPLIT, findings)
        left_out = {record.name for record in training if record.camera_name in blind}
        left_out |= _judge_files(capture, findings)
        for index, (record, found) in enumerate(zip(sample, looked_at, strict=True)):
            progress("images", index + 1, len(sample))
            if record.name in left_out:
                continue
            if isinstance(found, Glimpse):
                glimpses.append(found)
            else:
                damaged.append((record, found))
    if damaged:
        left_out |= {record.name for record, _ in damaged}
        findings.warn(
            "damaged-image",
            f"{count_of(len(damaged), 'image')} cannot be read and {are(damaged)} left out: "
            f"{str(damaged[0][1]).removesuffix('.')}",
            (record.name for record, _ in damaged),
        )
    left_out |= judge_images(training, glimpses, findings)
    _judge_frames(training, left_out, findings)
    order = {"error": 0, "warning": 1, "note": 2}
    return CaptureReport(
        capture=capture,
        findings=tuple(sorted(findings, key=lambda finding: order[finding.severity])),
        cameras=cameras,
        glimpses=tuple(glimpses),
        volume=volume,
        up=up_direction(list(rig.values() or cameras.values())),
        left_out=frozenset(left_out & {record.name for record in training}),
    )


def _reader_count(records: Sequence[CaptureRecord]) -> int:
    """Return how many images to read at a time: one a processor, as far as they fit into memory."""
    largest = max((record.camera.width * record.camera.height for record in records), default=1)
    return max(1, min(MAX_READERS, os.cpu_count() or 1, PIXELS_AT_A_TIME // largest))


def _glimpse_or_error(record: CaptureRecord) -> Glimpse | BeamError:
    try:
        return glimpse_of(record)
    except BeamError as error:
        return error


def _below(folder: Path, path: Path | None) -> str:
    """Show a path as the capture names it."""
    return str(path.relative_to(folder) if path is not None and path.is_relative_to(folder) else path)


def _judge_files(capture: Capture, findings: Findings) -> set[str]:
    """Find files that are missing or of another size; return the names of records that cannot be read."""
    step = -(-len(capture.records) // MAX_HEADERS)
    missing: dict[str, list[CaptureRecord]] = {"image": [], "mask": [], "plate": []}
    sizes: dict[str, list[tuple[CaptureRecord, str]]] = {"image": [], "mask": [], "plate": []}
    damaged: list[tuple[CaptureRecord, BeamError]] = []
    for record in capture.records[::step]:
        expected = (record.camera.width, record.camera.height)
        for what, path in (("image", record.image_path), ("mask", record.mask_path), ("plate", record.plate_path)):
            if path is None:
                continue
            try:
                size = film_of(path).size if is_film(path) else image_size(path)
                if size != expected:
                    sizes[what].append((record, f"{size[0]} x {size[1]} for {expected[0]} x {expected[1]}"))
            except BeamError as error:
                if isinstance(error, MissingFileError):
                    missing[what].append(record)
                else:
                    damaged.append((record, error))
                if what == "image":
                    break
    images = missing["image"]
    if images:
        findings.add(
            "error" if len(images) * step >= len(capture.records) else "warning",
            "missing-image",
            f"{count_of(len(images), 'image')} of {len(capture.records)} {are(images)} missing and left out: "
            f"{_below(capture.folder, images[0].image_path)}",
            (record.name for record in images),
            "Copy them there, or take the records out.",
        )
    for what in ("mask", "plate"):
        if missing[what]:
            findings.warn(
                f"missing-{what}",
                f"{count_of(len(missing[what]), what)} {are(missing[what])} missing, and the images left out: "
                f"{_below(capture.folder, getattr(missing[what][0], f'{what}_path'))}",
                (record.name for record in missing[what]),
                "Copy them there.",
            )
    if damaged:
        what = f"{count_of(len(damaged), 'file')} cannot be read, and the images are left out: {damaged[0][1]}"
        findings.warn("damaged-image", what.rstrip("."), (record.name for record, _ in damaged))
    for what, wrong in sizes.items():
        if wrong:
            findings.add(
                "error",
                f"{what}-size",
                f"{count_of(len(wrong), what)} {are(wrong)} not of the camera's size: {wrong[0][1]}",
                (record.name for record, _ in wrong),
                "Scale the intrinsics with the images, or export the images at the size of the calibration.",
            )
    wrong = (*damaged, *sizes["image"], *sizes["mask"], *sizes["plate"])
    unusable = [*(record for records in missing.values() for record in records), *(record for record, _ in wrong)]
    return {record.name for record in unusable}


def _sample(capture: Capture, most: int) -> list[CaptureRecord]:
    """Return the records to look at: all those of evenly spaced frames, the first and the last among them."""
    by_frame: dict[int, list[CaptureRecord]] = defaultdict(list)
    for record in capture.records:
        by_frame[record.frame].append(record)
    frames = sorted(by_frame)
    count = min(len(frames), max(1, most // max(len(rows) for rows in by_frame.values())))
    picked = sorted({frames[round(place)] for place in np.linspace(0, len(frames) - 1, count)})
    rows = [record for frame in picked for record in by_frame[frame]]
    return rows if len(rows) <= most else [rows[round(place)] for place in np.linspace(0, len(rows) - 1, most)]


def _judge_frames(training: Sequence[CaptureRecord], left_out: set[str], findings: Findings) -> None:
    """Find frames that lack cameras, before and after records are left out."""
    by_frame: dict[int, set[str]] = defaultdict(set)
    usable: dict[int, int] = defaultdict(int)
    for record in training:
        by_frame[record.frame].add(record.camera_name)
        usable[record.frame] += record.name not in left_out
    cameras = set().union(*by_frame.values()) if by_frame else set()
    lacking = {frame: cameras - names for frame, names in by_frame.items() if names != cameras}
    if lacking:
        frame = min(lacking)
        findings.warn(
            "frame-lacks-cameras",
            f"{count_of(len(lacking), 'frame')} of {len(by_frame)} {are(lacking)} without some cameras: frame "
            f"{frame} without {names_of(sorted(lacking[frame]), 3)}",
            f"frames {names_of(sorted(lacking))}",
            "They are reconstructed from the cameras that there are.",
        )
    numbers = np.array(sorted(by_frame))
    if len(numbers) > 2:
        step = int(np.diff(numbers).min())  # every second frame of a take is whole in itself
        count = int(((np.diff(numbers) - 1) // step).sum())
        gaps = [int(number) for number in numbers[:-1][np.diff(numbers) > step]]
        if gaps:
            findings.warn(
                "missing-frames",
                f"{count_of(count, 'frame')} between {numbers[0]} and {numbers[-1]} {are(range(count))} not there",
                f"after {names_of(gaps)}",
                "Motion is tracked over the gap.",
            )
    bare = sorted(frame for frame, count in usable.items() if count < MIN_CAMERAS)
    if bare and len(cameras) >= MIN_CAMERAS:
        findings.add(
            "error",
            "frame-without-images",
            f"{count_of(len(bare), 'frame')} of {len(by_frame)} {are(bare)} left with under {MIN_CAMERAS} images",
            f"frames {names_of(bare)}",
            "Copy their images, or take the frames out.",
        )
