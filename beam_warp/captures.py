"""A multi-view capture on disk: its cameras, frames and images, read lazily.

Reads nerfstudio's ``transforms.json``: intrinsics for all records or for each one, and a camera-to-world pose in
OpenGL axes (x right, y up, looking down -z), turned here into `Camera`'s OpenCV axes. Photographs that a lens has bent
are undistorted as they are read, and their cameras are pinholes like all others. What nerfstudio does not have and a
performance needs is read from further fields of a record: ``time``, ``frame``, ``camera``, ``split``, and, for
measuring errors, ``truth`` and ``relit``.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.assets import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.cameras import Camera
from beam_warp.captured_views import CapturedView
from beam_warp.checks import require_number
from beam_warp.errors import AssetFormatError, BeamError, MissingFileError
from beam_warp.images import Image, read_image
from beam_warp.lenses import COEFFICIENT_NAMES, MAX_COEFFICIENT, Lens
from beam_warp.undistortion import COLORS, Intrinsics, Undistortion

FILE_NAME = "transforms.json"
"""The file that makes a folder a capture."""

MAX_FILE_BYTES = 2**30
"""Largest file read: a million records take about half of it."""

MAX_RECORDS = 2**22
"""Most images of one capture."""

MAX_FRAME = 10**9
"""Largest frame number."""

LENS_MODELS = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"), "OPENCV"),
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
}
"""Camera models of nerfstudio that are read, and what undistorts them: all but the last one are the same to it too."""

ALPHA_ROUNDING = 2.0**-10
"""Alpha this far outside [0, 1] is the rounding of a half float, two of which are added by a renderer's filter."""

COLOR_SPACES = {"srgb": DISPLAY_SRGB, "linear": LINEAR_REC709}
"""What ``color_space`` may say of image files, for all records or one; without it each format's custom holds."""

IMAGE_FOLDER = "images"
MASK_FOLDER = "masks"
"""Where a capture names no masks, ``images/a/0.jpg`` has ``masks/a/0.png``, or COLMAP's ``masks/a/0.jpg.png``."""

_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureRecord:
    """One image of a capture.

    Attributes:
        camera_name: Which camera took it; fit for a file name.
        frame: Which frame of the performance it shows, from 0.
        time: When it was taken [s].
        split: What it is for: ``train``, ``test``, ….
        camera: The pinhole that `image` was taken by.
        image_path: The image file, as photographed.
        mask_path: An image file, as photographed, that is white where the subject is; None if there is none.
        color_space: Of the image file, `assets.LINEAR_REC709` or `DISPLAY_SRGB`; None for the custom of its format.
        truth_path: An EXR of exact channels, where the capture is synthetic.
        relit_paths: By name of the light, the exact image under it.
        undistortion: What straightens the files, all of them, as they are read; None where a pinhole took them.
    """

    camera_name: str
    frame: int
    time: float
    split: str
    camera: Camera
    image_path: Path
    mask_path: Path | None = None
    color_space: str | None = None
    truth_path: Path | None = None
    relit_paths: Mapping[str, Path] = field(default_factory=dict)
    undistortion: Undistortion | None = None

    @property
    def name(self) -> str:
        """``CAMERA_FRAME``, which names the record's files and no other's."""
        return f"{self.camera_name}_{self.frame:04d}"

    @property
    def is_distorted(self) -> bool:
        """True if the file must be undistorted before a pinhole fits it, as `image` does."""
        return self.undistortion is not None

    def mask(self) -> NDArray[np.bool_]:
        """Return which pixels of `image` were photographed, ``(H, W)``: all unless `Capture.read` keeps more."""
        if self.undistortion is None:
            return np.ones((self.camera.height, self.camera.width), dtype=bool)
        return self.undistortion.mask()

    def image(self) -> Image:
        """Read the image, undistorted.

        Raises:
            MissingFileError: It is not there.
            AssetFormatError: It is damaged, or its size is not the camera's.
        """
        return self._undistorted(self._photograph())

    def view(self) -> CapturedView:
        """Read what reconstruction sees: scene-linear colour, undistorted, and the coverage of the subject.

        Coverage is the image's alpha; a mask file multiplies it, or stands for it where the image has none. The mask
        is applied to the photograph before that is undistorted, so that edges of both are filtered alike. Without
        either, coverage is not known: alpha is None. Nothing is kept: each call reads the files again.

        Raises:
            MissingFileError: The image or the mask that the capture names is not there.
            AssetFormatError: One is damaged, not of the camera's size, or holds values that no image has.
        """
        image = self._photograph()
        if self.mask_path is not None:
            image = _masked(image, self._sized(read_image(self.mask_path), "mask"))
        image = self._undistorted(image)
        rgba = image.linear_rgba()
        alpha = None if image.alpha is None else rgba[..., 3]
        if alpha is not None:
            if not ((alpha >= -ALPHA_ROUNDING) & (alpha <= 1.0 + ALPHA_ROUNDING)).all():
                raise AssetFormatError(
                    f"alpha must lie in [0, 1], got {np.nanmin(alpha):g} to {np.nanmax(alpha):g}"
                    f"{' and NaN' if np.isnan(alpha).any() else ''} at {self.image_path}. Export the image again."
                )
            alpha = np.clip(alpha, 0.0, 1.0)
        if not np.isfinite(rgba).all():
            raise AssetFormatError(
                f"image must be finite, got NaN or infinity in {int((~np.isfinite(rgba)).any(axis=-1).sum())} pixels "
                f"at {self.image_path}. Export it again, or repair those pixels."
            )
        return CapturedView(name=self.name, camera=self.camera, color=rgba[..., :3], alpha=alpha)

    def truth(self) -> Image:
        """Read the exact channels, undistorted like the image.

        Raises:
            MissingFileError: The record has none, or the file is not there.
            AssetFormatError: It is damaged, or its size is not the camera's.
        """
        if self.truth_path is None:
            raise MissingFileError(f"truth must be given for {self.name}, got none. Choose a record that has it.")
        return self._undistorted(self._sized(read_image(self.truth_path), "image"))

    def _photograph(self) -> Image:
        return self._sized(read_image(self.image_path, color_space=self.color_space), "image")

    def _sized(self, image: Image, what: str) -> Image:
        if (image.width, image.height) != (self.camera.width, self.camera.height):
            raise AssetFormatError(
                f"{what} must be {self.camera.width} x {self.camera.height} as the capture says, "
                f"got {image.width} x {image.height} at {image.path}. Correct the size there, or the {what}."
            )
        return image

    def _undistorted(self, image: Image) -> Image:
        return image if self.undistortion is None else self.undistortion.image(image)


def _masked(image: Image, mask: Image) -> Image:
    """Return an image whose alpha is multiplied by a mask's brightness, as the file has it: coverage has no curve."""
    rgb = mask.rgb()
    coverage = rgb[..., 0] if (rgb == rgb[..., :1]).all() else rgb.mean(axis=-1, dtype=np.float32)
    channels = dict(image.channels)
    if image.premultiplied:
        if image.color_space == DISPLAY_SRGB:
            raise AssetFormatError(
                f"image must be scene-linear or have straight alpha to be masked, got sRGB premultiplied at "
                f"{image.path}. State its colour space, or convert it."
            )
        channels.update((name, channels[name] * coverage) for name in COLORS if name in channels)
    channels["A"] = coverage if image.alpha is None else image.alpha * coverage
    return replace(image, channels=channels)


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """Images of a scene from many places and times.

    Attributes:
        folder: Where it is.
        records: One for each image, in file order.
        frames_per_second: Rate of the performance [1/s]; None if the file does not say.
        environment_path: The light of the capture as a lat-long image; None if there is none.
    """

    folder: Path
    records: tuple[CaptureRecord, ...]
    frames_per_second: float | None = None
    environment_path: Path | None = None

    @property
    def frames(self) -> tuple[int, ...]:
        """The frames there are images of, ascending."""
        return tuple(sorted({record.frame for record in self.records}))

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits there are, ascending."""
        return tuple(sorted({record.split for record in self.records}))

    def select(self, *, split: str | None = None, frames: Collection[int] | None = None) -> tuple[CaptureRecord, ...]:
        """Return the records of a split, of some frames, or of both, in file order."""
        return tuple(
            record
            for record in self.records
            if (split is None or record.split == split) and (frames is None or record.frame in frames)
        )

    @classmethod
    def read(cls, folder: str | os.PathLike[str], *, keep: float = 0.0) -> Capture:
        """Read a capture; images stay on disk until they are asked for.

        Plain nerfstudio files have no frames or cameras: there, every record is of frame 0 at time 0, its camera is
        named after its image, and its split is ``train`` unless ``test_filenames`` or ``val_filenames`` lists it.

        Args:
            folder: The folder that holds ``transforms.json``, or that file.
            keep: Of photographs that a lens has bent: 0 for the part that fills an undistorted image, 1 for all of
                it with void at the borders (see `CaptureRecord.mask`), or anything between.

        Raises:
            MissingFileError: There is no such file.
            AssetFormatError: It is not JSON, a field is missing or out of range, or a lens cannot be inverted over
                its photograph; the message names the record.
            InvalidOptionError: ``keep`` is out of range.
        """
        require_number("keep", keep, 0.0, 1.0)
        path = Path(folder)
        path = path / FILE_NAME if path.is_dir() else path
        content = _read_json(path)
        root = path.parent
        listed = content.get("frames")
        if not isinstance(listed, list) or not 0 < len(listed) <= MAX_RECORDS:
            raise AssetFormatError(
                f"frames must be a list of 1 to {MAX_RECORDS} records, got "
                f"{len(listed) if isinstance(listed, list) else _shown(listed)} at {path}. List the images there."
            )
        splits = {
            name: split
            for split in ("train", "val", "test")
            for name in _Fields(content, str(path)).texts(f"{split}_filenames")
        }
        has_masks = (root / MASK_FOLDER).is_dir()
        records, seen = [], {}
        for index, entry in enumerate(listed):
            where = f"{path}, frames[{index}]"
            if not isinstance(entry, dict):
                raise AssetFormatError(f"record must be an object, got {_shown(entry)} at {where}. Write it as one.")
            record = _record(_Fields({**_shared(content), **entry}, where), root, splits, keep, has_masks)
            if record.name in seen:
                raise AssetFormatError(
                    f"camera and frame must be another pair in each record, got {record.name} "
                    f"at {where} and frames[{seen[record.name]}]. Number the frames or name the cameras apart."
                )
            seen[record.name] = index
            records.append(record)
        fields = _Fields(content, str(path))
        environment = root / fields.text("environment", "environment.exr")
        if "environment" in content and not environment.is_file():
            raise MissingFileError(
                f"environment must be a file, got {environment} (named in {path}). Correct the name."
            )
        return cls(
            folder=root,
            records=tuple(records),
            frames_per_second=fields.number("fps", low=1e-3, high=1e6) if "fps" in content else None,
            environment_path=environment if environment.is_file() else None,
        )


class _Fields:
    """One JSON object, read field by field; errors name the field and the place."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        self.values = values
        self.where = where

    def number(self, name: str, default: float | None = None, *, low: float, high: float) -> float:
        """Return a finite number in range."""
        value = self._get(name, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not (low <= value <= high):
            raise self.error(name, f"a number in [{low:g}, {high:g}]", value)
        return float(value)

    def integer(self, name: str, default: int | None = None, *, low: int, high: int) -> int:
        """Return an integer in range, also where a writer made it ``320.0``."""
        value = self.number(name, default, low=low, high=high)
        if value != math.floor(value):
            raise self.error(name, "an integer", value)
        return int(value)

    def text(self, name: str, default: str | None = None) -> str:
        """Return a text that is not empty."""
        value = self._get(name, default)
        if not isinstance(value, str) or not value or "\0" in value:
            raise self.error(name, "a text", value)
        return value

    def texts(self, name: str) -> list[str]:
        """Return a list of texts, empty if it is not there."""
        value = self.values.get(name, [])
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self.error(name, "a list of texts", value)
        return value

    def file_stem(self, name: str, default: str) -> str:
        """Return a text that is safe in a file name."""
        value = self.text(name, default)
        if value in (".", "..") or any(c in '/\\:*?"<>|' or not c.isprintable() for c in value):
            raise self.error(name, "fit for a file name", value)
        return value

    def paths(self, name: str, root: Path) -> dict[str, Path]:
        """Return named files, none if the field is not there."""
        value = self.values.get(name, {})
        if not isinstance(value, dict) or not all(isinstance(item, str) and item for item in value.values()):
            raise self.error(name, "an object of file names", value)
        return {key: root / item for key, item in value.items()}

    def matrix(self, name: str) -> NDArray[np.float64]:
        """Return a 4 x 4 matrix; nerfstudio also writes it without its last row."""
        value = self._get(name, None)
        try:
            matrix = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.zeros(0)
        if matrix.shape == (3, 4):
            matrix = np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise self.error(name, "a 4 x 4 matrix of finite numbers", value)
        return matrix

    def error(self, name: str, contract: str, value: Any) -> AssetFormatError:
        """Say what a field must be."""
        found = _shown(value) if value is not None else "nothing"
        return AssetFormatError(f"{name} must be {contract}, got {found} at {self.where}. Correct the file.")

    def _get(self, name: str, default: Any) -> Any:
        value = self.values.get(name)
        return default if value is None else value


_SHARED_NAMES = ("w", "h", "fl_x", "fl_y", "cx", "cy", *COEFFICIENT_NAMES, "camera_model", "color_space")


def _shared(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields that hold for every record unless the record says otherwise."""
    return {name: content[name] for name in _SHARED_NAMES if name in content}


def _record(fields: _Fields, root: Path, splits: Mapping[str, str], keep: float, has_masks: bool) -> CaptureRecord:
    """Read one record."""
    model = fields.text("camera_model", "OPENCV")
    if model not in LENS_MODELS:
        raise fields.error("camera_model", f"one of {', '.join(LENS_MODELS)}", model)
    intrinsics = Intrinsics(
        fields.integer("w", low=1, high=2**16),
        fields.integer("h", low=1, high=2**16),
        fields.number("fl_x", low=1e-3, high=1e9),
        fields.number("fl_y", low=1e-3, high=1e9),
        fields.number("cx", low=-1e9, high=1e9),
        fields.number("cy", low=-1e9, high=1e9),
    )
    pose = fields.matrix("transform_matrix") @ _OPENGL_TO_OPENCV
    coefficients = tuple(
        fields.number(name, 0.0, low=-MAX_COEFFICIENT, high=MAX_COEFFICIENT) for name in COEFFICIENT_NAMES
    )
    try:
        undistortion = Undistortion.fit(Lens(coefficients, LENS_MODELS[model]), intrinsics, keep)
    except BeamError as error:  # it has no inverse: say where
        raise AssetFormatError(f"{model} has no pinhole at {fields.where}: {error}") from error
    try:
        camera = undistortion.camera(pose)
    except BeamError as error:  # the pose is not rigid: say where
        raise AssetFormatError(f"transform_matrix is no camera pose at {fields.where}: {error}") from error
    file_path = fields.text("file_path")
    beside = mask_beside(root, file_path) if has_masks else None
    image_name = PurePosixPath(file_path.replace("\\", "/"))
    parts = [*(part for part in image_name.parts[:-1] if part not in ("/", "..")), image_name.stem]
    return CaptureRecord(
        camera_name=fields.file_stem("camera", "_".join(parts)),
        frame=fields.integer("frame", 0, low=0, high=MAX_FRAME),
        time=fields.number("time", 0.0, low=-1e9, high=1e9),
        split=fields.text("split", splits.get(file_path, "train")),
        camera=camera,
        image_path=root / file_path,
        mask_path=root / fields.text("mask_path") if fields.values.get("mask_path") is not None else beside,
        color_space=_color_space(fields),
        truth_path=root / fields.text("truth") if fields.values.get("truth") is not None else None,
        relit_paths=fields.paths("relit", root),
        undistortion=None if undistortion.lens.is_straight else undistortion,
    )


def _color_space(fields: _Fields) -> str | None:
    if fields.values.get("color_space") is None:
        return None
    name = fields.text("color_space")
    if name not in COLOR_SPACES:
        raise fields.error("color_space", f"one of {', '.join(COLOR_SPACES)}", name)
    return COLOR_SPACES[name]


def mask_beside(root: Path, file_path: str) -> Path | None:
    """Return the mask that lies in a capture's folder of masks where the image lies in that of images, if it does."""
    image = PurePosixPath(file_path.replace("\\", "/"))
    parts = image.parts[1:] if image.parts[:1] == (IMAGE_FOLDER,) else image.parts
    inner = PurePosixPath(*parts)
    for name in (inner.with_suffix(".png"), inner.with_name(inner.name + ".png")):
        path = root / MASK_FOLDER / name
        if path.is_file():
            return path
    return None


def _read_json(path: Path) -> dict[str, Any]:
    """Read one JSON object from a file."""
    if not path.is_file():
        raise MissingFileError(f"capture must be a folder with {FILE_NAME}, got {path} (no such file). Check the path.")
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise AssetFormatError(
                f"capture must be smaller than {MAX_FILE_BYTES} bytes, got more at {path}. Split it."
            )
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise MissingFileError(f"capture must be readable, got {path} ({error.strerror}). Check the rights.") from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise AssetFormatError(f"capture must be JSON in UTF-8, got {reason} at {path}. Correct the file.") from error
    if not isinstance(content, dict):
        raise AssetFormatError(f"capture must be a JSON object, got {_shown(content)} at {path}. Correct the file.")
    return content


def _shown(value: Any) -> str:
    """Show a value in a message, shortened."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
