"""``beam inspect``: what a capture holds, what is wrong with it, and pictures of its cameras and masks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from beam_warp.capture.capture import Capture
from beam_warp.capture.corrections import RigCorrection
from beam_warp.capture.inspect import MAX_IMAGES, inspect_capture
from beam_warp.capture.page import write_page
from beam_warp.capture.picture import all_findings, headline, verdict, write_picture
from beam_warp.checks import require_package
from beam_warp.cli.common.console import escaped, print_json, progress
from beam_warp.errors import MissingFileError
from beam_warp.jobs.store import make_folders


@dataclass(frozen=True)
class Inspect:
    """Say what is wrong with a capture before hours are spent on it, and draw its cameras, frustums and masks.

    Reads nerfstudio's transforms.json, COLMAP models (text and binary) and folders of 3 x 4 projection matrices. With
    --out, writes OUT/capture.png and OUT/capture.html (one file, no network).

    Exit code: 0 ready (warnings allowed), 1 something makes reconstruction impossible, 2 the capture cannot be read.

    With --cameras, it also shows what a reconstruction found wrong with the cameras, and how sure that is.

    Example: beam inspect captures/walker --out report
    """

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE", help="Folder of the capture.")]
    out: Annotated[Path | None, arg(metavar="DIR", help="Folder for the pictures; none are drawn without.")] = None
    cameras: Annotated[
        Path | None, arg(metavar="DIR", help="Folder of a reconstruction: show what it found wrong with the cameras.")
    ] = None
    max_images: Annotated[
        int, arg(metavar="N", help="Images to look at, of evenly many frames; poses and file sizes are all checked.")
    ] = MAX_IMAGES
    json: Annotated[bool, arg(help="Print the report as JSON.")] = False
    quiet: Annotated[bool, arg(help="Print nothing; only the exit code answers.")] = False


def inspect(args: Inspect) -> int:
    """Inspect a capture, draw it, and say what was found."""
    if args.out is not None:
        for package in ("matplotlib", "plotly"):
            require_package(package)
    with progress(args.quiet or args.json, compiles=False) as advance:
        capture = Capture.read(args.capture)
        rig = None if args.cameras is None else _corrections(args.cameras)
        report = inspect_capture(capture, max_images=args.max_images, progress=advance)
    files = []
    if args.out is not None:
        make_folders(args.out)
        files = [args.out / "capture.png", args.out / "capture.html"]
        write_picture(report, files[0], rig)
        write_page(report, files[1], rig)
    if args.json and not args.quiet:
        moved = None if rig is None else rig.as_dict()
        print_json({**report.as_dict(), "corrections": moved, "files": [str(path) for path in files]})
    elif not args.quiet:
        for finding in all_findings(report, rig):
            print(escaped(str(finding)))
        print(escaped(f"{args.capture}: {verdict(report)} ({headline(report, rig)})"))
        if files:
            print(f"look at {files[0]} and {files[1]}")
    return 0 if report.is_reconstructable else 1


def _corrections(folder: Path) -> RigCorrection:
    """Read the corrections of a reconstruction, or of the one within the folder of `beam run`."""
    found = RigCorrection.read(folder) or RigCorrection.read(folder / "reconstruction")
    if found is None:
        raise MissingFileError(
            f"cameras must be the folder of a reconstruction with {RigCorrection.FILE}, got none in {folder}. Pass "
            "what beam reconstruct or beam run wrote."
        )
    return found
