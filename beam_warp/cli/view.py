"""``beam view``: an asset in the browser, under lights that are moved about."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp.checks import require_count, require_number
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, Quiet, ReadingFlags, notes_of
from beam_warp.demo.lights import stage, studio, sunset
from beam_warp.errors import AssetFormatError, InvalidOptionError, MissingFileError
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence

LIGHT_SUFFIXES = (".exr", ".hdr")

BUILT_IN: dict[str, Callable[[], EnvironmentMap]] = {"studio": studio, "sunset": sunset, "stage": stage}
"""Lights that need no file."""


@dataclass(frozen=True)
class ViewCommand:
    """Look at an asset in the browser: orbit, time, environments, lights that are dragged, channels and their errors.

    What the page shows are our own frames: what is seen is the renderer. While something moves they are as small as
    it takes to hold --rate, and in full size once nothing does. The page is served to this machine alone unless --host
    says otherwise. Ctrl-C ends it.

    Example: beam view person --environment studio.hdr hdri/

    Example: beam view person.usdz --port 0 --no-open
    """

    asset: Annotated[
        Positional[Path],
        arg(metavar="ASSET", help="File of Gaussians, a folder with asset.usda, or a folder of numbered files."),
    ]
    environment: Annotated[
        tuple[Path, ...],
        arg(metavar="FILE ...", help="Lat-long lights, .exr or .hdr, or folders of them; three are built in."),
    ] = ()
    host: Annotated[str, arg(help="Address of this machine to listen at; 0.0.0.0 lets others in.")] = "127.0.0.1"
    port: Annotated[int, arg(help="Port to listen at; 0 takes any that is free.")] = 8080
    open: Annotated[bool, arg(help="Open a browser; so it is by default where there is a screen.")] = False
    no_open: Annotated[bool, arg(help="Open no browser.")] = False
    rate: Annotated[float, arg(metavar="FPS", help="Frames per second to hold while something moves.")] = 10.0
    longest: Annotated[int, arg(metavar="PX", help="No side of a picture is longer.")] = 2048
    reading: OmitArgPrefixes[ReadingFlags] = field(default_factory=ReadingFlags)
    device: Device = None
    quiet: Quiet = False
    json: Annotated[bool, arg(help="Print the address as JSON once the page is there.")] = False


def view(args: ViewCommand) -> int:
    """Serve the page until Ctrl-C."""
    if args.open and args.no_open:
        raise InvalidOptionError("open must be given once, got --open and --no-open. Leave one out.")
    require_number("rate", args.rate, 0.1, 240.0)
    require_count("longest", args.longest, 64, 8192)
    lights = environments(args.environment)
    sequence = args.reading.read(args.asset)

    from beam_warp.view.viewer import Viewer, ViewOptions

    options = ViewOptions(
        host=args.host,
        port=args.port,
        rate=args.rate,
        longest=args.longest,
        device=args.device,
        raster=args.reading.raster(sequence),
    )
    viewer = Viewer(sequence, lights, title=args.asset.name or str(args.asset), options=options)
    try:
        _say(args, sequence, viewer.url, viewer.device)
        if args.open or (not (args.no_open or args.json or args.quiet) and _has_screen()):
            webbrowser.open(viewer.url)
        with progress(args.quiet or args.json):
            viewer.wait()
    except KeyboardInterrupt:
        pass  # that is how it ends
    finally:
        viewer.close()
    return 0


def environments(paths: tuple[Path, ...]) -> dict[str, Callable[[], EnvironmentMap]]:
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
    lights: dict[str, Callable[[], EnvironmentMap]] = {}
    for path in files:
        lights[_unused(path.stem, lights)] = partial(EnvironmentMap.read, path)
    for name, make in BUILT_IN.items():
        lights[_unused(f"{name} (built in)", lights)] = make
    return lights


def _unused(name: str, taken: dict[str, Callable[[], EnvironmentMap]]) -> str:
    """Return a name that is not taken: the same, or with a number."""
    names = (name, *(f"{name} {number}" for number in range(2, len(taken) + 3)))
    return next(candidate for candidate in names if candidate not in taken)


def _say(args: ViewCommand, sequence: GaussianSequence, url: str, device: str) -> None:
    """Say where the page is."""
    notes = notes_of(sequence)
    if args.json:
        print_json({"url": url, "device": device, "frames": len(sequence), "notes": notes})
        sys.stdout.flush()
    elif not args.quiet:
        print_notes(notes)
        print(f"{args.asset} is at {url} ({device}); Ctrl-C ends it", flush=True)


def _has_screen() -> bool:
    """True where a browser has somewhere to open: elsewhere one for terminals would take this one."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
