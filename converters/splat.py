"""`.splat` files: 32 bytes a Gaussian, without a header, and without view-dependent colour.

Source of the layout: antimatter15/splat. A row has a position and linear standard deviations as six float32, then red,
green, blue and opacity as bytes of [0, 1], then a quaternion w x y z as bytes of 128 + 128 v. Axes and units are not
stated; they are those of the PLY from which such files are made.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beam_warp.checks import rows_at
from beam_warp.converters.common.activations import color_from_dc, dc_from_color
from beam_warp.converters.common.colors import display_radiance
from beam_warp.converters.common.frames import DecodedFrame, FrameToWrite
from beam_warp.converters.common.options import ReadOptions, WriteOptions
from beam_warp.errors import AssetFormatError
from beam_warp.image.color import DISPLAY_SRGB

_ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def probe(path: Path) -> int:
    """Return the number of rows.

    Raises:
        AssetFormatError: The file is no whole number of rows long.
    """
    size = path.stat().st_size
    if size % _ROW.itemsize:
        raise AssetFormatError(
            f"{path.name} must have rows of {_ROW.itemsize} bytes, got {size} bytes. Export or copy the file again."
        )
    return size // _ROW.itemsize


def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read a file.

    Raises:
        AssetFormatError: It is cut short, or a quaternion is zero.
    """
    rows = np.fromfile(path, _ROW, probe(path))
    wxyz = (rows["rotation"].astype(np.float32) - 128.0) / 128.0
    length = np.linalg.norm(wxyz, axis=1, keepdims=True)
    zero = length[:, 0] == 0.0
    if zero.any() and not options.drop_invalid:
        raise AssetFormatError(
            f"{path.name}: rotations must be quaternions, got a zero quaternion at {rows_at(zero)}. "
            "Drop those rows with --drop-invalid."
        )
    color = rows["color"].astype(np.float32) / 255.0
    return DecodedFrame(
        fields={
            "positions": rows["position"],
            "orientations": (wxyz / np.where(zero[:, None], 1.0, length))[:, [1, 2, 3, 0]],
            "scales": rows["scale"],
            "opacities": color[:, 3],
            "radiance": dc_from_color(color[:, None, :3]),
            "radiance_color_space": DISPLAY_SRGB,
        },
        format="splat, 32 bytes a Gaussian",
    )


def encode(frame: FrameToWrite, path: Path, options: WriteOptions) -> None:
    """Write one frame: the mean colour over all directions, clipped to [0, 1], and every value rounded to nearest."""
    del options  # degree 0 is all that fits
    cloud = frame.cloud
    rows = np.empty(len(cloud), _ROW)
    rows["position"], rows["scale"] = cloud.positions, cloud.scales
    color = color_from_dc(display_radiance(cloud)[0][:, 0])
    rows["color"] = np.rint(255.0 * np.clip(np.column_stack([color, cloud.opacities]), 0.0, 1.0))
    wxyz = cloud.orientations[:, [3, 0, 1, 2]]
    largest = np.take_along_axis(wxyz, np.abs(wxyz).argmax(axis=1)[:, None], axis=1)
    negative = wxyz * -np.sign(largest)  # the same rotation; -1 fits into the byte, and +1 does not
    rows["rotation"] = np.clip(np.rint(128.0 + 128.0 * negative), 0.0, 255.0)
    rows.tofile(path)
