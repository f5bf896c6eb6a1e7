"""Store of finished frames: one HDF5 file a frame, written whole or not at all. Workers never share a file.

What a file was computed from, the receipt of its step says (`beam_warp.plan.steps`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zlib import crc32

import h5py
import numpy as np
from numpy.typing import NDArray

from beam_warp.errors import AssetFormatError, OutputError
from beam_warp.outputs import replacing

CHECKSUM = "crc32"


def make_folders(out: Path, *names: str) -> list[Path]:
    """Make a folder for results, those above it and the named ones in it; those that exist stay as they are.

    Raises:
        OutputError: One of them cannot be made.
    """
    folders = [out / name for name in names]
    try:
        for folder in (out, *folders):
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"out must be a folder that can be made, got {out} ({error.strerror}). Choose another place."
        ) from error
    return folders


def write_frame(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a frame's arrays.

    Raises:
        OutputError: The file cannot be written; nothing is left behind.
    """
    with replacing(path) as temporary, h5py.File(temporary, "w") as file:
        for name, array in arrays.items():
            data = np.asarray(array, order="C")
            file.create_dataset(name, data=data, track_times=False).attrs[CHECKSUM] = _checksum(
                data
            )  # same bytes again


def is_stored_frame(path: Path) -> bool:
    """Return whether a file is a whole one of those that `write_frame` writes, going by its structure alone."""
    try:
        with h5py.File(path, "r") as file:
            return all(CHECKSUM in dataset.attrs for dataset in file.values())
    except (OSError, KeyError, RuntimeError, ValueError):
        return False


def frame_names(path: Path) -> tuple[str, ...]:
    """Return the names of a stored frame's arrays."""
    with h5py.File(path, "r") as file:
        return tuple(file)


def read_frame(path: Path, names: tuple[str, ...] | None = None) -> dict[str, NDArray[Any]]:
    """Read a frame's arrays, all or some.

    Raises:
        AssetFormatError: The file is damaged, or lacks one.
    """
    try:
        with h5py.File(path, "r") as file:
            wanted = tuple(file) if names is None else names
            return {name: _checked(file[name]) for name in wanted}
    except (OSError, KeyError, RuntimeError, TypeError, ValueError, MemoryError) as error:
        reason = " ".join(str(error).split())
        raise AssetFormatError(
            f"stored frame must be whole, got a damaged file at {path} ({reason}). Delete it; it is made again."
        ) from error


def _checksum(array: NDArray[Any]) -> int:
    return crc32(array.data if array.size else b"")


def _checked(dataset: Any) -> NDArray[Any]:
    """Read an array, and compare it with its checksum: zeros in a damaged file would be values like any others."""
    array = np.asarray(dataset)
    if _checksum(np.ascontiguousarray(array)) != dataset.attrs[CHECKSUM]:
        raise ValueError(f"another checksum of {dataset.name[1:]}")
    return array
