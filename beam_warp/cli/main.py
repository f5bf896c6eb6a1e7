"""``beam``: one command with a word for each thing the package does."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from beam_warp._version import __version__
from beam_warp.cli.common.console import options_named, run_command
from beam_warp.cli.common.pages import parse
from beam_warp.cli.common.paths import paths_checked
from beam_warp.errors import InvalidOptionError
from beam_warp.plan.processes import serve

_HELP = """Relightable 4D Gaussian assets: reconstruct, decompose, relight, view, evaluate, demonstrate.

Example: beam run person.ply --environment studio.hdr --out person

{commands}

`beam COMMAND --help` shows the options of a command.
See also beam-convert (formats, axes, units) and beam-validate (is an asset valid?).
"""


class Command(NamedTuple):
    """One word of ``beam``; its module is imported when the word is used.

    Attributes:
        record: Name of the dataclass of its options, in the module ``beam_warp.cli.<word>``, _ for -.
        line: Description of the command in a line.
    """

    record: str
    line: str

    def load(self, word: str) -> tuple[type, Callable[[Any], int]]:
        """Return the record of its options, and the function that takes it and returns the exit code."""
        name = word.replace("-", "_")
        module = import_module(f"beam_warp.cli.{name}")
        return getattr(module, self.record), getattr(module, name)


COMMANDS = {
    "run": Command("Run", "Make a relightable asset from Gaussians, or all the way from a capture."),
    "reconstruct": Command("Reconstruct", "Reconstruct a multi-view capture as Gaussians, tracked over time."),
    "decompose": Command("Decompose", "Find materials of Gaussians, from the images that they were fitted to."),
    "render": Command("Render", "Relight assets: an image, numbered images or a film."),
    "channel": Command("DrawChannel", "Draw one array of an asset without light: materials, errors, flags."),
    "view": Command("ViewCommand", "Look at an asset in the browser, under lights that are moved about."),
    "evaluate": Command("Evaluate", "Score an asset against a capture whose truth is known."),
    "reduce": Command("Reduce", "Merge Gaussians until a bound on relit images, a size or a number is met."),
    "mesh": Command("Mesh", "Extract the surface of every frame as a mesh."),
    "demo": Command("Demo", "Build, capture, decompose, relight and score a small figure."),
    "stability": Command("Stability", "Run what tracing, reconstruction, materials and relighting may fail on."),
    "chart": Command("Chart", "Measure error against time on your own data and device."),
    "inspect": Command("Inspect", "Say what is wrong with a capture before hours are spent on it."),
    "plates": Command("Plates", "Tell the subject by what moves, for a capture without masks."),
    "warm-up": Command("WarmUp", "Compile the kernels that jobs need, so that none of them waits for that."),
    "plan": Command("ShowPlan", "Say how far a long job is: frames done, running, left, failed, and an estimate."),
}

STEP_MODULES = ("beam_warp.decomposition.work", "beam_warp.reconstruction.steps")
"""What processes need for steps of reconstruction and materials."""

GPU_DRIVERS = ("/dev/nvidiactl", "/dev/dxg")
"""What there is where CUDA may be: its driver, or that of Windows' subsystem for Linux."""

MOVED = {("render", "--channel"): "beam channel ASSET NAME --out FILE"}
"""Options that became commands of their own."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``beam``; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        print(f"beam {__version__}")
        return 0
    if not words or words[0] in ("-h", "--help", "--help-all"):
        rows = (f"  {word:12} {command.line}" for word, command in COMMANDS.items())
        print(_HELP.format(commands="\n".join(rows)), end="")
        return 0 if words else 2
    return run_command(lambda: _run(words[0], words[1:]))


def _forks(words: Sequence[str]) -> bool:
    """Return whether several processes of this machine are to work, before options are read: a guess, for speed."""
    given = dict.fromkeys(("--workers", "--device"), "")
    for word, following in zip(words, [*words[1:], ""], strict=True):
        name, _, value = word.partition("=")
        if name in given:
            given[name] = value or following
    if given["--workers"] in ("", "auto"):
        return given["--device"] != "cpu" and any(Path(driver).exists() for driver in GPU_DRIVERS)
    return given["--workers"] != "1"


def _run(word: str, words: list[str]) -> int:
    """Read the options of a command and run it."""
    if word not in COMMANDS:
        raise InvalidOptionError(f"command must be one of {', '.join(COMMANDS)}, got {word}. See beam --help.")
    for (command, option), now in MOVED.items():
        if word == command and any(given.split("=")[0] == option for given in words):
            raise InvalidOptionError(f"{option[2:]} must be drawn by a command of its own. Use {now}.")
    if word in ("run", "reconstruct") and _forks(words):
        serve(STEP_MODULES)  # it imports while this process does
    record, function = COMMANDS[word].load(word)
    with options_named(record):
        options = parse(record, words, f"beam {word}")
        with paths_checked(options):
            return function(options)
