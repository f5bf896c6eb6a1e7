"""Writer of the delivery container b4d; ``docs/delivery.md`` specifies it."""

from __future__ import annotations

import hashlib
import json
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from io import BytesIO
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from beam_warp._version import __version__
from beam_warp.converters.common.activations import log_scale
from beam_warp.converters.common.bounds import bounds_of
from beam_warp.converters.common.colors import resize_bands
from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.delivery.decoder import FREE_BYTES, MANIFEST, MAX_RATIO, product, quaternions, rotated
from beam_warp.converters.delivery.motion import Planes, differences, moving, still, stored, width
from beam_warp.errors import InvalidArrayError
from beam_warp.outputs import replacing
from beam_warp.world.axes import change_axes
from beam_warp.world.curve import morton_order
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

AXES = "rub"
"""Axes of every container: y up, right-handed, as in glTF and three.js."""

SEGMENT_FRAMES = 12
"""Frames of a segment: longer ones take a little less space, but their motion takes more planes at every frame."""

SMALLEST = 9
"""Level of zlib of what is kept."""

MEMORY = 9
"""Memory level of zlib: the longest blocks. Without matches of few bytes, planes take less than by its defaults."""

_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of every entry, so that the same Gaussians give the same bytes."""

Arrays = dict[str, NDArray[np.float32]]


def _allowed(name: str, bound: float) -> float:
    """Return how far each stored number of an array may be off, so that the array keeps to its bound.

    Modified Rodrigues parameters move by a quarter of an angle [rad] at most, and a unit vector turns by at most the
    arc sine of what is added to it. Orientations of the static block have a third: the turns back to what they were
    before rounding, whose components may be longer than those of the rounding, are then small enough to be left out.
    """
    if name == "orientations":
        return bound / 12.0
    if name == "turns":
        return bound / (4.0 * np.sqrt(3.0))
    return float(np.sin(min(bound, 1.5)) / np.sqrt(3.0)) if name == "normals" else bound


def write(sequence: GaussianSequence, path: Path, options: WriteOptions) -> list[Path]:
    """Write a take: one archive, or, to a ``manifest.json``, a manifest with the blocks beside it.

    Raises:
        InvalidArrayError: Frames differ in the number of Gaussians or in their arrays.
        OutputError: A file cannot be written; nothing of the call is left behind.
    """
    with TemporaryFile() as spool, ExitStack() as outputs:
        text, sizes = _spooled(Take.of(sequence, options), spool, SMALLEST)
        paths = [path, *(path.parent / name for name in sizes)] if path.suffix == ".json" else [path]
        places = [outputs.enter_context(replacing(place)) for place in paths]
        if path.suffix == ".json":
            for place, content in zip(places, [text, *_contents(spool, sizes)], strict=True):
                place.write_bytes(content)
        else:
            _archive(places[0], text, spool, sizes)
    return paths


def archive_bytes(sequence: GaussianSequence, options: WriteOptions, level: int) -> bytes:
    """Return a take as an archive, packed by a level of zlib; raises as `write` does."""
    spool, archive = BytesIO(), BytesIO()
    text, sizes = _spooled(Take.of(sequence, options), spool, level)
    _archive(archive, text, spool, sizes)
    return archive.getvalue()


def _spooled(take: Take, spool: IO[bytes], level: int) -> tuple[bytes, dict[str, int]]:
    """Put all blocks of a take into a file, one behind the other; return the manifest, and their sizes by name."""
    sizes: dict[str, int] = {}
    end = 0

    def placed(block: Block) -> dict[str, Any]:
        nonlocal end
        spool.write(block.content)
        name = block.entry["file"]
        sizes[name] = len(block.content)
        offset = end + 30 + len(name)
        end = offset + len(block.content)
        return block.entry | {"offset": offset}

    static = placed(take.static_block(level))
    starts = range(0, len(take.sequence), SEGMENT_FRAMES)
    segments = [placed(take.segment_block(start, SEGMENT_FRAMES, level)) for start in starts]
    return json_bytes(take.manifest() | {"static": static, "segments": segments}), sizes


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """Return JSON without spaces."""
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode()


def _contents(spool: IO[bytes], sizes: Mapping[str, int]) -> Iterator[bytes]:
    """Yield the packed blocks of a file that `_spooled` filled."""
    spool.seek(0)
    yield from map(spool.read, sizes.values())


def _archive(place: Path | IO[bytes], text: bytes, spool: IO[bytes], sizes: Mapping[str, int]) -> None:
    with zipfile.ZipFile(place, "w", zipfile.ZIP_STORED) as archive:
        for name, content in zip([MANIFEST, *sizes], chain([text], _contents(spool, sizes)), strict=True):
            archive.writestr(zipfile.ZipInfo(name, _ZIP_TIME), content)


def _order(positions: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the rows along a curve through space: neighbours have alike numbers, whose differences are small."""
    if not len(positions):
        return np.arange(0)
    low, extent = positions.min(axis=0), max(float(np.ptp(positions, axis=0).max()), 1e-30)
    return morton_order(((positions - low) * (65535.0 / extent)).astype(np.uint32))


def delivered(cloud: GaussianCloud, options: WriteOptions) -> tuple[str, ...]:
    """Return the arrays of a cloud that a container holds: what is drawn.

    Radiance is left out of an asset that can be relit, unless its degree is asked for.
    """
    shows_radiance = options.sh_degree is not None or not cloud.is_relightable
    wanted = {*_ROWS, "orientations", *(["radiance"] if shows_radiance else [])}
    return tuple(name for name in cloud.arrays() if name in wanted)


_ROWS = ("positions", "scales", "opacities", "base_color", "roughness", "ambient_occlusion", "normals")


def _raw(cloud: GaussianCloud, options: WriteOptions) -> Arrays:
    """Return what is stored of a frame as numbers that add up, planar ``(C, N)``; orientations as quaternions."""
    arrays = {name: getattr(cloud, name) for name in delivered(cloud, options)}
    for name in arrays.keys() & {"orientations", "normals"}:
        arrays[name] = arrays[name] / np.linalg.norm(arrays[name], axis=1, keepdims=True)
    arrays["scales"] = log_scale(cloud.scales)
    if (radiance := arrays.pop("radiance", None)) is not None:
        bands = resize_bands(radiance, options.sh_degree)
        arrays |= {f"radiance_{k}": bands[:, k] for k in range(bands.shape[1])}
    planar = {name: values[None] if values.ndim == 1 else values.T for name, values in arrays.items()}
    return {name: np.ascontiguousarray(values, np.float32) for name, values in planar.items()}


@dataclass(frozen=True, eq=False)
class Block:
    """A packed block, and what a manifest says of it but for its offset."""

    entry: dict[str, Any]
    content: bytes

    @classmethod
    def of(cls, name: str, frames: int, arrays: Mapping[str, list[Planes]], level: int) -> Block:
        """Pack the arrays of some frames by a level of zlib."""
        content = block_parts(frames, arrays)
        packed, unpacked = _packed(content, level), sum(map(len, content))
        if unpacked > FREE_BYTES + MAX_RATIO * sum(map(len, packed)):  # nearly nothing in it: a decoder would refuse it
            packed = _packed(content, 0)
        joined, parts = b"".join(packed), [len(part) for part in packed[:-1]]
        digest = hashlib.sha256(joined).hexdigest()
        entry = {"file": name, "bytes": len(joined), "unpacked": unpacked, "sha256": digest, "parts": parts}
        return cls(entry, joined)


def _packed(parts: Sequence[bytes], level: int) -> list[bytes]:
    """Return a zlib stream in a part for each one that is given, which can be unpacked alone, and its end."""
    packer = zlib.compressobj(level, zlib.DEFLATED, zlib.MAX_WBITS, MEMORY, zlib.Z_FILTERED)
    return [*(packer.compress(part) + packer.flush(zlib.Z_FULL_FLUSH) for part in parts), packer.flush()]


@dataclass
class Take:
    """A take that is packed block by block; every block can be made at any time.

    Attributes:
        sequence: The take.
        order: Rows in the order of the container.
        bounds: As `bounds_of` gives them.
        first: What `_raw` gives of the first frame, in the order of the container.
        options: Those of the writer.
        color_space: That of the radiance.
    """

    sequence: GaussianSequence
    order: NDArray[np.intp]
    bounds: dict[str, float]
    first: Arrays
    options: WriteOptions
    color_space: str | None = None

    @classmethod
    def of(cls, sequence: GaussianSequence, options: WriteOptions) -> Take:
        """Read the first frame, and settle order and bounds by it."""
        first = change_axes(sequence[0], AXES)
        order = _order(first.positions)
        bounds, raw = bounds_of(first, options.error_scale), _raw(first.select(order), options)
        bounds["turns"] = bounds["orientations"]
        return cls(sequence, order, bounds, raw, options, first.radiance_color_space)

    def __post_init__(self) -> None:
        """Settle what the static block says, as a decoder reads it."""
        raw = self.first | {"orientations": _rodrigues(self.first["orientations"][None])[0]}
        self._planes = {name: [still(row, self._allowed(name)) for row in values] for name, values in raw.items()}
        self._static = {name: _values(planes)[0] for name, planes in self._planes.items()}
        self._turned_from = quaternions(self._static["orientations"])

    def _allowed(self, name: str) -> float:
        return _allowed(name, self.bounds[name.partition("_")[0] if name.startswith("radiance") else name])

    def static_block(self, level: int) -> Block:
        """Return the static block: the first frame."""
        return Block.of("static.bin", 1, self._planes, level)

    def segment_block(self, first: int, count: int, level: int) -> Block:
        """Return the segment of at most ``count`` frames from a first one on.

        Raises:
            InvalidArrayError: A frame differs from the first of the take in the number of Gaussians or in its arrays.
        """
        frames = range(first, min(first + count, len(self.sequence)))
        with threadpool_limits(1, "blas"):  # matrices of few rows: threads would mostly wait for each other
            planes = self._segment_planes(frames)
        block = Block.of(f"{first:06d}.bin", len(frames), planes, level)
        return Block({"first": first, "frames": len(frames), **block.entry}, block.content)

    def _segment_planes(self, frames: range) -> Mapping[str, list[Planes]]:
        """Return what some frames add to the static block: the arrays that differ from it by more than the bound."""
        raw = [self._checked(frame) for frame in frames]
        found = dict[str, list[Planes]]()

        def add(name: str, values: NDArray[np.float32]) -> NDArray[np.float32] | None:
            """Keep an array ``(F, C, N)`` if it is needed, and return what a decoder makes of it."""
            if not np.abs(values).max(initial=0.0) > self._allowed(name):
                return None
            found[name] = [moving(component, self._allowed(name)) for component in values.swapaxes(0, 1)]
            return _values(found[name])

        turns = add("turns", _turns(np.stack([each.pop("orientations") for each in raw]), self._turned_from))
        if "normals" in raw[0]:
            normals = [each.pop("normals") for each in raw]
            if turns is not None:
                back = [quaternions(-turn) for turn in turns]
                normals = [rotated(turn, each) for turn, each in zip(back, normals, strict=True)]
            add("normals", np.stack(normals) - self._static["normals"])
        for name in raw[0]:
            add(name, np.stack([each[name] for each in raw]) - self._static[name])
        return found

    def manifest(self) -> dict[str, Any]:
        """Return what the manifest says of the take, but for its blocks."""
        names = self.first
        colored = {"radianceColorSpace": self.color_space} if "radiance_0" in names else {}
        return {
            "format": "b4d",
            "version": 1,
            "generator": f"beam-warp {__version__}",
            "frames": len(self.sequence),
            "rate": self.sequence.frames_per_second,
            "count": len(self.order),
            "topology": self.sequence.topology,
            "axes": AXES,
            **colored,
            "bounds": {
                name: bound
                for name, bound in self.bounds.items()
                if name in (*names, "turns") or (name == "radiance" and colored)
            },
            "metadata": {key: value for key, value in self.sequence.metadata.items() if key != "notes"},
        }

    def _checked(self, frame: int) -> Arrays:
        """Return what `_raw` gives of a frame, in the order of the container."""
        cloud = change_axes(self.sequence[frame], AXES)
        if len(cloud) != len(self.order):
            raise InvalidArrayError(
                f"frames of a b4d must have as many Gaussians as the first one ({len(self.order)}), got {len(cloud)} "
                f"in frame {frame}. Write the parts between such changes as takes of their own, or another format."
            )
        found = _raw(cloud.select(self.order), self.options)
        if found.keys() != self.first.keys():
            differs = ", ".join(sorted(found.keys() ^ self.first.keys()))
            raise InvalidArrayError(
                f"frames of a b4d must have the arrays of the first one, got {differs} in only one of frames 0 and "
                f"{frame}. Leave them out, or give them to every frame."
            )
        return found


def _rodrigues(quaternions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return modified Rodrigues parameters ``(F, 3, N)`` of unit quaternions ``(F, 4, N)``.

    A quaternion and its negative are the same rotation. In the middle frame the one with the smaller parameters is
    taken, and in the others the one that goes on from there; far from there, where parameters grow without bound, the
    smaller one again.
    """
    found, middle = quaternions.astype(np.float32), len(quaternions) // 2
    found[middle] *= np.where(found[middle, 3] < 0.0, -1.0, 1.0)
    for frame, before in (
        *((f, f - 1) for f in range(middle + 1, len(found))),
        *((f, f + 1) for f in range(middle)[::-1]),
    ):
        found[frame] *= np.where(np.einsum("cn,cn->n", found[frame], found[before]) < 0.0, -1.0, 1.0)
    found *= np.where(found[:, 3:] < -0.8, -1.0, 1.0)
    return (found[:, :3] / (1.0 + found[:, 3:])).astype(np.float32)


def _turns(orientations: NDArray[np.float32], start: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the turns from orientations ``(4, N)`` to those of each frame, ``(F, 3, N)``."""
    back = start * np.array([[-1.0], [-1.0], [-1.0], [1.0]], np.float32)
    return _rodrigues(np.stack([product(each, back) for each in orientations]))


def _values(components: Sequence[Planes]) -> NDArray[np.float32]:
    """Return what a decoder makes of the components of an array, ``(F, C, N)``."""
    return np.stack([each.values() for each in components], axis=1)


def block_parts(frames: int, arrays: Mapping[str, list[Planes]]) -> list[bytes]:
    """Return a block: the length of its header, the header, and the weights of all arrays; then each plane."""
    described, weights, planes = [], [], []
    for name, components in arrays.items():
        widths = []
        for each in components:
            assert len(each.weights) == frames
            groups = [[differences(plane) for plane in each.summed], list(each.plain)]
            widths.append([[width(plane) for plane in group] for group in groups])
            weights.append(each.weights.astype("<f4").tobytes())
            planes += [stored(plane) for group in groups for plane in group]
        described.append({"name": name, "planes": widths})
    header = json.dumps({"arrays": described}, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 4)
    return [b"".join([struct.pack("<I", len(header)), header, *weights]), *planes]
