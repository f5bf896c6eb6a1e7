"""``beam plates``: images of the empty scene, from frames in which the subject moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from beam_warp.capture.capture import Capture
from beam_warp.capture.findings import count_of
from beam_warp.capture.still import write_plates
from beam_warp.cli.common.console import escaped, print_json, progress


@dataclass(frozen=True)
class Plates:
    """Tell the subject by what moves, for a capture without masks and without images of the empty scene.

    Writes CAPTURE/plates/CAMERA.png (.exr for scene-linear images): the median of each camera's frames. From then on,
    all commands take what differs from them as the subject. What stays in its place in half of the frames is lost.

    Example: beam plates captures/walker
    """

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE", help="Folder of the capture; plates are put there.")]
    json: Annotated[bool, arg(help="Print what was written as JSON.")] = False
    quiet: Annotated[bool, arg(help="Print nothing.")] = False


def plates(args: Plates) -> int:
    """Write the plates, and say how much moves before each camera."""
    with progress(args.quiet or args.json, compiles=False) as advance:
        found = write_plates(Capture.read(args.capture), progress=advance)
    if args.json:
        rows = [{**vars(plate), "path": str(plate.path)} for plate in found]
        print_json({"plates": rows})
    elif not args.quiet:
        parts = [100.0 * plate.moving for plate in found]
        folder, count = found[0].path.parent, count_of(len(found), "plate")
        print(escaped(f"{folder}: {count}; {min(parts):.1f} to {max(parts):.1f} % of each image move"))
    return 0
