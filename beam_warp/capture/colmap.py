"""Loader of COLMAP models: ``cameras``, ``images`` and ``points3D``, as text or binary.

COLMAP's poses are world-to-camera in `Camera`'s axes, and its pixel (0, 0) has its centre at (0.5, 0.5), as ours has.
COLMAP's world states no unit and no up direction: coordinates are kept as they are.

Source: COLMAP's documentation, "Output Format", and its camera models; binary files are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.lenses import COEFFICIENT_NAMES
from beam_warp.capture.records import (
    IMAGE_FOLDER,
    MAX_RECORDS,
    CaptureContents,
    CaptureRecord,
    Photograph,
    SparsePoints,
    camera_name_of,
    mask_beside,
    plate_beside,
    read_bytes,
    read_text,
)
from beam_warp.capture.undistort import Intrinsics
from beam_warp.errors import AssetFormatError
from beam_warp.image.color import srgb_to_linear
from beam_warp.world.quaternions import matrix_of

FOLDERS = ("", "sparse", "sparse/0")
"""Folders below a capture in which its model is looked for, in this order."""

SUFFIXES = (".bin", ".txt")
"""Forms of a model; if both exist, the binary one is read, which has all digits."""

MODELS = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2"),
}
"""Camera models that `Lens` can express: COLMAP's number and parameters of each."""

OTHER_MODELS = {6: "FULL_OPENCV", 7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE"}
"""Camera models that are refused by name."""

MAX_NAME_BYTES = 4096
"""Longest image name that is read [byte]."""

_POINT_2D_BYTES = 24
_TRACK_BYTES = 8
_NAMES_BY_NUMBER = {number: name for name, (number, _) in MODELS.items()}


@dataclass(frozen=True, eq=False)
class _Pose:
    """One row of ``images``: a world-to-camera pose (quaternion with w first), its camera and its image."""

    quaternion: NDArray[np.float64]
    translation: NDArray[np.float64]
    camera: int
    name: str
    where: str


def find(folder: Path) -> tuple[Path, str] | None:
    """Return the folder of a capture's model and the suffix of its files, or None if there is none."""
    for model in (folder / inner for inner in FOLDERS):
        for suffix in SUFFIXES:
            if (model / f"cameras{suffix}").is_file() and (model / f"images{suffix}").is_file():
                return model, suffix
    return None


def read(folder: Path, model: Path, suffix: str, keep: float) -> CaptureContents:
    """Read a model whose images lie in ``folder/images`` or, if there is no such folder, in ``folder``.

    Args:
        folder: The capture.
        model: Folder that `find` returned.
        suffix: Suffix that `find` returned.
        keep: See `Capture.read`.

    Raises:
        MissingFileError: A file cannot be read.
        AssetFormatError: A file is truncated or damaged, a camera model is not one of `MODELS`, an image names a camera
            that does not exist, a pose is not rigid, or a lens cannot be inverted; the message names file and row.
    """
    binary = suffix == ".bin"
    cameras_path, images_path = model / f"cameras{suffix}", model / f"images{suffix}"
    photographs = _binary_cameras(cameras_path) if binary else _text_cameras(cameras_path)
    images_folder = folder / IMAGE_FOLDER if (folder / IMAGE_FOLDER).is_dir() else folder
    records: list[CaptureRecord] = []
    seen: dict[str, str] = {}
    for row in _binary_poses(images_path) if binary else _text_poses(images_path):
        record = _record(row, photographs, folder, images_folder, keep)
        if record.name in seen:
            raise AssetFormatError(
                f"image names must differ without their suffix, got {row.name} and {seen[record.name]} at {row.where}. "
                "Rename one of them."
            )
        seen[record.name] = row.name
        records.append(record)
    if not records:
        raise AssetFormatError(f"images must be at least one, got none at {images_path}. Register some.")
    points = model / f"points3D{suffix}"
    read_points = partial(_binary_points if binary else _text_points, points) if points.is_file() else None
    return CaptureContents(folder=folder, records=tuple(records), read_points=read_points)


def _record(row: _Pose, photographs: dict[int, Photograph], folder: Path, images: Path, keep: float) -> CaptureRecord:
    if row.camera not in photographs:
        raise AssetFormatError(
            f"camera of an image must be one of cameras, got {row.camera} at {row.where}. Export the model again."
        )
    length = float(np.linalg.norm(row.quaternion))
    if not (0.99 <= length <= 1.01 and np.isfinite(row.translation).all()):
        raise AssetFormatError(
            f"pose must be a unit quaternion and a finite translation, got |q| = {length:.4g} and "
            f"{row.translation.tolist()} at {row.where}. Export the model again."
        )
    name = row.name.replace("\\", "/")
    if not name or Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
        raise AssetFormatError(f"image name must be a path below images, got {row.name!r} at {row.where}. Rename it.")
    camera, undistortion = photographs[row.camera].undistort(
        _camera_to_world(row.quaternion / length, row.translation), "pose", keep
    )
    return CaptureRecord(
        camera_name=camera_name_of(name),
        camera=camera,
        image_path=images / name,
        mask_path=mask_beside(folder, name),
        plate_path=plate_beside(folder, camera_name_of(name)),
        undistortion=undistortion,
    )


def _camera_to_world(quaternion: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert a world-to-camera pose, given as a unit quaternion (w first) and a translation."""
    rotation = matrix_of(quaternion[[1, 2, 3, 0]])
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ translation
    return pose


def _photograph(model: str, width: int, height: int, parameters: list[float], where: str) -> Photograph:
    """Make a camera of a model's parameters, which are told apart by their names."""
    if not (0 < width <= 2**16 and 0 < height <= 2**16):
        raise AssetFormatError(
            f"size of a camera must be in [1, {2**16}] px, got {width} x {height} at {where}. Correct the file."
        )
    values = dict(zip(MODELS[model][1].split(), parameters, strict=True))
    focal_x, focal_y = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    bound = {"fx": (focal_x, 1e-3, 1e9), "fy": (focal_y, 1e-3, 1e9)}
    bound |= {name: (values[name], -1e9, 1e9) for name in ("cx", "cy")}
    for name, (value, low, high) in bound.items():
        if not (low <= value <= high):
            raise AssetFormatError(
                f"{name} of a camera must be a number in [{low:g}, {high:g}], got {value:g} at {where}. "
                "Correct the file."
            )
    intrinsics = Intrinsics(width, height, focal_x, focal_y, values["cx"], values["cy"])
    return Photograph.of(intrinsics, tuple(values.get(name, 0.0) for name in COEFFICIENT_NAMES), model, where)


def _refused(model: str, where: str) -> AssetFormatError:
    return AssetFormatError(
        f"camera model must be one of {', '.join(MODELS)}, got {model} at {where}. Undistort the images with COLMAP "
        "(image_undistorter), or estimate another model."
    )


def _cut(path: Path) -> AssetFormatError:
    return AssetFormatError(
        f"model must hold what it counts, got a file cut short or damaged at {path}. Copy it again."
    )


class _Bytes:
    """A binary file, read from front to back; no count is believed that the file's length does not allow."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = read_bytes(path)
        self.place = 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Return the next values."""
        if self.place + layout.size > len(self.data):
            raise _cut(self.path)
        values = layout.unpack_from(self.data, self.place)
        self.place += layout.size
        return values

    def count(self, least: int, most: int = 2**63) -> int:
        """Return a count of items that take at least ``least`` bytes each, all within the file."""
        (count,) = self.take(_COUNT)
        if count > most or count * least > len(self.data) - self.place:
            raise _cut(self.path)
        return count

    def skip_list(self, size: int) -> None:
        """Skip a list of items of ``size`` bytes each, with the count before it."""
        count = self.count(size)
        self.place += count * size

    def name(self) -> str:
        """Return a text that ends in a zero byte."""
        end = self.data.find(b"\0", self.place, self.place + MAX_NAME_BYTES)
        if end < 0:
            raise _cut(self.path)
        text = self.data[self.place : end]
        self.place = end + 1
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError as error:
            raise _cut(self.path) from error

    def finish(self) -> None:
        """Refuse bytes that are left over."""
        if self.place != len(self.data):
            raise _cut(self.path)


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3Bd")


def _binary_cameras(path: Path) -> dict[int, Photograph]:
    source, found = _Bytes(path), {}
    for index in range(source.count(_CAMERA.size + 24, MAX_RECORDS)):
        number, model, width, height = source.take(_CAMERA)
        where = f"{path}, camera {index}"
        if model not in _NAMES_BY_NUMBER:
            raise _refused(OTHER_MODELS.get(model, f"number {model}"), where)
        name = _NAMES_BY_NUMBER[model]
        parameters = source.take(struct.Struct(f"<{len(MODELS[name][1].split())}d"))
        found[number] = _photograph(name, width, height, list(parameters), where)
    source.finish()
    return found


def _binary_poses(path: Path) -> Iterator[_Pose]:
    source = _Bytes(path)
    for index in range(source.count(_IMAGE.size + 1 + _COUNT.size, MAX_RECORDS)):
        values = source.take(_IMAGE)
        name = source.name()
        source.skip_list(_POINT_2D_BYTES)
        yield _Pose(np.array(values[1:5]), np.array(values[5:8]), values[8], name, f"{path}, image {index}")
    source.finish()


def _binary_points(path: Path) -> SparsePoints:
    source = _Bytes(path)
    count = source.count(_POINT.size + _COUNT.size)
    positions, colors = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for index in range(count):
        values = source.take(_POINT)
        positions[index], colors[index] = values[1:4], values[4:7]
        source.skip_list(_TRACK_BYTES)
    source.finish()
    return _points(path, positions, colors)


def _points(path: Path, positions: NDArray[np.float64], colors: NDArray[np.uint8]) -> SparsePoints:
    if not np.isfinite(positions).all():
        raise AssetFormatError(f"points must be finite, got NaN or infinity in {path}. Export the model again.")
    return SparsePoints(positions, srgb_to_linear(colors / 255.0).astype(np.float32))


class _Line:
    """The words of one line; errors name its place."""

    def __init__(self, text: str, where: str) -> None:
        self.words = text.split()
        self.where = where

    def whole(self, index: int) -> int:
        """Return a whole number that is not negative."""
        word = self._word(index)
        if not (word.isascii() and word.isdigit() and len(word) <= 19):
            raise self._error(f"a whole number as word {index + 1}", word)
        return int(word)

    def numbers(self, start: int, end: int | None = None) -> list[float]:
        """Return some words as numbers, which may be infinite or NaN."""
        if end is not None:
            self._word(end - 1)
        try:
            return [float(word) for word in self.words[start:end]]
        except ValueError as error:
            raise self._error(f"numbers from word {start + 1}", " ".join(self.words[start:end])) from error

    def _word(self, index: int) -> str:
        if index >= len(self.words):
            raise self._error(f"at least {index + 1} words", f"{len(self.words)}")
        return self.words[index]

    def _error(self, contract: str, got: str) -> AssetFormatError:
        return AssetFormatError(f"line must have {contract}, got {got[:60]!r} at {self.where}. Copy the file again.")


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Return the lines of a text file with their numbers, without comments; empty lines are kept."""
    return ((number, line) for number, line in enumerate(read_text(path).splitlines(), 1) if not line.startswith("#"))


def _text_cameras(path: Path) -> dict[int, Photograph]:
    found = {}
    for number, text in _lines(path):
        line = _Line(text, f"{path}, line {number}")
        if not line.words:
            continue
        model = line.words[1] if len(line.words) > 1 else "none"
        if model not in MODELS:
            raise _refused(model, line.where)
        parameters = line.numbers(4)
        names = MODELS[model][1].split()
        if len(parameters) != len(names):
            raise AssetFormatError(
                f"{model} must have the parameters {' '.join(names)}, got {len(parameters)} numbers at {line.where}. "
                "Copy the file again."
            )
        found[line.whole(0)] = _photograph(model, line.whole(2), line.whole(3), parameters, line.where)
    return found


def _text_poses(path: Path) -> Iterator[_Pose]:
    """Yield the poses of a text file: two lines for each image, of which the second lists points and may be empty."""
    lines = _lines(path)
    for number, text in lines:
        line = _Line(text, f"{path}, line {number}")
        if not line.words:
            continue
        values = line.numbers(1, 8)
        camera = line.whole(8)
        words = text.split(maxsplit=9)
        if len(words) < 10:
            raise AssetFormatError(f"image must have a name, got none at {line.where}. Copy the file again.")
        following = next(lines, None)
        if following is not None and len(following[1].split()) % 3:
            raise AssetFormatError(
                f"points of an image must be triples, got {len(following[1].split())} words at {path}, line "
                f"{following[0]}. Copy the file again."
            )
        yield _Pose(np.array(values[:4]), np.array(values[4:]), camera, words[9].strip(), line.where)


def _text_points(path: Path) -> SparsePoints:
    positions, colors = [], []
    for number, text in _lines(path):
        line = _Line(text, f"{path}, line {number}")
        if not line.words:
            continue
        positions.append(line.numbers(1, 4))
        color = [line.whole(index) for index in (4, 5, 6)]
        if max(color) > 255:
            raise AssetFormatError(f"colour must be three bytes, got {color} at {line.where}. Copy the file again.")
        colors.append(color)
    shape = (len(positions), 3)
    return _points(path, np.array(positions, float).reshape(shape), np.array(colors, np.uint8).reshape(shape))
