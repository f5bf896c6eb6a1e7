"""Loader of captures in nerfstudio's layout: a ``transforms.json`` beside the images.

The file states intrinsics for all records or for each one, and for each record a camera-to-world pose in OpenGL axes
(x right, y up, looking down -z), which is turned into `Camera`'s OpenCV axes. Further fields of a record, which
nerfstudio does not have, describe a performance: ``time``, ``frame``, ``camera``, ``split`` and ``color_space``; and,
for measuring errors, ``truth`` and ``relit``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.lenses import COEFFICIENT_NAMES, MAX_COEFFICIENT
from beam_warp.capture.records import (
    COLOR_SPACES,
    MAX_RECORDS,
    CaptureContents,
    CaptureRecord,
    Photograph,
    SparsePoints,
    camera_name_of,
    mask_beside,
    plate_beside,
    read_json,
)
from beam_warp.capture.undistort import Intrinsics
from beam_warp.checks import is_text
from beam_warp.converters.ply.container import read_columns, read_header
from beam_warp.errors import AssetFormatError, MissingFileError
from beam_warp.image.color import srgb_to_linear
from beam_warp.image.film import film_times, is_film
from beam_warp.world.camera import OPENGL_TO_OPENCV

FILE_NAME = "transforms.json"
"""Name of the file that describes the capture."""

MAX_FILE_BYTES = 2**27
"""Largest file that is read; a million records take about half of it."""

MAX_FRAME = 10**9
"""Largest frame number that is read."""

CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FISHEYE")
"""Camera models that are read; nerfstudio too treats all but the last one alike."""


def read(path: Path, keep: float) -> CaptureContents:
    """Read a ``transforms.json``; see `Capture.read` for ``keep`` and errors."""
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
    shared = {name: content[name] for name in _SHARED_NAMES if name in content}
    records, seen, fields = [], {}, _Fields(content, str(path))
    rate = fields.number("fps", low=1e-3, high=1e6) if "fps" in content else None
    for index, entry in enumerate(listed):
        where = f"{path}, frames[{index}]"
        if not isinstance(entry, dict):
            raise AssetFormatError(f"record must be an object, got {_shown(entry)} at {where}. Write it as one.")
        named = _Fields({**shared, **entry}, where)
        first = _record(named, root, splits, keep)
        rate = _rate_of(first.image_path) if rate is None and is_film(first.image_path) else rate
        for record in [first] if rate is None or not is_film(first.image_path) else _shots(first, named, rate):
            if record.name in seen:
                raise AssetFormatError(
                    f"camera and frame must be another pair in each record, got {record.name} "
                    f"at {where} and frames[{seen[record.name]}]. Number the frames or name the cameras apart."
                )
            seen[record.name] = index
            records.append(record)
    environment = root / fields.text("environment", "environment.exr")
    if "environment" in content and not environment.is_file():
        raise MissingFileError(f"environment must be a file, got {environment} (named in {path}). Correct the name.")
    return CaptureContents(
        folder=root,
        records=tuple(records),
        frames_per_second=rate,
        environment_path=environment if environment.is_file() else None,
        read_points=partial(read_points, root / fields.text("ply_file_path")) if "ply_file_path" in content else None,
    )


def _rate_of(path: Path) -> float | None:
    """Return the rate of a video [1/s]; None for one of a single frame."""
    times = film_times(path)
    return 1.0 / float(np.median(np.diff(times))) if len(times) > 1 else None


def _shots(record: CaptureRecord, fields: _Fields, rate: float) -> Iterator[CaptureRecord]:
    """Yield a record for each frame of a video, or for the one that is stated: those that it shows at the right time.

    Frame k is what is shown nearest to k frames' time after ``video_start``, the time of the first frame; where nothing
    is within half a frame of that, the camera has dropped the frame, and there is no record.
    """
    times = film_times(record.image_path)
    start = fields.number("video_start", float(times[0]), low=-1e6, high=1e6)
    stated = fields.values.get("frame") is not None
    count = max(int((times[-1] - start) * rate + 1.5), 0)
    for frame in [record.frame] if stated else range(min(count, MAX_RECORDS)):
        due = start + frame / rate
        moment = float(times[np.argmin(np.abs(times - due))])
        if abs(moment - due) <= 0.5 / rate:
            yield replace(record, frame=frame, time=frame / rate, moment=moment)


def read_points(path: Path) -> SparsePoints:
    """Read the points of a PLY file, with colours if it has any, which are bytes of sRGB.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: It is damaged, has no positions, or has some that are not finite.
    """
    header = read_header(path)
    element = header.element("vertex")
    properties = element.names if element else tuple("xyz")  # without the element, reading says what is there
    if missing := [name for name in "xyz" if name not in properties]:
        raise AssetFormatError(f"points must have x, y and z, got no {missing[0]} in {path}. Export points.")
    names = ("red", "green", "blue")
    groups = [tuple("xyz"), *([names] if set(names) <= set(properties) else [])]
    positions, *colors = read_columns(header, "vertex", groups, np.float64)
    if not np.isfinite(positions).all():
        raise AssetFormatError(f"points must be finite, got NaN or infinity in {path}. Drop those points.")
    if not colors:
        return SparsePoints(positions)
    codes = {column.code for column in element.properties if column.name in names} if element else set()
    if codes != {"u1"}:
        raise AssetFormatError(f"colours of points must be bytes, got {sorted(codes)} in {path}. Export them as uchar.")
    return SparsePoints(positions, srgb_to_linear(colors[0] / 255.0).astype(np.float32))


class _Fields:
    """One JSON object, read field by field; errors name the field and where the object is."""

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
        """Return an integer in range; ``320.0`` counts as one."""
        value = self.number(name, default, low=low, high=high)
        if value != math.floor(value):
            raise self.error(name, "an integer", value)
        return int(value)

    def text(self, name: str, default: str | None = None) -> str:
        """Return a text that is not empty."""
        value = self._get(name, default)
        if not is_text(value):
            raise self.error(name, "a text", value)
        return value

    def texts(self, name: str) -> list[str]:
        """Return a list of texts; an empty one if the field is absent."""
        value = self.values.get(name, [])
        if not isinstance(value, list) or not all(map(is_text, value)):
            raise self.error(name, "a list of texts", value)
        return value

    def file_stem(self, name: str, default: str) -> str:
        """Return a text that is safe in a file name."""
        value = self.text(name, default)
        if value in (".", "..") or any(c in '/\\:*?"<>|' or not c.isprintable() for c in value):
            raise self.error(name, "fit for a file name", value)
        return value

    def path(self, name: str, root: Path) -> Path | None:
        """Return a named file; None if the field is absent."""
        return None if self.values.get(name) is None else root / self.text(name)

    def paths(self, name: str, root: Path) -> dict[str, Path]:
        """Return named files; none if the field is absent."""
        value = self.values.get(name, {})
        if not isinstance(value, dict) or not all(map(is_text, value.values())):
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
        """Make the error of a field that breaks its contract."""
        found = _shown(value) if value is not None else "nothing"
        return AssetFormatError(f"{name} must be {contract}, got {found} at {self.where}. Correct the file.")

    def _get(self, name: str, default: Any) -> Any:
        value = self.values.get(name)
        return default if value is None else value


_SHARED_NAMES = ("w", "h", "fl_x", "fl_y", "cx", "cy", *COEFFICIENT_NAMES, "camera_model", "color_space")
"""Fields of the whole file that apply to every record that does not state them itself."""


def _record(fields: _Fields, root: Path, splits: Mapping[str, str], keep: float) -> CaptureRecord:
    """Read one record."""
    model = fields.text("camera_model", "OPENCV")
    if model not in CAMERA_MODELS:
        raise fields.error("camera_model", f"one of {', '.join(CAMERA_MODELS)}", model)
    photograph = Photograph.of(
        Intrinsics(
            fields.integer("w", low=1, high=2**16),
            fields.integer("h", low=1, high=2**16),
            fields.number("fl_x", low=1e-3, high=1e9),
            fields.number("fl_y", low=1e-3, high=1e9),
            fields.number("cx", low=-1e9, high=1e9),
            fields.number("cy", low=-1e9, high=1e9),
        ),
        tuple(fields.number(name, 0.0, low=-MAX_COEFFICIENT, high=MAX_COEFFICIENT) for name in COEFFICIENT_NAMES),
        model,
        fields.where,
    )
    camera, undistortion = photograph.undistort(
        fields.matrix("transform_matrix") @ OPENGL_TO_OPENCV, "transform_matrix", keep
    )
    file_path = fields.text("file_path")
    camera_name = fields.file_stem("camera", camera_name_of(file_path))
    return CaptureRecord(
        camera_name=camera_name,
        frame=fields.integer("frame", 0, low=0, high=MAX_FRAME),
        time=fields.number("time", 0.0, low=-1e9, high=1e9),
        split=fields.text("split", splits.get(file_path, "train")),
        camera=camera,
        image_path=root / file_path,
        mask_path=fields.path("mask_path", root) or mask_beside(root, file_path),
        plate_path=fields.path("plate_path", root) or plate_beside(root, camera_name),
        color_space=_color_space(fields),
        truth_path=fields.path("truth", root),
        relit_paths=fields.paths("relit", root),
        undistortion=undistortion,
    )


def _color_space(fields: _Fields) -> str | None:
    if fields.values.get("color_space") is None:
        return None
    name = fields.text("color_space")
    if name not in COLOR_SPACES:
        raise fields.error("color_space", f"one of {', '.join(COLOR_SPACES)}", name)
    return COLOR_SPACES[name]


def _read_json(path: Path) -> dict[str, Any]:
    """Read one JSON object from a file."""
    if not path.is_file():
        raise MissingFileError(f"capture must be a folder with {FILE_NAME}, got {path} (no such file). Check the path.")
    content = read_json(path, "capture", MAX_FILE_BYTES)
    if not isinstance(content, dict):
        raise AssetFormatError(f"capture must be a JSON object, got {_shown(content)} at {path}. Correct the file.")
    return content


def _shown(value: Any) -> str:
    """Show a value in a message, shortened."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
