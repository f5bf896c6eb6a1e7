"""Producers of PLY files: how to recognise them, and how they name and store materials.

Names and activations were read in the producers' own exporters: Relightable 3D Gaussian (Gao et al. 2024), GS-IR
(Liang et al. 2024), IRGS (Gu et al. 2025) and mesh2splat. No two agree, so materials are never read on a guess.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.converters.common.activations import linear, sigmoid, sigmoid_base_color, sigmoid_roughness
from beam_warp.converters.common.options import MaterialActivation
from beam_warp.converters.ply.container import PlyHeader

Activate = Callable[[ArrayLike], NDArray[np.float32]]

NORMAL_NAMES = ("nx", "ny", "nz")


@dataclass(frozen=True)
class MaterialLayout:
    """Property names of one producer's materials and their activations.

    Attributes:
        channels: For each attribute of a cloud, the names of its properties and the map from stored to linear values.
        normals: Property names of the normals.
    """

    channels: dict[str, tuple[tuple[str, ...], Activate]]
    normals: tuple[str, str, str] = NORMAL_NAMES


def _triple(stem: str) -> tuple[str, str, str]:
    return (f"{stem}_0", f"{stem}_1", f"{stem}_2")


LAYOUTS: dict[MaterialActivation, MaterialLayout] = {
    "linear": MaterialLayout(
        {
            "base_color": (_triple("base_color"), linear),
            "roughness": (("roughness",), linear),
            "ambient_occlusion": (("ambient_occlusion",), linear),
        }
    ),
    "r3dg": MaterialLayout(
        {"base_color": (_triple("base_color"), sigmoid_base_color), "roughness": (("roughness",), sigmoid_roughness)}
    ),
    "gsir": MaterialLayout(
        {"base_color": (_triple("albedo"), sigmoid), "roughness": (("roughness",), sigmoid)},
        ("normal_0", "normal_1", "normal_2"),
    ),
    "irgs": MaterialLayout(
        {"base_color": (_triple("base_color"), sigmoid_base_color), "roughness": (("roughness",), sigmoid)}
    ),
}

_SIGNATURES: tuple[tuple[frozenset[str], str, MaterialActivation | None], ...] = (
    (frozenset({"base_color_0", "incidents_dc_0"}), "Relightable3DGaussian", "r3dg"),
    (frozenset({"albedo_0", "normal_0"}), "GS-IR", "gsir"),
    (frozenset({"base_color_0", "metallic"}), "IRGS", "irgs"),
    (frozenset({"metallicFactor", "roughnessFactor"}), "mesh2splat", None),
)
"""Properties that only one producer writes together, with its name and the activation of its materials."""

_MATERIAL_STEMS = (
    "base_color",
    "albedo",
    "roughness",
    "roughnessFactor",
    "metallic",
    "metallicFactor",
    "ambient_occlusion",
)


def material_properties(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the properties, without their component numbers, that look like material channels."""
    stems = {re.sub(r"_\d+$", "", name) for name in names}
    return tuple(stem for stem in _MATERIAL_STEMS if stem in stems)


def material_producer(names: tuple[str, ...]) -> tuple[str, MaterialActivation | None] | None:
    """Return the producer that uses these names for materials and its activation, or None if it is unknown."""
    for signature, producer, activation in _SIGNATURES:
        if signature <= set(names):
            return producer, activation
    return None


def guess_producer(header: PlyHeader) -> str:
    """Return the producer of a PLY, as far as comments and property names tell, with the evidence."""
    vertex = header.element("vertex")
    names = vertex.names if vertex else ()
    if "beam_schema" in header.statements:
        return f"beam-warp (beam_schema {header.statements['beam_schema']})"
    if known := material_producer(names):
        return f"{known[0]}, by its property names"
    for comment in header.comments:
        if found := re.match(r"(?:generated|created|exported|written) (?:by|with|from) (.+)", comment, re.IGNORECASE):
            return f"{found[1][:80]}, by its comment"
        if comment.startswith("SplatRenderMode"):
            return "Brush or splat-transform, by its SplatRenderMode comment"
    if "packed_position" in names:
        return "a PlayCanvas tool, by its packed layout"
    if names[:9] == ("x", "y", "z", *NORMAL_NAMES, *_triple("f_dc")):
        return "3DGS training or a tool with its layout, by its property order"
    return "unknown"
