"""Writer of SPZ, versions 3 and 4; the format is described in `beam_warp.converters.spz.reader`."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.converters.common.activations import log_scale
from beam_warp.converters.common.colors import display_radiance, resize_bands
from beam_warp.converters.common.frames import FrameToWrite
from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.common.rotations import SMALLER_LIMIT, to_smaller
from beam_warp.converters.spz.reader import (
    ANTIALIASED,
    AXES,
    COORDINATES,
    EXTENDED,
    FRAMES_HEADER,
    MAGIC,
    RECORD,
    STATED_AXES,
    STREAM_HEADER,
    TABLE_ENTRY,
)
from beam_warp.errors import InvalidOptionError
from beam_warp.world.gaussians import GaussianCloud

_GZIP_LEVEL, _ZSTANDARD_LEVEL = 4, 9

_FRACTIONAL_BITS = 12
"""Fractional bits of positions as other writers have them: 0.24 mm in metres."""

_BAND_STEPS = (8, 16, 16, 16)
"""Multiples to which the bytes of bands 1 to 4 are rounded, as the format's own library does for compression."""


def encode(frame: FrameToWrite, path: Path, options: WriteOptions) -> None:
    """Write one frame.

    Positions are rounded to 1/4096 of a unit, or finer if the farthest is nearer than 2 and coarser beyond 1024.

    Raises:
        InvalidOptionError: Materials, a degree or axes are asked for that the format cannot hold.
    """
    cloud, version = frame.cloud, options.spz_version
    radiance = resize_bands(display_radiance(cloud)[0], options.sh_degree)
    degree = round(np.sqrt(radiance.shape[1])) - 1
    if options.profile == "beam":
        raise InvalidOptionError("profile must be standard for SPZ, which has no materials, got beam. Leave it out.")
    if degree > 3 and version < 4:
        raise InvalidOptionError("sh_degree must be at most 3 in SPZ 3, got 4. Pass sh_degree 3, or spz_version 4.")
    records = _axes_record(cloud.axes)
    bits = fractional_bits(float(np.abs(cloud.positions).max(initial=0.0)))
    arrays = _packed(cloud, radiance, bits)
    flags = (ANTIALIASED if frame.raster and frame.raster[0] else 0) | (EXTENDED if records else 0)
    facts = (MAGIC, version, len(cloud), degree, bits, flags)
    path.write_bytes(_frames(facts, arrays, records) if version == 4 else _stream(facts, arrays, records))


def fractional_bits(reach: float) -> int:
    """Return the fractional bits of positions whose largest coordinate is ``reach``.

    Raises:
        InvalidOptionError: 24 bits do not reach so far.
    """
    exponent = int(np.frexp(reach)[1])  # reach < 2^exponent
    bits = min(max(_FRACTIONAL_BITS, 14 - exponent), 22 - exponent, 22)
    if bits < 0:
        raise InvalidOptionError(f"positions must be within 4194304 units for SPZ, got {reach:g}. Scale them.")
    return bits


def _axes_record(axes: str) -> bytes:
    """Return the record that states axes; nothing for those of every file.

    Raises:
        InvalidOptionError: No record can state them.
    """
    if axes == AXES:
        return b""
    if axes not in STATED_AXES:
        stated = ", ".join(STATED_AXES[1:])
        raise InvalidOptionError(f"axes must be one of {stated} for SPZ, got {axes}. Choose one of them.")
    return RECORD.pack(COORDINATES, 4) + STATED_AXES.index(axes).to_bytes(4, "little")


def _packed(cloud: GaussianCloud, radiance: NDArray[np.float32], bits: int) -> list[bytes]:
    """Return the arrays in the order of the file."""
    fixed = np.rint(np.ldexp(cloud.positions.astype(np.float64), bits)).astype("<i4")
    return [
        np.ascontiguousarray(fixed).view(np.uint8).reshape(-1, 3, 4)[..., :3].tobytes(),
        _to_bytes(cloud.opacities * 255.0),
        _to_bytes((0.15 * radiance[:, 0].astype(np.float64) + 0.5) * 255.0),
        _to_bytes(16.0 * (log_scale(cloud.scales).astype(np.float64) + 10.0)),
        _words(cloud.orientations).tobytes(),
        _bands(radiance[:, 1:]),
    ]


def _to_bytes(values: ArrayLike) -> bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _words(orientations: NDArray[np.float32]) -> NDArray[np.uint32]:
    smaller, largest_at = to_smaller(orientations / np.linalg.norm(orientations, axis=1, keepdims=True))
    fields = np.minimum(np.rint(np.abs(smaller) * (511.0 / SMALLER_LIMIT)), 511).astype(np.uint32)
    fields |= np.where(smaller < 0.0, 512, 0).astype(np.uint32)
    words = largest_at.astype(np.uint32)
    for place in range(3):
        words = words << np.uint32(10) | fields[:, place]
    return words.astype("<u4")


def _bands(higher: NDArray[np.float32]) -> bytes:
    steps = np.repeat(_BAND_STEPS, (3, 5, 7, 9))[: higher.shape[1], None]
    return _to_bytes(np.rint((128.0 * higher.astype(np.float64) + 128.0) / steps) * steps)


def _stream(facts: tuple[Any, ...], arrays: list[bytes], records: bytes) -> bytes:
    """Return a file of version 3."""
    packer = zlib.compressobj(_GZIP_LEVEL, wbits=31)
    parts = (STREAM_HEADER.pack(*facts), *arrays, records)
    return b"".join([*(packer.compress(part) for part in parts), packer.flush()])


def _frames(facts: tuple[Any, ...], arrays: list[bytes], records: bytes) -> bytes:
    """Return a file of version 4."""
    from zstandard import ZstdCompressor

    packer = ZstdCompressor(level=_ZSTANDARD_LEVEL)
    kept = [array for array in arrays if array]
    frames = [packer.compress(array) for array in kept]
    table = (TABLE_ENTRY.pack(len(frame), len(array)) for frame, array in zip(frames, kept, strict=True))
    header = FRAMES_HEADER.pack(*facts, len(kept), FRAMES_HEADER.size + len(records))
    return b"".join([header, records, *table, *frames])
