"""Reader of SOG, the compressed splats of PlayCanvas: textures of 8-bit codes, and the tables that decode them.

Every Gaussian has one pixel in textures of one size, row after row. Positions are 16 bits an axis between bounds of
``sign(x) ln(1 + |x|)``, in two textures; rotations are the three smaller of w, x, y, z over ± sqrt(1/2) with alpha
252 + place of the largest; scales are codes of natural logs; colour is a code of the zeroth coefficient, with
opacity in alpha; the higher bands are rows of a palette, 64 to a row of texture and one pixel a coefficient, whose row
number has 16 bits in R and G. In version 2, codes are looked up in codebooks of 256 numbers. In version 1 they lie
evenly between bounds, and opacity is a logit.

Source: PlayCanvas user manual, "The SOG Format"; version 1, codebooks that begin with null, and the entry ``model``:
the files that SplatTransform writes and reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import rows_at
from beam_warp.converters.common.activations import LOG_SCALE_LIMITS, exp_scale, sigmoid
from beam_warp.converters.common.colors import BASE_COLOR_ONLY, CAPTURED, NO_COLOR
from beam_warp.converters.common.frames import DecodedFrame
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.common.rotations import SMALLER_LIMIT, from_smaller
from beam_warp.converters.sog.files import SogFiles, open_sog
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.axes import AXIS_CODES
from beam_warp.world.metadata import UNSTATED_RASTER

COEFFICIENTS = {1: 3, 2: 8, 3: 15}
"""Coefficients above the zeroth, by degree."""

PALETTE_COLUMNS = 64
"""Entries in a row of the palette's texture."""

PALETTE_LIMIT = 2**16
"""Entries of the largest palette: their numbers have 16 bits."""

LARGEST_AT_CODE = 252
"""Alpha of a rotation whose largest component is the first, w."""

_CODES = np.arange(256) / 255.0

_FREE_COUNT = 2**18
"""Gaussians that a SOG of any size may have."""

_COUNT_PER_BYTE = 4
"""Gaussians that a larger SOG may have for every byte; those of real scenes have 5 bytes or more each."""


@dataclass(frozen=True)
class SogHeader:
    """What meta.json and the headers of the textures say, checked against each other.

    Attributes:
        count: Number of Gaussians.
        names: File names of each group of textures.
        sizes: Width and height of each texture, by its file name [px].
        log_bounds: Least and greatest position as ``sign(x) ln(1 + |x|)``, ``(2, 3)``.
        log_scales: Table of each axis, ``(3, 256)``.
        colors: Table of the zeroth coefficient for R, G and B, ``(3, 256)``.
        opacities: Table of opacities, ``(256,)``.
        rest: Table of the coefficients above the zeroth, ``(256,)``, or None without any.
        palette_count: Entries of the palette.
        meta: All of meta.json.
    """

    count: int
    names: Mapping[str, list[str]]
    sizes: Mapping[str, tuple[int, int]]
    log_bounds: NDArray[np.float64]
    log_scales: NDArray[np.float64]
    colors: NDArray[np.float64]
    opacities: NDArray[np.floating]
    rest: NDArray[np.float64] | None
    palette_count: int
    meta: Mapping[str, Any]


def probe(path: Path) -> SogHeader:
    """Read meta.json and the textures' headers, and check them against each other.

    Raises:
        MissingFileError, AssetFormatError: There is no SOG, or a malformed one.
    """
    with open_sog(path) as files:
        return _read_header(files)


def decode(path: Path, options: ReadOptions) -> DecodedFrame:
    """Read the Gaussians of a SOG.

    Args:
        path: Bundle, folder with a meta.json, or that meta.json.
        options: Only ``drop_invalid`` matters here; it accepts rotations that are marked as none.

    Raises:
        MissingFileError: There is nothing at ``path``.
        AssetFormatError: The SOG is malformed; the message names the file in it.
    """
    notes: list[str] = []
    with open_sog(path) as files:
        header = _read_header(files)
        said = _own_statements(files, header.meta)
        fields = _fields(files, header, options)
    model = _model(header.meta, notes)
    if model == "2dgs":
        fields["scales"][:, 2] = 0.0
    if said.get("radiance_meaning") == NO_COLOR:
        del fields["radiance"], fields["radiance_color_space"]
    return DecodedFrame(
        fields=fields,
        format=f"SOG version {header.meta.get('version', 1)}, {'folder' if files.is_folder else 'bundle'}",
        producer=_producer(header.meta),
        raster=(True, UNSTATED_RASTER[1]) if model == "antialiased" else None,
        notes=tuple(notes),
        **said,
    )


def _model(meta: Mapping[str, Any], notes: list[str]) -> object:
    """Return how splats are to be drawn, in the word of the file, and note what that changes."""
    model = meta.get("model", "antialiased" if meta.get("antialias") is True else "default")
    if model == "2dgs":
        notes.append("model 2dgs: read as 2D Gaussians of thickness 0")
    elif model not in ("default", "antialiased"):
        notes.append(f"model {str(model)[:40]!r} is unknown: read as the usual one")
    return model


def _producer(meta: Mapping[str, Any]) -> str:
    asset = meta.get("asset")
    generator = asset.get("generator") if isinstance(asset, dict) else None
    if not isinstance(generator, str):
        return "unknown"
    printable = "".join(letter if letter.isprintable() else "?" for letter in generator[:80])
    return f"{printable}, by its meta.json"


def _own_statements(files: SogFiles, meta: Mapping[str, Any]) -> dict[str, Any]:
    """Return what our own writer adds to meta.json, checked."""
    if not isinstance(said := meta.get("beam"), dict):
        return {}
    axes, rate, meaning = (said.get(key) for key in ("axes", "framesPerSecond", "radianceMeaning"))
    if axes not in AXIS_CODES or meaning not in (CAPTURED, BASE_COLOR_ONLY, NO_COLOR):
        raise files.malformed("beam must state axes and a meaning of colour", repr(said)[:80])
    rate = float(_numbers(files, "beam.framesPerSecond", rate, 1)[0])
    if not 1e-3 <= rate <= 1e6:
        raise files.malformed("beam.framesPerSecond must lie in [0.001, 1e+06]", f"{rate:g}")
    return {"axes": axes, "frames_per_second": rate, "radiance_meaning": meaning, "color_space_is_stated": True}


def _read_header(files: SogFiles) -> SogHeader:
    meta = files.meta()
    version = meta.get("version", 1)
    if version not in (1, 2) or isinstance(version, bool):
        raise files.malformed("version must be 1 or 2", repr(version)[:40], "Update beam-warp to read it.")
    groups = {name: _group(files, meta, name) for name in ("means", "scales", "quats", "sh0")}
    if meta.get("shN") is not None:
        groups["shN"] = _group(files, meta, "shN")
    names = {
        name: _file_names(files, name, group, 2 if name in ("means", "shN") else 1) for name, group in groups.items()
    }
    count = _count(files, meta["count"] if version == 2 and "count" in meta else _first_of_shape(groups["means"]))
    if version == 2:
        scales, colors = (np.tile(_codebook(files, name, groups[name]), (3, 1)) for name in ("scales", "sh0"))
        opacities = _CODES
        rest = _codebook(files, "shN", groups["shN"]) if "shN" in groups else None
    else:
        scales, colors = (_evenly(files, name, groups[name], size) for name, size in (("scales", 3), ("sh0", 4)))
        opacities = sigmoid(colors[3])
        rest = _evenly(files, "shN", groups["shN"], 1)[0] if "shN" in groups else None
    if not (scales <= LOG_SCALE_LIMITS[1]).all():
        raise files.malformed(f"scales must be natural logs up to {LOG_SCALE_LIMITS[1]:g}", f"{scales.max():g}")
    sizes = {name: files.texture_size(name) for group in names.values() for name in group}
    _require_sizes(files, names, sizes, count)
    return SogHeader(
        count=count,
        names=names,
        sizes=sizes,
        log_bounds=np.stack([_numbers(files, f"means.{key}", groups["means"].get(key), 3) for key in ("mins", "maxs")]),
        log_scales=scales,
        colors=colors[:3],
        opacities=opacities,
        rest=rest,
        palette_count=_palette_count(files, groups["shN"], sizes[names["shN"][0]], version) if "shN" in groups else 0,
        meta=meta,
    )


def _group(files: SogFiles, meta: Mapping[str, Any], name: str) -> dict[str, Any]:
    group = meta.get(name)
    if not isinstance(group, dict):
        raise files.malformed(
            f"{files.meta_name} must describe {name}", "nothing" if group is None else repr(group)[:40]
        )
    return group


def _file_names(files: SogFiles, name: str, group: Mapping[str, Any], count: int) -> list[str]:
    """Return the texture names of a group, which must lie beside meta.json."""
    names = group.get("files")
    if not isinstance(names, list) or len(names) != count or not all(_is_plain(each) for each in names):
        raise files.malformed(f"{name}.files must be {count} plain file names", repr(names)[:80])
    return names


def _is_plain(name: object) -> bool:
    return isinstance(name, str) and 0 < len(name) < 256 and name.isprintable() and not {*name} & {*"/\\:"}


def _first_of_shape(means: Mapping[str, Any]) -> object:
    shape = means.get("shape")
    return shape[0] if isinstance(shape, list) and shape else None


def _count(files: SogFiles, count: object) -> int:
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count < 2**31:
        raise files.malformed("count must be a number of Gaussians below 2^31", repr(count)[:40])
    return count


def _numbers(files: SogFiles, name: str, values: object, count: int) -> NDArray[np.float64]:
    """Return finite numbers of meta.json."""
    numbers = [values] if count == 1 and not isinstance(values, list) else values
    right = isinstance(numbers, list) and len(numbers) == count
    if right and all(isinstance(v, (int, float)) and abs(v) <= 1e38 for v in numbers):  # type: ignore[union-attr]
        return np.array(numbers, np.float64)
    raise files.malformed(f"{name} must be {count} finite numbers", repr(values)[:60])


def _codebook(files: SogFiles, name: str, group: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return the table of a codebook. If its first number is null, it goes on as the others do in the mean."""
    codes = group.get("codebook")
    if isinstance(codes, list) and len(codes) == 256 and codes[0] is None:
        rest = _numbers(files, f"{name}.codebook", codes[1:], 255)
        return np.concatenate([[rest[0] + (rest[0] - rest[-1]) / 255.0], rest])
    return _numbers(files, f"{name}.codebook", codes, 256)


def _evenly(files: SogFiles, name: str, group: Mapping[str, Any], count: int) -> NDArray[np.float64]:
    """Return the tables of version 1, ``(count, 256)``: numbers evenly between bounds."""
    low, high = (_numbers(files, f"{name}.{key}", group.get(key), count)[:, None] for key in ("mins", "maxs"))
    return low * (1.0 - _CODES) + high * _CODES


def _require_sizes(
    files: SogFiles, names: Mapping[str, list[str]], sizes: Mapping[str, tuple[int, int]], count: int
) -> None:
    """Refuse textures of Gaussians that differ in size, or fit neither their number nor the size of the files."""
    size = sum(files.bytes_of(name) for name in sizes)
    if count > _FREE_COUNT + _COUNT_PER_BYTE * size:
        raise files.malformed(f"{size} bytes must hold at most {_COUNT_PER_BYTE} Gaussians each", f"count {count}")
    first = names["means"][0]
    width, height = sizes[first]
    if not count <= width * height <= 4 * count + _FREE_COUNT:
        raise files.malformed(f"{first} must have a pixel for each of {count} Gaussians", f"{width} x {height} px")
    for name in [*names["means"], *names["scales"], *names["quats"], *names["sh0"], *names.get("shN", [])[1:]]:
        if sizes[name] != (width, height):
            raise files.malformed(
                f"{name} must have {width} x {height} px like {first}", "{} x {} px".format(*sizes[name])
            )


def _palette_count(files: SogFiles, group: Mapping[str, Any], size: tuple[int, int], version: int) -> int:
    """Return the entries of the palette, after checking its texture."""
    width, height = size
    bands = group.get("bands") if version == 2 else {64 * k: degree for degree, k in COEFFICIENTS.items()}.get(width)
    count = group.get("count") if version == 2 else PALETTE_COLUMNS * height
    if bands not in (1, 2, 3) or not isinstance(bands, int):
        got = f"shN.bands {bands!r:.40}" if version == 2 else f"a palette {width} px wide"
        raise files.malformed("spherical harmonics must have degree 1 to 3", got)
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= PALETTE_LIMIT:
        raise files.malformed(f"shN.count must be at most {PALETTE_LIMIT}", repr(count)[:40])
    wanted, most = PALETTE_COLUMNS * COEFFICIENTS[bands], PALETTE_LIMIT // PALETTE_COLUMNS
    if width != wanted or not -(-count // PALETTE_COLUMNS) <= height <= most:
        contract = f"the palette of {count} rows of degree {bands} must be {wanted} px wide, and high enough"
        raise files.malformed(contract, f"{width} x {height} px")
    return count


def _fields(files: SogFiles, header: SogHeader, options: ReadOptions) -> dict[str, Any]:
    """Decode all textures into the fields of a cloud."""

    def pixels(group: str, index: int = 0, channels: int = 3) -> NDArray[np.uint8]:
        name = header.names[group][index]
        return files.texture(name, header.sizes[name], channels)[: header.count]

    positions = _positions(pixels("means"), pixels("means", 1), header.log_bounds)
    orientations = _orientations(files, header.names["quats"][0], pixels("quats", channels=4), options)
    scales = _looked_up(exp_scale(header.log_scales), pixels("scales"))
    colors = pixels("sh0", channels=4)
    if header.rest is None:
        radiance = np.empty((header.count, 1, 3), np.float32)
    else:  # by far the largest array: after all that can be refused
        name = header.names["shN"][0]
        palette = _palette(header.rest, files.texture(name, header.sizes[name], 3), header.sizes[name][0])
        radiance = palette[_labels(files, header, pixels("shN", 1))]
    radiance[:, 0] = _looked_up(header.colors, colors[:, :3])
    return {
        "positions": positions,
        "orientations": orientations,
        "scales": scales,
        "opacities": header.opacities.astype(np.float32)[colors[:, 3]],
        "radiance": radiance,
        "radiance_color_space": DISPLAY_SRGB,
    }


def _positions(low: NDArray[np.uint8], high: NDArray[np.uint8], log_bounds: NDArray[np.float64]) -> NDArray[np.float32]:
    positions = np.empty(low.shape, np.float32)
    fraction = np.arange(2**16) / (2**16 - 1.0)
    for axis, (least, greatest) in enumerate(log_bounds.T):
        logs = least * (1.0 - fraction) + greatest * fraction
        with np.errstate(over="ignore"):  # what overflows is infinite, which a cloud refuses
            table = (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)
        positions[:, axis] = table[low[:, axis] | high[:, axis].astype(np.uint16) << np.uint16(8)]
    return positions


def _orientations(files: SogFiles, name: str, codes: NDArray[np.uint8], options: ReadOptions) -> NDArray[np.floating]:
    """Return unit quaternions xyzw; zeros where a code marks none, if such rows are to be dropped."""
    none = codes[:, 3] < LARGEST_AT_CODE
    if none.any() and not options.drop_invalid:
        raise files.malformed(
            f"{name} must have alpha {LARGEST_AT_CODE} to 255",
            f"{codes[:, 3][none][0]} at {rows_at(none)}",
            "Export it again, or drop those rows with --drop-invalid.",
        )
    smaller = ((2.0 * _CODES - 1.0) * SMALLER_LIMIT)[codes[:, :3]]
    wxyz = from_smaller(smaller, np.where(none, 0, codes[:, 3].astype(np.intp) - LARGEST_AT_CODE))
    wxyz[none] = 0.0
    return wxyz[:, [1, 2, 3, 0]]


def _looked_up(tables: NDArray[np.floating], codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return ``(N, 3)`` numbers for codes of three channels, each with its table."""
    return np.stack([table.astype(np.float32)[code] for table, code in zip(tables, codes.T, strict=True)], axis=1)


def _palette(table: NDArray[np.float64], codes: NDArray[np.uint8], width: int) -> NDArray[np.float32]:
    """Return ``(entries, K, 3)`` coefficients, with room for the zeroth."""
    entries = table.astype(np.float32)[codes].reshape(-1, width // PALETTE_COLUMNS, 3)
    return np.concatenate([np.zeros_like(entries[:, :1]), entries], axis=1)


def _labels(files: SogFiles, header: SogHeader, codes: NDArray[np.uint8]) -> NDArray[np.uint16]:
    labels = codes[:, 0] | codes[:, 1].astype(np.uint16) << np.uint16(8)
    outside = labels >= header.palette_count
    if outside.any():
        got = f"{labels[outside][0]} at {rows_at(outside)}"
        raise files.malformed(f"labels of spherical harmonics must be below {header.palette_count}", got)
    return labels
