"""Decoding of single frames of a video by ffmpeg, by time; see `beam_warp.image.video` for encoding and the program.

Every frame is read by a process of its own, which seeks to it: nothing is kept, and any order gives the same pixels.
Colours go from the matrix and range that the file states to full-range sRGB of 16 bits; BT.709's transfer tag is taken
for sRGB. A file of 720 rows or more that states no matrix has that of BT.709, a smaller one that of BT.601.
"""

from __future__ import annotations

import re
import subprocess
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beam_warp.errors import AssetFormatError, MissingFileError, MissingPackageError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.image.files import MAX_PIXELS, MAX_SIDE, Image
from beam_warp.image.video import INSTALL, find_ffmpeg

FILM_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi")
"""Suffixes of videos that are read, in lower case."""

PATIENCE = 120.0
"""Time after which ffmpeg is said to hang [s]."""

SLACK = 5e-4
"""How much earlier than a frame decoding begins [s], since times are rounded."""

_HDR = ("smpte2084", "arib-std-b67")
_DISCARDED = 4


@dataclass(frozen=True)
class Film:
    """A video's header.

    Attributes:
        width: [pixel].
        height: [pixel].
        matrix: Matrix of its colours, as ffmpeg's filter names it; ``auto`` for what the file states.
    """

    width: int
    height: int
    matrix: str

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixel]."""
        return self.width, self.height


def is_film(path: Path) -> bool:
    """Return whether a file is a video, by its suffix."""
    return path.suffix.lower() in FILM_SUFFIXES


def film_of(path: Path) -> Film:
    """Read the header of a video.

    Raises:
        MissingFileError: There is no such file.
        MissingPackageError: There is no ffmpeg.
        AssetFormatError: It is no video that ffmpeg reads, too large, or of high dynamic range.
    """
    if not path.is_file():
        raise MissingFileError(f"video must be a readable file, got {path} (no such file). Check the path.")
    return _film(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=512)
def _film(path: Path, changed: int) -> Film:
    """Read a header; ``changed`` makes a file that has changed another one."""
    said = _ffmpeg(path, ["-c", "copy", "-frames:v", "0", "-f", "null", "-"]).stderr.decode(errors="replace")
    line = re.search(r"Stream #0:\d+.*: Video: .*", said)
    size = line and re.search(r", (\d+)x(\d+)[ ,]", line[0])
    if not line or not size:
        raise AssetFormatError(f"video must hold pictures that ffmpeg knows, got none in {path}. Convert it to H.264.")
    width, height = int(size[1]), int(size[2])
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise AssetFormatError(
            f"video must have sides in [1, {MAX_SIDE}] px, got {width} x {height} in {path}. Resize it."
        )
    if any(name in line[0] for name in _HDR):
        raise AssetFormatError(
            f"video must be of standard dynamic range, got PQ or HLG in {path}. Export it as BT.709, or as EXR images."
        )
    is_tagged = re.search(r"\((?:\w+, )*(?:bt|smpte|fcc|gbr|ycgco)", line[0])
    return Film(width, height, "bt709" if height >= 720 and not is_tagged else "auto")


def film_times(path: Path) -> NDArray[np.float64]:
    """Return when each frame of a video is shown, on the clock of the file, ascending ``(F,)`` [s]; it is read whole.

    Raises:
        MissingFileError, MissingPackageError, AssetFormatError: As `film_of`; or it has no frame.
    """
    film_of(path)
    return _times(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=512)
def _times(path: Path, changed: int) -> NDArray[np.float64]:
    """Read the times of a video; see `_film`."""
    said = _ffmpeg(path, ["-c", "copy", "-f", "framecrc", "-"]).stdout.decode(errors="replace")
    base = re.search(r"#tb 0: (\d+)/(\d+)", said)
    rows = [row.split(",") for row in said.splitlines() if row[:1].isdigit()]
    shown = [int(row[2]) for row in rows if not any(_is_discarded(word) for word in row[5:])]
    if base is None or not shown:
        raise AssetFormatError(f"video must have a frame, got none in {path}. Record it again.")
    return np.array(sorted(float(time * Fraction(int(base[1]), int(base[2]))) for time in shown))


def _is_discarded(word: str) -> bool:
    """Return whether a word of a packet's row says that it is decoded for others' sake and not shown."""
    flags = re.fullmatch(r" *F=0x([0-9a-fA-F]+)", word)
    return flags is not None and bool(int(flags[1], 16) & _DISCARDED)


def read_film_frame(path: Path, time: float) -> Image:
    """Read the frame of a video that is shown at a time.

    Args:
        path: The video.
        time: That of the frame, as `film_times` says [s].

    Raises:
        MissingFileError, MissingPackageError: As `film_of`.
        AssetFormatError: It is damaged there, or has ended.
    """
    film = film_of(path)
    scale = f"scale=in_color_matrix={film.matrix}:out_range=pc:flags=accurate_rnd+full_chroma_int+bicubic"
    pick = ["-frames:v", "1", "-vf", f"{scale},format=rgb48be", "-c:v", "ppm", "-f", "image2pipe", "-"]
    content = _ffmpeg(path, pick, ["-ss", f"{max(time - SLACK, 0.0):.6f}"]).stdout
    head = re.match(rb"P6\s+(\d+)\s+(\d+)\s+65535\s", content)
    if head is None or len(content) != head.end() + 6 * int(head[1]) * int(head[2]):
        raise AssetFormatError(f"video must have a frame at {time:.3f} s, got none in {path}. Export it again.")
    pixels = np.frombuffer(content, ">u2", offset=head.end()).reshape(int(head[2]), int(head[1]), 3)
    planes = np.moveaxis(pixels.astype(np.float32) / np.float32(65535.0), -1, 0)
    return Image(path, dict(zip("RGB", map(np.ascontiguousarray, planes), strict=True)), DISPLAY_SRGB, False)


def _ffmpeg(path: Path, words: list[str], before: list[str] = []) -> subprocess.CompletedProcess[bytes]:  # noqa: B006
    """Run ffmpeg on the pictures of a file; it reaches nothing but that file, and is not heard on errors of content."""
    program = find_ffmpeg()
    if program is None:
        raise MissingPackageError(f"ffmpeg must be there to read videos, got none for {path}. To get it, {INSTALL}.")
    command = [program, "-hide_banner", "-nostdin", "-protocol_whitelist", "file,pipe", "-noautorotate", *before]
    try:
        return subprocess.run(
            [*command, "-i", f"file:{path}", "-map", "0:v:0", *words],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
            timeout=PATIENCE,
        )
    except subprocess.TimeoutExpired as error:
        raise AssetFormatError(
            f"video must be read within {PATIENCE:.0f} s, got no end of {path}. Convert it to H.264."
        ) from error
    except OSError as error:
        raise MissingPackageError(
            f"ffmpeg must run, got {error.strerror or error} of {program}. To mend it, {INSTALL}."
        ) from error
