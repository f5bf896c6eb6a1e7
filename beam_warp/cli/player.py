"""``beam-convert ASSET page.html --player``: a page that plays an asset, or a stage, in any browser."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beam_warp.checks import require_path
from beam_warp.cli.common.console import print_json, print_notes
from beam_warp.cli.common.flags import notes_of
from beam_warp.cli.view import environments
from beam_warp.converters.formats import FORMATS, suffix_of
from beam_warp.converters.player import write_player
from beam_warp.converters.staging import folders_made, require_writable
from beam_warp.errors import InvalidOptionError
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.lights import lights_to_json

if TYPE_CHECKING:
    from beam_warp.cli.convert import ConvertCommand
    from beam_warp.stage.assets import StageAsset
    from beam_warp.stage.stage import Stage

PATH_SIZE = 1600, 900
"""Width and height of the images that a stage's camera is asked for: an orbit that frames the assets looks at both."""


def publish(
    command: ConvertCommand, read: Callable[[], GaussianSequence], write: Callable[[GaussianSequence, Path], Any]
) -> int:
    """Write the page, and say what was done.

    Args:
        command: What was asked for.
        read: Reads the asset.
        write: Writes the take, by the options of the command.
    """
    started = time.perf_counter()
    page = require_path("output", command.output)
    if page.suffix.lower() != ".html":
        raise InvalidOptionError(f"output's name must end in .html for --player, got {page.name}. Rename it.")
    require_writable(page, is_made=True)
    offered = environments(command.environment)
    sequence, view, own = _staged(command.input) if _is_stage(command.input) else (read(), {}, {})
    lights = {**own, **{name: read_light() for name, read_light in offered.items()}}
    with tempfile.TemporaryDirectory() as folder, folders_made(page.parent):
        take = command.input
        if suffix_of(take.name) != ".b4d":
            take = Path(folder) / "take.b4d"
            write(sequence, take)
        paths = write_player(page, take, lights, title=_title(command.input), view=view, is_beside=command.beside)
    notes = notes_of(sequence)
    seconds = time.perf_counter() - started
    if command.json:
        outputs = [str(path) for path in paths]
        print_json({"outputs": outputs, "frame_count": len(sequence), "notes": notes, "seconds": round(seconds, 3)})
    elif not command.quiet:
        print_notes(notes)
        size = sum(path.stat().st_size for path in paths)
        print(f"wrote {' and '.join(map(str, paths))}: {len(sequence)} frames, {size / 1e6:.1f} MB, {seconds:.2f} s")
    return 0


def _title(path: Path) -> str:
    return path.resolve().parent.name if path.stem in ("asset", "manifest", "stage") else path.stem


def _is_stage(path: Path) -> bool:
    return path.suffix.lower() == ".json" and suffix_of(path.name) not in FORMATS


def _staged(path: Path) -> tuple[GaussianSequence, dict[str, Any], dict[str, EnvironmentMap]]:
    """Return a stage as one take, what its page shows first, and its light by name."""
    from beam_warp.stage.discs import discs_of
    from beam_warp.stage.stage import Stage

    stage = Stage.read(path)
    mesh = stage.mesh
    floor = None if mesh is None or mesh.catches_shadows.all() else discs_of(mesh)
    notes = stage.notes
    if mesh is not None and mesh.catches_shadows.any():
        notes = (*notes, "what only catches shadows is left out")
    sequence = GaussianSequence(
        stage.frame_count,
        lambda frame: _with(stage.cloud_at(stage.time_of(frame)), floor),
        frames_per_second=stage.rate,
        topology="constant" if all(_is_constant(asset) for asset in stage.assets) else "perFrame",
        metadata={**stage.raster_metadata, "notes": "\n".join(notes)},
    )
    light = stage.environment
    name = f"{path.stem} (stage)"
    turn = 0.0 if light is None else light.rotation_at(0.0)
    view = {
        "state": {"environment": "none" if light is None else name, "rotation": (turn + 180.0) % 360.0 - 180.0},
        "degreesPerSecond": 0.0 if light is None else light.degrees_per_second,
        "lights": lights_to_json(stage.lights),
        "cameras": [_pose(stage, frame) for frame in range(stage.frame_count)],
    }
    return sequence, view, {} if light is None else {name: light.map}


def _with(cloud: GaussianCloud, floor: GaussianCloud | None) -> GaussianCloud:
    from beam_warp.stage.assets import joined

    return cloud if floor is None else joined([cloud, floor])


def _is_constant(asset: StageAsset) -> bool:
    return len(asset.sequence) == 1 or asset.sequence.topology == "constant" or asset.blend == "rows"


def _pose(stage: Stage, frame: int) -> dict[str, Any]:
    """Return where the camera of an image is: position, rows of its rotation, vertical field of view [degree]."""
    assert stage.camera is not None
    camera = stage.camera.camera_at(stage.time_of(frame), *PATH_SIZE)
    pose = camera.camera_to_world
    fov = 2.0 * math.degrees(math.atan(0.5 * camera.height / camera.focal_y))
    return {"position": pose[:3, 3].tolist(), "worldToCamera": pose[:3, :3].T.ravel().tolist(), "fov": fov}
