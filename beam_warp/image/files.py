"""Reading and writing of image files: OpenEXR, Radiance HDR, PNG and JPEG.

An `Image` states whether it is scene-linear or display-referred, and whether its colour is multiplied by alpha; values
are never reinterpreted silently. OpenEXR and Pillow are imported only when a file is read or written, so that a PLY
converter, which only encodes colours, does not wait for them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_choice, require_finite, require_number, require_path
from beam_warp.errors import AssetFormatError, InvalidArrayError, MissingFileError
from beam_warp.image.color import COLOR_SPACES, DISPLAY_SRGB, LINEAR_REC709, linear_to_srgb, srgb_to_linear
from beam_warp.image.hdr import radiance_hdr_size, read_radiance_hdr
from beam_warp.outputs import replacing as replacing

MAX_SIDE = 32_768
"""Largest width or height read or written [px]."""

MAX_PIXELS = 2**28
"""Largest number of pixels read; it is checked in the header, before memory is allocated."""

MAX_ENVIRONMENT_PIXELS = 8192 * 4096
"""Largest number of pixels of an environment: beyond, light costs gigabytes and minutes, and no render differs."""

MAX_FILLED_VALUES = 2**26
"""Most values of an EXR's display window, unless its data window holds a sixteenth of them: zeros that a few bytes of a
header ask for."""

MAX_CHANNELS = 64
"""Most channels read from one EXR."""

SUFFIXES = (".exr", ".hdr", ".png", ".jpg", ".jpeg")
"""Suffixes of files that are read, in lower case."""

HALF_MAX = 65504.0
"""Largest finite half-precision value."""


def display_image(linear_rgb: ArrayLike, exposure_stops: float = 0.0) -> NDArray[np.uint8]:
    """Convert linear radiance to 8-bit sRGB: exposure, clip to [0, 1], sRGB, round to nearest; no tone curve.

    View transforms are in `beam_warp.image.tone`; their results are encoded here.

    Args:
        linear_rgb: Linear Rec.709, ``(H, W, 3)``, finite.
        exposure_stops: Gain in powers of two.

    Raises:
        InvalidArrayError: The shape is another, or a value is not finite.
    """
    linear = require_array("linear_rgb", linear_rgb, (None, None, 3))
    require_finite("linear_rgb", linear)
    gain = 2.0 ** require_number("exposure_stops", exposure_stops, -64, 64)
    with np.errstate(over="ignore"):  # what is brighter than float32 is white
        exposed = linear * gain
    return np.rint(linear_to_srgb(np.clip(exposed, 0.0, 1.0)) * 255.0).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Image:
    """The channels of one image file.

    Attributes:
        path: Path of the file, for errors.
        channels: Name → ``(H, W)`` array: float32, or uint32 for integer channels of an EXR. Colour is R, G, B (or
            Y alone), opacity is A in [0, 1]. PNG and JPEG values are scaled to [0, 1].
        color_space: `LINEAR_REC709` or `DISPLAY_SRGB`, for the colour channels.
        premultiplied: True if the colour is multiplied by A.
    """

    path: Path
    channels: Mapping[str, NDArray[Any]]
    color_space: str
    premultiplied: bool

    @property
    def height(self) -> int:
        """Number of rows."""
        return next(iter(self.channels.values())).shape[0]

    @property
    def width(self) -> int:
        """Number of columns."""
        return next(iter(self.channels.values())).shape[1]

    @property
    def alpha(self) -> NDArray[np.float32] | None:
        """Opacity ``(H, W)``, or None where the file has none."""
        return self.channels.get("A")

    def stack(self, *names: str) -> NDArray[Any]:
        """Return the named channels as ``(H, W, len(names))``.

        Raises:
            AssetFormatError: The file lacks one of them.
        """
        missing = [name for name in names if name not in self.channels]
        if missing:
            raise AssetFormatError(
                f"image must have the channels {', '.join(names)}, got {', '.join(self.channels)} in {self.path}. "
                "Write the missing ones or name others."
            )
        return np.stack([self.channels[name] for name in names], axis=-1)

    def rgb(self) -> NDArray[np.float32]:
        """Return the colour as the file has it, ``(H, W, 3)``; for a grey image, Y three times."""
        return self.stack(*("YYY" if "Y" in self.channels and "R" not in self.channels else "RGB"))

    def linear_rgba(self) -> NDArray[np.float32]:
        """Return scene-linear Rec.709 with alpha premultiplied, ``(H, W, 4)``; alpha is 1 where the file has none."""
        rgb = self.linear_rgb()
        alpha = np.ones(rgb.shape[:2], np.float32) if self.alpha is None else self.alpha
        return np.concatenate([rgb, alpha[..., None]], axis=-1)

    def linear_rgb(self) -> NDArray[np.float32]:
        """Return the colour of `linear_rgba`, ``(H, W, 3)``."""
        rgb, weight = self.rgb(), None if self.alpha is None else self.alpha[..., None]
        if self.color_space == DISPLAY_SRGB:
            if self.premultiplied and weight is not None:  # the curve applies to the colour, not to its product
                rgb = np.divide(rgb, weight, out=np.zeros_like(rgb), where=weight > 0)
            rgb = srgb_to_linear(rgb)
        elif self.premultiplied:
            return rgb
        return rgb if weight is None else rgb * weight


SCENE_REFERRED_SUFFIXES = (".exr", ".hdr")
"""Suffixes of formats whose values are not clipped at white, unless their colour space is stated to be another."""


def read_image(path: str | os.PathLike[str], *, color_space: str | None = None, max_pixels: int = MAX_PIXELS) -> Image:
    """Read an .exr, .hdr, .png, .jpg or .jpeg file.

    Args:
        path: The file.
        color_space: Colour space of a file that departs from the convention of its format: EXR and HDR are
            scene-linear with premultiplied alpha, PNG and JPEG are display sRGB with straight alpha.
        max_pixels: Largest number of pixels read; more are refused before memory is allocated.

    Returns:
        The image. An EXR's data window is placed in its display window, with zeros outside and overscan cut off.

    Raises:
        MissingFileError: There is no such file, or it cannot be read.
        AssetFormatError: The file is damaged, larger than `MAX_SIDE`, ``max_pixels`` or `MAX_CHANNELS`, or of a kind
            (deep, multi-part, subsampled, CMYK, ...) that is not read. NaN and infinity in an EXR are kept.
    """
    path = require_path("path", path)
    if color_space is not None:
        require_choice("color_space", color_space, COLOR_SPACES)
    suffix = path.suffix.lower()
    _require_file(path)
    if suffix == ".exr":
        return Image(path, _read_exr(path, max_pixels), color_space or LINEAR_REC709, premultiplied=True)
    if suffix == ".hdr":
        rgb = read_radiance_hdr(path, lambda file, width, height: _require_size(file, width, height, max_pixels))
        channels = {name: rgb[..., index] for index, name in enumerate("RGB")}
        return Image(path, channels, color_space or LINEAR_REC709, premultiplied=True)
    return Image(path, _read_pillow(path, max_pixels), color_space or DISPLAY_SRGB, premultiplied=False)


def image_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Return the width and height of an image file, from its header.

    Raises:
        MissingFileError: There is no such file, or it cannot be read.
        AssetFormatError: The header is not that of an image that `read_image` reads.
    """
    path = require_path("path", path)
    _require_file(path)
    suffix = path.suffix.lower()
    if suffix == ".hdr":
        size = radiance_hdr_size(path)
        _require_size(path, *size)
        return size
    if suffix == ".exr":
        import OpenEXR

        with _intact(path):
            first, end = _window(path, OpenEXR.File(str(path), header_only=True).header(), "displayWindow")
        width, height = (end - first).tolist()
        return width, height
    with _picture(path) as picture:
        return picture.size


def quantization_error(path: str | os.PathLike[str]) -> float:
    """Return how far a JPEG's luminance may be from what was photographed, from its header [level of 255].

    A coefficient that is rounded to steps of q is off by up to q / sqrt(12), root mean square; of a texture that is
    finer than its steps all coefficients are. The transform is orthonormal, so that pixels are off by as much.

    Returns:
        The root mean square over coefficients; 0 for files of other formats.

    Raises:
        MissingFileError: There is no such file, or it cannot be read.
        AssetFormatError: The header is not that of an image that `read_image` reads.

    Source: ITU-T T.81, Annex A.3.
    """
    path = require_path("path", path)
    _require_file(path)
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return 0.0
    with _picture(path) as picture:
        steps = getattr(picture, "quantization", {}).get(0, ())
        return float(np.sqrt(np.mean(np.square(steps, dtype=np.float64)) / 12.0)) if len(steps) else 0.0


def _require_file(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise AssetFormatError(
            f"image must be an .exr, .hdr, .png, .jpg or .jpeg file, got {path}. Convert it to one of them."
        )
    if not path.is_file():
        raise MissingFileError(f"image must be a readable file, got {path} (no such file). Check the path.")


def _require_size(path: Path, width: int, height: int, max_pixels: int = MAX_PIXELS) -> None:
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= max_pixels):
        raise AssetFormatError(
            f"image must have sides in [1, {MAX_SIDE}] px and at most {max_pixels} px, got {width} x {height} "
            f"in {path}. Resize it."
        )


def _damaged(path: Path, error: object) -> AssetFormatError:
    reason = " ".join(str(error).split())
    return AssetFormatError(
        f"image must be an intact {path.suffix[1:].upper()} file, got a damaged one at {path} ({reason}). "
        "Copy or export it again."
    )


_DAMAGE = (ArithmeticError, AttributeError, EOFError, LookupError, SyntaxError, TypeError, ValueError)
"""Errors that OpenEXR and Pillow raise about damaged files, beside those of the system."""


@contextmanager
def _intact(path: Path) -> Iterator[None]:
    """Turn errors that a library raises about a file into `AssetFormatError`."""
    try:
        yield
    except AssetFormatError:
        raise
    except (*_DAMAGE, OSError, RuntimeError, MemoryError) as error:
        raise _damaged(path, error) from error


@contextmanager
def _picture(path: Path, max_pixels: int = MAX_PIXELS) -> Iterator[Any]:
    """Open a PNG or JPEG file with Pillow, after checking its size."""
    from PIL import Image as PillowImage

    try:
        with _intact(path), PillowImage.open(path, formats=("PNG", "JPEG")) as picture:
            _require_size(path, *picture.size, max_pixels)
            yield picture
    except PillowImage.DecompressionBombError as error:
        raise AssetFormatError(f"image must be smaller, got {path} ({error}). Resize it.") from error


def _window(
    path: Path, header: Mapping[str, Any], name: str, max_pixels: int = MAX_PIXELS
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first and last + 1 corner of an EXR window as (x, y), after checking its size."""
    first, last = (np.asarray(corner, np.int64) for corner in header[name])
    width, height = (last - first + 1).tolist()
    _require_size(path, width, height, max_pixels)
    return first, last + 1


def _read_exr(path: Path, max_pixels: int) -> dict[str, NDArray[Any]]:
    import OpenEXR

    with _intact(path):
        lead = OpenEXR.File(str(path), header_only=True)
        header = lead.header()
        described = header["channels"]
        if len(lead.parts) != 1 or header.get("type") not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
            raise AssetFormatError(
                f"image must be a flat EXR of one part, got {len(lead.parts)} parts of type {header.get('type')} "
                f"in {path}. Export each part as its own flat file."
            )
        if not (0 < len(described) <= MAX_CHANNELS) or any((c.xSampling, c.ySampling) != (1, 1) for c in described):
            raise AssetFormatError(
                f"image must have 1 to {MAX_CHANNELS} channels without subsampling, got {len(described)} channels "
                f"in {path}. Export fewer, or not as luminance-chroma."
            )
        data_first, data_end = _window(path, header, "dataWindow", max_pixels)
        first, end = _window(path, header, "displayWindow", max_pixels)
        filled, held = (len(described) * int(np.prod(size)) for size in (end - first, data_end - data_first))
        if filled > max(MAX_FILLED_VALUES, 16 * held):
            raise AssetFormatError(
                f"image must fill a sixteenth of a display window that large, got {held} values for {filled} "
                f"in {path}. Crop its display window."
            )
        stored = OpenEXR.File(str(path), separate_channels=True).channels()
        pixels = {name: channel.pixels for name, channel in stored.items()}
        if any(array.shape != tuple(data_end - data_first)[::-1] for array in pixels.values()):
            raise ValueError("a channel is incomplete")
    low, high = np.maximum(data_first, first), np.minimum(data_end, end)
    into = tuple(slice(*pair) for pair in zip((low - first)[::-1], (high - first)[::-1], strict=True))
    part = tuple(slice(*pair) for pair in zip((low - data_first)[::-1], (high - data_first)[::-1], strict=True))
    channels = {}
    for name, array in pixels.items():
        kind = np.uint32 if array.dtype.kind == "u" else np.float32
        if (data_first == first).all() and (data_end == end).all():
            channels[name] = array.astype(kind)
            continue
        channels[name] = np.zeros(tuple(end - first)[::-1], kind)
        if (high > low).all():
            channels[name][into] = array[part]
    return channels


_PILLOW_CHANNELS = {"L": ("Y",), "LA": ("Y", "A"), "RGB": ("R", "G", "B"), "RGBA": ("R", "G", "B", "A")}


def _read_pillow(path: Path, max_pixels: int) -> dict[str, NDArray[np.float32]]:
    with _picture(path, max_pixels) as picture:
        coding = str(picture.tile[0][3] if picture.tile else "")
        if picture.mode == "P":
            picture = picture.convert("RGBA" if "transparency" in picture.info else "RGB")
        if picture.mode in ("I;16", "I"):
            return {"Y": np.asarray(picture).astype(np.float32) / np.float32(65535)}
        names = _PILLOW_CHANNELS.get(picture.mode)
        if names is None or coding == "LA;16B":
            raise AssetFormatError(
                f"image must be grey, RGB or RGBA, of 8 or 16 bits (grey with alpha: 8), got mode {picture.mode} "
                f"in {path}. Convert it."
            )
        values, full = np.asarray(picture), 255
    if coding.endswith(";16B"):  # Pillow keeps the high bytes only: decode the low ones as a second picture
        with _picture(path) as picture:
            codec, extents, offset, _ = picture.tile[0]
            picture.tile = [(codec, extents, offset, f"{picture.mode};16L")]
            values, full = values * np.uint16(256) + np.asarray(picture), 65535
    values = values.reshape(*values.shape[:2], -1)
    return {name: values[..., index].astype(np.float32) / np.float32(full) for index, name in enumerate(names)}


def write_exr(path: str | os.PathLike[str], channels: Mapping[str, ArrayLike], *, half: bool = False) -> None:
    """Write an EXR of named channels, ZIP-compressed; readers see the old file or the complete new one.

    Args:
        path: The file, replaced if it exists.
        channels: Name → ``(H, W)`` array, all of one shape, linear; by convention colour is premultiplied by A.
        half: Store 16-bit floats, |x| ≤ 65504, instead of 32-bit ones.

    Raises:
        InvalidArrayError: No channels, shapes that differ, or a value too large for a half.
        OutputError: The file cannot be written.
    """
    import OpenEXR

    path = require_path("path", path)
    if not channels:
        raise InvalidArrayError("channels must hold at least one channel, got none. Pass name → (H, W) arrays.")
    arrays = {name: require_array(name, value, (None, None)) for name, value in channels.items()}
    shape = next(iter(arrays.values())).shape
    for name, array in arrays.items():
        if array.shape != shape or array.size == 0:
            raise InvalidArrayError(
                f"{name} must have the shape of the first channel {shape}, not empty, got {array.shape}. Resample it."
            )
        if half and (np.abs(array) > HALF_MAX).any():
            raise InvalidArrayError(
                f"{name} must be at most {HALF_MAX:g} in size as half floats, got {np.nanmax(np.abs(array)):g}. "
                "Write 32-bit floats."
            )
    kind = np.float16 if half else np.float32
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    file = OpenEXR.File(header, {name: array.astype(kind) for name, array in arrays.items()})
    with replacing(path) as temporary:
        file.write(str(temporary))


def write_png(path: str | os.PathLike[str], pixels: NDArray[np.uint8]) -> None:
    """Write 8-bit display sRGB as PNG; readers see the old file or the complete new one.

    Linear values are to be encoded by `display_image` first.

    Args:
        path: The file, replaced if it exists.
        pixels: ``(H, W)``, ``(H, W, 3)`` or ``(H, W, 4)`` uint8, alpha straight.

    Raises:
        InvalidArrayError: Another type or shape.
        OutputError: The file cannot be written.
    """
    from PIL import Image as PillowImage

    path = require_path("path", path)
    array = np.asarray(pixels)
    if (
        array.dtype != np.uint8
        or not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] in (3, 4)))
        or not array.size
    ):
        raise InvalidArrayError(
            f"pixels must be uint8 of shape (H, W), (H, W, 3) or (H, W, 4), got {array.dtype} {array.shape}. "
            "Encode linear values with display_image."
        )
    with replacing(path) as temporary:
        # Higher levels take far longer, and save little of what renders are.
        PillowImage.fromarray(np.ascontiguousarray(array)).save(temporary, format="PNG", compress_level=3)
