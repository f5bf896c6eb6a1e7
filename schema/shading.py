"""Shading networks of an asset's material: OpenPBR as MaterialX, and UsdPreviewSurface for readers without it.

Both read the primvars of `beam_warp.schema.layout`. OpenPBR's defaults agree with the reflection model of SPEC.md: an
index of refraction of 1.5 is an F0 of 0.04, the diffuse lobe is Lambert's, and alpha is the square of roughness.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pxr import Gf, Sdf

from beam_warp.image.color import LINEAR_REC709
from beam_warp.schema.layout import CHANNELS, MATERIAL_PATH
from beam_warp.schema.survey import display_color
from beam_warp.world.gaussians import GaussianCloud

MATERIALX_VERSION = "1.39"
"""First version of MaterialX that has OpenPBR; without a statement, OpenUSD takes 1.38."""


@dataclass(frozen=True)
class _Network:
    """One surface shader and the readers of its inputs.

    Attributes:
        terminal: Output of the material.
        name: Prim of the shader.
        shader: Identifier of the shader.
        output: Output of the shader.
        key: Input of a reader that names the primvar.
        fallback: Input of a reader whose value stands in for a missing primvar.
        result: Output of a reader.
        inputs: Input of the shader for each array, with the identifier and the output type of its reader.
    """

    terminal: str
    name: str
    shader: str
    output: str
    key: str
    fallback: str
    result: str
    inputs: dict[str, tuple[str, str, str]]


_NETWORKS = (
    _Network(
        terminal="outputs:mtlx:surface",
        name="OpenPBR",
        shader="ND_open_pbr_surface_surfaceshader",
        output="outputs:out",
        key="inputs:geomprop",
        fallback="inputs:default",
        result="outputs:out",
        inputs={
            "base_color": ("base_color", "ND_geompropvalue_color3", "color3f"),
            "roughness": ("specular_roughness", "ND_geompropvalue_float", "float"),
        },
    ),
    _Network(
        terminal="outputs:surface",
        name="Preview",
        shader="UsdPreviewSurface",
        output="outputs:surface",
        key="inputs:varname",
        fallback="inputs:fallback",
        result="outputs:result",
        inputs={
            "base_color": ("diffuseColor", "UsdPrimvarReader_float3", "float3"),
            "roughness": ("roughness", "UsdPrimvarReader_float", "float"),
            "ambient_occlusion": ("occlusion", "UsdPrimvarReader_float", "float"),
        },
    ),
)


def author_material(layer: Sdf.Layer, cloud: GaussianCloud) -> None:
    """Define /Asset/Material, whose networks read the primvars of the arrays that a cloud has.

    A renderer that does not offer primvars of Gaussians to shaders gets the cloud's means instead.

    Args:
        layer: Layer to author in.
        cloud: First frame of the asset, with base colour.
    """
    material = _define(layer, MATERIAL_PATH, "Material")
    material.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["MaterialXConfigAPI"]))
    _value(material, "config:mtlx:version", "string", MATERIALX_VERSION)
    for network in _NETWORKS:
        path = f"{MATERIAL_PATH}/{network.name}"
        _connected(material, network.terminal, "token", f"{path}.{network.output}")
        surface = _shader(layer, path, network.shader, network.output, "token")
        for name, (target, reader_id, type_name) in network.inputs.items():
            array = cloud.arrays().get(name)
            if array is None:
                continue
            place = f"{path}_{target}"
            reader = _shader(layer, place, reader_id, network.result, type_name)
            _value(reader, network.key, "string", CHANNELS[name].primvar.removeprefix("primvars:"))
            color = name == "base_color"
            mean = Gf.Vec3f(*display_color(cloud).tolist()) if color else float(np.mean(array)) if array.size else 1.0
            fallback = _value(reader, network.fallback, type_name, mean)
            if color:
                fallback.colorSpace = LINEAR_REC709
            _connected(surface, f"inputs:{target}", "color3f" if color else "float", f"{place}.{network.result}")


def _shader(layer: Sdf.Layer, path: str, identifier: str, output: str, output_type: str) -> Sdf.PrimSpec:
    shader = _define(layer, path, "Shader")
    spec = Sdf.AttributeSpec(shader, "info:id", Sdf.ValueTypeNames.Token, Sdf.VariabilityUniform)
    spec.default = identifier
    Sdf.AttributeSpec(shader, output, Sdf.ValueTypeNames.Find(output_type))
    return shader


def _define(layer: Sdf.Layer, path: str, type_name: str) -> Sdf.PrimSpec:
    prim = Sdf.CreatePrimInLayer(layer, path)
    prim.specifier, prim.typeName = Sdf.SpecifierDef, type_name
    return prim


def _value(prim: Sdf.PrimSpec, name: str, type_name: str, value: Any) -> Sdf.AttributeSpec:
    spec = Sdf.AttributeSpec(prim, name, Sdf.ValueTypeNames.Find(type_name))
    spec.default = value
    return spec


def _connected(prim: Sdf.PrimSpec, name: str, type_name: str, source: str) -> None:
    spec = Sdf.AttributeSpec(prim, name, Sdf.ValueTypeNames.Find(type_name))
    spec.connectionPathList.explicitItems = [source]
