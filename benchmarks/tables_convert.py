"""What pages say of files in and out beside splat-transform, and of viewers of the web."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from tables import Row, Rows, cell, table

from beam_warp.converters.formats import FORMATS

CONVERT = "convert_cpu.json"
VIEWERS = "viewers_chromium.json"
PROGRAMS = ("ours", "theirs")
LOOKS = ("position", "covariance", "opacity", "color")
HEADS = {
    "position": "centres, of the diagonal",
    "covariance": "covariance, relative",
    "opacity": "opacity",
    "color": "colour",
}


def _rows(result: Row, part: str) -> list[Row]:
    """Return the rows of a part; none if it was not measured."""
    return result.get(part, {}).get("rows", [])


@table("convert_formats", CONVERT)
def convert_formats(result: Row) -> Rows:
    """Return who reads and who writes which files: a column a format, and who does what as rows.

    What we do is in our own table of formats, and what splat-transform does was found with the measurement.
    """
    theirs = {row["name"]: row["theirs"] for row in result["formats"]}
    groups: dict[str, list[str]] = {}
    for ending in dict.fromkeys([*FORMATS, *theirs]):
        groups.setdefault(FORMATS[ending].name if ending in FORMATS else ending, []).append(ending)
    known: dict[str, Callable[[str], Sequence[object]]] = {
        "beam-convert": lambda ending: (
            (FORMATS[ending].reader, FORMATS[ending].writer) if ending in FORMATS else (0, 0)
        ),
        f"splat-transform {result['splat_transform']}": lambda ending: theirs.get(ending, (0, 0)),
    }
    rows: list[list[Any]] = [["", *(f"`{name}`" if name[0] == "." else name for name in groups)]]
    for program, roles in known.items():
        for way, does in enumerate(("reads", "writes")):
            cells = (any(roles(ending)[way] for ending in endings) for endings in groups.values())
            rows.append([f"{program} {does}", *("yes" if does_it else "" for does_it in cells)])
    return rows


@table("convert_speed", CONVERT)
def convert_speed(result: Row) -> Rows:
    """Return times and peak memory of conversions; programs took turns."""
    head = ["Gaussians", "from", "to", "beam-convert [s]", "splat-transform [s]", "time", "[MiB]", "[MiB]", "memory"]
    rows: list[list[Any]] = [head]
    for row in _rows(result, "speed"):
        ours, theirs = row["ours"], row.get("theirs", {})
        rows.append(
            [
                f"{row['gaussians']:,}",
                f"`{row['from']}`",
                f"`{row['to']}`",
                ours["seconds"],
                theirs.get("seconds"),
                _times(row.get("time_ratio")),
                cell(ours["mib"]["median"], ",.0f"),
                cell(theirs.get("mib", {}).get("median"), ",.0f"),
                _times(row.get("memory_ratio")),
            ]
        )
    return rows


def _times(ratio: Any) -> str:
    return f"{cell(ratio['median'], '.2f')} ×" if ratio else ""


def _size(error: float) -> str:
    return cell(error, ".1e") if error else "0"


@table("convert_readings", CONVERT)
def convert_readings(result: Row) -> Rows:
    """Return the largest difference of both readings of each file."""
    rows: list[list[Any]] = [["file", "Gaussians", *HEADS.values()]]
    for row in [*_rows(result, "errors"), *_rows(result, "files")]:
        name, found = row["name"].replace(", theirs", ", by splat-transform"), row.get("readings")
        if found:
            sizes = (_size(found[look]["largest"]) for look in LOOKS)
            rows.append([name, f"{found['gaussians']:,}", *sizes])
        elif "ours_refuses" in row or "theirs_refuses" in row:
            who = " and ".join(
                {"ours": "beam-warp", "theirs": "splat-transform"}[p] for p in PROGRAMS if f"{p}_refuses" in row
            )
            rows.append([name, "", f"refused by {who}", "", "", ""])
    return rows


@table("convert_written", CONVERT)
def convert_written(result: Row) -> Rows:
    """Return how far each written file is from what was to be written, root mean square, and its size."""
    rows: list[list[Any]] = [["file", "bytes a Gaussian", *HEADS.values()]]
    for row in _rows(result, "errors"):
        name, found = row["name"].replace(", theirs", ", by splat-transform"), row["written"]
        size = f"{row['bytes'] / found['gaussians']:.1f}"
        rows.append([name, size, *(_size(found[look]["rms"]) for look in LOOKS)])
    return rows


@table("convert_sequence", CONVERT)
def convert_sequence(result: Row) -> Rows:
    """Return what writing a relightable sequence, and reading its frames at random, costs."""
    head = ["file", "written [s]", "memory for it [MiB]", "size [MB]", "frame by OpenUSD [ms]", "frame by `read` [ms]"]
    keys = ("write_seconds", "write_mib", "megabytes", "usd_frame_ms", "beam_frame_ms")
    return [head, *([f"`{row['name']}`", *(row[key] for key in keys)] for row in _rows(result, "sequence"))]


@table("viewers", VIEWERS)
def viewers(result: Row) -> Rows:
    """Return what stood where it must in which viewer, to which pixel."""
    rows: list[list[Any]] = [["viewer", "files", "largest shift of a ball [pixel]", "largest error of a seen colour"]]
    for name, version in result["versions"].items():
        found = [row for row in result["rows"] if row["viewer"] == name]
        wrong = [f"`{row['ending']}`" for row in found if row["color_error"] is None]
        error = cell(max(row["color_error"] for row in found if row["color_error"] is not None), ".3f")
        rows.append(
            [
                f"{name} {version}",
                ", ".join(f"`{row['ending']}`" for row in found),
                cell(max(row["largest_shift"] for row in found), ".2f"),
                error + (f"; {', '.join(wrong)}: wrong, whoever wrote the file" if wrong else ""),
            ]
        )
    return rows
