"""``beam``: one command with a word for each thing the package does."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

import tyro
from tyro.conf import FlagCreatePairsOff, subcommand

from beam_warp._version import __version__
from beam_warp.cli.chart import Chart, chart
from beam_warp.cli.console import run_command
from beam_warp.cli.decompose import Decompose, decompose
from beam_warp.cli.demo import Demo, demo
from beam_warp.cli.evaluate import Evaluate, evaluate
from beam_warp.cli.inspect import Inspect, inspect
from beam_warp.cli.mesh import Mesh, mesh
from beam_warp.cli.reconstruct import Reconstruct, reconstruct
from beam_warp.cli.render import Render, render
from beam_warp.cli.run import Run, run
from beam_warp.cli.stability import Stability, stability
from beam_warp.cli.view import View, view

_HELP = """Relightable 4D Gaussian assets: reconstruct, decompose, relight, view, evaluate, demonstrate.

Example: beam run person.ply --environment studio.hdr --out person

See also beam-convert (formats, axes, units) and beam-validate (is an asset valid?).
"""

Command = (
    Annotated[Run, subcommand("run", prefix_name=False)]
    | Annotated[Reconstruct, subcommand("reconstruct", prefix_name=False)]
    | Annotated[Decompose, subcommand("decompose", prefix_name=False)]
    | Annotated[Render, subcommand("render", prefix_name=False)]
    | Annotated[View, subcommand("view", prefix_name=False)]
    | Annotated[Evaluate, subcommand("evaluate", prefix_name=False)]
    | Annotated[Mesh, subcommand("mesh", prefix_name=False)]
    | Annotated[Demo, subcommand("demo", prefix_name=False)]
    | Annotated[Stability, subcommand("stability", prefix_name=False)]
    | Annotated[Chart, subcommand("chart", prefix_name=False)]
    | Annotated[Inspect, subcommand("inspect", prefix_name=False)]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``beam``; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        print(f"beam {__version__}")
        return 0
    command = tyro.cli(Command, prog="beam", description=_HELP, args=words, config=(FlagCreatePairsOff,))  # type: ignore[arg-type]
    if isinstance(command, Run):
        return run_command(lambda: run(command))
    if isinstance(command, Reconstruct):
        return run_command(lambda: reconstruct(command))
    if isinstance(command, Decompose):
        return run_command(lambda: decompose(command))
    if isinstance(command, Render):
        return run_command(lambda: render(command))
    if isinstance(command, View):
        return run_command(lambda: view(command))
    if isinstance(command, Evaluate):
        return run_command(lambda: evaluate(command))
    if isinstance(command, Mesh):
        return run_command(lambda: mesh(command))
    if isinstance(command, Stability):
        return run_command(lambda: stability(command))
    if isinstance(command, Chart):
        return run_command(lambda: chart(command))
    if isinstance(command, Inspect):
        return run_command(lambda: inspect(command))
    return run_command(lambda: demo(command))
