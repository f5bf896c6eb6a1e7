"""Images of one asset that ``beam render`` and ``beam channel`` draw: cameras that stay, and records of a capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beam_warp.capture.capture import Capture
from beam_warp.checks import require_count
from beam_warp.cli.drawing.flags import StillCameraFlags
from beam_warp.errors import InvalidOptionError
from beam_warp.jobs.store import make_folders
from beam_warp.stage.camera_paths import DEFAULT_FOV
from beam_warp.world.camera import MAX_SIDE, Camera
from beam_warp.world.framing import bulk_of
from beam_warp.world.gaussians import GaussianCloud

DEFAULT_SIDE = 1024
"""Width and height where none is given [pixel]."""

FRAMING_FRAMES = 3
"""A camera that frames a moving subject looks at this many of its frames: first, last and between."""


@dataclass(frozen=True)
class PlannedView:
    """One image to draw: which frame of the asset, from where, into which file."""

    frame: int
    camera: Camera
    path: Path


def capture_views(
    capture: Capture, numbers: tuple[int, ...], *, split: str, frame: int | None, out: Path, suffix: str
) -> tuple[list[PlannedView], list[str]]:
    """Plan one image for each record of a split whose frame the asset has.

    Args:
        capture: Whose records.
        numbers: The capture's number of every frame of the asset.
        split: Which records.
        frame: Only this frame of the asset; all without.
        out: Folder for the images; made if it does not exist.
        suffix: Kind of the images.

    Returns:
        The images in the order of frames, so that each frame is read once, and notes about what is left out.

    Raises:
        InvalidOptionError: There is no such frame, or no record shows one of the asset's frames.
        OutputError: The folder cannot be made.
    """
    if frame is not None:
        require_count("frame", frame, 0, len(numbers) - 1)
    records = capture.select(split=split, frames=None if frame is None else (numbers[frame],))
    if not records:
        of_frame = "" if frame is None else f" of frame {numbers[frame]}"
        raise InvalidOptionError(
            f"split must name records of the capture{of_frame}, got {split!r} "
            f"(it has {', '.join(capture.splits)}). Choose one of them."
        )
    place = {number: frame for frame, number in enumerate(numbers)}
    within = [record for record in records if record.frame in place]
    notes = []
    if len(within) < len(records):
        beyond = sorted({record.frame for record in records} - place.keys())
        notes.append(
            f"{len(records) - len(within)} records are of frames that the asset lacks "
            f"({', '.join(map(str, beyond[:5]))}{', …' if len(beyond) > 5 else ''}): not drawn"
        )
    if not within:
        raise InvalidOptionError(
            f"asset must have a frame that the records of split {split!r} show, got {len(numbers)} frames. "
            "Choose another split."
        )
    bent = sum(record.is_distorted for record in within)
    if bent:
        notes.append(f"{bent} records were photographed through a lens that bends lines: drawn as undistorted images")
    make_folders(out)
    views = [PlannedView(place[record.frame], record.camera, out / f"{record.name}.{suffix}") for record in within]
    return sorted(views, key=lambda view: view.frame), notes


def image_size(camera: StillCameraFlags) -> tuple[int, int]:
    """Return width and height [pixel]."""
    width = require_count("width", DEFAULT_SIDE if camera.width is None else camera.width, 1, MAX_SIDE)
    return width, width if camera.height is None else require_count("height", camera.height, 1, MAX_SIDE)


def still_camera(flags: StillCameraFlags, frames: Sequence[int], cloud_of: Callable[[int], GaussianCloud]) -> Camera:
    """Place a camera that stays; one that frames the asset sees several of its frames."""
    width, height = image_size(flags)
    lens = {"width": width, "height": height, "vertical_fov": DEFAULT_FOV if flags.fov is None else flags.fov}
    if flags.look_at is not None:
        return Camera.look_at(flags.look_at[:3], flags.look_at[3:], **lens)
    azimuth, elevation = flags.orbit or (0.0, 0.0)
    picked = sorted({frames[round(i)] for i in np.linspace(0, len(frames) - 1, FRAMING_FRAMES)})
    seen = bulk_of(cloud_of(frame) for frame in picked)
    if not len(seen):
        raise InvalidOptionError("asset must hold Gaussians to be framed, got none. Place the camera with --look-at.")
    return Camera.frame_points(seen, azimuth=azimuth, elevation=elevation, **lens)
