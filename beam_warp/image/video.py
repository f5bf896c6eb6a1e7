"""Encoding of images as an H.264 video by ffmpeg.

ffmpeg is a separate program: the one on PATH, or else that of the package imageio-ffmpeg (the extra ``video``). It
receives frames as raw pixels. sRGB is converted to BT.709 YUV of the narrow range with chroma at half resolution, and
tagged as such, which every player supports; players show BT.709's transfer tag as sRGB.
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_count, require_number, require_path
from beam_warp.errors import InvalidArrayError, OutputError
from beam_warp.image.files import replacing

INSTALL = (
    "install ffmpeg (apt install ffmpeg, brew install ffmpeg, winget install ffmpeg) or pip install 'beam-warp[video]'"
)
"""Remedy for a missing ffmpeg, for messages."""

ENCODER = "libx264"


@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Options of the encoder.

    Attributes:
        frames_per_second: Playback rate [1/s], stored as the nearest fraction with a denominator of at most 1001, such
            as 30000 / 1001.
        crf: Constant rate factor of x264, 0 (lossless) to 51; 18 is visually lossless for most.

    Raises:
        InvalidOptionError: A value is out of range.
    """

    frames_per_second: float = 30.0
    crf: int = 18

    def __post_init__(self) -> None:
        """Check both."""
        require_number("frames_per_second", self.frames_per_second, 0.01, 1000.0)
        require_count("crf", self.crf, 0, 51)


def find_ffmpeg() -> str | None:
    """Return the ffmpeg to use, or None where there is none."""
    found = shutil.which("ffmpeg")
    if found is not None:
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe  # type: ignore[import-not-found]

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):  # not installed, or without a program for this platform
        return None


def require_encoder(ffmpeg: str) -> None:
    """Refuse an ffmpeg that cannot write H.264, before hours are spent on frames.

    Raises:
        OutputError: ffmpeg does not run, or was built without libx264.
    """
    try:
        asked = subprocess.run(
            [ffmpeg, "-hide_banner", "-loglevel", "error", "-encoders"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
        )
    except OSError as error:
        raise _not_running(ffmpeg, error) from error
    if asked.returncode != 0:
        raise _failed(ffmpeg, asked.stderr, asked.returncode)
    if ENCODER not in asked.stdout.decode(errors="replace").split():
        raise OutputError(
            f"ffmpeg must be built with {ENCODER}, got {ffmpeg} without it. To get another one, {INSTALL}; or name "
            "numbered images instead."
        )


def write_mp4(path: str | Path, frames: Iterable[NDArray[np.uint8]], options: VideoOptions, *, ffmpeg: str) -> int:
    """Encode a video, which appears complete or not at all.

    Args:
        path: The .mp4, replaced if it exists.
        frames: At least one image, sRGB, ``(H, W, 3)`` uint8, all of one size. The last row or column of an odd side
            is repeated, since chroma is stored for pairs.
        options: Rate and quality.
        ffmpeg: The program: see `find_ffmpeg`.

    Returns:
        Number of frames.

    Raises:
        InvalidArrayError: There is no frame, or one differs in type or shape from the first.
        OutputError: ffmpeg cannot be run or fails; the message quotes its last line.
    """
    path, images = require_path("path", path), iter(frames)
    first = next(images, None)
    if first is None:
        raise InvalidArrayError("frames must hold at least one image, got none. Render some first.")
    _require_frame(first, first.shape)
    with replacing(path) as temporary, tempfile.TemporaryFile() as said:
        try:
            process = subprocess.Popen(
                _command(ffmpeg, first.shape[0], first.shape[1], options, temporary),
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=said,
                start_new_session=True,  # Ctrl-C is ours to handle: it must not end ffmpeg in the middle of a write
            )
        except OSError as error:
            raise _not_running(ffmpeg, error) from error
        assert process.stdin is not None
        try:
            count = _feed(process.stdin, first, images)
        except BaseException:
            process.kill()
            process.wait()
            with suppress(OSError):
                process.stdin.close()
            raise
        if process.wait() != 0 or count == 0 or not temporary.is_file():
            said.seek(0)
            raise _failed(ffmpeg, said.read(), process.returncode)
    return count


def _feed(pipe: IO[bytes], first: NDArray[np.uint8], images: Iterable[NDArray[np.uint8]]) -> int:
    """Write every frame and return their number; 0 if ffmpeg ended early, which its exit code explains."""
    try:
        pipe.write(_even(first).tobytes())
        count = 1
        for image in images:
            _require_frame(image, first.shape)
            pipe.write(_even(image).tobytes())
            count += 1
        pipe.close()
    except BrokenPipeError:
        with suppress(OSError):  # what is still in the buffer
            pipe.close()
        return 0
    return count


def _command(ffmpeg: str, rows: int, columns: int, options: VideoOptions, path: Path) -> list[str]:
    """Return the command line of ffmpeg."""
    rate = Fraction(options.frames_per_second).limit_denominator(1001)
    tags = ["-color_primaries", "bt709", "-color_trc", "bt709", "-colorspace", "bt709", "-color_range", "tv"]
    convert = "scale=in_range=pc:out_range=tv:out_color_matrix=bt709:flags=accurate_rnd+full_chroma_int+bicubic"
    return [
        *(ffmpeg, "-hide_banner", "-loglevel", "error", "-nostdin", "-y"),
        *("-f", "rawvideo", "-pixel_format", "rgb24", "-video_size", f"{columns + columns % 2}x{rows + rows % 2}"),
        *("-framerate", f"{rate.numerator}/{rate.denominator}", "-i", "pipe:0", "-vf", f"{convert},format=yuv420p"),
        *("-c:v", ENCODER, "-crf", str(options.crf), *tags, "-movflags", "+faststart", "-f", "mp4", str(path)),
    ]


def _even(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image with sides of even length."""
    rows, columns = image.shape[:2]
    return np.pad(image, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")


def _require_frame(image: NDArray[np.uint8], shape: tuple[int, ...]) -> None:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size or image.shape != shape:
        raise InvalidArrayError(
            f"frames must be uint8 of one shape (H, W, 3), got {image.dtype} {image.shape} in a film of {shape}. "
            "Resize them."
        )


def _not_running(ffmpeg: str, error: OSError) -> OutputError:
    return OutputError(f"ffmpeg must run, got {error.strerror or error} of {ffmpeg}. To mend it, {INSTALL}.")


def _failed(ffmpeg: str, said: bytes, code: int) -> OutputError:
    """Return the error of an ffmpeg that failed, with the last line of its output."""
    lines = [line for line in said.decode(errors="replace").splitlines() if line.strip()]
    last = lines[-1].strip() if lines else f"exit code {code}, and not a word"
    return OutputError(
        f"ffmpeg must end well, got a failure of {ffmpeg} ({last}). Free space or mend it; or name numbered images "
        "instead."
    )
