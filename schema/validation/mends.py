"""Mends of broken rules, one function for each; its docstring says what it does.

A mend restates what the asset says elsewhere, derives what follows from its arrays, or writes the only value that the
schema allows. No mend chooses between two statements that contradict each other, and none supplies what only the
producer knows: units, axes, missing arrays, or whether values are logits. An array is mended as a whole or not at all.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, Vt

from beam_warp.checks import UNIT_TOLERANCE
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.schema import MATERIAL_API, SCHEMA_VERSION, SEQUENCE_API
from beam_warp.schema.authoring import kernel_extent
from beam_warp.schema.layout import CHANNELS, SH_DEGREE, from_vt, to_vt
from beam_warp.schema.stage_queries import (
    ancestors,
    array_attribute,
    authored,
    clip_sets,
    frame_times,
    has_whole_clips,
    is_keyed,
    radiance_color_space,
    sample_times,
    sequence_prim,
    splat_prims,
)
from beam_warp.schema.validation.rules import SEQUENCE_FACTS, TOKENS
from beam_warp.world.gaussians import MAX_SH_DEGREE

NORMALISED_LENGTHS = (0.5, 2.0)
"""Lengths of quaternions and normals that are brought to 1: the mean of two unit vectors that are up to 120 degrees
apart is at least 0.5 long, and their sum is at most 2. Data of other lengths may be something else."""

CLIPPED_REACH = 2.0**-10
"""How far outside [0, 1] values are clipped: the distance of 1 to the next larger half."""

Mend = Callable[[Usd.Prim, str], None]
"""Mends the rule that a prim and its attribute break, or leaves them as they are."""

Change = Callable[[NDArray[Any], Sequence[float]], "NDArray[Any] | None"]
"""Returns what becomes of an array that is shown at some times: the same object if nothing does, None if it cannot be
mended."""

MENDS: dict[str, Mend] = {}
"""Mend of each rule that has one, by the rule's id."""


def mending(*rules: str) -> Callable[[Mend], Mend]:
    """Return a decorator that enters a mend for some rules."""

    def enter(mend: Mend) -> Mend:
        MENDS.update(dict.fromkeys(rules, mend))
        return mend

    return enter


def mend_text(rule: str) -> str:
    """Return what is done about a broken rule in one sentence; empty if nothing is."""
    return (MENDS[rule].__doc__ or "").strip() if rule in MENDS else ""


@mending("BEAM-STAGE-001")
def _name_default_prim(root: Usd.Prim, _: str) -> None:
    """The only root prim becomes the default prim."""
    prims = root.GetChildren()
    if len(prims) == 1:
        root.GetStage().GetRootLayer().defaultPrim = prims[0].GetName()


@mending("BEAM-STAGE-005")
def _state_times(root: Usd.Prim, name: str) -> None:
    """The range becomes that of the time samples, the rate that of the sequence."""
    layer, prims = root.GetStage().GetRootLayer(), _whole_prims(root.GetStage())
    if name == "startTimeCode":
        times = sorted(set().union(*map(sample_times, prims)))
        layer.startTimeCode, layer.endTimeCode = times[0], times[-1]
        return
    playing = [place for place in map(sequence_prim, prims) if place is not None]
    rates = {authored(place, "beam:sequence:framesPerSecond") for place in playing}
    rate = rates.pop() if len(rates) == 1 else None
    if isinstance(rate, float) and 0.0 < rate < math.inf:
        layer.timeCodesPerSecond = rate


@mending("BEAM-GEO-002")
def _clear_half(prim: Usd.Prim, name: str) -> None:
    """The half array is removed if it is the float array, rounded."""
    wide, half = prim.GetAttribute(name), prim.GetAttribute(f"{name}h")
    declared = set().union(*(clips.declared() for clips in clip_sets(prim)))
    times = _times(prim)
    if declared & {name, f"{name}h"} or not all(_is_rounded(wide.Get(time), half.Get(time)) for time in times):
        return
    specs = half.GetPropertyStack()
    if all(_is_own(spec.layer, prim.GetStage()) for spec in specs):
        for spec in specs:
            spec.owner.RemoveProperty(spec)


@mending("BEAM-GEO-004")
def _write_extent(prim: Usd.Prim, _: str) -> None:
    """Bounds of all kernels at three standard deviations are written for each frame."""
    home, times = _home(prim), _times(prim)
    boxes = {time: box for time in times if (box := _bounds(prim, time)) is not None}
    if home is None or len(boxes) < len(times):
        return
    spec, offset = home
    attribute = spec.attributes.get("extent") or Sdf.AttributeSpec(spec, "extent", Sdf.ValueTypeNames.Float3Array)
    for time, box in boxes.items():
        value = to_vt("float3[]", box)
        if len(boxes) == 1:
            attribute.default = value
        else:
            spec.layer.SetTimeSample(attribute.path, offset.GetInverse() * time, value)


@mending("BEAM-GEO-015")
def _widen_extent(prim: Usd.Prim, name: str) -> None:
    """Bounds that leave out a position are computed again."""

    def change(box: NDArray[Any], times: Sequence[float]) -> NDArray[Any] | None:
        found = [_bounds(prim, time) for time in times]
        known = [each for each in found if each is not None]
        if len(known) < len(found):
            return None
        low, high = np.min([each[0] for each in known], axis=0), np.max([each[1] for each in known], axis=0)
        is_wide = box.shape == (2, 3) and (box[0] <= low).all() and (box[1] >= high).all()
        return box if is_wide else np.stack([low, high])

    _rewrite(prim, name, 3, change)


@mending("BEAM-GEO-010", "BEAM-SH-002")
def _cut(prim: Usd.Prim, name: str) -> None:
    """An array that is too long is cut; USD ignores what is beyond."""
    degree, is_radiance = authored(prim, SH_DEGREE), name in CHANNELS["radiance"].usd_names
    terms = (degree + 1) ** 2 if is_radiance else 1

    def change(array: NDArray[Any], times: Sequence[float]) -> NDArray[Any] | None:
        counts = {_count(prim, time) for time in times}
        count = counts.pop()
        # As many coefficients as another degree has are no surplus: array and degree contradict each other.
        contradicts = is_radiance and _degree_of(len(array), count) not in (None, degree)
        if counts or len(array) < count * terms or contradicts:
            return None
        return array if len(array) == count * terms else array[: count * terms]

    _rewrite(prim, name, _columns(name), change)


@mending("BEAM-GEO-012", "BEAM-MAT-014")
def _normalise(prim: Usd.Prim, name: str) -> None:
    """Vectors of length 0.5 to 2 are brought to unit length."""

    def change(array: NDArray[Any], _: Sequence[float]) -> NDArray[Any] | None:
        wide = array.astype(np.float64)
        length = np.linalg.norm(wide, axis=1)
        off = np.isfinite(length) & ~(np.abs(length - 1.0) <= UNIT_TOLERANCE)
        if not off.any():
            return array
        low, high = NORMALISED_LENGTHS
        if not ((length[off] >= low) & (length[off] <= high)).all():
            return None
        wide[off] /= length[off, None]
        return wide.astype(array.dtype)

    _rewrite(prim, name, _columns(name), change)


@mending(*("BEAM-GEO-014", "BEAM-MAT-010", "BEAM-MAT-011", "BEAM-MAT-012", "BEAM-MAT-013", "BEAM-MAT-015"))
def _clip(prim: Usd.Prim, name: str) -> None:
    """Values that rounding to half explains, up to 0.001 outside, are clipped."""

    def change(array: NDArray[Any], _: Sequence[float]) -> NDArray[Any] | None:
        clipped = np.clip(array, 0.0, 1.0)
        off = (array != clipped) & ~np.isnan(array)
        near = (array >= -CLIPPED_REACH) & (array <= 1.0 + CLIPPED_REACH)
        return array if not off.any() else clipped if near[off].all() else None

    _rewrite(prim, name, _columns(name), change)


@mending("BEAM-SH-001")
def _state_degree(prim: Usd.Prim, _: str) -> None:
    """The degree that the number of coefficients has is stated where none was."""
    attribute = array_attribute(prim, CHANNELS["radiance"])
    if attribute is None or authored(prim, SH_DEGREE) is not None:
        return
    degrees = {_degree_of(len(attribute.Get(time) or ()), _count(prim, time)) for time in _times(prim)}
    degree = degrees.pop()
    if not degrees and degree is not None:
        _state(prim, SH_DEGREE, "int", degree)


@mending("BEAM-API-002")
def _apply_material_api(prim: Usd.Prim, _: str) -> None:
    """The schema that the attributes belong to is applied."""
    _apply(prim, MATERIAL_API)


@mending("BEAM-COLOR-001")
def _state_base_color_space(prim: Usd.Prim, name: str) -> None:
    """The only space that the schema allows is stated where none was."""
    specs = prim.GetAttribute(name).GetPropertyStack()
    own = [spec for spec in specs if _is_own(spec.layer, prim.GetStage())]
    if own and not any(spec.HasColorSpace() for spec in specs):
        own[0].colorSpace = LINEAR_REC709


@mending("BEAM-COLOR-002")
def _state_radiance_color_space(prim: Usd.Prim, _: str) -> None:
    """The space that colorSpace:name states, or that the stand-in for viewers has, is stated."""
    space, word = radiance_color_space(prim)
    if not word and authored(prim, "beam:radianceMeaning") == "baseColorOnly":
        space = DISPLAY_SRGB
    if space is not None:
        _state(prim, "beam:radianceColorSpace", "token", space)


@mending("BEAM-TOKEN-001")
def _state_token(prim: Usd.Prim, name: str) -> None:
    """A token with one allowed value is stated, and that there are no normals where there are none."""
    if len(TOKENS[name]) == 1:
        _state(prim, name, "token", TOKENS[name][0])
    elif name == "beam:normalSource" and array_attribute(prim, CHANNELS["normals"]) is None:
        _state(prim, name, "token", "none")


@mending("BEAM-VERSION-001")
def _state_version(prim: Usd.Prim, name: str) -> None:
    """The version is stated where none was, if it has every attribute of the asset."""
    known = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(MATERIAL_API)
    used = {used for used in prim.GetAuthoredPropertyNames() if used.startswith("beam:")}
    if not authored(prim, name) and known is not None and used <= set(known.GetPropertyNames()):
        _state(prim, name, "token", SCHEMA_VERSION)


@mending("BEAM-SEQ-001")
def _state_sequence(prim: Usd.Prim, name: str) -> None:
    """The schema is applied to the default prim; range, rate, and that rows are unrelated are stated."""
    stage = prim.GetStage()
    if not name:
        root = stage.GetDefaultPrim()
        if root in ancestors(prim) and root.GetTypeName() == "Xform":
            _apply(root, SEQUENCE_API)
    elif name == "beam:sequence:topology":
        _state(prim, name, "token", "perFrame")
    elif name == "beam:sequence:framesPerSecond":
        if stage.HasAuthoredMetadata("timeCodesPerSecond"):
            _state(prim, name, "double", stage.GetTimeCodesPerSecond())
    elif stage.HasAuthoredTimeCodeRange():
        count = stage.GetEndTimeCode() - stage.GetStartTimeCode() + 1.0
        if count.is_integer() and 1.0 <= count < 2.0**31:
            _state(prim, name, "int", int(count))


@mending("BEAM-SEQ-002")
def _state_frame_count(playing: Usd.Prim, name: str) -> None:
    """The frame count or the range becomes that of the time samples, if these agree with the other one."""
    stage = playing.GetStage()
    prims = [prim for prim in _whole_prims(stage) if sequence_prim(prim) == playing]
    times = sorted(set().union(*map(sample_times, prims)))
    if name != SEQUENCE_FACTS[0] or len(times) < 2 or times != [times[0] + frame for frame in range(len(times))]:
        return
    if (times[0], times[-1]) == (stage.GetStartTimeCode(), stage.GetEndTimeCode()):
        _state(playing, name, "int", len(times))
    elif len(times) == authored(playing, name):
        layer = stage.GetRootLayer()
        layer.startTimeCode, layer.endTimeCode = times[0], times[-1]


@mending("BEAM-SEQ-005")
def _state_topology(prim: Usd.Prim, _: str) -> None:
    """Rows are stated to be unrelated, since their number changes; not of an asset that has keys."""
    playing = sequence_prim(prim)
    if playing is not None and not is_keyed(prim):
        _state(playing, "beam:sequence:topology", "token", "perFrame")


@mending("BEAM-SEQ-008")
def _keep_signs(prim: Usd.Prim, name: str) -> None:
    """Quaternions are negated where they changed sign; both signs are the same rotation."""
    before: NDArray[Any] | None = None

    def change(array: NDArray[Any], _: Sequence[float]) -> NDArray[Any]:
        nonlocal before
        if before is not None and before.shape == array.shape:
            flipped = np.einsum("nk,nk->n", array.astype(np.float32), before.astype(np.float32)) < 0.0
            array = np.where(flipped[:, None], -array, array) if flipped.any() else array
        before = array
        return array

    _rewrite(prim, name, 4, change)


class _Place(NamedTuple):
    """Where a value is stored: in a layer at a path, as the sample of a time there, or as the default (None)."""

    layer: Sdf.Layer
    path: Sdf.Path
    time: float | None

    def write(self, value: Any) -> None:
        """Replace the value."""
        if self.time is None:
            self.layer.GetAttributeAtPath(self.path).default = value
        else:
            self.layer.SetTimeSample(self.path, self.time, value)

    def repeats(self) -> Iterator[_Place]:
        """Yield the place of the primvar that shows the same value to shading networks, where there is one."""
        for channel in CHANNELS.values():
            if channel.primvar and self.path.name in channel.usd_names:
                path = self.path.ReplaceName(channel.primvar)
                if self.layer.GetAttributeAtPath(path) is not None:
                    yield self._replace(path=path)


def _rewrite(prim: Usd.Prim, name: str, columns: int, change: Change) -> None:
    """Change an array wherever it is stored, in order of time; all of it or, if one part cannot be mended, nothing."""
    attribute = prim.GetAttribute(name)
    keys = attribute.GetTimeSamples() if is_keyed(prim) else []
    places = _places(attribute, keys or _times(prim))
    changed: dict[_Place, NDArray[Any]] = {}
    for place, times in places.items():
        value = np.asarray(attribute.Get(times[0]))
        array = value.reshape(-1) if columns == 1 else value.reshape(-1, columns)
        new = change(array, times)
        if new is None:
            return
        if new is not array:
            changed[place] = new
    for place, array in changed.items():
        for each in (place, *place.repeats()):
            each.write(to_vt(str(attribute.GetTypeName()), array))


def _places(attribute: Usd.Attribute, times: Sequence[float]) -> dict[_Place, list[float]]:
    """Return where an attribute's values are stored, with the stage times that each place serves.

    Empty if a value is interpolated, retimed by clips, or stored in a layer that is not the asset's own.
    """
    found: dict[_Place, list[float]] = {}
    prim = attribute.GetPrim()
    retimed = any(outer != inner for clips in clip_sets(prim) for outer, inner in clips.times)
    for time in times:
        place = next(_stored(attribute, time), None)
        if retimed or place is None or not _is_own(place.layer, prim.GetStage()):
            return {}
        found.setdefault(place, []).append(time)
    return found


def _stored(attribute: Usd.Attribute, time: float) -> Iterator[_Place]:
    """Yield the place of the value at a stage time; nothing if it lies between samples."""
    for spec, offset in attribute.GetPropertyStackWithLayerOffsets(time):
        local = offset.GetInverse() * time
        is_sampled, before, _ = spec.layer.GetBracketingTimeSamplesForPath(spec.path, local)
        if is_sampled or spec.HasDefaultValue():
            if not is_sampled or before == local:
                yield _Place(spec.layer, spec.path, local if is_sampled else None)
            return


def _is_own(layer: Sdf.Layer, stage: Usd.Stage) -> bool:
    """Return True for a layer in the folder of the asset that may be written."""
    home = Path(stage.GetRootLayer().realPath).parent
    return layer.permissionToEdit and Path(layer.realPath).is_relative_to(home) and os.access(layer.realPath, os.W_OK)


def _home(prim: Usd.Prim) -> tuple[Sdf.PrimSpec, Sdf.LayerOffset] | None:
    """Return the strongest own spec that gives a prim its type, and the offset of its layer's times."""
    for spec, offset in prim.GetPrimStackWithLayerOffsets():
        if spec.typeName and _is_own(spec.layer, prim.GetStage()):
            return spec, offset
    return None


def _state(prim: Usd.Prim, name: str, type_name: str, value: Any) -> None:
    """Author a uniform attribute where the prim is defined."""
    home = _home(prim)
    if home is not None:
        kind = Sdf.ValueTypeNames.Find(type_name)
        spec = home[0].attributes.get(name) or Sdf.AttributeSpec(home[0], name, kind, Sdf.VariabilityUniform)
        if spec.typeName == kind:
            spec.default = value


def _apply(prim: Usd.Prim, schema: str) -> None:
    """Apply a schema where the prim is defined."""
    home = _home(prim)
    if home is not None:
        schemas = home[0].GetInfo("apiSchemas") if home[0].HasInfo("apiSchemas") else Sdf.TokenListOp()
        if schemas.isExplicit:
            schemas.explicitItems = [*schemas.explicitItems, schema]
        else:
            schemas.deletedItems = [name for name in schemas.deletedItems if name != schema]
            schemas.prependedItems = [*schemas.prependedItems, schema]
        home[0].SetInfo("apiSchemas", schemas)


def _whole_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Return the Gaussian-splat prims whose samples can be asked for."""
    return [prim for prim in splat_prims(stage) if has_whole_clips(prim)]


def _times(prim: Usd.Prim) -> list[float]:
    return frame_times(prim) or [prim.GetStage().GetStartTimeCode()]


def _columns(name: str) -> int:
    return next(channel.columns for channel in CHANNELS.values() if name in channel.usd_names)


def _array(prim: Usd.Prim, name: str, time: float) -> NDArray[Any] | None:
    attribute = array_attribute(prim, CHANNELS[name])
    value = attribute.Get(time) if attribute is not None else None
    return None if value is None else from_vt(CHANNELS[name], value)


def _count(prim: Usd.Prim, time: float) -> int:
    positions = _array(prim, "positions", time)
    return 0 if positions is None else len(positions)


def _degree_of(coefficients: int, count: int) -> int | None:
    """Return the degree that has so many coefficients for so many Gaussians."""
    degrees = range(MAX_SH_DEGREE + 1)
    return next((degree for degree in degrees if count and coefficients == count * (degree + 1) ** 2), None)


def _bounds(prim: Usd.Prim, time: float) -> NDArray[np.float32] | None:
    """Return the bounds of all kernels that are finite; None if an array is missing or has another length."""
    arrays = [_array(prim, name, time) for name in ("positions", "orientations", "scales")]
    found = [array.astype(np.float64) for array in arrays if array is not None]
    if len(found) < 3 or len({len(array) for array in found}) > 1:
        return None
    finite = np.logical_and.reduce([np.isfinite(array).all(axis=1) for array in found])
    positions, orientations, scales = (array[finite] for array in found)
    lengths = np.linalg.norm(orientations, axis=1, keepdims=True)
    return kernel_extent(positions, orientations / np.where(lengths > 0.0, lengths, 1.0), scales)


def _is_rounded(wide: Vt.FloatArray, half: Vt.HalfArray) -> bool:
    """Return True if an array of halves is another array, rounded."""
    one, two = np.asarray(wide), np.asarray(half)
    with np.errstate(over="ignore"):
        return one.shape == two.shape and np.array_equal(one.astype(np.float16), two, equal_nan=True)
