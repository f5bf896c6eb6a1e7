"""The files of a SOG, which lie in a zip bundle or in a folder; every size is checked before anything is unpacked."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.archives import open_zip
from beam_warp.converters.common.errors import malformed
from beam_warp.errors import AssetFormatError, MissingFileError

META = "meta.json"

MAX_META_BYTES = 2**20
"""Largest meta.json read [byte]; one with three codebooks has 16 KiB."""

_HEAD_BYTES = 2**12
"""Bytes of a texture that are read for its size."""

_DAMAGE = (OSError, ValueError, EOFError, KeyError, struct.error, zlib.error, NotImplementedError, RuntimeError)
"""Errors that zipfile and Pillow raise about damaged files, beside their own classes."""


@dataclass(frozen=True)
class SogFiles:
    """The files of one SOG by name.

    Attributes:
        path: Path that was asked for, for errors.
        place: Open bundle, or folder.
        meta_name: Name of the file that describes the others.
    """

    path: Path
    place: zipfile.ZipFile | Path
    meta_name: str = META

    @property
    def is_folder(self) -> bool:
        """True if the files lie in a folder."""
        return isinstance(self.place, Path)

    def meta(self) -> dict[str, Any]:
        """Return the description of the SOG.

        Raises:
            AssetFormatError: It is missing, too large or no JSON object.
        """
        content = self._read(self.meta_name, MAX_META_BYTES + 1)
        if len(content) > MAX_META_BYTES:
            raise self.malformed(f"{self.meta_name} must have at most {MAX_META_BYTES} bytes", "more")
        try:
            meta = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise self.malformed(f"{self.meta_name} must be JSON", f"an error ({str(error)[:120]})") from error
        if not isinstance(meta, dict):
            raise self.malformed(f"{self.meta_name} must hold an object", type(meta).__name__)
        return meta

    def texture_size(self, name: str) -> tuple[int, int]:
        """Return width and height of a texture [px], from its header.

        Raises:
            AssetFormatError: It is missing, cut short, no lossless WebP and no 8-bit PNG.
        """
        return self._size_of(name, self._read(name, _HEAD_BYTES))

    def _size_of(self, name: str, head: bytes) -> tuple[int, int]:
        if head[:8] == b"\x89PNG\r\n\x1a\n" and head[24:25] == b"\x08" and len(head) > 24:
            width, height = struct.unpack(">II", head[16:24])
            return width, height
        if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
            stated = struct.unpack("<I", head[4:8])[0] + 8
            if self.bytes_of(name) < stated:
                raise self.malformed(f"{name} must have the {stated} bytes that it states", str(self.bytes_of(name)))
            if head[12:16] == b"VP8X" and len(head) <= _HEAD_BYTES:
                head = self._read(name)
            for kind, start in _chunks(head):
                if kind == b"VP8L" and len(head) >= start + 5:
                    sides = int.from_bytes(head[start + 1 : start + 5], "little")
                    return (sides & 0x3FFF) + 1, (sides >> 14 & 0x3FFF) + 1
                if kind == b"VP8 ":
                    raise self.malformed(f"{name} must be lossless, for lossy coding changes codes", "lossy WebP")
        raise self.malformed(f"{name} must be a lossless WebP or an 8-bit PNG", f"{head[:16]!r}")

    def texture(self, name: str, size: tuple[int, int], channels: int) -> NDArray[np.uint8]:
        """Return the pixels of a texture in order, ``(width * height, channels)``.

        Args:
            name: The file.
            size: Width and height [px], as `texture_size` gave them.
            channels: 3 for R, G and B, 4 for alpha too, which is 255 where the file has none.

        Raises:
            AssetFormatError: It is damaged.
        """
        from PIL import Image

        try:
            with Image.open(io.BytesIO(self._read(name)), formats=("WEBP", "PNG")) as picture:
                if picture.size != size:
                    raise ValueError(f"{picture.width} x {picture.height} px in {size[0]} x {size[1]}")
                pixels = np.asarray(picture.convert("RGBA" if channels == 4 else "RGB"))
        except AssetFormatError:
            raise
        except (*_DAMAGE, SyntaxError, MemoryError, Image.DecompressionBombError) as error:
            raise self.malformed(f"{name} must be an intact picture", _reason(error)) from error
        return pixels.reshape(-1, channels)

    def bytes_of(self, name: str) -> int:
        """Return the size of a file that is there [byte]."""
        if isinstance(self.place, Path):
            return (self.place / name).stat().st_size
        return self.place.getinfo(name).file_size

    def _read(self, name: str, count: int = -1) -> bytes:
        """Return a file, or its first bytes."""
        try:
            if isinstance(self.place, Path):
                if not (self.place / name).is_file():  # a pipe would not end
                    raise KeyError(name)
                with (self.place / name).open("rb") as stream:
                    return stream.read(count)
            limit = 2 * self.path.stat().st_size + MAX_META_BYTES
            if self.place.getinfo(name).file_size > limit:
                raise self.malformed(f"{name} must unpack to at most {limit} bytes", "more")
            with self.place.open(name) as stream:
                return stream.read(count)
        except AssetFormatError:
            raise
        except KeyError as error:
            raise self.malformed(f"a SOG must hold {name}", "no such file") from error
        except (*_DAMAGE, zipfile.BadZipFile) as error:
            raise self.malformed(f"{name} must be readable", _reason(error)) from error

    def malformed(self, contract: str, got: str, remedy: str = "Export or download it again.") -> AssetFormatError:
        """Make the error of a SOG that breaks its format."""
        return malformed(self.path, contract, got, remedy)


def _chunks(webp: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield kind and start of the content of every chunk of a WebP file."""
    at = 12
    while at + 8 <= len(webp):
        yield webp[at : at + 4], at + 8
        size = struct.unpack("<I", webp[at + 4 : at + 8])[0]
        at += 8 + size + size % 2


def _reason(error: Exception) -> str:
    return f"a damaged one ({' '.join(str(error).split())[:120] or type(error).__name__})"


@contextmanager
def open_sog(path: Path) -> Iterator[SogFiles]:
    """Open a bundle, a folder with meta.json, or the folder around a given meta.json.

    Raises:
        MissingFileError: There is nothing at ``path``, or it cannot be opened.
        AssetFormatError: It is no zip archive, or one with a directory that no SOG has.
    """
    if path.is_dir():
        yield SogFiles(path, path)
    elif path.name.lower().endswith(".json"):
        yield SogFiles(path, path.parent, path.name)
    else:
        with ExitStack() as opened:
            try:
                archive = opened.enter_context(open_zip(path))
            except OSError as error:
                raise MissingFileError(f"input must be an existing file, got {path} ({error.strerror}).") from error
            except (ValueError, NotImplementedError, struct.error, zipfile.BadZipFile) as error:
                got = _reason(error)
                raise malformed(
                    path, "a SOG bundle must be a zip archive of few files", got, "Export it again."
                ) from error
            yield SogFiles(path, archive)
