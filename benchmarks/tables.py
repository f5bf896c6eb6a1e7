"""Write every measured number of README and docs, from the results in `benchmarks/results`.

    python benchmarks/tables.py            # writes tables, numbers and figures; prints the pages that changed
    python benchmarks/tables.py --check    # only says which would change; exit status 1 then
    python benchmarks/tables.py --stale    # lists results whose code has changed since, and the files

A page marks the place of a table by its name; the function of that name, decorated with `table` in a module
``tables_*.py``, returns its rows:

    <!-- table tracing_speed -->
    <!-- /table -->

A number in a sentence is a link to its result, whose fragment leads to the value. Keys are written in small letters,
digits and underscores; rows of a list are found by their ``name``; after ``~`` comes a factor or a format, or both. The
text of the link and its title, which browsers show on hover, are written here:

    [0.47](benchmarks/results/raster_h200.json#peer/cases/rgb/forward_ms~.2f "NVIDIA H200 …")

A fragment that begins with ``=`` names a function decorated with `number`, for what is computed of several values.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import io
import json
import os
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import record

Row = Mapping[str, Any]
Rows = Sequence[Sequence[Any]]

TABLE = re.compile(r"(<!-- table (?P<name>[\w-]+) -->\n).*?(<!-- /table -->)", re.DOTALL)
NUMBER = re.compile(
    r'\[[^\[\]]*\]\((?P<path>[^()\s]*benchmarks/results/(?P<file>[\w.-]+\.json))#(?P<key>[^\s"()]+)(?: "[^"]*")?\)'
)

PLACES = ("data", "assets", "keep", "pictures", "folder")
"""Options that say where files are."""

TABLES: dict[str, tuple[tuple[str, ...], Callable[..., Rows]]] = {}
NUMBERS: dict[str, tuple[tuple[str, ...], Callable[..., Any]]] = {}
FIGURES: dict[str, tuple[tuple[str, ...], Callable[..., None]]] = {}


def table(name: str, *files: str) -> Callable[[Callable[..., Rows]], Callable[..., Rows]]:
    """Register a function as the table of a name: it takes the results of these files, and returns rows of cells.

    The first row is the head. Cells are text, numbers (three significant digits) or spreads, which `cell` writes.
    """
    return lambda function: TABLES.setdefault(name, (files, function))[1]


def number(name: str, *files: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register a function as the number of a name: it takes the results of these files, and returns a value."""
    return lambda function: NUMBERS.setdefault(name, (files, function))[1]


def figure(name: str, *files: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function as the figure ``docs/images/NAME``: it takes results and the path to write."""
    return lambda function: FIGURES.setdefault(name, (files, function))[1]


@functools.cache
def result(file: str) -> Row:
    """Return a result; it must say how it was measured."""
    found = json.loads((record.RESULTS / file).read_text(encoding="utf-8"))
    if "measured" not in found:
        raise ValueError(f"{file} must say how it was measured, got no key 'measured'. Measure it again.")
    return found


def is_spread(value: Any) -> bool:
    """Return whether a value is the median and range of repeats."""
    return isinstance(value, Mapping) and {"median", "lowest", "highest"} <= set(value)


def cell(value: Any, form: str = ".3g", *, factor: float = 1.0) -> str:
    """Return a value as text: a spread as its median and, in brackets, its range; nothing as an empty cell."""
    if value is None or isinstance(value, str):
        return value or ""
    if is_spread(value):
        ends = [cell(value[end], form, factor=factor) for end in ("median", "lowest", "highest")]
        return ends[0] if ends[1] == ends[2] else f"{ends[0]} ({ends[1]}–{ends[2]})"
    text = format(factor * value, form)
    if "e" in text and form.endswith("g"):
        text = f"{factor * value:,.0f}" if abs(factor * value) >= 1.0 else f"{factor * value:.1e}"
    return text


def source(file: str) -> str:
    """Return what was measured, in words: machine, commit, date, options; whether the code has changed since."""
    measured = result(file)["measured"]
    machine = measured["machine"]
    device = machine["device"] if machine["device"] != "cpu" else f"{machine['cores']} CPU cores"
    said = [device, f"commit {measured['commit']}", measured["date"]]
    for name, value in measured["options"].items():
        if name in PLACES:
            continue
        said.append(
            name if value is True else f"{name} {' '.join(map(str, value)) if isinstance(value, list) else value}"
        )
    if record.changed_since(measured):
        said.append("code has changed since")
    return ", ".join(said)


def filled(page: Path, text: str) -> str:
    """Return a page's text with its tables and numbers as the results have them."""
    to_results = os.path.relpath(record.RESULTS, page.parent).replace(os.sep, "/")

    def write_table(match: re.Match[str]) -> str:
        files, function = TABLES[match["name"]]
        rows = [[cell(value) for value in row] for row in function(*map(result, files))]
        lines = ["| " + " | ".join(row) + " |" for row in rows]
        lines.insert(1, "|" + "---|" * len(rows[0]))
        sources = [f"*Source: [{file}]({to_results}/{file}), {source(file)}.*  " for file in files]
        lines += ["", *sources[:-1], sources[-1].rstrip()] if sources else []
        return match[1] + "\n" + "\n".join(lines) + "\n\n" + match[3]

    def write_number(match: re.Match[str]) -> str:
        path, _, spec = match["key"].partition("~")
        files, value = found_at(match["file"], path)
        said, spread = written(value, spec)
        title = "; ".join(map(source, files)) + spread
        return f'[{said}]({match["path"]}#{match["key"]} "{title}")'

    return NUMBER.sub(write_number, TABLE.sub(write_table, text))


def found_at(file: str, path: str) -> tuple[tuple[str, ...], Any]:
    """Return the results that a number is of, and its value."""
    if path.startswith("="):
        files, function = NUMBERS[path[1:]]
        return files, function(*map(result, files))
    return (file,), functools.reduce(step, path.split("/"), result(file))


def written(value: Any, spec: str) -> tuple[str, str]:
    """Return a value as text by what stands after ``~``, and in words the range of its repeats."""
    factor, form = re.fullmatch(r"(?:\*([\d.e+-]+):?)?(.*)", spec).groups()  # pyright: ignore[reportOptionalMemberAccess]
    scale, form = float(factor or 1.0), form or ".3g"
    if is_spread(value):
        low, high = (cell(value[end], form, factor=scale) for end in ("lowest", "highest"))
        return cell(value["median"], form, factor=scale), f"; median of repeats, which range from {low} to {high}"
    return cell(value, form, factor=scale), ""


def slug(text: str) -> str:
    """Return a key as fragments have it."""
    return re.sub(r"[^a-z0-9.-]+", "_", text.lower()).strip("_")


def step(value: Any, word: str) -> Any:
    """Return what a word of a fragment leads to: an entry of a record, or a row of a list by its name or number."""
    if isinstance(value, Mapping):
        found = [item for key, item in value.items() if slug(key) == word]
    else:
        found = [row for row in value if isinstance(row, Mapping) and slug(str(row.get("name", ""))) == word]
        found = found or ([value[int(word)]] if re.fullmatch(r"-?\d+", word) else [])
    if len(found) != 1:
        raise KeyError(f"'{word}' must lead to one value, got {len(found)}. There are {sorted(map(str, value))[:40]}.")
    return found[0]


def pages() -> list[Path]:
    """Return the pages that can hold measured numbers."""
    root = record.ROOT
    return [
        root / "README.md",
        root / "CONTRIBUTING.md",
        *sorted((root / "docs").rglob("*.md")),
        *sorted((root / "schema").glob("*.md")),
    ]


def figure_source(files: Sequence[str]) -> str:
    """Return what a figure says of the results that it was drawn from."""
    return "; ".join(f"{file} {record.content_digest(record.RESULTS / file)}" for file in files)


def drawn_from(path: Path) -> str | None:
    """Return the results that a figure was drawn from, as it says itself."""
    from PIL import Image

    if not path.is_file():
        return None
    with Image.open(path) as picture:
        return picture.info["xmp"].decode()


def draw(name: str) -> None:
    """Draw a figure, and write into it what it was drawn from."""
    from PIL import Image

    files, function = FIGURES[name]
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / "figure.png"
        function(*map(result, files), drawn)
        with Image.open(drawn) as picture:
            packed = packed_picture(picture, figure_source(files))
    (record.ROOT / "docs" / "images" / name).write_bytes(packed)


def packed_picture(picture: Any, about: str) -> bytes:
    """Return a picture as WebP: few colours without loss or, if that is smaller, as it is for photographs, with loss.

    Args:
        picture: Of Pillow.
        about: A text that the file keeps (XMP).
    """
    lines, photograph = io.BytesIO(), io.BytesIO()
    color = picture.convert("RGB")
    color.quantize(64, dither=0).convert("RGB").save(lines, "WEBP", lossless=True, quality=60, xmp=about.encode())
    color.save(photograph, "WEBP", quality=85, method=6, xmp=about.encode())
    return min(lines.getvalue(), photograph.getvalue(), key=len)


def load_tables() -> None:
    """Import every module that registers tables, numbers and figures."""
    for path in sorted(Path(__file__).parent.glob("tables_*.py")):
        importlib.import_module(path.stem)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit status 1 where a page would change")
    parser.add_argument("--stale", action="store_true", help="list results whose code has changed since")
    parser.add_argument("--draw", action="store_true", help="draw every figure again, also those of unchanged results")
    arguments = parser.parse_args()
    if arguments.stale:
        changed = {f.name: record.changed_since(result(f.name)["measured"]) for f in record.RESULTS.glob("*.json")}
        for name, files in sorted(changed.items()):
            if files:
                print(f"{name}, commit {result(name)['measured']['commit']}: {', '.join(files)}")
        return 1 if any(changed.values()) else 0
    load_tables()
    different = []
    for page in pages():
        text = page.read_text(encoding="utf-8")
        new = filled(page, text)
        if new != text:
            different.append(page)
            if not arguments.check:
                page.write_text(new, encoding="utf-8")
    for name, (files, _) in FIGURES.items():
        path = record.ROOT / "docs" / "images" / name
        if arguments.draw or drawn_from(path) != figure_source(files):
            different.append(path)
            if not arguments.check:
                draw(name)
    for path in different:
        print(path.relative_to(record.ROOT))
    return 1 if arguments.check and different else 0


if __name__ == "__main__":
    # Modules of tables import this one by its name: they must register with what runs here.
    sys.modules["tables"] = sys.modules["__main__"]
    sys.exit(main())
