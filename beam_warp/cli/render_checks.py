"""Which options of ``beam render`` contradict each other; asked before anything is read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from beam_warp.checks import require_choice, require_range
from beam_warp.errors import InvalidOptionError, OutputError
from beam_warp.stage.output import IMAGE_SUFFIXES, Film, FramePattern, parse_target, require_folder

if TYPE_CHECKING:
    from beam_warp.cli.render import Render

_LIT = (
    *(
        "environment",
        "rotate",
        "exposure",
        "background",
        "aov",
        "mode",
        "rotate_per_second",
        "lights",
        "ground",
        "view",
    ),
    *("camera", "turntable", "turns", "frames", "seconds", "fps", "speed", "loop", "spacing", "on_ground", "crf"),
)
"""Options of what is lit, and of what plays."""

_LIGHTING = ("spp", "target_error", "denoise", "seed", "bounces", "environment_shadows", "shadow_resolution")
_PATH = ("spp", "target_error", "denoise", "seed")
_DEFERRED = ("environment_shadows", "shadow_resolution", "antialiased", "low_pass")
_TIMED = ("frames", "seconds", "fps", "speed", "crf")
_MOVING = ("loop", "turntable", "turns", "rotate_per_second")
_STAGED = ("spacing", "on_ground", "loop", "source_axes", "drop_invalid")
"""What a stage states itself."""


def require_consistent(args: Render) -> None:
    """Refuse options that contradict each other, and an output that cannot be written."""
    _require_one_camera(args)
    if args.channel is None and args.range is not None:
        raise InvalidOptionError(f"range must come with --channel, got {args.range} without. Leave it out.")
    if args.channel is not None:
        _require_channel(args)
    if not isinstance(args.background, str):
        require_range("background", np.asarray(args.background), 0.0, 1.0, "Use display values from 0 to 1.")
    _refuse(args, _DEFERRED if args.mode == "path" else _PATH, f"with --mode {args.mode}", "The other mode has it.")
    if is_stage(args):
        _refuse(args, _STAGED, "with a stage", "The stage states it.")
    elif not args.asset:
        raise InvalidOptionError("asset must be given, got none. Name a PLY, a USD file, a folder or a stage.")
    elif any(path.suffix.lower() == ".json" for path in args.asset):
        raise InvalidOptionError(f"asset must be one stage, or several assets, got {_listed(args.asset)}. Choose one.")
    if args.frame is not None:
        _refuse(args, _TIMED, "with --frame", "That is one image.")
    if args.capture is not None:
        _require_capture(args)
        return
    _require_output(args)


def is_stage(args: Render) -> bool:
    """Say whether what is drawn is one stage."""
    return len(args.asset) == 1 and args.asset[0].suffix.lower() == ".json"


def _require_one_camera(args: Render) -> None:
    """Refuse a second camera, and turns of one that does not turn."""
    names = ("orbit", "look_at", "camera", "capture")
    given = [_flag(name) for name in names if getattr(args, name) is not None]
    if len(given) > 1:
        raise InvalidOptionError(f"camera must be given once, got {' and '.join(given)}. Leave one out.")
    turning = [_flag(name) for name in ("turntable", "turns") if getattr(args, name) is not None]
    if len(turning) > 1 or (turning and given and args.orbit is None):
        both = turning if len(turning) > 1 else [given[0], turning[0]]
        raise InvalidOptionError(f"camera must move in one way, got {' and '.join(both)}. Leave one out.")
    if args.camera is not None and args.fov is not None:
        raise InvalidOptionError(f"fov must be left out with --camera, got {args.fov}. The path states it.")


def _require_channel(args: Render) -> None:
    """Refuse a channel that is none, and what a channel has no use for."""
    from beam_warp.render.channels import DRAWABLE

    require_choice("channel", args.channel or "", DRAWABLE)
    _refuse(args, (*_LIT, *_LIGHTING), "with --channel", "", ": a channel is drawn on grey, and without light")
    if args.range is not None and not args.range[0] < args.range[1]:
        raise InvalidOptionError(f"range must be two numbers, the lower one first, got {args.range}. Swap them.")
    if len(args.asset) != 1 or is_stage(args):
        raise InvalidOptionError(f"asset must be one with --channel, got {_listed(args.asset)}. Name one asset.")


def _require_capture(args: Render) -> None:
    """Refuse what a capture says itself."""
    _refuse(args, ("width", "height", "fov"), "with --capture", "Its cameras have their own.")
    _refuse(args, (*_TIMED, *_MOVING), "with --capture", "Its records have their times.")
    if len(args.asset) != 1 or is_stage(args):
        raise InvalidOptionError(f"asset must be one with --capture, got {_listed(args.asset)}. Name one asset.")
    if args.out.exists() and not args.out.is_dir():
        raise OutputError(f"out must be a folder with --capture, got the file {args.out}. Name a folder.")


def _require_output(args: Render) -> None:
    """Refuse an output of another kind, or where nothing can be written."""
    target = parse_target(args.out)
    kind = target.kind if isinstance(target, FramePattern) else target.path.suffix.lower()
    if args.aov and kind != ".exr":
        raise InvalidOptionError(f"out must end in .exr to hold the layers of --aov, got {args.out.name}. Rename it.")
    if args.channel is not None and kind not in IMAGE_SUFFIXES:
        raise InvalidOptionError(f"out must end in .png or .exr with --channel, got {args.out.name}. Rename it.")
    if not isinstance(target, Film) and args.crf is not None:
        raise InvalidOptionError(f"crf must be left out unless out ends in .mp4, got {args.crf}. Leave it out.")
    if args.frame is not None and not isinstance(target, FramePattern) and kind not in IMAGE_SUFFIXES:
        raise InvalidOptionError(f"out must end in .png or .exr with --frame, got {args.out.name}. Rename it.")
    folder = target.folder.parent if isinstance(target, FramePattern) else target.path.parent
    if isinstance(target, FramePattern) and target.folder.is_dir():
        folder = target.folder
    if not folder.is_dir():
        raise OutputError(f"out must be in a folder that exists, got {folder}. Create it first.")
    if not isinstance(target, FramePattern):
        require_folder(target)


def _refuse(args: Render, names: Iterable[str], when: str, why: str, reason: str = "") -> None:
    """Refuse options that say nothing in this place."""
    usual = {field.name: field.default for field in fields(args)}
    given = [name for name in names if getattr(args, name) != usual[name]]
    if given:
        raise InvalidOptionError(
            f"{given[0].replace('_', '-') if not reason else given[0]} must be left out {when}, got "
            f"{getattr(args, given[0])}{reason}. {why or 'Leave it out.'}"
        )


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _listed(values: Iterable[Any]) -> str:
    return " and ".join(str(value) for value in values)
