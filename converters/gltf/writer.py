"""Writer of glTF splats: KHR_gaussian_splatting in ``.glb``, or ``.gltf`` with its ``.bin`` beside it.

All values are single precision, as they are in a cloud; ``COLOR_0`` is what a viewer without the extension shows.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from beam_warp._version import __version__
from beam_warp.converters.common.activations import color_from_dc
from beam_warp.converters.common.colors import display_radiance, resize_bands
from beam_warp.converters.common.frames import FrameToWrite
from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.gltf.container import FLOAT, GLB_CHUNK, GLB_HEADER, UNSIGNED_BYTE, WIDTHS
from beam_warp.converters.gltf.reader import AXES, COLOR_SPACES, EXTENSION, GEOMETRY, MATERIALS, harmonic
from beam_warp.errors import InvalidOptionError, OutputError
from beam_warp.image.color import DISPLAY_SRGB, srgb_to_linear
from beam_warp.world.gaussians import GaussianCloud, sh_degree_of

_TYPES = {width: name for name, width in WIDTHS.items()}


def encode(frame: FrameToWrite, path: Path, options: WriteOptions) -> None:
    """Write one frame; of ``.gltf``, the bytes are written beside it.

    Raises:
        InvalidOptionError: There are no Gaussians, materials are asked for that are not there, or bands that the
            extension does not have.
        OutputError: The file would be too large.
    """
    cloud = frame.cloud
    materials = [name for name in MATERIALS if getattr(cloud, name) is not None] if options.profile == "beam" else []
    if options.profile == "beam" and not materials:
        wanted = ", ".join(MATERIALS)
        raise InvalidOptionError(f"profile beam must have one of {wanted}, got none. Use profile standard.")
    radiance, meaning = display_radiance(cloud)
    space = DISPLAY_SRGB
    if materials and cloud.radiance is not None and cloud.radiance_color_space is not None:
        radiance, space = cloud.radiance, cloud.radiance_color_space
    arrays = _arrays(cloud, resize_bands(radiance, options.sh_degree), space, materials)
    said: dict[str, Any] = {"radiance_meaning": meaning, "frames_per_second": frame.frames_per_second}
    if cloud.axes != AXES:
        said["axes"] = cloud.axes
    if frame.raster is not None:
        said["raster"] = list(frame.raster)
    document = _document(arrays, {"beam": said}, space)
    if path.suffix.lower() == ".gltf":
        name = f"{frame.name}.bin"
        document["buffers"][0]["uri"] = quote(name)
        with frame.beside(name).open("wb") as file:
            file.writelines(array.data for array in arrays.values())
        path.write_text(json.dumps(document, indent=1), encoding="utf-8")
    else:
        _write_glb(path, document, arrays)


def _arrays(
    cloud: GaussianCloud, radiance: NDArray[np.float32], space: str, materials: list[str]
) -> dict[str, NDArray[Any]]:
    """Return the attributes in the order of the file, ``(N, width)``."""
    degree = sh_degree_of(radiance.shape[1])
    if degree > 3 or not len(cloud):
        got = f"{len(cloud)} of degree {degree}"
        raise InvalidOptionError(f"{EXTENSION} must have a Gaussian, of at most degree 3, got {got}. Pass sh_degree 3.")
    arrays = {place: getattr(cloud, name).reshape(len(cloud), width) for name, (place, width) in GEOMETRY.items()}
    names = [harmonic(band, order) for band in range(degree + 1) for order in range(2 * band + 1)]
    arrays |= {name: np.ascontiguousarray(radiance[:, number]) for number, name in enumerate(names)}
    for name in materials:
        place, width = MATERIALS[name]
        arrays[place] = getattr(cloud, name).reshape(len(cloud), width)
    shown = np.clip(color_from_dc(radiance[:, 0]), 0.0, 1.0)
    shown = srgb_to_linear(shown) if space == DISPLAY_SRGB else shown
    color = np.rint(255.0 * np.column_stack([shown, cloud.opacities])).astype(np.uint8)
    return {name: np.ascontiguousarray(array, "<f4") for name, array in arrays.items()} | {"COLOR_0": color}


def _document(arrays: dict[str, NDArray[Any]], extras: dict[str, Any], space: str) -> dict[str, Any]:
    """Return the JSON document of one node with one mesh of points."""
    views, accessors, at = [], [], 0
    for name, array in arrays.items():
        views.append({"buffer": 0, "byteOffset": at, "byteLength": array.nbytes})
        accessor = {
            "bufferView": len(accessors),
            "componentType": FLOAT if array.dtype.kind == "f" else UNSIGNED_BYTE,
            "count": len(array),
            "type": _TYPES[array.shape[1]],
        }
        if name == "POSITION":
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        elif array.dtype.kind == "u":
            accessor["normalized"] = True
        accessors.append(accessor)
        at += array.nbytes
    color_space = next(name for name, ours in COLOR_SPACES.items() if ours == space)
    primitive = {
        "attributes": {name: number for number, name in enumerate(arrays)},
        "mode": 0,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": color_space}},
        "extras": extras,
    }
    return {
        "asset": {"version": "2.0", "generator": f"beam-warp {__version__}"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }


def _write_glb(path: Path, document: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    """Write a GLB; every array has a multiple of 4 bytes, so that chunks are aligned without padding."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = document["buffers"][0]["byteLength"]
    total = GLB_HEADER.size + 2 * GLB_CHUNK.size + len(text) + size
    if total >= 1 << 32:
        raise OutputError(f"a GLB must be under 4 GiB, got {total / 2**30:.2f} GiB. Write fewer Gaussians, or .gltf.")
    with path.open("wb") as file:
        file.write(GLB_HEADER.pack(b"glTF", 2, total) + GLB_CHUNK.pack(len(text), b"JSON") + text)
        file.write(GLB_CHUNK.pack(size, b"BIN\0"))
        file.writelines(array.data for array in arrays.values())
