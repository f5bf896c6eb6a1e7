"""Decoder of the delivery container b4d: NumPy and the standard library only, so that it can be copied as it is.

``docs/delivery.md`` specifies the container. Arrays are planar: a row for each component, a column for each Gaussian.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MANIFEST, MAX_MANIFEST_BYTES = "manifest.json", 2**26
COMPONENTS = dict.fromkeys(("opacities", "roughness", "ambient_occlusion"), 1)
COMPONENTS |= dict.fromkeys(("positions", "orientations", "turns", "scales", "base_color", "normals"), 3)
COMPONENTS |= {f"radiance_{k}": 3 for k in range(25)}
REQUIRED = {"positions", "orientations", "scales", "opacities"}
MAX_FRAMES, FREE_BYTES, MAX_RATIO = 30, 2**24, 64  # of a segment; b bytes unpack to FREE_BYTES + MAX_RATIO b
FREE_COUNT, LARGEST = 2**18, 1e6  # of Gaussians that need no byte each in the static block; of offsets and weights

Float32 = NDArray[np.float32]
Arrays = dict[str, Float32]
Track = list["Component"]


class DeliveryError(ValueError):
    """A container breaks its format; the text names the file in it."""


def _require(condition: object, contract: str, got: object) -> None:
    if not condition:
        raise DeliveryError(f"{contract}, got {got!r:.80}. Export or download it again.")


def _whole(value: Any, name: str, least: int, most: int) -> int:
    _require(type(value) is int and least <= value <= most, f"{name} must be an integer in [{least}, {most}]", value)
    return value


@dataclass(frozen=True, eq=False)
class Component:
    """One component of an array of a block: at frame f it is ``weights[f, 0] + weights[f, 1:] @ planes``."""

    weights: Float32  # (F, 1 + S + P)
    summed: Float32  # (S, N), the first planes, which all frames use
    plain: list[Callable[[], NDArray[np.signedinteger]]]  # return the others, P of (N,); most are of one frame only

    def add(self, frame: int, values: Float32) -> None:
        """Add the numbers at a frame of the block to others, ``(N,)``."""
        offset, first, last = np.split(self.weights[frame], [1, 1 + len(self.summed)])
        values += np.einsum("s,sn->n", first, self.summed)  # of few rows, faster than a product of matrices
        values += offset
        for plane in np.flatnonzero(last):
            values += self.plain[plane]() * last[plane]


class Container:
    """A container that is open for reading: a ``.b4d`` file, a folder, or the manifest in it.

    Attributes:
        manifest: What its manifest says, checked.
        still: The static arrays by name, ``(C, N)``, as `frame` gives them.
    """

    def __init__(self, path: str | Path) -> None:
        """Read the manifest and the static block; `DeliveryError` if they are malformed."""
        self._path = Path(path) / MANIFEST if Path(path).is_dir() else Path(path)
        self._is_archive, self._start = self._path.suffix != ".json", 0
        content = self._manifest()
        with _sound(MANIFEST, "JSON"):
            self.manifest: dict[str, Any] = json.loads(content)
        _check(self.manifest)
        tracks = self.tracks(self.manifest["static"], 1)
        _require(tracks.keys() >= REQUIRED, f"the static block must hold {', '.join(sorted(REQUIRED))}", sorted(tracks))
        self._raw = self._values(tracks, 0, self.manifest["static"]["file"], {})
        self.still: Arrays = {name: activated(name, values) for name, values in self._raw.items()}
        self._unpacked: tuple[Any, dict[str, Track]] = None, {}

    def _manifest(self) -> bytes:
        """Return the manifest: a file, or the first entry of an archive, which is stored as it is."""
        with self._path.open("rb") as stream:
            size = MAX_MANIFEST_BYTES + 1
            if self._is_archive:
                head = stream.read(30).ljust(30, b"\0")
                mark, flags, method, size, names, extra = struct.unpack("<4s2xHH8xI4xHH", head)
                name = stream.read(names + extra)[:names]
                self._start = 30 + names + extra + size
                is_stored = mark == b"PK\3\4" and method == 0 and not flags & 9 and name == MANIFEST.encode()
                _require(is_stored, f"a b4d file must be a zip archive that begins with {MANIFEST}, stored", head[:4])
            content = stream.read(min(size, MAX_MANIFEST_BYTES + 1))
        _require(len(content) <= MAX_MANIFEST_BYTES, f"{MANIFEST} must have at most {MAX_MANIFEST_BYTES} bytes", size)
        return content

    def tracks(self, entry: dict[str, Any], frames: int) -> dict[str, Track]:
        """Read, check and unpack a block, one range of the file; `DeliveryError` if it was altered or is malformed."""
        name, path = entry["file"], self._path if self._is_archive else self._path.with_name(entry["file"])
        _require(path.is_file(), "a container must hold all its files", f"no {name}")
        with path.open("rb") as stream:
            stream.seek(self._start + entry["offset"] if self._is_archive else 0)
            packed = stream.read(min(entry["bytes"], path.stat().st_size))
        _require(len(packed) == entry["bytes"], f"{name} must have {entry['bytes']} bytes", len(packed))
        digest = hashlib.sha256(packed).hexdigest()
        _require(digest == entry.get("sha256"), f"{name} must have the digest that {MANIFEST} says", digest)
        with _sound(name):
            return _tracks(packed, entry, frames, self.manifest["count"])

    def _values(self, tracks: dict[str, Track], frame: int, name: str, start: Arrays) -> Arrays:
        shapes = {array: (len(track), self.manifest["count"]) for array, track in tracks.items()}
        found = {array: start[array].copy() if array in start else np.zeros(shapes[array], "f4") for array in tracks}
        with _sound(name):
            for array, track in tracks.items():
                for component, row in zip(track, found[array], strict=True):
                    component.add(frame, row)
        return found

    def frame(self, number: int) -> Arrays:
        """Return the arrays of a frame by name, ``(C, N)``: quaternions xyzw, linear scales, unit normals."""
        entry = next(entry for entry in self.manifest["segments"] if number < entry["first"] + entry["frames"])
        if self._unpacked[0] is not entry:
            self._unpacked = entry, self.tracks(entry, entry["frames"])
        raw = self._values(self._unpacked[1], number - entry["first"], entry["file"], self._raw)
        turn = quaternions(raw.pop("turns")) if "turns" in raw else None
        arrays = self.still | {name: activated(name, values) for name, values in raw.items()}
        for name, turned in (("orientations", product), ("normals", rotated)):
            if turn is not None and name in arrays:
                arrays[name] = turned(turn, arrays[name])
        return arrays


@contextmanager
def _sound(name: str, kind: str = "a sound block") -> Iterator[None]:
    """Name the block in what is wrong with its content."""
    try:
        yield
    except (zlib.error, struct.error, KeyError, TypeError, ValueError, RecursionError) as error:
        raise DeliveryError(f"{name} must be {kind}, got {str(error)[:160]!r}. Export it again.") from None


def _check(said: Any) -> None:
    """Refuse a manifest whose numbers and names cannot be right."""
    _require(isinstance(said, dict), f"{MANIFEST} must hold an object", said)
    version, rate, static, segments, following = *map(said.get, ("version", "rate", "static", "segments")), 0
    _require((said.get("format"), version) == ("b4d", 1), "version must be 1 of b4d", version)
    _require(type(rate) in (int, float) and 1e-3 <= rate <= 1e6, "rate must be a rate", rate)
    _require(isinstance(static, dict) and isinstance(segments, list), "static and segments must be there", static)
    for entry in (static, *segments):
        name = entry.get("file") if isinstance(entry, dict) else entry
        is_name = isinstance(name, str) and 0 < len(name) < 256 and name.isprintable() and not set(name) & set("/\\:")
        _require(is_name and name.strip("."), "blocks must say their file, a name beside the manifest", name)  # type: ignore
        _whole(entry.get("offset"), f"offset of {name}", 0, 2**53)
        size = _whole(entry.get("bytes"), f"bytes of {name}", 1, 2**40)
        _whole(entry.get("unpacked"), f"unpacked of {name}", 4, min(FREE_BYTES + MAX_RATIO * size, 2**31))
    _whole(said.get("count"), "count", 0, FREE_COUNT + static["bytes"])
    for entry in segments:
        _whole(entry.get("first"), f"first of {entry['file']}", following, following)
        following += _whole(entry.get("frames"), f"frames of {entry['file']}", 1, MAX_FRAMES)
    _whole(said.get("frames"), "frames", max(following, 1), following)


def _tracks(packed: bytes, entry: dict[str, Any], frames: int, count: int) -> dict[str, Track]:
    """Split a block into its arrays; planes that are parts of their own are unpacked when they are needed."""
    parts, sizes, weights, found = entry.get("parts"), [], [], dict[str, Track]()
    content = zlib.decompressobj().decompress(packed[: parts[0]] if parts else packed, entry["unpacked"] + 1)
    at = 4 + struct.unpack_from("<I", content)[0]
    arrays = json.loads(content[4:at])["arrays"]
    for name, planes in ((array["name"], array["planes"]) for array in arrays):
        _require(name in COMPONENTS and len(planes) == COMPONENTS[name], "arrays must be known", name)
        for summed, plain in planes:
            widths = *summed, *plain
            _require(all(type(n) is int and 1 <= n <= 4 for n in widths), "planes must have 1 to 4 bytes", name)
            weights.append(np.frombuffer(content, "<f4", frames * (1 + len(widths)), at).reshape(frames, -1))
            _require((np.abs(weights[-1]) <= LARGEST).all(), f"weights must be at most {LARGEST:g}", name)
            at += weights[-1].nbytes
            sizes += [width * count for width in widths]
    stream, lengths = (io.BytesIO(packed), parts) if parts else (io.BytesIO(content), [at, *sizes])
    end = at + sum(sizes)
    _require(end == entry["unpacked"] and len(content) == (at if parts else end), f"planes must fill {end} bytes", at)
    room = np.empty((sum(len(summed) for array in arrays for summed, _ in array["planes"]), count), np.float32)
    following = iter(list(zip([stream.read(length) for length in lengths][1:], sizes, strict=True)))
    for array in arrays:
        track = found[array["name"]] = []
        for summed, plain in array["planes"]:
            planes = [partial(_plane, *next(following), width, bool(parts)) for width in (*summed, *plain)]
            sums, room = np.split(room, [len(summed)])  # of one room: many pieces of memory cost more page faults
            for row, unpack in zip(sums, planes, strict=False):
                row[:] = np.cumsum(unpack(), dtype=np.int32)
            track.append(Component(weights.pop(0), sums, planes[len(summed) :]))
    return found


def _plane(octets: bytes, size: int, width: int, is_packed: bool) -> NDArray[np.signedinteger]:
    """Return a plane: 0, 1, 2, 3, 4 … stand for 0, -1, 1, -2, 2 …; the bytes of each order stand together."""
    content = zlib.decompressobj(-zlib.MAX_WBITS).decompress(octets, size + 1) if is_packed else octets
    _require(len(content) == size, f"a plane must have {size} bytes", len(content))
    orders, kind = np.frombuffer(content, np.uint8).reshape(width, -1), np.dtype(f"u{(1, 2, 4, 4)[width - 1]}")
    numbers, one = orders[0].astype(kind), np.array(1, kind)
    for order in range(1, width):
        numbers |= orders[order].astype(kind) << np.array(8 * order, kind)
    return ((numbers >> one) ^ -(numbers & one)).view(f"i{kind.itemsize}")


def activated(name: str, values: Float32) -> Float32:
    """Return what the numbers of an array stand for."""
    if name == "orientations":
        return quaternions(values)
    if name == "normals":
        return values / np.maximum(np.sqrt(np.einsum("cn,cn->n", values, values)), np.float32(1e-12))
    if name == "scales":
        return np.where(values < -29.0, np.float32(0.0), np.exp(np.minimum(values, np.float32(20.0))))
    return values if name == "positions" or name.startswith("radiance") else np.clip(values, 0.0, 1.0)


def quaternions(rodrigues: Float32) -> Float32:
    """Return the unit quaternions xyzw of modified Rodrigues parameters, axis times tan(angle / 4)."""
    share = np.float32(2.0) / (np.float32(1.0) + np.einsum("cn,cn->n", rodrigues, rodrigues))
    return np.concatenate([rodrigues * share, (share - np.float32(1.0))[None]])


def product(left: Float32, right: Float32) -> Float32:
    """Return Hamilton products of quaternions: the rotations of ``right``, then those of ``left``."""
    (a, b, c, d), (x, y, z, w) = left, right
    first = [d * x + a * w + b * z - c * y, d * y + b * w + c * x - a * z]
    return np.stack([*first, d * z + c * w + a * y - b * x, d * w - a * x - b * y - c * z])


def rotated(turn: Float32, vectors: Float32) -> Float32:
    """Return vectors turned by unit quaternions."""
    (a, b, c, d), (x, y, z), two = turn, vectors, np.float32(2.0)
    p, q, r = two * (b * z - c * y), two * (c * x - a * z), two * (a * y - b * x)
    return np.stack([x + d * p + b * r - c * q, y + d * q + c * p - a * r, z + d * r + a * q - b * p])
