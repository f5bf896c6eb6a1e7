"""Files in and out beside splat-transform: how long, on what memory, and how far apart both read and write.

    python benchmarks/convert.py [--quick] [--parts PART] [--repeats 5] --out result.json

splat-transform comes from npm (`npm_packages.py`); without it, this package is measured alone. Which formats there are
is read from `beam_warp.converters.formats.FORMATS` and from what splat-transform says of itself.

- ``speed``: whole conversions, each in a process of its own, from start to end. Both programs take turns.
- ``errors``: a cloud in every format. Each file is read by both programs, and compared with the other's reading and
  with what was written (`convert_looks.py`).
- ``files``: files of other producers under ``$BEAM_DATA``, read by both.
- ``sequence``: a relightable sequence, written and read at random (`convert_sequence.py`).
"""

from __future__ import annotations

import argparse
import functools
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import npm_packages
import numpy as np
import record
import warp as wp
from convert_looks import Looks, difference, looks_of_cloud, looks_of_ply
from parts import measure, say
from timing import spread
from write_lcc import write_lcc, write_lcc2

from beam_warp.converters import WriteOptions, read, write
from beam_warp.converters.formats import FORMATS, suffix_of
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.axes import axes_matrix, change_axes
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

Row = dict[str, Any]

ONE_FILE = (".ply", ".compressed.ply", ".spz", ".sog", ".splat", ".ksplat", ".glb")
"""Endings of splat formats that keep a frame in one file, for the tables."""

AXES = "rdf"
"""Axes of every cloud here."""

THEIR_AXES = {".glb": "luf"}
"""Axes in which splat-transform writes such a cloud, which it does not state; into other formats it copies numbers."""

KSPLAT_LEVELS = (0, 1, 2)

SCENES = (".lcc", ".lcc2", "lod-meta.json")
"""Endings of indices of scenes with levels, the finest of which is read."""

PATTERNS = ("splats/**/*", "fixtures/splat_transform/*", "sequences/wave_sog/wave_0*01.sog")
"""Files of other producers, in the folder of data."""

_LAUNCH = """
import json, os, sys, time
started = time.perf_counter()
quiet = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
child = os.posix_spawnp(sys.argv[1], sys.argv[1:], os.environ, file_actions=quiet)
_, status, usage = os.wait4(child, 0)
print(json.dumps([time.perf_counter() - started, usage.ru_utime + usage.ru_stime, usage.ru_maxrss, status]))
"""
"""A small process between: peak memory of a child counts from that of the process that starts it."""


@dataclass(frozen=True)
class Bench:
    """What the parts share.

    Attributes:
        count: Gaussians of a conversion that is timed.
        sog_count: Gaussians of one to or from SOG, for whose palettes splat-transform takes minutes otherwise.
        error_count: Gaussians of which errors are measured.
        repeats: Repeats of everything that is timed.
        sequence: Frames of the sequence, and Gaussians of each.
        folder: Where files go.
        theirs: Command of splat-transform; empty where it is not to be had.
        reads: Endings that splat-transform reads.
        writes: Endings that it writes.
        data: Folder of files of other producers.
    """

    count: int
    sog_count: int
    error_count: int
    repeats: int
    sequence: tuple[int, int]
    folder: Path
    theirs: Sequence[str]
    reads: frozenset[str]
    writes: frozenset[str]
    data: Path


@dataclass(frozen=True)
class Run:
    """A process that ended well.

    Attributes:
        seconds: From its start to its end.
        cpu_seconds: Of all its threads.
        mib: Peak of its resident memory [MiB].
    """

    seconds: float
    cpu_seconds: float
    mib: float


def run(command: Sequence[str]) -> Run:
    """Run a command to its end.

    Raises:
        RuntimeError: It fails.
    """
    launched = [sys.executable, "-I", "-S", "-c", _LAUNCH, *command]
    done = subprocess.run(launched, capture_output=True, text=True, check=True)
    seconds, cpu, kib, status = json.loads(done.stdout)
    if status:
        raise RuntimeError(f"{' '.join(command[-4:])} fails: {done.stderr.strip()[-300:]}")
    return Run(seconds, cpu, kib / 1024.0)


def ours(source: Path, target: Path) -> list[str]:
    """Return our command for a conversion."""
    return [str(Path(sys.executable).with_name("beam-convert")), str(source), str(target), "--quiet"]


def theirs(bench: Bench, source: Path, target: Path) -> list[str]:
    """Return splat-transform's command for a conversion; like ours, it writes SPZ 3, and no GPU is used."""
    options = ["-q", "-w", *(["-g", "cpu"] if target.name.endswith((".sog", ".json")) else [])]
    tags = ["-l", "0"] if target.name == "lod-meta.json" else []
    return [
        *bench.theirs,
        *options,
        *(["-L", "0"] if suffix_of(source.name) in SCENES else []),
        *(["--spz-version", "3"] if target.suffix == ".spz" else []),
        str(source),
        *tags,
        str(target),
    ]


def splat_transform() -> list[str]:
    """Return the command of splat-transform, or nothing."""
    try:
        return npm_packages.splat_transform()
    except npm_packages.MissingPackagesError as error:
        print(f"splat-transform is left out: {error}", flush=True)
        return []


def their_formats(command: Sequence[str]) -> tuple[frozenset[str], frozenset[str]]:
    """Return the endings that splat-transform reads and writes, as its help lists them."""
    if not command:
        return frozenset(), frozenset()
    text = subprocess.run([*command, "--help"], capture_output=True, text=True).stdout
    lists = [re.search(rf"SUPPORTED {word}\n(.+)\n", text) for word in ("INPUTS", "OUTPUTS")]
    reads, writes = (frozenset(found[1].split()) if found else frozenset() for found in lists)
    return reads, writes


def formats(bench: Bench) -> list[Row]:
    """Return who reads and who writes which ending."""
    not_splats = {".mjs", ".csv", ".html", ".webp", ".voxel.json", "null"}
    return [
        {
            "name": ending,
            "format": FORMATS[ending].name if ending in FORMATS else None,
            "ours": [bool(ending in FORMATS and role) for role in roles(ending)],
            "theirs": [ending in bench.reads, ending in bench.writes],
        }
        for ending in dict.fromkeys([*FORMATS, *sorted((bench.reads | bench.writes) - not_splats)])
    ]


def roles(ending: str) -> tuple[Any, Any]:
    """Return our reader and our writer of an ending, None where there is none."""
    form = FORMATS.get(ending)
    return (form.reader, form.writer) if form else (None, None)


def made_cloud(count: int, degree: int) -> GaussianCloud:
    """Return random Gaussians, in random order, that look like trained ones and whose centres keep a distance.

    A centre is within a quarter of a cell from the middle of its own cell of a grid: rounding cannot make it another's
    nearest.
    """
    rng = np.random.default_rng(7)
    side = int(np.ceil(count ** (1.0 / 3.0)))
    cells = np.stack(np.unravel_index(rng.permutation(side**3)[:count], (side,) * 3), axis=1)
    falloff = np.repeat([1.0, 0.3, 0.15, 0.1], [1, 3, 5, 7])[: (degree + 1) ** 2]
    turns = rng.normal(size=(count, 4))
    return GaussianCloud(
        positions=((cells + 0.5 + rng.uniform(-0.25, 0.25, (count, 3))) / side - 0.5).astype(np.float32),
        orientations=(turns / np.linalg.norm(turns, axis=1, keepdims=True)).astype(np.float32),
        scales=np.exp(rng.normal(np.log(0.5 / side), 0.7, (count, 3))).astype(np.float32),
        opacities=(1.0 / (1.0 + np.exp(-rng.normal(1.0, 2.0, count)))).astype(np.float32),
        radiance=(rng.normal(size=(count, len(falloff), 3)) * falloff[:, None]).astype(np.float32),
        radiance_color_space=DISPLAY_SRGB,
        axes=AXES,
    )


def source_file(bench: Bench, count: int) -> Path:
    """Return a PLY of degree 2 with this many Gaussians, written once."""
    path = bench.folder / f"source_{count}.ply"
    if not path.is_file():
        write(GaussianSequence.from_clouds([made_cloud(count, 2)]), path)
    return path


def made_file(bench: Bench, ending: str, source: Path) -> Path | None:
    """Return a file that holds what a PLY does, of splat-transform if that writes the format; None if nobody does."""
    path = source.with_name(f"made_{source.stem}{ending}")
    if path.is_file():
        return path
    if ending == ".ksplat" and bench.theirs:
        write_ksplat(source, path, level=1)
    elif ending in bench.writes:
        run(theirs(bench, source, path))
    elif roles(ending)[1]:
        run(ours(source, path))
    return path if path.is_file() else None


def write_ksplat(source: Path, path: Path, level: int) -> None:
    """Write a .ksplat with harmonics of degree 2 by the library of its inventor."""
    module = npm_packages.packages() / "@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js"
    script = Path(__file__).with_name("write_ksplat.mjs")
    run([npm_packages.node(), str(script), str(module), str(source), str(path), str(level), "2"])


def conversions(bench: Bench) -> Iterator[tuple[int, Path, str]]:
    """Yield what is timed: how many Gaussians, the input, and the ending of the output."""
    for ending in (*ONE_FILE, ".usdc"):
        count = bench.sog_count if ending == ".sog" else bench.count
        source = source_file(bench, count)
        if roles(ending)[1]:
            yield count, source, ending
        if ending != ".ply" and roles(ending)[0] and (made := made_file(bench, ending, source)):
            yield count, made, ".ply"


def speed(bench: Bench) -> Iterator[Row]:
    """Time every conversion that we do."""
    rows: list[Row] = []
    for count, source, ending in conversions(bench):
        row = {"gaussians": count, "from": suffix_of(source.name), "to": ending, **timed(bench, source, ending)}
        rows.append({"name": f"{row['from'][1:]} to {ending[1:]}", **row})
        say(f"{rows[-1]['name']}: {row['ours']['seconds']['median']:.2f} s")
        yield {"rows": rows}


def timed(bench: Bench, source: Path, ending: str) -> Row:
    """Return what a conversion costs each program that does it; they take turns, after one unmeasured round."""
    target = bench.folder / f"converted{ending}"
    commands = {"ours": ours(source, target)}
    if suffix_of(source.name) in bench.reads and ending in bench.writes:
        commands["theirs"] = theirs(bench, source, target)
    runs: dict[str, list[Run]] = {who: [] for who in commands}
    sizes: dict[str, int] = {}
    for repeat in range(-1, bench.repeats):
        for who in commands if repeat % 2 else reversed(commands):
            target.unlink(missing_ok=True)
            done = run(commands[who])
            sizes[who] = target.stat().st_size
            if repeat >= 0:
                runs[who].append(done)
    row: Row = {}
    for who, found in runs.items():
        costs = {name: spread(np.array([getattr(one, name) for one in found])) for name in Run.__dataclass_fields__}
        row[who] = {**costs, "bytes": sizes[who]}
    if "theirs" in runs:
        pairs = list(zip(runs["ours"], runs["theirs"], strict=True))
        row["time_ratio"] = spread(np.array([us.seconds / them.seconds for us, them in pairs]))
        row["memory_ratio"] = spread(np.array([us.mib / them.mib for us, them in pairs]))
    return row


def their_reading(bench: Bench, path: Path) -> Looks:
    """Return what splat-transform reads in a file: the PLY that it makes of it, by a reader that is nobody's."""
    ply = bench.folder / "their_reading.ply"
    run(theirs(bench, path, ply))
    return looks_of_ply(ply)


def our_reading(path: Path) -> Looks:
    """Return what we read in a file, in the axes that it has."""
    return looks_of_cloud(read(path)[0])


def our_reading_turned(path: Path, axes: str | None) -> Looks:
    """Return what we read in a file, in `AXES`; the file's are given, or else those that it states."""
    cloud = read(path)[0]
    return looks_of_cloud(cloud, axes_matrix(axes or cloud.axes, AXES))


def errors(bench: Bench) -> Iterator[Row]:
    """Compare every file that either program writes: with the other's reading, and with what was to be written."""
    source = source_file(bench, bench.error_count)
    truth = looks_of_ply(source)
    rows: list[Row] = []
    for name, path, axes in (*_files_of_both(bench, source), *_scenes_of_both(bench, source)):
        ending = suffix_of(path.name)
        is_scene = ending in SCENES  # which have a folder of their own
        row: Row = {
            "name": name,
            "bytes": sum(file.stat().st_size for file in (path.parent.rglob("*") if is_scene else [path])),
            "written": difference(our_reading_turned(path, axes), truth),
        }
        if ending in bench.reads:
            ours = our_reading_turned(path, None) if is_scene else our_reading(path)
            row["readings"] = difference(ours, their_reading(bench, path))
        rows.append(row)
        yield {"gaussians": bench.error_count, "rows": rows}


def _files_of_both(bench: Bench, source: Path) -> Iterator[tuple[str, Path, str | None]]:
    """Yield files that hold what a PLY does: a name, the file, and its axes where it does not state them."""
    for ending in ONE_FILE:
        if not roles(ending)[0]:
            continue
        if roles(ending)[1]:
            path = bench.folder / f"ours{ending}"
            write(read(source), path)
            yield f"{ending}, ours", path, None
        if ending in bench.writes:
            path = bench.folder / f"theirs{ending}"
            run(theirs(bench, source, path))
            yield f"{ending}, theirs", path, THEIR_AXES.get(ending, AXES)
        if ending == ".ksplat" and bench.theirs:
            for level in KSPLAT_LEVELS:
                path = bench.folder / f"level{level}.ksplat"
                write_ksplat(source, path, level)
                yield f"{ending}, level {level}", path, AXES


def _scenes_of_both(bench: Bench, source: Path) -> Iterator[tuple[str, Path, None]]:
    """Yield scenes with levels that hold what a PLY does, as `_files_of_both` yields files."""
    path = bench.folder / "ours_streamed" / "lod-meta.json"
    write(read(source), path)
    yield f"{path.name}, ours", path, None
    if path.name in bench.writes:
        path = bench.folder / "theirs_streamed" / path.name
        path.parent.mkdir(exist_ok=True)
        run(theirs(bench, source, path))
        yield f"{path.name}, theirs", path, None
    cloud = change_axes(read(source)[0], "rfu")
    path = bench.folder / "lcc" / "meta.lcc"
    path.parent.mkdir(exist_ok=True)
    write_lcc(cloud, path)
    yield ".lcc", path, None
    for kind in (".sog", ".spz"):
        path = bench.folder / f"lcc2_{kind[1:]}" / "meta.lcc2"
        write_lcc2(cloud, path, kind, functools.partial(_write_numbers, axes=FORMATS[kind].axes or cloud.axes))
        yield f".lcc2 of {kind}", path, None


def _write_numbers(cloud: GaussianCloud, path: Path, axes: str) -> None:
    """Write a cloud as if it had other axes."""
    write(GaussianSequence.from_clouds([cloud.with_arrays(axes=axes)]), path, WriteOptions(axes=axes))


def files(bench: Bench) -> Iterator[Row]:
    """Compare both readings of files of other producers."""
    rows: list[Row] = []
    yield {"rows": rows}
    found = sorted(path for pattern in PATTERNS for path in bench.data.glob(pattern))
    for path in found:
        if suffix_of(path.name) in bench.reads:
            rows.append(_compared(bench, path))
            yield {"rows": rows}


def _compared(bench: Bench, path: Path) -> Row:
    """Return how both readings of a file differ, or who refuses it."""
    row: Row = {"name": str(path.relative_to(bench.data))}
    found: dict[str, Looks] = {}
    readings: dict[str, Callable[[], Looks]] = {
        "ours": lambda: our_reading(path),
        "theirs": lambda: their_reading(bench, path),
    }
    for who, reading in readings.items():
        try:
            found[who] = reading()
        except Exception as error:
            row[f"{who}_refuses"] = str(error).replace(str(bench.data), "")[:200]
    if len(found) == 2:
        row["readings"] = difference(found["ours"], found["theirs"])
    return row


def sequence(bench: Bench) -> Iterator[Row]:
    """Write and read a relightable sequence, in a process of its own for each repeat."""
    frames, count = bench.sequence
    program = Path(__file__).with_name("convert_sequence.py")
    rows: list[Row] = []
    for ending in (".usda", ".usdc"):
        found = []
        for _ in range(bench.repeats):
            with tempfile.TemporaryDirectory(dir=bench.folder) as folder:
                command = [
                    sys.executable,
                    "-P",
                    str(program),
                    str(Path(folder) / f"asset{ending}"),
                    str(frames),
                    str(count),
                ]
                found.append(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout))
        rows.append({"name": ending, **{key: spread(np.array([one[key] for one in found])) for key in found[0]}})
        yield {"frames": frames, "gaussians": count, "rows": rows}


PARTS = {"errors": errors, "files": files, "speed": speed, "sequence": sequence}


def main() -> int:
    parser = record.parser(__doc__, data=True, quick="few Gaussians and one repeat", parts=PARTS)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    for form in FORMATS.values():  # so that the result's list of code has what child processes load
        for module in filter(None, (form.reader, form.writer)):
            import_module(f"beam_warp.converters.{module}")
    command = splat_transform()
    reads, writes = their_formats(command)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(
            count=2_000 if args.quick else 1_000_000,
            sog_count=2_000 if args.quick else 10_000,
            error_count=500 if args.quick else 10_000,
            repeats=1 if args.quick else args.repeats,
            sequence=(3, 500) if args.quick else (30, 140_000),
            folder=Path(folder),
            theirs=command,
            reads=reads,
            writes=writes,
            data=args.data,
        )
        head = {
            "splat_transform": npm_packages.version("@playcanvas/splat-transform") if bench.theirs else None,
            "formats": formats(bench),
        }
        keep = functools.partial(_keep, args, head)
        found = measure(PARTS, bench, only=args.parts, keep=keep)
    return 1 if found["failed"] else 0


def _keep(args: argparse.Namespace, head: Row, found: Row) -> None:
    record.write_result(args, wp.get_device("cpu"), head | found)


if __name__ == "__main__":
    sys.exit(main())
