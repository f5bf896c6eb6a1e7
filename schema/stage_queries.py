"""Queries of a stage that the reader and the rules share: its prims, its frames, and the variant of each array."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdUtils

from beam_warp.errors import AssetFormatError
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.outputs import keep_original, keeps_originals
from beam_warp.schema import MATERIAL_API, SEQUENCE_API, register
from beam_warp.schema.clips import CLIP_FRAMES
from beam_warp.schema.files import require_asset_file, require_opens, said_by_usd
from beam_warp.schema.layout import CHANNELS, SPLAT_TYPE, UP_AXES, Channel

_COLOR_SPACES = {
    "srgb_rec709_display": DISPLAY_SRGB,
    "srgb_rec709_scene": DISPLAY_SRGB,
    "lin_rec709_display": LINEAR_REC709,
    "lin_rec709_scene": LINEAR_REC709,
}
"""Names that writers give to the two spaces in which splats are trained; OpenUSD has no name for the first."""

MAX_HELD_FRAMES = 16_384
"""Most frames that an asset may have beyond its time samples: nine minutes of stillness at 30 frames per second."""

METERS_RANGE = (1e-9, 1e16)
"""Range of metersPerUnit: from `UsdGeom.LinearUnits.nanometers` to beyond `UsdGeom.LinearUnits.lightYears`."""


def open_asset(path: str | Path, *, trusted: bool) -> tuple[Path, Usd.Stage]:
    """Check a file, register our schema, and open the file as a stage.

    Args:
        path: A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
        trusted: True skips the child process that opens the file first.

    Returns:
        The absolute path and the stage.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: The file is broken.
    """
    source = require_asset_file(path)
    if not trusted:
        require_opens(source)
    register()
    try:
        stage = Usd.Stage.Open(str(source), Usd.Stage.LoadAll)
        if keeps_originals():
            layers, textures, _ = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(str(source)))
            keep_original(source, *(Path(layer.realPath) for layer in layers), *map(Path, textures))
        return source, stage
    except Tf.ErrorException as error:
        said = said_by_usd(error)
        raise AssetFormatError(f"{source} must open in OpenUSD, got {said}. Export the file again.") from error


def layer_files(path: Path) -> list[Path]:
    """Return the files of all layers of a stage, including value clips, with the stage's own file first.

    Raises:
        AssetFormatError: OpenUSD cannot open the stage, or a layer is missing.
    """
    try:
        layers, _, missing = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(str(path)))
    except Tf.ErrorException as error:
        said = said_by_usd(error)
        raise AssetFormatError(f"{path} must open in OpenUSD, got {said}. Export the file again.") from error
    if missing:
        raise AssetFormatError(f"{path} must have all its layers, got none at {missing[0]}. Copy it with them.")
    files = {Path(layer.realPath) for layer in layers if layer.realPath and Path(layer.realPath).is_file()}
    return [path, *sorted(files - {path, path.absolute(), path.resolve()})]


def stage_axes(stage: Usd.Stage, source: Path) -> str:
    """Return the axes code of a stage's up axis.

    Raises:
        AssetFormatError: It is neither Y nor Z.
    """
    up = str(UsdGeom.GetStageUpAxis(stage))
    axes = next((axes for axes, name in UP_AXES.items() if up == name), None)
    if axes is None:
        raise AssetFormatError(f"{source} must have upAxis Y or Z, got {up!r}. Set it.")
    return axes


def stage_meters(stage: Usd.Stage, source: Path) -> float:
    """Return the length of a stage's unit [m], USD's default if it states none.

    Raises:
        AssetFormatError: It is beyond the units that OpenUSD names, from nanometres to light years.
    """
    meters = UsdGeom.GetStageMetersPerUnit(stage)
    if not METERS_RANGE[0] <= meters <= METERS_RANGE[1]:
        low, high = METERS_RANGE
        raise AssetFormatError(f"{source} must have metersPerUnit in [{low:g}, {high:g}], got {meters:g}. Set it.")
    return meters


def splat_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Return every Gaussian-splat prim that is defined and active, also inside instances."""
    every = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    return [prim for prim in every if prim.GetTypeName() == SPLAT_TYPE]


def applied_schemas(prim: Usd.Prim) -> list[str]:
    """Return the names of applied schemas as authored; GetAppliedSchemas leaves out those that USD does not know."""
    return [str(name) for name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()]


def has_material_api(prim: Usd.Prim) -> bool:
    """Return True if a prim has BeamRelightableGaussianAPI."""
    return MATERIAL_API in applied_schemas(prim)


def sequence_prim(prim: Usd.Prim) -> Usd.Prim | None:
    """Return the prim itself or its nearest ancestor that has BeamSequenceAPI, or None."""
    return next((place for place in ancestors(prim) if SEQUENCE_API in applied_schemas(place)), None)


def ancestors(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield a prim and those above it, without the pseudo-root."""
    while prim and not prim.IsPseudoRoot():
        yield prim
        prim = prim.GetParent()


def authored(prim: Usd.Prim, name: str, kind: type = object) -> Any:
    """Return an attribute's authored value at the default time, or None.

    Args:
        prim: Prim that has the attribute.
        name: Name of the attribute.
        kind: Type that the value must have; a layer may author another one than the schema's.

    Raises:
        AssetFormatError: It is of another type.
    """
    attribute = prim.GetAttribute(name)
    if not (attribute and attribute.HasAuthoredValue()):
        return None
    value = attribute.Get()
    if not isinstance(value, kind):
        got = type(value).__name__
        raise AssetFormatError(
            f"{prim.GetStage().GetRootLayer().identifier}: {attribute.GetPath()} must be of type {kind.__name__}, "
            f"got {got}. Export it again."
        )
    return value


def array_attribute(prim: Usd.Prim, channel: Channel) -> Usd.Attribute | None:
    """Return the authored variant of an array, or None; float goes before half, as in OpenUSD's schema."""
    for name in channel.usd_names:
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasAuthoredValue():
            return attribute
    return None


def sample_times(prim: Usd.Prim) -> list[float]:
    """Return the sample times of a prim's arrays and of the transforms above it, ascending."""
    times: set[float] = set()
    for channel in CHANNELS.values():
        attribute = array_attribute(prim, channel)
        if attribute is not None:
            times.update(attribute.GetTimeSamples())
    return sorted(times | transform_times(prim))


def is_keyed(prim: Usd.Prim) -> bool:
    """Return True if the arrays of a prim have time samples at keys only, between which frames are interpolated."""
    playing = sequence_prim(prim)
    return playing is not None and authored(playing, "beam:sequence:sampling") == "keyed"


def frame_times(prim: Usd.Prim) -> list[float]:
    """Return the time of each frame: of a keyed prim, every whole step from its first sample to its last one."""
    times = sample_times(prim)
    span = times[-1] - times[0] if times and is_keyed(prim) else np.nan
    return [times[0] + frame for frame in range(int(span) + 1)] if span < most_frames(len(times)) else times


def most_frames(sample_count: int) -> int:
    """Return the most frames that an asset may have with so many time samples."""
    return max(CLIP_FRAMES * sample_count, MAX_HELD_FRAMES)


def transform_times(prim: Usd.Prim) -> set[float]:
    """Return the sample times of the transforms of a prim and those above it."""
    xforms = (UsdGeom.Xformable(place) for place in ancestors(prim) if place.IsA(UsdGeom.Xformable))
    return {time for xform in xforms for time in xform.GetTimeSamples()}


def radiance_color_space(prim: Usd.Prim) -> tuple[str | None, str]:
    """Return the colour space of a prim's radiance, and the token that states it.

    ``beam:radianceColorSpace`` goes first, then ``colorSpace:name`` of the prim and of its ancestors. The colour space
    is None if nothing is stated (the token is then empty) or the token is unknown.
    """
    words = (authored(place, "colorSpace:name") for place in ancestors(prim))
    word = authored(prim, "beam:radianceColorSpace")
    word = next((found for found in words if found is not None), None) if word is None else word
    return _COLOR_SPACES.get(str(word)), str(word or "")


def has_whole_clips(prim: Usd.Prim) -> bool:
    """Return True if all clip layers of a prim can be opened; otherwise, OpenUSD raises on every query of samples."""
    return not any(clips.missing_layers() for clips in clip_sets(prim))


@dataclass(frozen=True)
class ClipSet:
    """One set of explicit value clips of a prim.

    Attributes:
        prim_path: Path of the prim inside each clip layer.
        manifest: Absolute path of the manifest; empty if none is stated.
        paths: Absolute paths of the clip layers.
        active: Pairs of the stage time at which a clip becomes active and its index.
        times: Pairs of stage time and time inside the clip.
    """

    prim_path: str
    manifest: str
    paths: tuple[str, ...]
    active: tuple[tuple[float, int], ...]
    times: tuple[tuple[float, float], ...]

    def missing_layers(self) -> list[str]:
        """Return the layers that cannot be opened."""
        return [path or "no manifest" for path in (self.manifest, *self.paths) if _open_layer(path) is None]

    def declared(self) -> set[str]:
        """Return the attributes that the manifest declares."""
        layer = _open_layer(self.manifest)
        prim = layer.GetPrimAtPath(self.prim_path) if layer else None
        return set(prim.attributes.keys()) if prim else set()

    def sampled(self, index: int) -> set[str]:
        """Return the attributes that have samples in one clip layer."""
        layer = _open_layer(self.paths[index])
        prim = layer.GetPrimAtPath(self.prim_path) if layer else None
        if layer is None or not prim:
            return set()
        names = prim.attributes.keys()
        return {name for name in names if layer.GetNumTimeSamplesForPath(f"{self.prim_path}.{name}")}

    def has_sample(self, name: str, time: float) -> bool:
        """Return True if the clip that is active at a stage time has a sample at that time."""
        index = next((index for start, index in reversed(self.active) if start <= time), None)
        layer = _open_layer(self.paths[index]) if index is not None and 0 <= index < len(self.paths) else None
        if layer is None or not self.times:
            return False
        inside = float(np.interp(time, *np.transpose(self.times)))
        return inside in layer.ListTimeSamplesForPath(f"{self.prim_path}.{name}")


def clip_sets(prim: Usd.Prim) -> list[ClipSet]:
    """Return the explicit value clips of a prim, with absolute paths."""
    clips = prim.GetMetadata("clips") or {}
    api = Usd.ClipsAPI(prim)
    return [
        ClipSet(
            prim_path=str(api.GetClipPrimPath(name)),
            manifest=_absolute(prim, api.GetClipManifestAssetPath(name)),
            paths=tuple(_absolute(prim, path) for path in paths),
            active=tuple((float(start), int(index)) for start, index in api.GetClipActive(name) or ()),
            times=tuple((float(outer), float(inner)) for outer, inner in api.GetClipTimes(name) or ()),
        )
        for name in clips
        if (paths := api.GetClipAssetPaths(name))
    ]


def _absolute(prim: Usd.Prim, path: Sdf.AssetPath | None) -> str:
    """Make a clip's path absolute, relative to the layer that names it; OpenUSD resolves it, in packages too."""
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
