"""``beam view``: an asset in the browser, under lights that are moved about."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp.checks import require_count
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, Quiet, ReadingFlags, notes_of
from beam_warp.converters.formats import FORMATS, suffix_of
from beam_warp.demo.lights import stage, studio, sunset
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.framing import bulk_of
from beam_warp.world.gaussians import WORLD_AXES, GaussianSequence

if TYPE_CHECKING:
    from beam_warp.world.shot import ShotMesh

LIGHT_SUFFIXES = (".exr", ".hdr")

GROUND_REACH = 12.0
"""Side of the ground over the subject's diagonal."""

Lights = dict[str, Callable[[], EnvironmentMap]]
"""What reads or makes a light, by its name."""

BUILT_IN: dict[str, Callable[[], EnvironmentMap]] = {"studio": studio, "sunset": sunset, "stage": stage}
"""Lights that need no file."""


@dataclass(frozen=True)
class ViewCommand:
    """Look at an asset or a stage in the browser: orbit, time, environments, lights that are dragged, channels.

    The page draws by the graphics card of whoever looks. This machine sends the take as it is played, and draws stills
    on demand: by paths, with exact shadows, or of what the page cannot show, such as standard errors. The page is
    served to this machine alone unless --host says otherwise. Ctrl-C ends it.

    Example: beam view person --environment studio.hdr hdri/

    Example: beam view stage.json --port 0 --no-open
    """

    asset: Annotated[
        Positional[Path],
        arg(
            metavar="ASSET",
            help="File of Gaussians, folder with asset.usda or with numbered files, or a stage (docs/stages.md).",
        ),
    ]
    environment: Annotated[
        tuple[Path, ...],
        arg(metavar="FILE ...", help="Lat-long lights, .exr or .hdr, or folders of them; three are built in."),
    ] = ()
    host: Annotated[str, arg(help="Address of this machine to listen at; 0.0.0.0 lets others in.")] = "127.0.0.1"
    port: Annotated[int, arg(help="Port to listen at; 0 takes any that is free.")] = 8080
    open: Annotated[bool, arg(help="Open a browser; so it is by default where there is a screen.")] = False
    no_open: Annotated[bool, arg(help="Open no browser.")] = False
    longest: Annotated[int, arg(metavar="PX", help="No side of a still is longer.")] = 2048
    reading: OmitArgPrefixes[ReadingFlags] = field(default_factory=ReadingFlags)
    device: Device = None
    quiet: Quiet = False
    json: Annotated[bool, arg(help="Print the address as JSON once the page is there.")] = False


def view(args: ViewCommand) -> int:
    """Serve the page until Ctrl-C."""
    if args.open and args.no_open:
        raise InvalidOptionError("open must be given once, got --open and --no-open. Leave one out.")
    require_count("longest", args.longest, 64, 8192)
    lights = environments(args.environment)
    sequence, parts = shown(args, lights)

    from beam_warp.view.viewer import Viewer, ViewOptions

    options = ViewOptions(host=args.host, port=args.port, longest=args.longest, device=args.device)
    viewer = Viewer(sequence, title=title_of(args.asset), options=options, **parts)
    try:
        _say(args, sequence, viewer.url)
        if args.open or (not (args.no_open or args.json or args.quiet) and _has_screen()):
            webbrowser.open(viewer.url)
        with progress(args.quiet or args.json):
            viewer.wait()
    except KeyboardInterrupt:
        pass  # that is how it ends
    finally:
        viewer.close()
    return 0


def shown(args: ViewCommand, lights: Lights) -> tuple[GaussianSequence, dict[str, Any]]:
    """Return what is shown, and what else `beam_warp.view.viewer.Viewer` is told."""
    if is_stage(args.asset):
        if args.reading != ReadingFlags():
            raise InvalidOptionError("a stage must state how its assets are read, got options for it. Leave them out.")
        return _staged(args.asset, lights)
    sequence = args.reading.read(args.asset)
    if args.reading == ReadingFlags():
        file = args.asset if suffix_of(args.asset.name) == ".b4d" else None
    else:
        metadata = {**sequence.metadata, **args.reading.raster(sequence).as_metadata()}
        sequence, file = replace(sequence, metadata=metadata), None
    return sequence, {"environments": lights, "file": file, "grounds": _grounds(sequence)}


def _grounds(sequence: GaussianSequence) -> dict[str, Callable[[], ShotMesh]]:
    """Return what an asset may stand on: a square under its first, middle and last frame."""

    def ground(catches_shadows: bool) -> ShotMesh:
        from beam_warp.stage.meshes import Ground  # stages wait for Warp

        frames = sorted({0, len(sequence) // 2, len(sequence) - 1})
        points = bulk_of([change_axes(sequence[frame], WORLD_AXES) for frame in frames])
        reach = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 1.0
        return Ground(size=GROUND_REACH * max(reach, 1e-3), catches_shadows=catches_shadows).mesh(points)

    return {"grey": partial(ground, False), "shadows": partial(ground, True)}


def _staged(path: Path, lights: Lights) -> tuple[GaussianSequence, dict[str, Any]]:
    """Return the take of a stage, and what it lacks."""
    from beam_warp.stage.stage import Stage  # it waits for Warp
    from beam_warp.stage.takes import staged_take
    from beam_warp.view.viewer import Staging

    found = Stage.read(path)
    sequence, view, own = staged_take(found, title_of(path))
    staging = Staging(view=view, cloud=lambda frame: found.cloud_at(found.time_of(frame)), mesh=found.mesh)
    return sequence, {
        "environments": {**{name: partial(own.__getitem__, name) for name in own}, **lights},
        "staging": staging,
    }


def is_stage(path: Path) -> bool:
    """Return True for the name of a stage's file."""
    return path.suffix.lower() == ".json" and suffix_of(path.name) not in FORMATS


def title_of(path: Path) -> str:
    """Return what an asset is called: its file, or the folder of a file whose name says nothing."""
    return path.resolve().parent.name if path.stem in ("asset", "manifest", "stage") else path.stem


def environments(paths: tuple[Path, ...]) -> Lights:
    """Return by name what reads or makes each light: the files given, those of the folders given, then built-in ones.

    Raises:
        MissingFileError: There is no such file, or a folder holds no light.
        AssetFormatError: A file is no .exr or .hdr.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            found = sorted(file for file in path.iterdir() if file.suffix.lower() in LIGHT_SUFFIXES)
            if not found:
                raise MissingFileError(
                    f"environment must be a folder with .exr or .hdr files, got {path}. Name another."
                )
            files += found
        elif not path.is_file():
            raise MissingFileError(f"environment must be a file or a folder, got {path}. Check the path.")
        elif path.suffix.lower() not in LIGHT_SUFFIXES:
            raise AssetFormatError(f"environment must be an .exr or .hdr file, got {path}. Convert it.")
        else:
            files.append(path)
    lights: Lights = {}
    for path in files:
        lights[_unused(path.stem, lights)] = partial(EnvironmentMap.read, path)
    for name, make in BUILT_IN.items():
        lights[_unused(f"{name} (built in)", lights)] = make
    return lights


def _unused(name: str, taken: Lights) -> str:
    """Return a name that is not taken: the same, or with a number."""
    names = (name, *(f"{name} {number}" for number in range(2, len(taken) + 3)))
    return next(candidate for candidate in names if candidate not in taken)


def _say(args: ViewCommand, sequence: GaussianSequence, url: str) -> None:
    """Say where the page is."""
    notes = notes_of(sequence)
    if args.json:
        print_json({"url": url, "frames": len(sequence), "notes": notes})
        sys.stdout.flush()
    elif not args.quiet:
        print_notes(notes)
        print(f"{args.asset} is at {url}; Ctrl-C ends it", flush=True)


def _has_screen() -> bool:
    """True where a browser has somewhere to open: elsewhere one for terminals would take this one."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
