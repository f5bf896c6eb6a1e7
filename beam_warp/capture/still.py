"""Plates of captures without masks: what stands still, the median of a camera's frames.

Where the subject leaves each place in most frames, the median of a pixel over them is the empty scene, with less noise
than one image of it. It commutes with a curve, so that files' values are taken as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.inspect import SPLIT
from beam_warp.capture.records import PLATE_FOLDER
from beam_warp.errors import AssetFormatError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import write_exr, write_png
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.jobs.store import make_folders

FEWEST_FRAMES, MOST_FRAMES = 5, 15
"""Fewest frames of a camera, and most that are read of it, evenly spaced."""

LEAST_MOVING = 1e-3
"""Part of an image that must differ from the plate in the first frame or the last, for there to be a subject."""


@dataclass(frozen=True)
class Plate:
    """A plate that was written.

    Attributes:
        camera: Name of the camera.
        path: The file, an 8-bit PNG for images of display sRGB, else an EXR.
        frames: How many frames it is the median of.
        moving: Largest part of the first or last frame's image that differs from it.
    """

    camera: str
    path: Path
    frames: int
    moving: float


def write_plates(capture: Capture, *, progress: StageProgress = no_progress) -> list[Plate]:
    """Write what stands still before each training camera to ``plates/<camera>`` in the capture's folder.

    Captures that are read after that have coverage: what differs from the plates. A subject that stays in place in half
    of the frames, as a foot may, is part of the plate, and is lost; shadows that move with the subject are its.

    Args:
        capture: Images without masks and alpha, of cameras that stand still.
        progress: Called with (stage, done, total).

    Raises:
        AssetFormatError: Images have masks, alpha or plates, cameras move, have fewer than `FEWEST_FRAMES` frames, or
            nothing moves before most of them; nothing is written then.
        BeamError: An image cannot be read, or the folder cannot be written.
    """
    by_camera: dict[str, list[CaptureRecord]] = {}
    for record in sorted(capture.select(split=SPLIT), key=lambda record: record.frame):
        by_camera.setdefault(record.camera_name, []).append(record)
    for name, records in by_camera.items():
        _require_still(name, records)
    make_folders(capture.folder, PLATE_FOLDER)
    plates: list[Plate] = []
    for done, (name, records) in enumerate(by_camera.items()):
        progress("plates", done, len(by_camera))
        plates.append(_written(capture.folder / PLATE_FOLDER, name, records))
    progress("plates", len(by_camera), len(by_camera))
    still = [plate for plate in plates if not plate.moving > LEAST_MOVING]
    if 2 * len(still) > len(plates):
        for plate in plates:
            plate.path.unlink()
        raise AssetFormatError(
            f"subject must move from its place between frames, got nothing that moves before {len(still)} of "
            f"{len(plates)} cameras, {still[0].camera} among them. Photograph the empty scene, or write masks."
        )
    return plates


def _require_still(name: str, records: Sequence[CaptureRecord]) -> None:
    """Refuse a camera of which no plate can be made, or that needs none."""
    first = records[0]
    if len(records) < FEWEST_FRAMES:
        raise AssetFormatError(
            f"cameras must have {FEWEST_FRAMES} frames or more, got {len(records)} of {name}. Photograph the empty "
            "scene, or write masks."
        )
    if any(not np.array_equal(first.camera.camera_to_world, record.camera.camera_to_world) for record in records):
        raise AssetFormatError(f"cameras must stand still, got {name}, which moves. Write masks.")
    if first.mask_path is not None or first.plate_path is not None or first.view().alpha is not None:
        raise AssetFormatError(
            f"images must have neither masks, alpha nor plates, got some of {name}. Use what is there, or take it away."
        )


def _written(folder: Path, name: str, records: Sequence[CaptureRecord]) -> Plate:
    """Write the plate of one camera."""
    count = min(len(records), MOST_FRAMES)
    chosen = [records[round(place)] for place in np.linspace(0, len(records) - 1, count)]
    images = [record.photograph() for record in chosen]
    values = np.median(np.stack([image.rgb() for image in images]), axis=0).astype(np.float32)
    is_display = images[0].color_space == DISPLAY_SRGB
    path = folder / f"{name}.{'png' if is_display else 'exr'}"
    if is_display:
        write_png(path, np.round(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8))
    else:
        write_exr(path, dict(zip("RGB", np.moveaxis(values, -1, 0), strict=True)))
    moving = max(_coverage(replace(record, plate_path=path)) for record in (chosen[0], chosen[-1]))
    return Plate(name, path, count, moving)


def _coverage(record: CaptureRecord) -> float:
    """Return the part of an image that is the subject."""
    alpha: NDArray[np.float32] | None = record.view().alpha
    return 0.0 if alpha is None else float(alpha.mean())
