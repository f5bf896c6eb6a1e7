"""glTF splats: reader of the extension KHR_gaussian_splatting in ``.gltf`` and ``.glb``, its SPZ form included.

Primitives of the scene are joined in the order of its nodes, each moved by its node's transform. glTF is right-handed
with y up, the front of an asset faces +z, and its own left is +x. Whoever faces that front has x to the right and z
towards them, and so has a camera: these are the axes here, as for meshes.

A writer of ours adds materials as attributes that other readers skip (`MATERIALS`), and in the primitive's ``extras``
an object ``beam`` with ``radiance_meaning``, ``raster``, ``frames_per_second``, and ``axes`` if they are others.

Source: Khronos, glTF 2.0, "Coordinate System and Units"; "KHR_gaussian_splatting", release candidate of 2026, and the
draft "KHR_gaussian_splatting_compression_spz_2", whose bytes are taken as they are stored, as CesiumJS takes them.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_choice, require_number
from beam_warp.converters.common.colors import BASE_COLOR_ONLY, CAPTURED, NO_COLOR, resize_bands
from beam_warp.converters.common.frames import DecodedFrame
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.gltf.container import GltfFile, read_gltf
from beam_warp.converters.spz import reader as spz
from beam_warp.errors import AssetFormatError, BeamError
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.schema.placement import Placement, placement_of
from beam_warp.world.axes import require_axes
from beam_warp.world.gaussians import MAX_SH_DEGREE
from beam_warp.world.metadata import LOW_PASS_RANGE
from beam_warp.world.quaternions import rotation_matrices

AXES = "rub"
"""Axes of a file that states no others."""

_TURNING = "splat-transform"
"""Generator whose files face the other way than ours; both stand upright."""

EXTENSION = "KHR_gaussian_splatting"

COLOR_SPACES = {"srgb_rec709_display": DISPLAY_SRGB, "lin_rec709_display": LINEAR_REC709}
"""Colour spaces of the extension and ours. Both of glTF are display-referred; ours of linear values is of the scene."""

GEOMETRY = {
    "positions": ("POSITION", 3),
    "orientations": (f"{EXTENSION}:ROTATION", 4),
    "scales": (f"{EXTENSION}:SCALE", 3),
    "opacities": (f"{EXTENSION}:OPACITY", 1),
}
"""Arrays of a cloud, with the attribute that holds each and its width."""

MATERIALS = {
    "base_color": ("_BEAM_BASE_COLOR", 3),
    "roughness": ("_BEAM_ROUGHNESS", 1),
    "ambient_occlusion": ("_BEAM_AMBIENT_OCCLUSION", 1),
    "normals": ("_BEAM_NORMAL", 3),
}
"""Material channels likewise, linear as in a cloud."""

_SPZ = (f"{EXTENSION}_compression_spz_2", f"{EXTENSION}_compression_spz")
_OLDER_SPZ = "KHR_spz_gaussian_splats_compression"
"""Extension of a primitive, before there was `EXTENSION`; files of Cesium's older tools have it."""

_KNOWN = (EXTENSION, *_SPZ, _OLDER_SPZ, "KHR_mesh_quantization")

_UNIT_ROUNDING = 1e-6
"""Largest difference of a length from 1 that is float32 rounding; such quaternions are kept bit for bit."""

_MOST_NODES, _MOST_PRIMITIVES = 10_000, 1000
"""Most nodes and primitives of a scene."""

_MOST_REPEATED, _LEAST_BYTES = 1 << 18, 8
"""Gaussians that any scene may have, and bytes of a file for each where there are more: SPZ has ten, accessors 56."""


def harmonic(degree: int, order: int) -> str:
    """Return the attribute of a coefficient; ``order`` counts from 0."""
    return f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"


@dataclass(frozen=True)
class _Splats:
    """A primitive with splats, where a node of the scene places it."""

    placement: Placement
    primitive: dict[str, Any]


def probe(path: Path) -> int:
    """Read the document and count the Gaussians that its scene places."""
    file = read_gltf(path)
    return sum(_count(file, splats.primitive) for splats in _splats(file))


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is refused by a cloud
def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read the Gaussians of a file.

    Raises:
        MissingFileError: The file or one that it names is not there.
        AssetFormatError: The file holds no splats, or breaks glTF or the extension.
    """
    del options  # they are settled when the frame is placed
    file = read_gltf(path)
    found = _splats(file)
    notes: list[str] = []
    parts = [_part(file, splats, notes) for splats in found]
    meaning, raster, rate, axes = _statements(file, found[0].primitive)
    fields = _joined(file, parts, notes)
    if meaning == NO_COLOR or (meaning == BASE_COLOR_ONLY and "base_color" in fields):
        del fields["radiance"]
    else:
        fields["radiance_color_space"] = _color_space(file, [splats.primitive for splats in found], notes)
    generator = file.object(file.content, "asset").get("generator")
    if isinstance(generator, str) and generator.startswith(_TURNING):
        notes.append(f"{_TURNING} turns its input by 180° about z: pass --source-axes luf to undo it")
    return DecodedFrame(
        fields=fields,
        format="glTF, " + ("JSON" if file.chunk is None else "binary"),
        producer=f"{_shown(generator)} (asset.generator)" if isinstance(generator, str) else "unknown",
        axes=axes,
        frames_per_second=rate,
        color_space_is_stated=True,
        radiance_meaning=meaning,
        raster=raster,
        notes=tuple(dict.fromkeys(notes)),
    )


def _shown(text: str) -> str:
    """Return a text of the file as a terminal may show it."""
    return "".join(letter if letter.isprintable() else "?" for letter in text[:80])


def _splats(file: GltfFile) -> list[_Splats]:
    """Return the splats of the scene in the order of its nodes."""
    unknown = [str(name) for name in file.items(file.content, "extensionsRequired") if name not in _KNOWN]
    unknown = [_shown(name) for name in unknown if not name.startswith("KHR_materials_")]
    if unknown:
        raise file.error("extensionsRequired must be known", ", ".join(unknown[:4]), "Export it without them.")
    meshes: dict[int, list[dict[str, Any]]] = {}
    found = []
    for mesh, matrix in _placed_meshes(file):
        if mesh not in meshes:
            primitives = file.items(file.item("meshes", mesh), "primitives")
            meshes[mesh] = [primitive for primitive in primitives if _extension(file, primitive) is not None]
        if meshes[mesh]:
            placement = placement_of(matrix, 1.0, f"{file.path.name}: mesh {mesh}")
            found += [_Splats(placement, primitive) for primitive in meshes[mesh]]
        if len(found) > _MOST_PRIMITIVES:
            raise file.error(f"a scene must place at most {_MOST_PRIMITIVES} primitives", "more", "Join them.")
    if not found:
        got = f"{len(file.items(file.content, 'meshes'))} meshes without it"
        raise file.error(f"the scene must have points with {EXTENSION}", got, "Train Gaussians from a mesh first.")
    total = sum(_count(file, splats.primitive) for splats in found)
    most = max(_MOST_REPEATED, file.held() // _LEAST_BYTES)
    if total > most:
        raise file.error(f"the scene must have at most {most} Gaussians", str(total), "Export it without repetition.")
    return found


def _placed_meshes(file: GltfFile) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield the meshes of the scene, each with the transform of row vectors from it to the world."""
    nodes = file.items(file.content, "nodes")
    if file.items(file.content, "scenes"):
        roots = file.items(file.item("scenes", file.number(file.content, "scene", 0)), "nodes")
    else:
        children = {str(c) for n in range(len(nodes)) for c in file.items(file.item("nodes", n), "children")}
        roots = [number for number in range(len(nodes)) if str(number) not in children]
    waiting, seen = [(root, np.eye(4)) for root in reversed(roots)], set()
    while waiting:
        number, parent = waiting.pop()
        node = file.item("nodes", number)
        if number in seen:
            raise file.error("a node must have one parent", f"several for node {number}")
        if len(seen) == _MOST_NODES:
            raise file.error(f"a scene must have at most {_MOST_NODES} nodes", "more", "Export the splats alone.")
        seen.add(number)
        with np.errstate(all="ignore"):  # what overflows is refused at a mesh
            matrix = _transform(file, node) @ parent
        if "mesh" in node:
            if not (np.abs(matrix) < 1e30).all():
                raise file.error("transforms must stay below 1e30", f"more at node {number}")
            yield file.number(node, "mesh"), matrix
        waiting += [(child, matrix) for child in reversed(file.items(node, "children"))]


def _transform(file: GltfFile, node: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return a node's transform of row vectors, ``p' = p M``; glTF's columns are its rows."""
    holder = dict(node)
    if "matrix" in node:
        return file.vector(holder, "matrix", (0.0,) * 16).reshape(4, 4)
    matrix = np.eye(4)
    matrix[3, :3] = file.vector(holder, "translation", (0.0, 0.0, 0.0))
    if "rotation" in node:
        rotation = file.vector(holder, "rotation", (0.0,) * 4)
        if not np.linalg.norm(rotation) > 1e-6:
            raise file.error("rotation must be a quaternion", repr(node["rotation"]))
        matrix[:3, :3] = rotation_matrices(rotation).T
    matrix[:3, :3] *= file.vector(holder, "scale", (1.0, 1.0, 1.0))[:, None]
    return matrix


def _extension(file: GltfFile, primitive: Any) -> dict[str, Any] | None:
    """Return the extension of a primitive with splats; None of others."""
    if not isinstance(primitive, dict):
        raise file.error("a primitive must be an object", repr(primitive))
    extensions = file.object(primitive, "extensions")
    if _OLDER_SPZ in extensions:
        return {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "extensions": extensions}
    return file.object(extensions, EXTENSION) if EXTENSION in extensions else None


def _attributes(file: GltfFile, primitive: dict[str, Any]) -> dict[str, Any]:
    return file.object(primitive, "attributes")


def _count(file: GltfFile, primitive: dict[str, Any]) -> int:
    """Return the number of Gaussians of a primitive."""
    return file.count(_attributes(file, primitive).get("POSITION"))


def _part(file: GltfFile, splats: _Splats, notes: list[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a primitive, in the axes of the scene."""
    primitive, extension = splats.primitive, _extension(file, splats.primitive) or {}
    if primitive.get("mode", 4) != 0:
        raise file.error("splats must be points, mode 0", repr(primitive.get("mode", 4)))
    if extension.get("kernel") != "ellipse":
        notes.append(f"kernel is not ellipse but {_shown(repr(extension.get('kernel')))}: read as ellipses")
    packed = file.object(extension, "extensions")
    form = next((name for name in (*_SPZ, _OLDER_SPZ) if name in packed), None)
    arrays = _plain(file, primitive) if form is None else _unpacked(file, file.object(packed, form), notes)
    count = _count(file, primitive)
    if wrong := [name for name, array in arrays.items() if len(array) != count]:
        raise file.error(f"all attributes must have {count} elements", f"{len(arrays[wrong[0]])} for {wrong[0]}")
    return arrays if splats.placement.is_identity else splats.placement.apply(arrays)


def _unpacked(file: GltfFile, form: dict[str, Any], notes: list[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays of splats that are stored as SPZ."""
    content, _ = file.view(form.get("bufferView"))
    fields = dict(spz.unpack(io.BytesIO(content.tobytes()), file.path).fields)
    del fields["radiance_color_space"]
    notes.append("SPZ is taken as stored, as CesiumJS does; the draft asks for half a turn: --source-axes luf")
    return fields


def _plain(file: GltfFile, primitive: dict[str, Any]) -> dict[str, NDArray[Any]]:
    """Return the arrays of splats whose attributes are accessors."""
    attributes = _attributes(file, primitive)
    if missing := [name for name, _ in (*GEOMETRY.values(), (harmonic(0, 0), 3)) if name not in attributes]:
        raise file.error(f"splats must have {', '.join(missing)}", ", ".join(map(_shown, attributes)))
    wanted = {**GEOMETRY, **{name: place for name, place in MATERIALS.items() if place[0] in attributes}}
    arrays = {name: file.array(attributes[attribute], width) for name, (attribute, width) in wanted.items()}
    arrays = {name: array[:, 0] if array.shape[1] == 1 else array for name, array in arrays.items()}
    lengths = np.linalg.norm(arrays["orientations"], axis=1, keepdims=True)
    off = np.abs(lengths - 1.0) > _UNIT_ROUNDING  # integers are; a cloud refuses a length of 0
    arrays["orientations"] = arrays["orientations"] / np.where(off & (lengths > 0.0), lengths, 1.0)
    arrays["radiance"] = _harmonics(file, attributes)
    return arrays


def _harmonics(file: GltfFile, attributes: Mapping[str, Any]) -> NDArray[np.float32]:
    """Return spherical harmonics ``(N, K, 3)``; each band is whole, and those below it are there."""
    names = [harmonic(degree, order) for degree in range(MAX_SH_DEGREE + 1) for order in range(2 * degree + 1)]
    present = [name for name in names if name in attributes]
    if present != names[: len(present)] or len(present) not in (1, 4, 9, 16, 25):
        lacking = next(name for name in names if name not in attributes)
        raise file.error("bands of spherical harmonics must be whole", f"none of {lacking} beside {present[-1]}")
    radiance = np.empty((file.count(attributes[names[0]]), len(present), 3), np.float32)
    for place, name in enumerate(present):
        array = file.array(attributes[name], 3)
        if len(array) != len(radiance):
            raise file.error(f"{name} must have {len(radiance)} elements", str(len(array)))
        radiance[:, place] = array
    return radiance


def _joined(file: GltfFile, parts: list[dict[str, NDArray[Any]]], notes: list[str]) -> dict[str, Any]:
    """Return the arrays of all primitives one after the other, bands padded with zeros to the most."""
    degree = max(round(np.sqrt(part["radiance"].shape[1])) - 1 for part in parts)
    for part in parts:
        part["radiance"] = resize_bands(part["radiance"], degree)
    kept = set.intersection(*(set(part) for part in parts))
    if left_out := sorted(set().union(*parts) - kept):
        notes.append(f"left out, since not all of {len(parts)} primitives have it: {', '.join(left_out)}")
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0] if name in kept}


def _color_space(file: GltfFile, primitives: list[dict[str, Any]], notes: list[str]) -> str:
    """Return the colour space of all primitives."""
    stated = {repr((_extension(file, primitive) or {}).get("colorSpace")) for primitive in primitives}
    known = {repr(name): space for name, space in COLOR_SPACES.items()}
    if len(stated) != 1 or not stated <= set(known):
        wanted = f"colorSpace must be one of {', '.join(COLOR_SPACES)}, the same everywhere"
        raise file.error(wanted, ", ".join(sorted(stated)), "State it.")
    space = known[stated.pop()]
    if space == LINEAR_REC709:
        notes.append("linear display-referred colour is taken as scene-linear")
    return space


def _statements(file: GltfFile, primitive: dict[str, Any]) -> tuple[str | None, tuple[bool, float] | None, float, str]:
    """Return what our writer states: the meaning of the colour, how splats are drawn, the playback rate, the axes."""
    said = file.object(file.object(primitive, "extras"), "beam")
    meaning, raster = said.get("radiance_meaning"), said.get("raster")
    try:
        if meaning is not None:
            require_choice("radiance_meaning", meaning, (CAPTURED, BASE_COLOR_ONLY, NO_COLOR))
        if raster is not None:
            antialiased, low_pass = raster
            raster = (bool(antialiased), require_number("raster", low_pass, *LOW_PASS_RANGE))
        rate = require_number("frames_per_second", said.get("frames_per_second", 30.0), 1e-3, 1e6)
        return meaning, raster, rate, require_axes("axes", said.get("axes", AXES))
    except (BeamError, TypeError, ValueError) as error:
        raise AssetFormatError(f"{file.path.name}: extras.beam: {error}") from error
