"""Takes in Blender's axes: Gaussians of a delivery container (b4d) or of one PLY file, at any moment.

Arrays are by name, a row for each Gaussian, float32; x right, y forward, z up, in metres. Nothing here needs Blender.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import decoder

MATERIALS = ("base_color", "roughness", "ambient_occlusion", "normals")
COLUMNS = {
    "positions": ("x", "y", "z"),
    "orientations": ("rot_1", "rot_2", "rot_3", "rot_0"),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "opacities": ("opacity",),
    "base_color": ("base_color_0", "base_color_1", "base_color_2"),
    "roughness": ("roughness",),
    "ambient_occlusion": ("ambient_occlusion",),
    "normals": ("nx", "ny", "nz"),
}
WORDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
WORDS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
WORDS |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
MAX_HEADER_BYTES = 2**16
DIRECTIONS = {"r": (1, 0, 0), "l": (-1, 0, 0), "f": (0, 1, 0), "b": (0, -1, 0), "u": (0, 0, 1), "d": (0, 0, -1)}


FLATTEST = 1e-3
"""Least deviation of a Gaussian along an axis, in its largest one: flat ones have 0, and no inverse."""


class TakeError(ValueError):
    """A file is no take that can be lit; the text says why, and what to do."""


@dataclass(frozen=True, eq=False)
class Take:
    """Gaussians over time.

    Attributes:
        path: The file.
        frames: Number of frames.
        rate: Frames a second.
        blends: Whether row i is the same Gaussian in every frame, so that frames may be blended.
        source: The open container, or the arrays of the only frame as ``(C, N)``.
        axes: Where x, y and z of the source point: three of r, l, u, d, f and b.
        scale: Metres in a unit of the source.
    """

    path: Path
    frames: int
    rate: float
    blends: bool
    source: decoder.Container | decoder.Arrays
    axes: str
    scale: float = 1.0

    def at(self, seconds: float) -> decoder.Arrays:
        """Return the Gaussians at a time since the first frame; the first and the last frame are held outside."""
        place = min(max(seconds * self.rate, 0.0), self.frames - 1.0)
        nearest = round(place)
        if not self.blends or abs(place - nearest) < 1e-3:
            number = nearest if abs(place - nearest) < 1e-3 else math.floor(place)
            arrays = self.frame(number)
        else:
            first = math.floor(place)
            arrays = blended(self.frame(first), self.frame(first + 1), place - first)
        return in_blender(arrays, self.axes, self.scale)

    def frame(self, number: int) -> decoder.Arrays:
        """Return the Gaussians of a frame as the file has them, ``(C, N)``, in its axes and units."""
        return self.source.frame(number) if isinstance(self.source, decoder.Container) else self.source


def open_take(path: str | Path, axes: str = "") -> Take:
    """Open a ``.b4d`` file, the ``manifest.json`` of a folder, or a PLY with materials.

    Args:
        path: The file.
        axes: Axes of a PLY that does not state them; by default right, down, forward.

    Raises:
        TakeError: It is none of these, is damaged, or has no materials.
    """
    path = Path(path)
    try:
        take = _ply(path, axes or "rdf") if path.suffix.lower() == ".ply" else _container(path)
        arrays = take.frame(0)
    except (OSError, decoder.DeliveryError) as error:
        raise TakeError(f"{path.name}: {' '.join(str(error).split())}") from None
    if missing := [name for name in MATERIALS if name not in arrays]:
        raise TakeError(f"{path.name} must have materials, got no {', '.join(missing)}. Decompose it with beam run.")
    if not all(np.isfinite(values).all() for values in arrays.values()):
        raise TakeError(f"{path.name} must hold finite numbers, got NaN or infinity. Export it again.")
    return take


def _container(path: Path) -> Take:
    container = decoder.Container(path)
    said = container.manifest
    if said.get("axes") != "rub":
        raise TakeError(f"{path.name}: axes must be rub, got {str(said.get('axes'))[:20]!r}. Export it again.")
    return Take(path, said["frames"], said["rate"], said.get("topology") == "constant", container, "rub")


def _ply(path: Path, axes: str) -> Take:
    """Read a PLY of the training layout with the materials that ``beam-convert --profile beam`` appends."""
    with path.open("rb") as stream:
        head = stream.read(MAX_HEADER_BYTES)
    lines = head.partition(b"end_header\n")[0].decode("ascii", "replace").split("\n")[:-1]
    if b"end_header\n" not in head or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise TakeError(f"{path.name} must be a binary little-endian PLY, got another file. Write it by beam-convert.")
    words = [line.split() for line in lines[2:]]
    elements = [each for each in words if each[:1] == ["element"]]
    fields = [each for each in words if each[:1] == ["property"]]
    said = {each[1]: each[2] for each in words if each[:1] == ["comment"] and len(each) >= 3}
    columns = sum(COLUMNS.values(), ())
    missing = set(columns) - {each[-1] for each in fields}
    if [each[1] for each in elements] != ["vertex"] or missing:
        raise TakeError(
            f"{path.name} must hold Gaussians with materials, got no {', '.join(sorted(missing)) or 'plain vertices'}. "
            "Write it by beam-convert --profile beam."
        )
    try:
        layout = np.dtype([(name, "<" + WORDS[kind]) for _, kind, name in fields])
        count, scale = int(elements[0][2]), float(said.get("beam_meters_per_unit", 1.0))
        _turn_of(axes := said.get("beam_axes", axes))
    except (KeyError, ValueError, IndexError) as error:
        raise TakeError(f"{path.name}: the header must be sound, got {error}. Export it again.") from None
    start, size = head.index(b"end_header\n") + 11, path.stat().st_size
    if not (count >= 0 and 0.0 < scale < math.inf and start + count * layout.itemsize <= size):
        raise TakeError(f"{path.name} must hold {count} Gaussians, got {size} bytes. Copy or export it again.")
    rows = np.fromfile(path, layout, count, offset=start)
    return Take(path, 1, 30.0, False, _activated(rows), axes, scale)


def _activated(rows: np.ndarray) -> decoder.Arrays:
    """Return the arrays of a PLY's rows: scales are logarithms, opacities logits, orientations of any length."""
    arrays = {name: np.stack([rows[each] for each in names]).astype(np.float32) for name, names in COLUMNS.items()}
    with np.errstate(over="ignore", invalid="ignore"):
        arrays["scales"] = np.exp(arrays["scales"])
        arrays["opacities"] = 1.0 / (1.0 + np.exp(-arrays["opacities"]))
        for name in ("orientations", "normals"):
            arrays[name] = decoder.activated("normals", arrays[name])
    return arrays


def blended(first: decoder.Arrays, second: decoder.Arrays, part: float) -> decoder.Arrays:
    """Return the arrays between two frames: ``part`` 0 is the first, 1 the second."""
    arrays = {name: values + np.float32(part) * (second[name] - values) for name, values in first.items()}
    sign = np.where(np.einsum("cn,cn->n", first["orientations"], second["orientations"]) < 0.0, -1.0, 1.0)
    turned = (1.0 - part) * first["orientations"] + part * sign * second["orientations"]
    arrays["orientations"] = decoder.activated("normals", turned.astype(np.float32))
    arrays["normals"] = decoder.activated("normals", arrays["normals"])
    return arrays


def in_blender(arrays: decoder.Arrays, axes: str, scale: float) -> decoder.Arrays:
    """Return arrays ``(N, C)`` in Blender's axes and metres, and Gaussians as discs.

    A mirror image M of a Gaussian is the one of the rotation -M, for Gaussians are symmetric about their centres.
    """
    matrix = _turn_of(axes)
    turn = _quaternion(matrix * np.linalg.det(matrix))[:, None]
    result = arrays | {name: matrix @ arrays[name] for name in ("positions", "normals")}
    turned = decoder.product(np.broadcast_to(turn, arrays["orientations"].shape), arrays["orientations"])
    result["orientations"], result["scales"] = seen_along(result["normals"], turned, arrays["scales"])
    for name in ("positions", "scales"):
        result[name] = result[name] * scale
    return {name: np.ascontiguousarray(values.T, np.float32) for name, values in result.items()}


def seen_along(normals: np.ndarray, turns: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orientations and scales of the discs on which rays along the normals meet Gaussians at their peak.

    That is the slice across P n, P being the inverse covariance: a flat Gaussian keeps its plane and a rod its length,
    and a round one faces the way that its surface does. Who looks along a normal sees the Gaussian itself.
    """
    inverse = 1.0 / np.maximum(scales.astype(float), FLATTEST * np.maximum(scales.max(axis=0), 1e-12))
    axes = [decoder.rotated(turns, np.eye(3)[:, k : k + 1]) for k in range(3)]
    across = sum(each * (np.sum(each * normals, axis=0) * size**2) for each, size in zip(axes, inverse, strict=True))
    x, y, z = across / np.maximum(np.sqrt(np.sum(across**2, axis=0)), 1e-30)
    zero = np.zeros_like(x)
    upright = np.stack([-y, x, zero, 1.0 + z])  # the shortest turn to it from the third axis; below, from its opposite
    upright = np.where(z < 0.0, np.stack([1.0 - z, zero, x, -y]), upright)
    upright = upright / np.sqrt(np.sum(upright**2, axis=0))
    plane = [decoder.rotated(upright, np.eye(3)[:, k : k + 1]) for k in range(3)]
    first, second, third = (
        np.stack([np.sum(axis * each, axis=0) for axis in axes]) * inverse for each in plane
    )  # dot products of one with another are entries of P
    steep, flat, both = (np.sum(a * b, axis=0) for a, b in ((first, first), (second, second), (first, second)))
    half = 0.5 * np.arctan2(2.0 * both, steep - flat)
    mean, reach = 0.5 * (steep + flat), np.hypot(0.5 * (steep - flat), both)
    about = np.stack([zero, zero, np.sin(0.5 * half), np.cos(0.5 * half)])
    sizes = [1.0 / np.sqrt(square) for square in (mean + reach, mean - reach, np.sum(third**2, axis=0))]
    return decoder.product(upright, about), np.stack(sizes)


def _turn_of(axes: str) -> np.ndarray:
    """Return the matrix ``(3, 3)`` from axes by their letters to Blender's."""
    matrix = np.array([DIRECTIONS[letter] for letter in axes], float).T
    if matrix.shape != (3, 3) or abs(np.linalg.det(matrix)) != 1.0:
        raise ValueError(f"axes {axes!r}")
    return matrix


def _quaternion(m: np.ndarray) -> np.ndarray:
    """Return the unit quaternion xyzw of a rotation: an eigenvector (Bar-Itzhack 2000), without special cases."""
    (a, b, c), (d, e, f), (g, h, i) = m
    k = [[a - e - i, b + d, c + g, h - f], [b + d, e - a - i, f + h, c - g], [c + g, f + h, i - a - e, d - b]]
    return np.linalg.eigh(np.array([*k, [h - f, c - g, d - b, a + e + i]]))[1][:, -1].astype(np.float32)
