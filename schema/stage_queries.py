"""Questions that the reader and the rules both ask of a stage: which prims, which frames, which variant of an array."""

from __future__ import annotations

from typing import Any

from pxr import Usd, UsdGeom

from beam_warp.assets import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.schema import MATERIAL_API, SEQUENCE_API
from beam_warp.schema.layout import CHANNELS, SPLAT_TYPE, Channel

_COLOR_SPACES = {
    "srgb_rec709_display": DISPLAY_SRGB,
    "srgb_rec709_scene": DISPLAY_SRGB,
    "lin_rec709_display": LINEAR_REC709,
    "lin_rec709_scene": LINEAR_REC709,
}
"""Names that writers give to the two spaces that splats are trained in; OpenUSD itself has none for the first."""


def splat_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Return every Gaussian-splat prim that is defined and active, also inside instances."""
    every = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    return [prim for prim in every if prim.GetTypeName() == SPLAT_TYPE]


def applied_schemas(prim: Usd.Prim) -> list[str]:
    """Return the names of applied schemas as authored: unlike GetAppliedSchemas, also those that USD does not know."""
    return [str(name) for name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()]


def has_material_api(prim: Usd.Prim) -> bool:
    """Say whether a prim states that it holds our channels."""
    return MATERIAL_API in applied_schemas(prim)


def sequence_prim(prim: Usd.Prim) -> Usd.Prim | None:
    """Return the nearest ancestor that says how the Gaussians play."""
    while prim and not prim.IsPseudoRoot():
        if SEQUENCE_API in applied_schemas(prim):
            return prim
        prim = prim.GetParent()
    return None


def authored(prim: Usd.Prim, name: str) -> Any:
    """Return an attribute's authored value at the default time, or None."""
    attribute = prim.GetAttribute(name)
    return attribute.Get() if attribute and attribute.HasAuthoredValue() else None


def array_attribute(prim: Usd.Prim, channel: Channel) -> Usd.Attribute | None:
    """Return the authored variant of an array, float before half as OpenUSD's schema wants it."""
    for name in channel.usd_names:
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasAuthoredValue():
            return attribute
    return None


def sample_times(prim: Usd.Prim) -> list[float]:
    """Return the union of all sample times of a prim's arrays and of the transforms above it."""
    times: set[float] = set()
    for channel in CHANNELS.values():
        attribute = array_attribute(prim, channel)
        if attribute is not None:
            times.update(attribute.GetTimeSamples())
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable):
            times.update(UsdGeom.Xformable(prim).GetTimeSamples())
        prim = prim.GetParent()
    return sorted(times)


def radiance_color_space(prim: Usd.Prim) -> tuple[str | None, str]:
    """Return the colour space of a prim's radiance and the word that says so.

    The first of ``beam:radianceColorSpace``, then ``colorSpace:name`` of the prim or an ancestor, counts. None if
    nothing is stated (the word is then empty) or the word is unknown.
    """
    word = authored(prim, "beam:radianceColorSpace")
    ancestor = prim
    while word is None and ancestor and not ancestor.IsPseudoRoot():
        word = authored(ancestor, "colorSpace:name")
        ancestor = ancestor.GetParent()
    return _COLOR_SPACES.get(str(word)), str(word or "")
