"""Reader of PLY files of Gaussians: the 3DGS training layout in any property order, the beam profile, the packed form.

Source of the layout: the exporter of Kerbl et al. 2023: x y z, nx ny nz, f_dc, f_rest channel after channel, opacity
as a logit, scale as natural logs, rot as w x y z. A file without ``scale_2`` (2D Gaussians) is read as flat ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.blocks import replace_rows
from beam_warp.checks import require_choice, require_number
from beam_warp.converters.common.activations import exp_scale, sigmoid
from beam_warp.converters.common.colors import BASE_COLOR_ONLY, CAPTURED, NO_COLOR
from beam_warp.converters.common.errors import malformed
from beam_warp.converters.common.frames import DecodedFrame
from beam_warp.converters.common.options import MaterialActivation, ReadOptions
from beam_warp.converters.ply import compressed
from beam_warp.converters.ply.checks import require_not_linear, require_rotations, require_types, settle_log_scales
from beam_warp.converters.ply.container import RASTER_WORDS, PlyHeader, read_columns, read_header
from beam_warp.converters.ply.producers import (
    LAYOUTS,
    NORMAL_NAMES,
    guess_producer,
    material_producer,
    material_properties,
)
from beam_warp.errors import AssetFormatError, BeamError, SchemaVersionError
from beam_warp.image.color import COLOR_SPACES, DISPLAY_SRGB, LINEAR_REC709
from beam_warp.world.axes import AXIS_CODES
from beam_warp.world.metadata import LOW_PASS_RANGE, UNSTATED_RASTER

_POSITION = ("x", "y", "z")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_SCALE = ("scale_0", "scale_1", "scale_2")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_FLAT = _SCALE[:2]
_UNIT_ROUNDING = 1e-6
"""Largest difference of a length from 1 that is float32 rounding; such vectors are kept bit for bit."""


def probe(path: Path) -> PlyHeader:
    """Read the header and check that the file is as long as it says."""
    return read_header(path)


def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read the Gaussians of a file.

    Raises:
        AssetFormatError: It holds no Gaussians, or values outside their contract; the message names file and row.
    """
    header = read_header(path)
    statements = _Statements.of(header)
    notes: list[str] = []
    if compressed.is_compressed(header):
        fields = compressed.decode(header, options.drop_invalid)
        if statements.radiance_meaning == NO_COLOR:  # the layout has a place for colour that is not there
            del fields["radiance"], fields["radiance_color_space"]
    else:
        fields = _decode(header, options, statements, notes)
    if header.render_mode == "2dgs" and fields["scales"][:, 2].any():
        fields["scales"][:, 2] = 0.0
        notes.append("SplatRenderMode 2dgs: read as 2D Gaussians of thickness 0")
    return DecodedFrame(
        fields=fields,
        format=_format(header),
        producer=guess_producer(header),
        axes=statements.axes,
        meters_per_unit=statements.meters_per_unit,
        frames_per_second=statements.frames_per_second,
        color_space_is_stated="beam_radiance_color_space" in header.statements,
        radiance_meaning=statements.radiance_meaning,
        raster=statements.raster,
        comments=header.comments,
        notes=tuple(notes),
    )


def _format(header: PlyHeader) -> str:
    encoding = {"ascii": "text", "binary_little_endian": "binary", "binary_big_endian": "big-endian binary"}
    layout = "packed in chunks of 256" if compressed.is_compressed(header) else "one property per value"
    return f"PLY, {encoding[header.encoding]}, {layout}"


@dataclass(frozen=True)
class _Statements:
    """Values that comments state, nearly all of them those of our own writer; checked."""

    axes: str | None
    meters_per_unit: float
    frames_per_second: float
    material_linear: bool
    radiance_meaning: str | None
    radiance_color_space: str
    raster: tuple[bool, float] | None

    @classmethod
    def of(cls, header: PlyHeader) -> _Statements:
        said = header.statements
        version = said.get("beam_schema", "1.0")
        if version.split(".")[0] != "1":
            raise SchemaVersionError(
                f"{header.path.name}: beam_schema must be 1.x, got {version}. Update beam-warp to read it."
            )
        for key, allowed in (
            ("beam_axes", AXIS_CODES),
            ("beam_material", ("linear",)),
            ("beam_base_color_space", (LINEAR_REC709,)),
            ("beam_radiance_color_space", COLOR_SPACES),
            ("beam_radiance_meaning", (CAPTURED, BASE_COLOR_ONLY, NO_COLOR)),
        ):
            if key in said and said[key] not in allowed:
                choices = ", ".join(allowed) if len(allowed) < 5 else "an axis code such as rdf"
                raise malformed(header.path, f"comment {key} must be {choices}", said[key], "Correct that line.")
        try:
            units = require_number("beam_meters_per_unit", said.get("beam_meters_per_unit", 1.0), 1e-6, 1e6)  # type: ignore[arg-type]
            rate = said.get("beam_frame", "0 30").rpartition(" ")[2]
            frames_per_second = require_number("beam_frame's rate", rate, 1e-3, 1e6)  # type: ignore[arg-type]
            mip = (True, UNSTATED_RASTER[1]) if header.render_mode == "mip" else None
            raster = _raster(said["beam_raster"]) if "beam_raster" in said else mip
        except BeamError as error:
            raise AssetFormatError(f"{header.path.name}: {error}") from error
        return cls(
            axes=said.get("beam_axes"),
            meters_per_unit=units,
            frames_per_second=frames_per_second,
            material_linear="beam_material" in said,
            radiance_meaning=said.get("beam_radiance_meaning"),
            radiance_color_space=said.get("beam_radiance_color_space", DISPLAY_SRGB),
            raster=raster,
        )


def _raster(text: str) -> tuple[bool, float]:
    """Parse ``antialiased 0.1``, which states how splats are to be drawn."""
    word, _, low_pass = text.partition(" ")
    require_choice("beam_raster", word, tuple(RASTER_WORDS.values()))
    return word == RASTER_WORDS[True], require_number("beam_raster's low-pass", low_pass, *LOW_PASS_RANGE)  # type: ignore[arg-type]


def _require_gaussians(header: PlyHeader) -> tuple[str, ...]:
    """Check that a file holds Gaussians in the training layout; return its property names."""
    vertex = header.element("vertex")
    names = vertex.names if vertex else ()
    missing = [name for name in (*_POSITION, "opacity", *_FLAT, *_ROTATION) if name not in names]
    if vertex is None or missing:
        raise malformed(
            header.path,
            f"Gaussians must have the properties {', '.join(missing)}",
            f"vertices with {', '.join(names[:16]) or 'nothing'}",
            "This is a point cloud or a mesh: train Gaussians from it first."
            if set(_POSITION) <= set(names) and not {"opacity", "rot_0", "scale_0"} & set(names)
            else "Export it again as 3DGS PLY.",
        )
    used = (*_POSITION, "opacity", *_SCALE, *_ROTATION, *_DC, *(n for n in names if n.startswith("f_rest_")))
    require_types(header.path, vertex, tuple(name for name in used if name in names), ("f4", "f8"))
    return names


_Groups = dict[str, tuple[str, ...]]
"""Names of the columns that each field of a cloud is made of."""


def _decode(header: PlyHeader, options: ReadOptions, statements: _Statements, notes: list[str]) -> dict[str, Any]:
    """Return the fields of a cloud in the file's axes and units."""
    names = _require_gaussians(header)
    material = options.material_activation or ("linear" if statements.material_linear else None)
    layout = LAYOUTS[material or "linear"]
    groups = _geometry_groups(names, notes)
    groups |= _material_groups(header, names, options, material, notes)
    groups |= {"normals": layout.normals} if set(layout.normals) <= set(names) else {}
    groups |= _radiance_groups(header, names, statements, "base_color" in groups, notes)
    met = {*NORMAL_NAMES, *_DC, *(name for group in groups.values() for name in group)}
    if unread := [name for name in names if name not in met and not name.startswith("f_rest_")]:
        notes.append(f"properties left out: {', '.join(unread[:12])}{', …' if len(unread) > 12 else ''}")

    fields: dict[str, Any] = dict(zip(groups, read_columns(header, "vertex", list(groups.values())), strict=True))
    _activate(header.path, fields, options)
    for name, (_, activate) in layout.channels.items():
        if name in fields:
            replace_rows(activate, fields[name])
    for name in ("opacities", "roughness", "ambient_occlusion"):
        if name in fields:
            fields[name] = fields[name][:, 0]
    if "radiance" in fields:
        fields["radiance"] = fields["radiance"].reshape(len(fields["radiance"]), len(groups["radiance"]) // 3, 3)
        fields["radiance_color_space"] = statements.radiance_color_space
    if "normals" in fields and not _make_unit_normals(fields["normals"], notes):
        del fields["normals"]
    return fields


def _geometry_groups(names: tuple[str, ...], notes: list[str]) -> _Groups:
    """Return the columns of positions, orientations, scales and opacities."""
    is_flat = not set(_SCALE) <= set(names)
    if is_flat:
        notes.append("no scale_2: read as 2D Gaussians of thickness 0")
    return {
        "positions": _POSITION,
        "orientations": (*_ROTATION[1:], _ROTATION[0]),
        "scales": _FLAT if is_flat else _SCALE,
        "opacities": ("opacity",),
    }


def _activate(path: Path, fields: dict[str, Any], options: ReadOptions) -> None:
    """Make scales and opacities linear and quaternions unit, in place."""
    scales, opacities = fields["scales"], fields["opacities"]
    if options.activation != "linear":
        if options.activation is None:
            require_not_linear(path, scales, opacities)
        settle_log_scales(path, scales, options.drop_invalid)
        replace_rows(exp_scale, scales)
        replace_rows(sigmoid, opacities)
    if scales.shape[1] == 2:
        fields["scales"] = np.column_stack([scales, np.zeros(len(scales), np.float32)])
    replace_rows(_unit, fields["orientations"])
    if not options.drop_invalid:
        require_rotations(path, fields["orientations"])


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Divide vectors by their lengths; a zero vector stays zero, and one that is unit to rounding keeps its bits."""
    lengths = np.sqrt(np.einsum("ij,ij->i", vectors, vectors, dtype=np.float64))
    divisor = np.where((np.abs(lengths - 1.0) <= _UNIT_ROUNDING) | (lengths == 0.0), 1.0, lengths)
    return (vectors / divisor[:, None]).astype(np.float32)


def _radiance_groups(
    header: PlyHeader, names: tuple[str, ...], statements: _Statements, has_base_color: bool, notes: list[str]
) -> _Groups:
    """Return the columns of the captured colour, unless the file states that its colour only repeats the material."""
    rest = [name for name in names if name.startswith("f_rest_")]
    present = [name for name in _DC if name in names]
    if not present and not rest:
        notes.append("no f_dc_0 … f_dc_2: read without colour")
        return {}
    ordered = tuple(f"f_rest_{index}" for index in range(len(rest)))
    if len(present) != 3 or set(ordered) != set(rest) or len(rest) not in (0, 9, 24, 45, 72):
        raise malformed(
            header.path,
            "spherical harmonics must be f_dc_0 … 2 and f_rest_0 … with 0, 9, 24, 45 or 72 of them",
            f"{len(present)} and {len(rest)}",
            "Export it again with full bands.",
        )
    if statements.radiance_meaning == NO_COLOR or (statements.radiance_meaning == BASE_COLOR_ONLY and has_base_color):
        return {}
    if statements.radiance_meaning == BASE_COLOR_ONLY:
        notes.append("colour is base colour times ambient occlusion, not captured radiance")
    bands = len(rest) // 3  # of a channel; the file has channel after channel, a cloud coefficient after coefficient
    return {"radiance": (*_DC, *(ordered[channel * bands + k] for k in range(bands) for channel in range(3)))}


def _material_groups(
    header: PlyHeader,
    names: tuple[str, ...],
    options: ReadOptions,
    activation: MaterialActivation | None,
    notes: list[str],
) -> _Groups:
    """Return the columns of the material channels whose storage the file or the caller states."""
    found = material_properties(names)
    if activation is None:
        if found:
            producer = material_producer(names)
            named = f" of {producer[0]}" if producer else ""
            choice = producer[1] if producer and producer[1] else "linear|r3dg|gsir|irgs"
            notes.append(
                f"materials{named} left out ({', '.join(found)}): pass --material-activation {choice} to read them"
            )
        return {}
    channels = LAYOUTS[activation].channels
    groups = {name: columns for name, (columns, _) in channels.items() if set(columns) <= set(names)}
    if options.material_activation is not None and not groups:
        wanted = ", ".join(name for columns, _ in channels.values() for name in columns)
        raise malformed(
            header.path,
            f"materials of {activation} must have {wanted}",
            ", ".join(found) or "no material channels",
            "Choose another --material-activation, or leave it out.",
        )
    return groups


def _make_unit_normals(normals: NDArray[np.float32], notes: list[str]) -> bool:
    """Normalise normals in place; return False if the file has the usual zeros, or has them in part."""
    squares = np.einsum("ij,ij->i", normals, normals, dtype=np.float64)
    usable = (squares > 1e-12) & np.isfinite(squares)
    if usable.any() and not usable.all():
        notes.append(f"normals left out: {np.count_nonzero(~usable)} of {len(usable)} are zero or not finite")
    if not usable.all():
        return False
    replace_rows(_unit, normals)
    return bool(len(normals))
