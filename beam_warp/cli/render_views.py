"""Which images ``beam render`` draws of one asset: of the records of a capture, or numbered ones from one camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beam_warp.capture.capture import Capture
from beam_warp.checks import require_count
from beam_warp.errors import InvalidOptionError, OutputError
from beam_warp.world.camera import MAX_SIDE, Camera
from beam_warp.world.framing import bulk
from beam_warp.world.gaussians import GaussianCloud

if TYPE_CHECKING:
    from beam_warp.cli.render import Render

DEFAULT_SIDE = 1024
"""Width and height where none is given [pixel]."""

DEFAULT_FOV = 35.0
"""Vertical field of view where none is given [degree]."""

FRAMING_FRAMES = 3
"""A camera that frames a moving subject looks at this many of its frames: first, last and between."""


@dataclass(frozen=True)
class View:
    """One image to draw: which frame, from where, into which file."""

    frame: int
    camera: Camera
    path: Path


def capture_views(args: Render, capture: Capture, numbers: tuple[int, ...], notes: list[str]) -> list[View]:
    """Plan one image for each record of the split whose frame the asset has; say what is left out."""
    records = capture.select(split=args.split, frames=None if args.frame is None else (numbers[args.frame],))
    if not records:
        frame = "" if args.frame is None else f" of frame {numbers[args.frame]}"
        raise InvalidOptionError(
            f"split must name records of the capture{frame}, got {args.split!r} "
            f"(it has {', '.join(capture.splits)}). Choose one of them."
        )
    place = {number: frame for frame, number in enumerate(numbers)}
    within = [record for record in records if record.frame in place]
    if len(within) < len(records):
        beyond = sorted({record.frame for record in records} - place.keys())
        notes.append(
            f"{len(records) - len(within)} records are of frames that the asset lacks "
            f"({', '.join(map(str, beyond[:5]))}{', …' if len(beyond) > 5 else ''}): not drawn"
        )
    if not within:
        raise InvalidOptionError(
            f"asset must have a frame that the records of split {args.split!r} show, got {len(numbers)} frames in "
            f"{args.asset[0]}. Choose another split."
        )
    bent = sum(record.is_distorted for record in within)
    if bent:
        notes.append(f"{bent} records were photographed through a lens that bends lines: drawn as undistorted images")
    try:
        args.out.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"out must be a folder that can be made, got {args.out} ({error.strerror}). Name another."
        ) from error
    suffix = "exr" if args.channel is None else "png"
    views = [View(place[record.frame], record.camera, args.out / f"{record.name}.{suffix}") for record in within]
    return sorted(views, key=lambda view: view.frame)  # each frame is read once


def image_size(args: Render) -> tuple[int, int]:
    """Return width and height [pixel]."""
    width = require_count("width", DEFAULT_SIDE if args.width is None else args.width, 1, MAX_SIDE)
    return width, width if args.height is None else require_count("height", args.height, 1, MAX_SIDE)


def still_camera(args: Render, frames: Sequence[int], cloud_of: Callable[[int], GaussianCloud]) -> Camera:
    """Place a camera that stays; one that frames the asset sees several of its frames."""
    width, height = image_size(args)
    lens = {"width": width, "height": height, "vertical_fov": DEFAULT_FOV if args.fov is None else args.fov}
    if args.look_at is not None:
        return Camera.look_at(args.look_at[:3], args.look_at[3:], **lens)
    azimuth, elevation = (0.0, 0.0) if args.orbit is None else args.orbit
    picked = sorted({frames[round(i)] for i in np.linspace(0, len(frames) - 1, FRAMING_FRAMES)})
    clouds = (cloud_of(frame) for frame in picked)
    seen = [bulk(cloud.positions, cloud.opacities) for cloud in clouds if len(cloud)]
    if not seen:
        raise InvalidOptionError("asset must hold Gaussians to be framed, got none. Place the camera with --look-at.")
    return Camera.frame_points(np.concatenate(seen), azimuth=azimuth, elevation=elevation, **lens)
