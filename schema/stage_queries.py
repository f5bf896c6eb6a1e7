"""Questions that the reader and the rules both ask of a stage: which prims, which frames, which variant of an array."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom

from beam_warp.errors import AssetFormatError
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.schema import MATERIAL_API, SEQUENCE_API
from beam_warp.schema.layout import CHANNELS, SPLAT_TYPE, Channel

_COLOR_SPACES = {
    "srgb_rec709_display": DISPLAY_SRGB,
    "srgb_rec709_scene": DISPLAY_SRGB,
    "lin_rec709_display": LINEAR_REC709,
    "lin_rec709_scene": LINEAR_REC709,
}
"""Names that writers give to the two spaces that splats are trained in; OpenUSD itself has none for the first."""


_AXES = {"Y": "rub", "Z": "rfu"}


def stage_axes(stage: Usd.Stage, source: Path) -> str:
    """Return the axes code of a stage's up axis.

    Raises:
        AssetFormatError: It is neither Y nor Z.
    """
    up = str(UsdGeom.GetStageUpAxis(stage))
    if up not in _AXES:
        raise AssetFormatError(f"{source} must have upAxis Y or Z, got {up!r}. Set it.")
    return _AXES[up]


def stage_meters(stage: Usd.Stage, source: Path) -> float:
    """Return the length of a stage's unit [m], USD's default if it states none.

    Raises:
        AssetFormatError: It is not positive.
    """
    meters = UsdGeom.GetStageMetersPerUnit(stage)
    if not 0.0 < meters < np.inf:
        raise AssetFormatError(f"{source} must have a positive metersPerUnit, got {meters:g}. Set it.")
    return meters


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


def has_whole_clips(prim: Usd.Prim) -> bool:
    """Say whether all clip layers of a prim open; where one does not, every question about samples raises."""
    return not any(clips.missing_layers() for clips in clip_sets(prim))


@dataclass(frozen=True)
class ClipSet:
    """One set of explicit value clips of a prim.

    Attributes:
        prim_path: Where the data is inside each clip layer.
        manifest: Absolute path of the manifest, empty if none is stated.
        paths: Absolute paths of the clip layers.
        active: Pairs (stage time from which on, index of the clip).
        times: Pairs (stage time, time inside the clip).
    """

    prim_path: str
    manifest: str
    paths: tuple[str, ...]
    active: tuple[tuple[float, int], ...]
    times: tuple[tuple[float, float], ...]

    def missing_layers(self) -> list[str]:
        """Return the layers that do not open."""
        return [path or "no manifest" for path in (self.manifest, *self.paths) if _open_layer(path) is None]

    def declared(self) -> set[str]:
        """Return the attributes that the manifest declares."""
        layer = _open_layer(self.manifest)
        prim = layer.GetPrimAtPath(self.prim_path) if layer else None
        return set(prim.attributes.keys()) if prim else set()

    def sampled(self, index: int) -> set[str]:
        """Return the attributes that one clip layer has samples of."""
        layer = _open_layer(self.paths[index])
        prim = layer.GetPrimAtPath(self.prim_path) if layer else None
        if layer is None or not prim:
            return set()
        names = prim.attributes.keys()
        return {name for name in names if layer.GetNumTimeSamplesForPath(f"{self.prim_path}.{name}")}

    def has_sample(self, name: str, time: float) -> bool:
        """Say whether the clip that is active at a stage time has a sample there."""
        index = next((index for start, index in reversed(self.active) if start <= time), None)
        layer = _open_layer(self.paths[index]) if index is not None and 0 <= index < len(self.paths) else None
        if layer is None or not self.times:
            return False
        inside = float(np.interp(time, *np.transpose(self.times)))
        return inside in layer.ListTimeSamplesForPath(f"{self.prim_path}.{name}")


def clip_sets(prim: Usd.Prim) -> list[ClipSet]:
    """Return the explicit value clips of a prim, their layers' paths made absolute."""
    clips = prim.GetMetadata("clips") or {}
    found = []
    for name in clips:
        api = Usd.ClipsAPI(prim)
        paths = api.GetClipAssetPaths(name)
        if not paths:
            continue
        manifest = api.GetClipManifestAssetPath(name)
        found.append(
            ClipSet(
                prim_path=str(api.GetClipPrimPath(name)),
                manifest=_absolute(prim, manifest),
                paths=tuple(_absolute(prim, path) for path in paths),
                active=tuple((float(start), int(index)) for start, index in api.GetClipActive(name) or ()),
                times=tuple((float(outer), float(inner)) for outer, inner in api.GetClipTimes(name) or ()),
            )
        )
    return found


def _absolute(prim: Usd.Prim, path: Sdf.AssetPath | None) -> str:
    """Anchor a clip's path to the layer that names it; OpenUSD resolves it where the layer is a package too."""
    if path is None or not path.path:
        return ""
    if path.resolvedPath:
        return str(path.resolvedPath)
    stack = prim.GetPrimStack()
    anchor = next((spec.layer for spec in stack if spec.HasInfo("clips")), prim.GetStage().GetRootLayer())
    return str(anchor.ComputeAbsolutePath(path.path))


def _open_layer(path: str) -> Sdf.Layer | None:
    try:
        return Sdf.Layer.FindOrOpen(path) if path else None
    except Tf.ErrorException:
        return None
