"""Checks of ``beam render`` and ``beam channel``: options that contradict each other, before anything is read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from beam_warp.checks import require_range
from beam_warp.cli.drawing.flags import Render, StillCameraFlags
from beam_warp.converters.staging import require_writable
from beam_warp.errors import InvalidOptionError, OutputError
from beam_warp.stage.output import IMAGE_SUFFIXES, Film, FramePattern, Target, parse_target

_TIMED = ("frames", "seconds", "fps", "speed")


def require_consistent(args: Render) -> None:
    """Refuse options that contradict each other, and an output that cannot be written."""
    _require_one_motion(args)
    if not isinstance(args.output.background, str):
        require_range("background", np.asarray(args.output.background), 0.0, 1.0, "Use display values from 0 to 1.")
    other = args.deferred if args.mode == "path" else args.path
    refuse(other, f"with --mode {args.mode or 'deferred'}", why="The other mode has it.")
    if args.is_stage:
        staged = ("spacing", "on_ground", "source_axes", "meters_per_unit", "drop_invalid")
        refuse(args.assets, "with a stage", staged, why="The stage states it.")
        refuse(args.time, "with a stage", ("loop",), why="The stage states it.")
    elif not args.assets.asset:
        raise InvalidOptionError("asset must be given, got none. Name a PLY, a USD file, a folder or a stage.")
    elif any(path.suffix.lower() == ".json" for path in args.assets.asset):
        raise InvalidOptionError(f"asset must be one stage, or several assets, got {_listed(args)}. Choose one.")
    if args.time.frame is not None:
        refuse(args.time, "with --frame", _TIMED, why="That is one image.")
        refuse(args.output, "with --frame", ("crf",), why="That is one image.")
    if args.camera.capture is None:
        _require_output(args)
        return
    for record, names in (
        (args.time, (*_TIMED, "loop")),
        (args.output, ("crf",)),
        (args.camera, ("turntable", "turns")),
        (args.light, ("rotate_per_second",)),
    ):
        refuse(record, "with --capture", names, why="Its records have their times.")
    if len(args.assets.asset) != 1 or args.is_stage:
        raise InvalidOptionError(f"asset must be one with --capture, got {_listed(args)}. Name one asset.")
    require_capture_folder(args.camera, args.output.out)


def require_one_camera(camera: StillCameraFlags) -> list[str]:
    """Refuse a second camera; return the flag of the one that was given, if any."""
    names = ("orbit", "look_at", "camera", "capture")
    given = [_flag(name) for name in names if getattr(camera, name, None) is not None]
    if len(given) > 1:
        raise InvalidOptionError(f"camera must be given once, got {' and '.join(given)}. Leave one out.")
    return given


def require_capture_folder(camera: StillCameraFlags, out: Path) -> None:
    """Refuse what the cameras of a capture state themselves, and an output that is no folder."""
    refuse(camera, "with --capture", ("width", "height", "fov"), why="Its cameras have their own.")
    if out.exists() and not out.is_dir():
        raise OutputError(f"out must be a folder with --capture, got the file {out}. Name a folder.")


def require_place(target: Target) -> None:
    """Refuse an output where nothing can be written; folders that are missing are made when work begins."""
    require_writable(target.path(0) if isinstance(target, FramePattern) else target.path, is_made=True)


def kind_of(target: Target) -> str:
    """Return the suffix of the files that are written."""
    return target.kind if isinstance(target, FramePattern) else target.path.suffix.lower()


def refuse(record: Any, when: str, names: Iterable[str] | None = None, *, why: str) -> None:
    """Refuse options of a record that have no meaning beside others.

    Args:
        record: Options, of which those that differ from their defaults were given.
        when: Circumstance in which they have no meaning.
        names: Which of the options; all of them without.
        why: Explanation at the end of the message.
    """
    usual = {field.name: field.default for field in fields(record)}
    given = [name for name in names or usual if getattr(record, name) != usual[name]]
    if given:
        raise InvalidOptionError(
            f"{given[0].replace('_', '-')} must be left out {when}, got {getattr(record, given[0])}. {why}"
        )


def _require_one_motion(args: Render) -> None:
    """Refuse a second camera, and turns of one that does not turn."""
    camera = args.camera
    given = require_one_camera(camera)
    turning = [_flag(name) for name in ("turntable", "turns") if getattr(camera, name) is not None]
    if len(turning) > 1 or (turning and given and camera.orbit is None):
        both = turning if len(turning) > 1 else [given[0], turning[0]]
        raise InvalidOptionError(f"camera must move in one way, got {' and '.join(both)}. Leave one out.")
    if camera.camera is not None and camera.fov is not None:
        raise InvalidOptionError(f"fov must be left out with --camera, got {camera.fov}. The path states it.")


def _require_output(args: Render) -> None:
    """Refuse an output of another kind, or where nothing can be written."""
    out, target = args.output.out, parse_target(args.output.out)
    kind = kind_of(target)
    if args.output.aov and kind != ".exr":
        raise InvalidOptionError(f"out must end in .exr to hold the layers of --aov, got {out.name}. Rename it.")
    if not isinstance(target, Film) and args.output.crf is not None:
        raise InvalidOptionError(f"crf must be left out unless out ends in .mp4, got {args.output.crf}. Leave it out.")
    if args.time.frame is not None and not isinstance(target, FramePattern) and kind not in IMAGE_SUFFIXES:
        raise InvalidOptionError(f"out must end in .png or .exr with --frame, got {out.name}. Rename it.")
    require_place(target)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _listed(args: Render) -> str:
    return " and ".join(map(str, args.assets.asset))
