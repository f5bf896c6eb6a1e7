"""Reader of PLY files of Gaussians: the 3DGS training layout in any property order, the beam profile, the packed form.

Source of the layout: the exporter of Kerbl et al. 2023: x y z, nx ny nz, f_dc, f_rest channel after channel, opacity
as a logit, scale as natural logs, rot as w x y z. A file without ``scale_2`` (2D Gaussians) is read as flat ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_choice, require_number, rows_at
from beam_warp.converters import compressed_ply
from beam_warp.converters.activations import exp_scale, sigmoid
from beam_warp.converters.colors import BASE_COLOR_ONLY, CAPTURED, NO_COLOR
from beam_warp.converters.frames import DecodedFrame
from beam_warp.converters.options import ReadOptions
from beam_warp.converters.ply_checks import require_log_scales, require_not_linear, require_types
from beam_warp.converters.ply_container import RASTER_WORDS, PlyHeader, PlyTable, malformed, read_header, read_table
from beam_warp.converters.producers import (
    LAYOUTS,
    NORMAL_NAMES,
    MaterialLayout,
    guess_producer,
    material_producer,
    material_properties,
)
from beam_warp.errors import AssetFormatError, BeamError, SchemaVersionError
from beam_warp.image.color import COLOR_SPACES, DISPLAY_SRGB, LINEAR_REC709
from beam_warp.world.axes import AXIS_CODES
from beam_warp.world.metadata import LOW_PASS_RANGE

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
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is infinite or NaN, which a cloud refuses
        if compressed_ply.is_compressed(header):
            fields = compressed_ply.decode(header)
        else:
            fields = _decode(header, options, statements, notes)
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
    layout = "packed in chunks of 256" if compressed_ply.is_compressed(header) else "one property per value"
    return f"PLY, {encoding[header.encoding]}, {layout}"


@dataclass(frozen=True)
class _Statements:
    """Values that the comments of our own writer state, checked."""

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
            raster = _raster(said["beam_raster"]) if "beam_raster" in said else None
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


@dataclass
class _Reading:
    """A file while its columns are read.

    Attributes:
        header: The header.
        options: Statements of the caller.
        statements: Statements of the file.
        notes: List to which assumptions and omissions are added.
        table: The vertices.
        read_names: Properties that have been read.
    """

    header: PlyHeader
    options: ReadOptions
    statements: _Statements
    notes: list[str]
    table: PlyTable
    read_names: set[str]

    def has(self, names: Sequence[str]) -> bool:
        """Return True if the file has all these properties."""
        return set(names) <= set(self.table.names)

    def columns(self, names: Sequence[str]) -> NDArray[np.float32]:
        """Return properties as ``(N, len(names))``."""
        self.read_names |= set(names)
        return self.table.columns(names)


def _decode(header: PlyHeader, options: ReadOptions, statements: _Statements, notes: list[str]) -> dict[str, Any]:
    """Return the fields of a cloud in the file's axes and units."""
    names = _require_gaussians(header)
    reading = _Reading(header, options, statements, notes, read_table(header, "vertex"), set())
    if options.drop_invalid:
        reading.table = _without_invalid_rows(reading.table, notes)
    fields = _geometry(reading)
    fields |= _materials(reading)
    fields |= _radiance(reading, "base_color" in fields)
    unread = [name for name in names if name not in reading.read_names and name not in NORMAL_NAMES]
    if unread:
        notes.append(f"properties left out: {', '.join(unread[:12])}{', …' if len(unread) > 12 else ''}")
    return fields


def _geometry(reading: _Reading) -> dict[str, Any]:
    """Return positions, orientations, scales and opacities."""
    path, activation = reading.header.path, reading.options.activation
    is_flat = not reading.has(_SCALE)
    scales, opacities = reading.columns(_FLAT if is_flat else _SCALE), reading.columns(["opacity"])[:, 0]
    if activation != "linear":
        if activation is None:
            require_not_linear(path, scales, opacities)
        require_log_scales(path, scales)
        finite = np.isfinite(opacities)
        if not finite.all():
            raise malformed(path, "opacity must be finite", f"NaN or infinity at {rows_at(~finite)}", _DROP_REMEDY)
        scales, opacities = exp_scale(scales), sigmoid(opacities)
    if is_flat:
        reading.notes.append("no scale_2: read as 2D Gaussians of thickness 0")
        scales = np.column_stack([scales, np.zeros(len(scales), np.float32)])
    return {
        "positions": reading.columns(_POSITION),
        "orientations": _orientations(path, reading.columns(_ROTATION)),
        "scales": scales,
        "opacities": opacities,
    }


_DROP_REMEDY = "Repair those rows, or drop them with --drop-invalid."


def _without_invalid_rows(table: PlyTable, notes: list[str]) -> PlyTable:
    """Leave out rows that are no valid Gaussian."""
    geometry = table.columns([name for name in table.names if name in (*_POSITION, "opacity", *_SCALE, *_DC)])
    rotations = table.columns(_ROTATION).astype(np.float64)
    valid = np.isfinite(geometry).all(axis=1) & (np.linalg.norm(rotations, axis=1) > 1e-12)
    valid &= np.isfinite(rotations).all(axis=1)
    if not valid.all():
        notes.append(f"{np.count_nonzero(~valid)} of {len(valid)} Gaussians dropped: not finite, or zero quaternions")
    return table if valid.all() else PlyTable(table.names, table.rows[valid])


def _orientations(path: Path, wxyz: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return unit quaternions xyzw; those that are unit already keep their bits."""
    length = _lengths(wxyz)
    bad = ~((length > 1e-12) & np.isfinite(length))
    if bad.any():
        zero = length[int(np.flatnonzero(bad)[0])] <= 1e-12
        got = f"{'a zero quaternion' if zero else 'NaN or infinity'} at {rows_at(bad)}"
        raise malformed(path, "rot_0 … rot_3 must be a quaternion", got, _DROP_REMEDY)
    return _unit(wxyz[:, [1, 2, 3, 0]], length)


def _lengths(vectors: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors, dtype=np.float64))


def _unit(vectors: NDArray[np.float32], lengths: NDArray[np.float64]) -> NDArray[np.float32]:
    """Divide vectors by their lengths, except where these are 1 to rounding."""
    divisor = np.where(np.abs(lengths - 1.0) <= _UNIT_ROUNDING, 1.0, lengths)
    return (vectors / divisor[:, None]).astype(np.float32)


def _radiance(reading: _Reading, has_base_color: bool) -> dict[str, Any]:
    """Return the captured colour, unless the file states that its colour only repeats the material."""
    statements = reading.statements
    rest = [name for name in reading.table.names if name.startswith("f_rest_")]
    present = [name for name in _DC if name in reading.table.names]
    if not present and not rest:
        reading.notes.append("no f_dc_0 … f_dc_2: read without colour")
        return {}
    ordered = tuple(f"f_rest_{index}" for index in range(len(rest)))
    if len(present) != 3 or set(ordered) != set(rest) or len(rest) not in (0, 9, 24, 45, 72):
        raise malformed(
            reading.header.path,
            "spherical harmonics must be f_dc_0 … 2 and f_rest_0 … with 0, 9, 24, 45 or 72 of them",
            f"{len(present)} and {len(rest)}",
            "Export it again with full bands.",
        )
    reading.read_names |= {*_DC, *rest}
    if statements.radiance_meaning == NO_COLOR or (statements.radiance_meaning == BASE_COLOR_ONLY and has_base_color):
        return {}
    if statements.radiance_meaning == BASE_COLOR_ONLY:
        reading.notes.append("colour is base colour times ambient occlusion, not captured radiance")
    radiance = np.empty((len(reading.table.rows), 1 + len(rest) // 3, 3), np.float32)
    radiance[:, 0] = reading.columns(_DC)
    if rest:
        radiance[:, 1:] = reading.columns(ordered).reshape(len(radiance), 3, -1).transpose(0, 2, 1)
    return {"radiance": radiance, "radiance_color_space": statements.radiance_color_space}


def _materials(reading: _Reading) -> dict[str, Any]:
    """Return the material channels and normals whose storage the file or the caller states."""
    asked = reading.options.material_activation
    activation = asked or ("linear" if reading.statements.material_linear else None)
    layout = LAYOUTS[activation or "linear"]
    fields: dict[str, Any] = {}
    found = material_properties(reading.table.names)
    if activation is None and found:
        producer = material_producer(reading.table.names)
        named = f" of {producer[0]}" if producer else ""
        choice = producer[1] if producer and producer[1] else "linear|r3dg|gsir|irgs"
        reading.notes.append(
            f"materials{named} left out ({', '.join(found)}): pass --material-activation {choice} to read them"
        )
    elif activation is not None:
        for channel, (names, activate) in layout.channels.items():
            if reading.has(names):
                values = activate(reading.columns(names))
                fields[channel] = values if len(names) == 3 else values[:, 0]
        if asked is not None and not fields:
            wanted = ", ".join(name for names, _ in layout.channels.values() for name in names)
            raise malformed(
                reading.header.path,
                f"materials of {activation} must have {wanted}",
                ", ".join(found) or "no material channels",
                "Choose another --material-activation, or leave it out.",
            )
    return fields | _normals(reading, layout)


def _normals(reading: _Reading, layout: MaterialLayout) -> dict[str, Any]:
    """Return unit normals, or nothing if the file has the usual zeros."""
    if not reading.has(layout.normals):
        return {}
    normals = reading.columns(layout.normals)
    length = _lengths(normals)
    usable = (length > 1e-6) & np.isfinite(length)
    if not usable.any():
        return {}
    if not usable.all():
        reading.notes.append(f"normals left out: {np.count_nonzero(~usable)} of {len(usable)} are zero or not finite")
        return {}
    return {"normals": _unit(normals, length)}
