"""``beam-convert ASSET page.html --player``: a page that plays an asset, or a stage, in any browser."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beam_warp.checks import require_path
from beam_warp.cli.common.console import print_json, print_notes
from beam_warp.cli.common.flags import notes_of
from beam_warp.cli.view import environments, is_stage, title_of
from beam_warp.converters.formats import suffix_of
from beam_warp.converters.player import write_player
from beam_warp.converters.staging import folders_made, require_writable
from beam_warp.errors import InvalidOptionError
from beam_warp.world.gaussians import GaussianSequence

if TYPE_CHECKING:
    from beam_warp.cli.convert import ConvertCommand


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
    if is_stage(command.input):
        from beam_warp.stage.stage import Stage  # it waits for Warp
        from beam_warp.stage.takes import staged_take

        sequence, view, own = staged_take(Stage.read(command.input), title_of(command.input))
    else:
        sequence, view, own = read(), {}, {}
    lights = {**own, **{name: read_light() for name, read_light in offered.items()}}
    with tempfile.TemporaryDirectory() as folder, folders_made(page.parent):
        take = command.input
        if suffix_of(take.name) != ".b4d":
            take = Path(folder) / "take.b4d"
            write(sequence, take)
        paths = write_player(page, take, lights, title=title_of(command.input), view=view, is_beside=command.beside)
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
