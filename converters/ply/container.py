"""Header and tables of a PLY file; every size is checked against the file before memory is allocated.

Source: Turk 1994, "The PLY Polygon File Format". CRLF headers, comments and ``obj_info`` are accepted; lists are
accepted in elements that are not read.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.blocks import for_each_block
from beam_warp.converters.common.errors import malformed, opened

MAX_HEADER_BYTES = 64 * 1024
MAX_ELEMENTS = 16
MAX_PROPERTIES = 1024
MAX_COUNT = 2**31 - 1

ENCODINGS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}

SCALAR_TYPES = {
    word: code
    for code, words in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for word in words
}
"""NumPy code of each type word, old or new."""

_RENDER_MODE = re.compile(r"splatrendermode:?\s+(default|mip|2dgs)|antialiased\s+([01])")

RASTER_WORDS = {False: "classic", True: "antialiased"}
"""First word of the comment ``beam_raster``, by whether splats are drawn antialiased."""

_CONTROL_CHARACTERS = {code: "?" for code in (*range(32), *range(127, 160)) if chr(code) not in "\t\n\r"}
"""Characters of a header that are replaced, since its names and comments are shown on a terminal."""


@dataclass(frozen=True)
class Property:
    """One column with its name, type word and NumPy code, which is empty for a list."""

    name: str
    word: str
    code: str


@dataclass(frozen=True)
class Element:
    """Description of one table: its name, row count and columns."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Column names in file order."""
        return tuple(column.name for column in self.properties)

    @property
    def stride(self) -> int | None:
        """Bytes of a binary row, or None if a list makes rows differ."""
        if not all(column.code for column in self.properties):
            return None
        return sum(int(column.code[1]) for column in self.properties)


@dataclass(frozen=True)
class PlyHeader:
    """Contents of a header, checked against the size of its file."""

    path: Path
    encoding: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    data_start: int
    file_size: int

    def element(self, name: str) -> Element | None:
        """Return an element by name, or None."""
        return next((element for element in self.elements if element.name == name), None)

    @property
    def statements(self) -> dict[str, str]:
        """Comments of the form ``beam_<key> <value>``, by which our own writer describes a file."""
        pairs = (comment.partition(" ") for comment in self.comments if comment.startswith("beam_"))
        return {key: value.strip() for key, _, value in pairs}

    @property
    def render_mode(self) -> str:
        """How the splats are to be drawn: ``default``, ``mip`` or ``2dgs``, by the last comment that says it.

        Brush writes ``SplatRenderMode: mip``, and Postshot ``antialiased 1``.
        """
        mode = "default"
        for comment in self.comments:
            if said := _RENDER_MODE.fullmatch(comment.lower()):
                mode = said[1] or ("mip" if said[2] == "1" else "default")
        return mode


def _header_lines(path: Path, start: bytes) -> tuple[list[str], int]:
    """Return the header's lines and the offset of the data."""
    if not start:
        raise malformed(
            path, "a PLY file must start with the line ply", "an empty file", "Export or download it again."
        )
    if not re.match(rb"ply\r?\n", start):
        raise malformed(
            path, "a PLY file must start with the line ply", repr(start[:8]), "Check that it is a PLY file."
        )
    end = re.search(rb"\nend_header\r?\n", start)
    if end is None:
        got = f"none in the first {MAX_HEADER_BYTES // 1024} KiB" if len(start) == MAX_HEADER_BYTES else "a cut file"
        raise malformed(path, "the header must end with the line end_header", got, "Export or download it again.")
    text = start[: end.start()].decode("utf-8", "replace").translate(_CONTROL_CHARACTERS)
    return [line.strip() for line in text.split("\n")], end.end()


def _count(path: Path, name: str, word: str) -> int:
    if not re.fullmatch(r"\d{1,19}", word) or int(word) > MAX_COUNT:
        raise malformed(
            path, f"element {name} must count 0 to {MAX_COUNT} rows", repr(word[:32]), "Export the file again."
        )
    return int(word)


def _property(path: Path, line: str, words: list[str]) -> Property:
    if words[1] == "list" and len(words) == 5 and {words[2], words[3]} <= set(SCALAR_TYPES):
        return Property(words[4], "list", "")
    if len(words) == 3 and words[1] in SCALAR_TYPES:
        return Property(words[2], words[1], SCALAR_TYPES[words[1]])
    raise malformed(path, "a property must be a type word and a name", repr(line[:80]), "Export the file again.")


def read_header(path: Path) -> PlyHeader:
    """Read and check a header without reading data.

    Raises:
        MissingFileError: There is no such file, or it cannot be opened.
        AssetFormatError: The header is malformed or too large, or promises more bytes than the file has.
    """
    with opened(path) as file:
        start = file.read(MAX_HEADER_BYTES)
        file_size = file.seek(0, io.SEEK_END)
    lines, data_start = _header_lines(path, start)

    encoding: str | None = None
    comments: list[str] = []
    tables: list[tuple[str, int, list[Property]]] = []
    for line in lines[1:]:
        words = line.split()
        match words:
            case ["comment" | "obj_info", *_]:
                comments.append(line.partition(" ")[2].strip())
            case ["format", word, "1.0"] if word in ENCODINGS and encoding is None:
                encoding = word
            case ["element", name, count] if encoding is not None:
                tables.append((name, _count(path, name, count), []))
            case ["property", _, _, *_] if tables:
                tables[-1][2].append(_property(path, line, words))
            case _:
                raise malformed(
                    path,
                    "a header line must be format, comment, element or property, in that order",
                    repr(line[:80]),
                    "Export the file again.",
                )
    if encoding is None:
        raise malformed(
            path, f"the header must name its format ({', '.join(ENCODINGS)} 1.0)", "none", "Export the file again."
        )
    header = PlyHeader(
        path, encoding, tuple(Element(n, c, tuple(p)) for n, c, p in tables), tuple(comments), data_start, file_size
    )
    _check_limits(header)
    _check_sizes(header)
    return header


def _check_limits(header: PlyHeader) -> None:
    property_count = sum(len(element.properties) for element in header.elements)
    for what, count, limit in (
        ("elements", len(header.elements), MAX_ELEMENTS),
        ("properties", property_count, MAX_PROPERTIES),
    ):
        if count > limit:
            raise malformed(header.path, f"a header must have at most {limit} {what}", str(count), "Drop the rest.")
    for kind, names in (
        ("element", [element.name for element in header.elements]),
        *((f"property of {element.name}", list(element.names)) for element in header.elements),
    ):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise malformed(header.path, f"each {kind} must be named once", ", ".join(twice), "Rename one of them.")


def _least_row_bytes(header: PlyHeader, element: Element) -> int | None:
    """Return the least size of a row [byte], or None if it is unknown."""
    if header.encoding == "ascii":
        return max(1, 2 * len(element.properties))  # a digit and a separator each; at least a line end
    return element.stride


def _check_sizes(header: PlyHeader) -> None:
    """Refuse counts that are too large for the size of the file, before memory is allocated for them."""
    left = header.file_size - header.data_start + (header.encoding == "ascii")  # the last line may lack its end
    for element in header.elements:
        row_bytes = _least_row_bytes(header, element)
        if row_bytes is None:
            return
        left -= element.count * row_bytes
        if left < 0:
            held = max(0, left + element.count * row_bytes) // row_bytes
            raise malformed(
                header.path,
                f"element {element.name} must have the {element.count} rows that the header counts",
                f"bytes for {'at most ' if header.encoding == 'ascii' else ''}{held}",
                "The file is cut short: export or download it again.",
            )


def read_columns(
    header: PlyHeader, name: str, groups: Sequence[Sequence[str]], dtype: Any = np.float32
) -> list[NDArray[Any]]:
    """Read columns of one element, in one pass over the file that holds a block of its rows for each core.

    Args:
        header: The file's header.
        name: Name of the element.
        groups: Names of columns that the element has, for each matrix to return.
        dtype: Type of the matrices; values too large for it become infinite.

    Returns:
        For each group a new matrix ``(N, len(group))`` with the columns in the group's order.

    Raises:
        AssetFormatError: The element is absent, has list properties, follows lists of unknown length, or is cut short.
    """
    element, read = open_columns(header, name)
    matrices = [np.empty((element.count, len(group)), dtype) for group in groups]

    def fill(part: slice) -> None:
        read(part, [(group, matrix[part]) for group, matrix in zip(groups, matrices, strict=True)])

    for_each_block(fill, element.count)
    return matrices


ReadBlock = Callable[[slice, Sequence[tuple[Sequence[str], NDArray[Any]]]], None]
"""Reads some rows: copies columns, named in their order, into each matrix."""


def open_columns(header: PlyHeader, name: str) -> tuple[Element, ReadBlock]:
    """Return an element and a function that reads blocks of its rows, on any thread.

    Raises:
        AssetFormatError: As `read_columns`; if the file has been cut since, the function raises it.
    """
    element, offset = _require_plain_rows(header, name)
    is_text, order = header.encoding == "ascii", ENCODINGS[header.encoding]
    kind = np.dtype([(column.name, order + column.code) for column in element.properties])
    text = _ascii_rows(header, element, kind, offset) if is_text else None

    def read(part: slice, matrices: Sequence[tuple[Sequence[str], NDArray[Any]]]) -> None:
        rows = _binary_rows(header, kind, offset, part) if text is None else text[part]
        for names, matrix in matrices:
            _pick(rows, names, matrix)

    return element, read


def _require_plain_rows(header: PlyHeader, name: str) -> tuple[Element, int]:
    """Return an element whose rows can be found without reading, and where they begin: at a byte, or a text row."""
    element = header.element(name)
    if element is None:
        names = ", ".join(e.name for e in header.elements) or "no elements"
        raise malformed(header.path, f"the file must have an element {name}", names, "Check that it holds Gaussians.")
    before = header.elements[: header.elements.index(element)]
    for other in (*before, element):
        if other.stride is None:
            raise malformed(
                header.path,
                f"element {other.name} must have no list properties{'' if other is element else f' before {name}'}",
                ", ".join(column.name for column in other.properties if not column.code),
                "Export Gaussians, not a mesh.",
            )
    if header.encoding == "ascii":
        return element, sum(other.count for other in before)
    return element, header.data_start + sum(other.count * (other.stride or 0) for other in before)


def _pick(rows: NDArray[Any], names: Sequence[str], out: NDArray[Any]) -> None:
    """Copy columns of a structured array into a matrix."""
    known: list[str] = list(rows.dtype.names or ())
    if {rows.dtype[name] for name in known} == {out.dtype}:  # a matrix: one call that copies all columns is faster
        places = [known.index(name) for name in names]
        np.take(rows.view(out.dtype).reshape(len(rows), -1), places, axis=1, out=out, mode="clip")
        return
    for column, name in enumerate(names):
        out[:, column] = rows[name]


def _binary_rows(header: PlyHeader, kind: np.dtype[Any], offset: int, part: slice) -> NDArray[Any]:
    # Not memory-mapped: a file that another program cuts while it is mapped would kill the process.
    count = part.stop - part.start
    rows = np.fromfile(header.path, dtype=kind, count=count, offset=offset + part.start * kind.itemsize)
    if len(rows) != count:
        raise malformed(header.path, "the file must not change while it is read", "fewer bytes", "Read it again.")
    return rows


def _ascii_rows(header: PlyHeader, element: Element, kind: np.dtype[Any], skipped_rows: int) -> NDArray[Any]:
    """Return the rows of an element in text; each number is read as the type that the header gives it."""
    if not element.count:
        return np.empty(0, kind)
    with header.path.open("rb") as file, warnings.catch_warnings():
        file.seek(header.data_start)
        text = io.TextIOWrapper(file, encoding="ascii", errors="replace")
        try:
            warnings.simplefilter("ignore", UserWarning)  # of blank lines and missing rows: counted below
            rows = np.loadtxt(text, dtype=kind, comments=None, skiprows=skipped_rows, max_rows=element.count, ndmin=1)
        except ValueError as error:
            said = re.sub(r"^the dtype .* but (\d+) were found (at row \d+);.*", r"\1 \2", str(error)).rstrip(".")
            raise malformed(
                header.path,
                f"element {element.name} must hold rows of {len(element.properties)} numbers of its types",
                said,
                "Export the file again.",
            ) from error
    if len(rows) != element.count:
        raise malformed(
            header.path, f"element {element.name} must hold {element.count} rows", str(len(rows)), "Export it again."
        )
    return rows
