"""Writer of SOG, version 2, as bundles and in folders; the format is described in `beam_warp.converters.sog.reader`.

All codes are the nearest ones. Gaussians are put in Morton order of their 16-bit positions, so that neighbouring pixels
are alike, and textures small. The same Gaussians give the same bytes.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp._version import __version__
from beam_warp.converters.common.activations import log_scale
from beam_warp.converters.common.colors import display_radiance, resize_bands
from beam_warp.converters.common.frames import FrameToWrite
from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.common.rotations import SMALLER_LIMIT, to_smaller
from beam_warp.converters.sog.clustering import codebook, nearest_codes, palette
from beam_warp.converters.sog.files import META
from beam_warp.converters.sog.reader import COEFFICIENTS, LARGEST_AT_CODE, PALETTE_COLUMNS, PALETTE_LIMIT
from beam_warp.errors import InvalidOptionError, OutputError
from beam_warp.world.curve import morton_order
from beam_warp.world.gaussians import GaussianCloud

MAX_SIDE = 16_380
"""Largest side of a texture [px]: WebP ends at 16,383, and ours are multiples of 4."""

_ZIP_TIME = (1980, 1, 1, 0, 0, 0)
"""Time of every entry, so that the same Gaussians give the same bytes; it is the first that zip knows."""


Textures = Mapping[str, NDArray[np.uint8]]
"""Textures by the name of their file."""


def encode(frame: FrameToWrite, path: Path, options: WriteOptions) -> None:
    """Write one frame: as a bundle, or, to a ``meta.json``, as files beside it.

    Raises:
        InvalidOptionError: Material channels or degree 4 are asked for, which the format cannot hold.
        OutputError: There are more Gaussians than a texture has pixels.
    """
    meta, textures = sog_of(frame.cloud, frame, options)
    if path.suffix == ".json":
        write_folder(path, meta, textures, frame.beside)
    else:
        _write_bundle(path, meta, textures)


def sog_of(
    cloud: GaussianCloud, frame: FrameToWrite, options: WriteOptions, runs: NDArray[np.integer] | None = None
) -> tuple[dict[str, Any], Textures]:
    """Return meta.json and the textures of Gaussians.

    Args:
        cloud: The Gaussians.
        frame: What the file is to say beside them.
        options: Degree and profile.
        runs: A number for each Gaussian, ``(N,)``: those of a lower one come first. None for Morton order alone.

    Raises:
        InvalidOptionError, OutputError: As for `encode`.
    """
    if options.profile != "standard":
        raise InvalidOptionError(
            f"profile must be standard for SOG, which has no materials, got {options.profile}. Leave it out."
        )
    if len(cloud) > MAX_SIDE**2:
        raise OutputError(f"a SOG must have at most {MAX_SIDE**2} Gaussians, got {len(cloud)}. Write another format.")
    shown, meaning = display_radiance(cloud)
    radiance = resize_bands(shown, options.sh_degree)
    if radiance.shape[1] - 1 not in (0, *COEFFICIENTS.values()):
        raise InvalidOptionError("sh_degree must be at most 3 for SOG, got 4. Pass --sh-degree 3.")
    codes, log_bounds = _position_codes(cloud.positions)
    order = morton_order(codes)
    if runs is not None:
        order = order[np.argsort(runs[order], kind="stable")]
    textures, meta = _textures(cloud, radiance, codes, log_bounds, order)
    meta["beam"] = {"axes": cloud.axes, "framesPerSecond": frame.frames_per_second, "radianceMeaning": meaning}
    if frame.model is not None:
        meta["model"] = frame.model
    return meta, textures


def _textures(
    cloud: GaussianCloud,
    radiance: NDArray[np.float32],
    codes: NDArray[np.uint16],
    log_bounds: NDArray[np.float64],
    order: NDArray[np.intp],
) -> tuple[dict[str, NDArray[np.uint8]], dict[str, Any]]:
    """Return the textures by file name, and meta.json."""
    log_scales = log_scale(cloud.scales[order])
    colors = radiance[order, 0]
    scale_codes, color_codes = codebook(log_scales), codebook(colors)
    opacities = np.rint(cloud.opacities[order] * 255.0).astype(np.uint8)
    positions = codes[order]
    textures = {
        "means_l.webp": _image((positions & np.uint16(255)).astype(np.uint8)),
        "means_u.webp": _image((positions >> np.uint16(8)).astype(np.uint8)),
        "scales.webp": _image(nearest_codes(scale_codes, log_scales)),
        "quats.webp": _image(_rotation_codes(cloud.orientations[order])),
        "sh0.webp": _image(np.column_stack([nearest_codes(color_codes, colors), opacities])),
    }
    meta = {
        "version": 2,
        "asset": {"generator": f"beam-warp {__version__}"},
        "count": len(cloud),
        "means": {
            "mins": log_bounds[0].tolist(),
            "maxs": log_bounds[1].tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": _numbers(scale_codes), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _numbers(color_codes), "files": ["sh0.webp"]},
    }
    if radiance.shape[1] > 1:
        bands, centroids, labels = _bands(radiance[order, 1:])
        meta["shN"] = {**bands, "files": ["shN_centroids.webp", "shN_labels.webp"]}
        textures |= {"shN_centroids.webp": centroids, "shN_labels.webp": _image(labels)}
    return textures, meta


def _position_codes(positions: NDArray[np.float32]) -> tuple[NDArray[np.uint16], NDArray[np.float64]]:
    """Return positions as 16 bits an axis, and the bounds of ``sign(x) ln(1 + |x|)``, ``(2, 3)``."""
    wide = positions.astype(np.float64)
    logs = np.copysign(np.log1p(np.abs(wide)), wide)
    bounds = np.stack([logs.min(axis=0), logs.max(axis=0)]) if len(logs) else np.zeros((2, 3))
    extent = bounds[1] - bounds[0]
    return np.rint((logs - bounds[0]) / np.where(extent > 0.0, extent, 1.0) * 65535.0).astype(np.uint16), bounds


def _rotation_codes(orientations: NDArray[np.float32]) -> NDArray[np.uint8]:
    smaller, largest_at = to_smaller(orientations[:, [3, 0, 1, 2]])
    fraction = np.clip(smaller / SMALLER_LIMIT, -1.0, 1.0) * 0.5 + 0.5
    return np.column_stack([np.rint(fraction * 255.0), largest_at + LARGEST_AT_CODE]).astype(np.uint8)


def _bands(rest: NDArray[np.float32]) -> tuple[dict[str, Any], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the statements on higher bands ``(N, K, 3)``, the texture of their palette, and the labels' codes."""
    coefficients = rest.shape[1]
    size = min(PALETTE_LIMIT, max(PALETTE_COLUMNS, 1 << len(rest).bit_length() >> 1))  # half of the Gaussians, or more
    entries, labels = palette(rest.reshape(len(rest), 3 * coefficients), size)
    codes = codebook(entries)
    rows = max(1, -(-len(entries) // PALETTE_COLUMNS))
    texture = np.zeros((rows * PALETTE_COLUMNS, coefficients, 3), np.uint8)
    texture[: len(entries)] = nearest_codes(codes, entries).reshape(-1, coefficients, 3)
    bands = next(degree for degree, count in COEFFICIENTS.items() if count == coefficients)
    split = np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels)]).astype(np.uint8)
    statements = {"count": len(entries), "bands": bands, "codebook": _numbers(codes)}
    return statements, texture.reshape(rows, PALETTE_COLUMNS * coefficients, 3), split


def _numbers(codes: NDArray[np.float32]) -> list[float]:
    """Return single-precision numbers with no more digits than they need."""
    return [float(str(code)) for code in codes]


def _image(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Put pixels ``(N, C)`` in rows of an image whose sides are multiples of 4; what is left over is 0."""
    width = max(4, 4 * int(np.ceil(np.sqrt(len(pixels)) / 4.0)))
    height = max(4, 4 * -(-len(pixels) // (4 * width)))
    image = np.zeros((height * width, pixels.shape[1]), np.uint8)
    image[: len(pixels)] = pixels
    return image.reshape(height, width, -1)


def _webp(pixels: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    stream = io.BytesIO()  # exact: colour is kept where alpha is 0
    Image.fromarray(pixels).save(stream, format="WEBP", lossless=True, exact=True, quality=0, method=2)
    return stream.getvalue()


def _write_bundle(path: Path, meta: Mapping[str, Any], textures: Textures) -> None:
    """Write a zip archive of meta.json and the textures, which are compressed already."""
    with ThreadPoolExecutor() as threads, zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as bundle:
        bundle.writestr(zipfile.ZipInfo(META, _ZIP_TIME), json.dumps(meta, separators=(",", ":")))
        for name, content in zip(textures, threads.map(_webp, textures.values()), strict=True):
            bundle.writestr(zipfile.ZipInfo(name, _ZIP_TIME), content)


def write_folder(path: Path, meta: Mapping[str, Any], textures: Textures, beside: Callable[[str], Path]) -> None:
    """Write meta.json, and the textures to the places that ``beside`` gives their names."""
    path.write_text(json.dumps(meta, separators=(",", ":")), encoding="utf-8")
    with ThreadPoolExecutor() as threads:
        for name, content in zip(textures, threads.map(_webp, textures.values()), strict=True):
            beside(name).write_bytes(content)
