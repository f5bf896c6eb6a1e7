"""glTF 2.0 files: the JSON document, the bytes beside or within it, and accessors as arrays.

Every index, offset and count is checked before bytes are read, and a URI reaches no file outside the folder of its
glTF. Source: Khronos, "glTF 2.0 Specification", sections 3.6 (binary data) and 4 (GLB).
"""

from __future__ import annotations

import base64
import binascii
import json
import os
import struct
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from beam_warp.converters.common.errors import malformed, opened, unreadable
from beam_warp.errors import AssetFormatError, MissingFileError

GLB_HEADER, GLB_CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")

FLOAT, UNSIGNED_BYTE = 5126, 5121
COMPONENTS = {5120: "i1", UNSIGNED_BYTE: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
"""NumPy code of each component type."""

WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
"""Components of an element of each accessor type."""

_MOST_VALUES = 300_000
"""Most commas and brackets of a document: each can cost a hundred bytes of memory when it is parsed."""

_REMEDY = "Export or download it again."


@dataclass(eq=False)
class GltfFile:
    """A document, and its binary data, which are read when they are asked for.

    Attributes:
        path: The file.
        content: The JSON document.
        chunk: Offset and length of a GLB's binary chunk; None if there is none.
    """

    path: Path
    content: dict[str, Any]
    chunk: tuple[int, int] | None
    _buffers: dict[int, NDArray[np.uint8]] = field(default_factory=dict)

    def error(self, contract: str, got: str, remedy: str = _REMEDY) -> AssetFormatError:
        """Make the error of a file that breaks its format."""
        return malformed(self.path, contract, got[:200], remedy)

    def items(self, holder: dict[str, Any], key: str) -> list[Any]:
        """Return an array of JSON; an empty one if there is none."""
        value = holder.get(key, [])
        if not isinstance(value, list):
            raise self.error(f"{key} must be an array", repr(value))
        return value

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """Return one object of an array at the top of the document."""
        items = self.items(self.content, kind)
        if type(index) is not int or not 0 <= index < len(items) or not isinstance(items[index], dict):
            raise self.error(f"an index must name one of {len(items)} {kind}", repr(index))
        return items[index]

    def object(self, holder: dict[str, Any], key: str) -> dict[str, Any]:
        """Return an object of JSON; an empty one if there is none."""
        value = holder.get(key, {})
        if not isinstance(value, dict):
            raise self.error(f"{key} must be an object", repr(value))
        return value

    def number(self, holder: dict[str, Any], key: str, default: int | None = None) -> int:
        """Return an integer of JSON that is not negative."""
        value = holder.get(key, default)
        if type(value) is not int or not 0 <= value < 1 << 53:
            raise self.error(f"{key} must be an integer of at least 0", repr(value))
        return value

    def vector(self, holder: dict[str, Any], key: str, default: tuple[float, ...]) -> NDArray[np.float64]:
        """Return as many finite numbers of JSON as the default has."""
        values = holder.get(key, default)
        whole = isinstance(values, (list, tuple)) and len(values) == len(default)
        if not whole or not all(type(value) in (int, float) and abs(value) < 1e30 for value in values):
            raise self.error(f"{key} must be {len(default)} finite numbers", repr(values))
        return np.array(values, np.float64)

    def held(self) -> int:
        """Return the bytes that the file and those beside it have, each file counted once.

        Raises:
            AssetFormatError: Buffers state far more.
        """
        buffers = [self.item("buffers", index) for index in range(len(self.items(self.content, "buffers")))]
        names = {uri for b in buffers if isinstance(uri := b.get("uri"), str) and not uri.startswith("data:")}
        held = sum(os.path.getsize(place) for place in {self.path, *map(self._beside, names)} if os.path.isfile(place))  # noqa: PTH113, PTH202
        stated = sum(self.number(buffer, "byteLength") for buffer in buffers)
        if stated > 2 * held:  # one file in two buffers is sound
            raise self.error(f"buffers must have at most twice the {held} bytes of their files", str(stated))
        return held

    def buffer(self, index: int) -> NDArray[np.uint8]:
        """Return the bytes of a buffer."""
        if index not in self._buffers:
            buffer = self.item("buffers", index)
            length = self.number(buffer, "byteLength")
            read = self._bytes_of(buffer.get("uri"), index, length)
            if len(read) < length:
                raise self.error(f"buffer {index} must have {length} bytes", str(len(read)))
            self._buffers[index] = read[:length]
        return self._buffers[index]

    def _bytes_of(self, uri: Any, index: int, length: int) -> NDArray[np.uint8]:
        """Return the bytes that a buffer names, or all there are if these are fewer."""
        if uri is None and index == 0 and self.chunk is not None:
            offset, held = self.chunk
            return _bytes(self.path, min(length, held), offset)
        if not isinstance(uri, str):
            raise self.error(f"buffer {index} must be in the file or name a URI", repr(uri))
        if uri.startswith("data:"):
            header, _, text = uri.partition(",")
            try:
                return np.frombuffer(base64.b64decode(text if header.endswith(";base64") else "?", validate=True), "u1")
            except (binascii.Error, ValueError) as error:
                raise self.error(f"the data of buffer {index} must be base64", header[:80]) from error
        place = self._beside(uri)
        if not os.path.isfile(place):  # noqa: PTH113, a Path raises of names that are too long
            raise MissingFileError(f"{self.path.name}: file of buffer {index} must exist, got {uri!r}. Put it beside.")
        return _bytes(place, min(length, place.stat().st_size))

    def _beside(self, uri: str) -> Path:
        """Return the file that a relative URI names, in the folder of the glTF or below."""
        name = unquote(uri)
        relative = PurePosixPath(name)
        if not name.isprintable() or set(name) & set("\\:") or relative.is_absolute() or ".." in relative.parts:
            raise self.error("a URI must be data or a path below the file's folder", repr(uri[:80]), "Put it there.")
        folder = Path(os.path.realpath(self.path.parent))
        place = Path(os.path.realpath(folder / relative))
        if not place.is_relative_to(folder):
            raise self.error("a URI must stay in the file's folder", f"the link {name!r}", "Copy the file there.")
        return place

    def view(self, index: Any) -> tuple[NDArray[np.uint8], int]:
        """Return the bytes of a buffer view, and its stride, which is 0 if elements follow each other."""
        view = self.item("bufferViews", index)
        if packed := [name for name in self.object(view, "extensions") if "compression" in name]:
            raise self.error("buffer views must not be compressed", ", ".join(packed), "Export it without.")
        buffer = self.buffer(self.number(view, "buffer"))
        start, length = self.number(view, "byteOffset", 0), self.number(view, "byteLength")
        if start + length > len(buffer):
            raise self.error(f"buffer view {index} must end within {len(buffer)} bytes", f"{start} + {length}")
        return buffer[start : start + length], self.number(view, "byteStride", 0)

    def count(self, index: Any) -> int:
        """Return the number of elements of an accessor."""
        return self.number(self.item("accessors", index), "count")

    def array(self, index: Any, width: int) -> NDArray[np.float32]:
        """Return an accessor's elements ``(count, width)``, with normalised integers as fractions."""
        accessor = self.item("accessors", index)
        if "sparse" in accessor or "bufferView" not in accessor:
            got = "a sparse one" if "sparse" in accessor else "one without a buffer view"
            raise self.error(f"accessor {index} must be plain", got, "Export it with plain accessors.")
        code, kind = COMPONENTS.get(self.number(accessor, "componentType")), accessor.get("type")
        if code is None or not isinstance(kind, str) or WIDTHS.get(kind) != width:
            got = f"{accessor['componentType']} and {kind!r}"
            raise self.error(f"accessor {index} must have known components, {width} in an element", got)
        count, start = self.count(index), self.number(accessor, "byteOffset", 0)
        content, stride = self.view(accessor["bufferView"])
        dtype = np.dtype(code)
        stride = stride or width * dtype.itemsize
        if stride < width * dtype.itemsize or (
            count and start + stride * (count - 1) + width * dtype.itemsize > len(content)
        ):
            got = f"{count} every {stride} bytes from {start}"
            raise self.error(f"accessor {index} must lie within {len(content)} bytes", got)
        found = np.ndarray((count, width), dtype, content.data, start if count else 0, (stride, dtype.itemsize))
        if accessor.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(found / np.float32(np.iinfo(dtype).max), np.float32(-1.0))
        return found.astype(np.float32)


def read_gltf(path: Path) -> GltfFile:
    """Read the document of a ``.gltf`` or ``.glb``, and check that the file is as long as it says.

    Raises:
        MissingFileError: There is no such file, or it cannot be opened.
        AssetFormatError: It is no glTF 2.0, is cut short, or requires an extension that is not read.
    """
    with opened(path) as file:
        start, size = file.read(GLB_HEADER.size), path.stat().st_size
        if start[:4] != b"glTF":
            return GltfFile(path, _document(path, start + file.read()), None)
        places = _chunks(path, file, start, size)
        file.seek(places["JSON"][0])
        return GltfFile(path, _document(path, file.read(places["JSON"][1])), places.get("BIN"))


def _bytes(path: Path, count: int, offset: int = 0) -> NDArray[np.uint8]:
    """Return bytes of a file."""
    try:
        return np.fromfile(path, np.uint8, count, offset=offset)
    except OSError as error:
        raise unreadable(path, error) from error


def _chunks(path: Path, file: BinaryIO, start: bytes, size: int) -> dict[str, tuple[int, int]]:
    """Return offset and length of the first two chunks of a GLB by type; the first holds the document."""
    if len(start) < GLB_HEADER.size:
        raise malformed(path, f"the header of a GLB must have {GLB_HEADER.size} bytes", str(len(start)), _REMEDY)
    _, version, length = GLB_HEADER.unpack(start)
    if version != 2 or length > size:
        got = f"version {version} and {length} of {size} bytes"
        raise malformed(path, "a GLB must be of version 2 and as long as it says", got, _REMEDY)
    places: dict[str, tuple[int, int]] = {}
    at = GLB_HEADER.size
    while at + GLB_CHUNK.size <= length and len(places) < 2:
        file.seek(at)
        held, kind = GLB_CHUNK.unpack(file.read(GLB_CHUNK.size))
        at += GLB_CHUNK.size
        if held > length - at:
            raise malformed(path, f"a chunk must end within {length} bytes", f"{held} after {at}", _REMEDY)
        places[kind.decode("latin-1").rstrip("\0")] = (at, held)
        at += held
    if next(iter(places), None) != "JSON":
        raise malformed(path, "a GLB must begin with a chunk JSON", repr("".join(places)), _REMEDY)
    return places


def _document(path: Path, content: bytes) -> dict[str, Any]:
    """Parse and check the document."""
    if sum(content.count(mark) for mark in b",[{") > _MOST_VALUES:
        raise malformed(path, f"the document must have at most {_MOST_VALUES} values", "more", "Split the file.")
    try:
        document = json.loads(content.decode("utf-8-sig"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise malformed(path, "glTF must be JSON, alone or in a GLB", " ".join(str(error).split()), _REMEDY) from error
    asset = document.get("asset") if isinstance(document, dict) else None
    if not isinstance(asset, dict) or not str(asset.get("version")).startswith("2."):
        raise malformed(path, "glTF must state asset.version 2.x", repr(asset)[:80], "Export it as glTF 2.0.")
    return document


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name}, which JSON does not have")
