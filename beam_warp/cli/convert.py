"""``beam-convert``: Gaussians from one file format, set of axes and profile to another; and a look into a file."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from beam_warp import __version__, converters
from beam_warp.checks import require_path
from beam_warp.cli.common.console import escaped, options_named, print_json, print_notes, progress, run_command
from beam_warp.cli.common.flags import Json, Keyed, MetersPerUnit, Quiet, SourceAxes, notes_of, options_of
from beam_warp.cli.common.pages import parse
from beam_warp.cli.common.paths import paths_checked
from beam_warp.converters.common.importers import IMPORTERS
from beam_warp.converters.common.options import Activation, MaterialActivation, Profile, ReadOptions
from beam_warp.converters.delivery.writer import delivered
from beam_warp.converters.formats import FORMATS, format_of
from beam_warp.converters.frame_files import written_axes
from beam_warp.converters.numbering import holds_a_frame, numbered_path
from beam_warp.errors import InvalidOptionError
from beam_warp.outputs import require_apart
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

READ = f"File ({', '.join(FORMATS)}), or a folder with asset.usda, meta.json or numbered files."
"""What is read, in words."""

WRITTEN = f"File to write: {', '.join(suffix for suffix, form in FORMATS.items() if form.writer)}."
"""What is written, in words."""


@dataclass(frozen=True)
class ConvertCommand:
    """Convert Gaussians between file formats, axes, units and profiles.

    Example: beam-convert person.compressed.ply person.ply --for aras-p

    A folder of numbered files is a sequence, also if it is zipped; several frames written to walk.ply become
    walk000000.ply and so on. `beam-convert inspect FILE` says what a file holds; `beam-convert --version` prints the
    version. A stage (docs/stages.md) is read for --player only.

    Example: beam-convert person/asset.usda person.html --player --environment studio.hdr
    """

    input: Annotated[Positional[Path], arg(metavar="IN", help=READ)]
    output: Annotated[Positional[Path], arg(metavar="OUT", help=WRITTEN)]
    target: Annotated[
        str | None,
        arg(
            name="for",
            aliases=("--target",),
            metavar="IMPORTER",
            help=f"Write what an importer reads: its axes, units, harmonics. One of {', '.join(IMPORTERS)}.",
        ),
    ] = None
    axes: Annotated[
        str | None, arg(metavar="CODE", help="Where x, y, z of the output point; by default rdf, as viewers assume.")
    ] = None
    source_axes: SourceAxes = None
    meters_per_unit: MetersPerUnit = None
    profile: Annotated[
        Profile, arg(help="PLY and glTF: standard for every importer, beam to append the materials.")
    ] = "standard"
    sh_degree: Annotated[int | None, arg(metavar="0..3", help="Pad or cut spherical harmonics to this degree.")] = None
    spz_version: Annotated[int, arg(metavar="3|4", help="SPZ: 3 for nearly every reader, 4 for smaller files.")] = 3
    activation: Annotated[
        Activation | None, arg(help="How a PLY stores scales and opacities: log (3DGS) or linear.")
    ] = None
    material_activation: Annotated[
        MaterialActivation | None, arg(help="Whose material channels a PLY holds; else only stated ones are read.")
    ] = None
    drop_invalid: Annotated[bool, arg(help="Drop rows with NaN or zero quaternions instead of refusing them.")] = False
    full_float: Annotated[bool, arg(help="USD: single precision throughout.")] = False
    lighting_variants: Annotated[
        bool, arg(help="USD: add a variant whose radiance is the base colour, for renderers that light it.")
    ] = False
    keyed: Keyed = False
    error_scale: Annotated[float, arg(metavar="X", help="b4d, and USD with --keyed: multiply all bounds.")] = 1.0
    player: Annotated[bool, arg(help="Write a page, OUT.html, that plays the asset in any browser.")] = False
    environment: Annotated[
        tuple[Path, ...],
        arg(metavar="FILE ...", help="Player: lat-long lights, .exr or .hdr, or folders of them; three are built in."),
    ] = ()
    beside: Annotated[bool, arg(help="Player: put the take beside the page, for servers, and not into it.")] = False
    quiet: Quiet = False
    json: Json = False


@dataclass(frozen=True)
class InspectCommand:
    """Say what a file or a folder of numbered files holds, who wrote it and what it leaves open.

    Example: beam-convert inspect person.compressed.ply --json
    """

    input: Annotated[Positional[Path], arg(metavar="FILE", help=READ)]
    json: Json = False


def _require_apart(source: Path, output: Path, frame_count: int) -> None:
    """Refuse frames that would replace those of the input, or end up among them."""
    planned = [numbered_path(output, frame) for frame in range(frame_count)]
    require_path("output", planned[-1])
    require_apart(planned)
    if source.is_dir() and output.parent.resolve() == source.resolve() and holds_a_frame(output.name):
        raise InvalidOptionError(
            f"output must be in another folder than the frames that are read, got {output}. Choose another folder."
        )


def _read(command: ConvertCommand) -> GaussianSequence:
    return converters.read(command.input, **vars(options_of(command, ReadOptions)))


def _write(command: ConvertCommand, sequence: GaussianSequence, path: Path) -> list[Path]:
    with progress(command.quiet or command.json, compiles=False) as report:

        def read_and_report(frame: int) -> GaussianCloud:
            cloud = sequence[frame]
            report("convert", frame + 1, len(sequence))
            return cloud

        return converters.write(
            dataclasses.replace(sequence, read_frame=read_and_report),
            path,
            options_of(command, converters.WriteOptions),
        )


def convert(command: ConvertCommand) -> int:
    """Read, write, and say what was done."""
    started = time.perf_counter()
    options = options_of(command, converters.WriteOptions)
    if command.player:
        from beam_warp.cli.player import publish  # its lights wait for SciPy

        return publish(command, partial(_read, command), partial(_write, command))
    converters.require_output(command.output, options)
    sequence = _read(command)
    form = format_of(command.output)
    is_numbered = len(sequence) > 1 and not form.holds_sequences
    if is_numbered:
        _require_apart(command.input, command.output, len(sequence))
    first = sequence[0]
    paths = _write(command, sequence, command.output)

    notes = notes_of(sequence)
    if form.name == "splat" and (first.sh_degree or first.base_color is not None):
        notes.append("a .splat holds neither materials nor view-dependent colour: they are left out")
    elif (
        not form.holds_sequences
        and form.name != "NumPy"
        and command.profile == "standard"
        and first.base_color is not None
    ):
        notes.append("materials are left out: --profile beam keeps them in PLY and glTF")
    elif form.name == "b4d" and (without := [name for name in first.arrays() if name not in delivered(first, options)]):
        notes.append(f"what is not drawn and left out: {', '.join(without)}")
    axes = written_axes(command.output, options, form)
    if form.axes is not None and axes != form.axes:
        notes.append(f"{form.name} means {form.axes}; this file is in {axes} and states it, which few readers heed")
    if command.target is not None:
        notes.append(f"in {IMPORTERS[command.target].name}: {IMPORTERS[command.target].to_do}")
    seconds = time.perf_counter() - started
    if command.json:
        print_json(
            {
                "outputs": [str(path) for path in paths],
                "frame_count": len(sequence),
                "gaussian_count": len(first),
                "source_axes": first.axes,
                "notes": notes,
                "seconds": round(seconds, 3),
            }
        )
    elif not command.quiet:
        print_notes(notes)
        if is_numbered:
            files = f"{paths[0]} … {paths[len(sequence) - 1].name}"
        else:
            files = f"{command.output}" + (f" and {len(paths) - 1} more beside it" if len(paths) > 1 else "")
        frames = f"{len(sequence)} frames, " if len(sequence) > 1 else ""
        print(f"wrote {files}: {frames}{len(first):,} Gaussians, {seconds:.2f} s")
    return 0


def inspect(command: InspectCommand) -> int:
    """Print what a file holds."""
    found = converters.inspect(command.input)
    if command.json:
        print_json(dataclasses.asdict(found))
    else:
        print("\n".join(map(escaped, found.as_text().split("\n"))))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``beam-convert``; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words == ["--version"]:
        print(f"beam-convert {__version__}")
        return 0
    if words[:1] == ["inspect"]:
        asked = parse(InspectCommand, words[1:], "beam-convert inspect")
        return run_command(lambda: _run(inspect, asked))
    command = parse(ConvertCommand, words, "beam-convert")
    return run_command(lambda: _run(convert, command))


def _run(function: Callable[[Any], int], command: Any) -> int:
    with options_named(type(command)), paths_checked(command):
        return function(command)
