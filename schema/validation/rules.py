"""Rules about stages and prims, one function each; its docstring is the text of the rule.

Rules about the arrays of a frame are in `beam_warp.schema.validation.frame_rules`. Each rule has a stable id and a
severity. Ids are never reused: a rule that is dropped leaves a gap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pxr import Usd, UsdGeom

from beam_warp.errors import AssetFormatError
from beam_warp.image.color import COLOR_SPACES, LINEAR_REC709
from beam_warp.schema import MATERIAL_API, SCHEMA_VERSION, SEQUENCE_API
from beam_warp.schema.layout import CHANNELS, SH_DEGREE
from beam_warp.schema.placement import placement_of
from beam_warp.schema.stage_queries import (
    METERS_RANGE,
    array_attribute,
    authored,
    clip_sets,
    has_material_api,
    has_whole_clips,
    is_keyed,
    sample_times,
    sequence_prim,
    splat_prims,
)
from beam_warp.schema.validation.report import Severity
from beam_warp.world.gaussians import MATERIAL_CHANNELS, MAX_SH_DEGREE


class Fault(NamedTuple):
    """One violation of a rule, as its check yields it; ``prim`` is empty if it is the prim that is checked."""

    message: str
    attribute: str = ""
    prim: str = ""


Check = Callable[[Any], Iterator[Fault]]


@dataclass(frozen=True)
class Rule:
    """A rule of the schema.

    Attributes:
        id: Stable id, ``BEAM-<AREA>-<nnn>``.
        severity: ``error`` or ``warning``.
        text: The contract, in one sentence.
        check: Function that yields the violations of a stage, a prim or a frame.
        reads: Channels that the check of a frame reads beside positions; empty if it reads all.
    """

    id: str
    severity: Severity
    text: str
    check: Check
    reads: tuple[str, ...] = ()


def entering(table: list[Rule], rule_id: str, severity: Severity, *reads: str) -> Callable[[Check], Check]:
    """Return a decorator that enters a check in a table of rules, with its docstring as the text."""

    def enter(check: Check) -> Check:
        table.append(Rule(rule_id, severity, (check.__doc__ or "").strip(), check, reads))
        return check

    return enter


STAGE_RULES: list[Rule] = []
FIRST_RULES: list[Rule] = []
"""Rules about a prim that are checked before all others: a missing clip layer makes OpenUSD raise errors everywhere."""
PRIM_RULES: list[Rule] = []

REQUIRED = ("positions", "orientations", "scales", "opacities", "radiance")
TOKENS = {
    "beam:brdf": ("ggx-metallic-roughness",),
    "beam:aoMeaning": ("hemisphericalVisibility",),
    "beam:normalSource": ("authored", "shortestAxis", "none"),
    "beam:radianceMeaning": ("captured", "shaded", "baseColorOnly"),
}
SEQUENCE_FACTS = ("beam:sequence:frameCount", "beam:sequence:framesPerSecond", "beam:sequence:topology")
OPTIONAL_TOKENS = {
    "beam:roughnessSource": ("texture", "estimated", "constant", "unknown"),
    "beam:sequence:topology": ("constant", "perSegment", "perFrame"),
    "beam:sequence:sampling": ("everyFrame", "keyed"),
}


@entering(STAGE_RULES, "BEAM-STAGE-001", "error")
def _default_prim(stage: Usd.Stage) -> Iterator[Fault]:
    """The stage names a default prim that exists, so that it can be referenced."""
    if not stage.GetDefaultPrim():
        yield Fault(f"defaultPrim must name a prim, got {stage.GetRootLayer().defaultPrim or 'none'!r}. Set it.")


@entering(STAGE_RULES, "BEAM-STAGE-002", "error")
def _meters_per_unit(stage: Usd.Stage) -> Iterator[Fault]:
    """metersPerUnit is authored and positive; without it, USD assumes centimetres."""
    meters = UsdGeom.GetStageMetersPerUnit(stage)
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        yield Fault("metersPerUnit must be authored, got none. Set it, for example to 1.")
    elif not METERS_RANGE[0] <= meters <= METERS_RANGE[1]:
        yield Fault(f"metersPerUnit must be positive and at most {METERS_RANGE[1]:g}, got {meters:g}. Set it to 1.")


@entering(STAGE_RULES, "BEAM-STAGE-003", "error")
def _up_axis(stage: Usd.Stage) -> Iterator[Fault]:
    """upAxis is authored as Y or Z."""
    up = stage.GetRootLayer().pseudoRoot.GetInfo("upAxis") if stage.HasAuthoredMetadata("upAxis") else None
    if up not in ("Y", "Z"):
        yield Fault(f"upAxis must be Y or Z, got {up!r}. Author it.")


@entering(STAGE_RULES, "BEAM-STAGE-004", "error")
def _holds_splats(stage: Usd.Stage) -> Iterator[Fault]:
    """The stage holds at least one ParticleField3DGaussianSplat."""
    if not splat_prims(stage):
        yield Fault("the stage must hold a ParticleField3DGaussianSplat, got none. Convert the splats first.")


@entering(STAGE_RULES, "BEAM-STAGE-005", "error")
def _time_codes(stage: Usd.Stage) -> Iterator[Fault]:
    """A stage with time samples states its time range and timeCodesPerSecond."""
    if not any(has_whole_clips(prim) and len(sample_times(prim)) > 1 for prim in splat_prims(stage)):
        return
    first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    if not stage.HasAuthoredTimeCodeRange() or not first <= last:
        got = f"{first:g} and {last:g}" if stage.HasAuthoredTimeCodeRange() else "none"
        message = f"startTimeCode and endTimeCode must be authored in order, got {got}. Author them."
        yield Fault(message, "startTimeCode")
    is_stated, rate = stage.HasAuthoredMetadata("timeCodesPerSecond"), stage.GetTimeCodesPerSecond()
    if not is_stated or not 0.0 < rate < np.inf:
        got = f"{rate:g}" if is_stated else "none"
        message = f"timeCodesPerSecond must be authored and positive, got {got}. Author the frame rate."
        yield Fault(message, "timeCodesPerSecond")


@entering(STAGE_RULES, "BEAM-STAGE-006", "error")
def _composes(stage: Usd.Stage) -> Iterator[Fault]:
    """Every layer that the stage references exists and composes."""
    for problem in stage.GetCompositionErrors():
        yield Fault(f"the stage must compose, got: {' '.join(str(problem).split())} Restore the missing layer.")


@entering(PRIM_RULES, "BEAM-GEO-001", "error")
def _required_arrays(prim: Usd.Prim) -> Iterator[Fault]:
    """Positions, orientations, scales, opacities and spherical harmonics are authored."""
    for name in REQUIRED:
        channel = CHANNELS[name]
        if array_attribute(prim, channel) is None:
            yield Fault(f"{channel.usd_name} must be authored, got none. Write the array.", channel.usd_name)


@entering(PRIM_RULES, "BEAM-GEO-002", "error")
def _one_precision(prim: Usd.Prim) -> Iterator[Fault]:
    """An array is authored in float or in half precision, not in both, so that no host reads a stale variant."""
    for channel in CHANNELS.values():
        if len([name for name in channel.usd_names if authored_at_all(prim, name)]) > 1:
            yield Fault("one precision must be authored, got float and half. Clear one of them.", channel.usd_name)


@entering(PRIM_RULES, "BEAM-GEO-003", "error")
def _similarity(prim: Usd.Prim) -> Iterator[Fault]:
    """The transform to the world is rotation, uniform scale and translation."""
    for time in sample_times(prim) or [Usd.TimeCode.Default()]:
        matrix = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim))
        try:
            placement_of(matrix, 1.0, str(prim.GetPath()))
        except AssetFormatError as error:
            yield Fault(str(error))
            return


@entering(PRIM_RULES, "BEAM-GEO-004", "error")
def _extent_authored(prim: Usd.Prim) -> Iterator[Fault]:
    """extent is authored; USD computes none for Gaussian splats."""
    if not authored_at_all(prim, "extent"):
        yield Fault("extent must be authored, got none. Write the bounds of each frame.", "extent")


@entering(PRIM_RULES, "BEAM-SH-001", "error")
def _sh_degree(prim: Usd.Prim) -> Iterator[Fault]:
    """The spherical-harmonics degree is authored, from 0 to 4; without it, USD assumes 3."""
    degree = authored(prim, SH_DEGREE)
    if not isinstance(degree, int) or not 0 <= degree <= MAX_SH_DEGREE:
        yield Fault(f"the degree must be authored, 0 to {MAX_SH_DEGREE}, got {degree!r}. Author it.", SH_DEGREE)


@entering(PRIM_RULES, "BEAM-API-001", "warning")
def _is_relightable(prim: Usd.Prim) -> Iterator[Fault]:
    """The prim has BeamRelightableGaussianAPI; without it, the Gaussians cannot be relit."""
    if not has_material_api(prim) and not _beam_attributes(prim):
        yield Fault(f"{MATERIAL_API} should be applied, got ordinary splats. Decompose them to relight them.")


@entering(PRIM_RULES, "BEAM-API-002", "error")
def _api_applied(prim: Usd.Prim) -> Iterator[Fault]:
    """A prim with authored beam: attributes has BeamRelightableGaussianAPI applied."""
    names = _beam_attributes(prim)
    if names and not has_material_api(prim):
        yield Fault(f"{MATERIAL_API} must be applied, got beam: attributes without it. Apply it.", names[0])


@entering(PRIM_RULES, "BEAM-MAT-001", "warning")
def _relightable_channels(prim: Usd.Prim) -> Iterator[Fault]:
    """Base colour, roughness, ambient occlusion and normals, which relighting reads, are all authored."""
    missing = [CHANNELS[name].usd_name for name in MATERIAL_CHANNELS if array_attribute(prim, CHANNELS[name]) is None]
    if has_material_api(prim) and missing:
        yield Fault(f"relighting needs {', '.join(missing)}, got none. Decompose the asset.", missing[0])


@entering(PRIM_RULES, "BEAM-MAT-002", "error")
def _normal_source(prim: Usd.Prim) -> Iterator[Fault]:
    """normalSource is none if and only if there are no normals."""
    source = authored(prim, "beam:normalSource")
    has_normals = array_attribute(prim, CHANNELS["normals"]) is not None
    if has_material_api(prim) and source in TOKENS["beam:normalSource"] and (source == "none") == has_normals:
        got = "normals" if has_normals else "no normals"
        yield Fault(f"normalSource must fit the normals, got {source} with {got}. Mend it.", "beam:normalSource")


@entering(PRIM_RULES, "BEAM-COLOR-001", "error")
def _base_color_space(prim: Usd.Prim) -> Iterator[Fault]:
    """The base colour's colour space is authored as lin_rec709_scene, not left to a fallback."""
    attribute = array_attribute(prim, CHANNELS["base_color"])
    if attribute is not None:
        spaces = [spec.colorSpace for spec in attribute.GetPropertyStack() if spec.HasColorSpace()]
        if not spaces or spaces[0] != LINEAR_REC709:
            got = spaces[0] if spaces else "none"
            yield Fault(f"colorSpace must be {LINEAR_REC709}, got {got}. Author it.", attribute.GetName())


@entering(PRIM_RULES, "BEAM-COLOR-002", "error")
def _radiance_color_space(prim: Usd.Prim) -> Iterator[Fault]:
    """The colour space of the radiance is authored and is one of the known ones."""
    space = authored(prim, "beam:radianceColorSpace")
    if has_material_api(prim) and space not in COLOR_SPACES:
        wanted = " or ".join(COLOR_SPACES)
        yield Fault(f"the colour space must be {wanted}, got {space!r}. Author it.", "beam:radianceColorSpace")


@entering(PRIM_RULES, "BEAM-RASTER-001", "error")
def _low_pass(prim: Usd.Prim) -> Iterator[Fault]:
    """The variance of the low-pass that splats are drawn with, if authored, is positive and finite."""
    low_pass = authored(prim, "beam:rasterLowPass")
    if low_pass is not None and not 0.0 < low_pass < np.inf:
        yield Fault(f"the low-pass must be positive, got {low_pass:g}. Author that of the fit.", "beam:rasterLowPass")


@entering(PRIM_RULES, "BEAM-TOKEN-001", "error")
def _tokens_authored(prim: Usd.Prim) -> Iterator[Fault]:
    """brdf, aoMeaning, normalSource and radianceMeaning are authored; hosts without the plug-in see no fallbacks."""
    for name in TOKENS:
        if has_material_api(prim) and authored(prim, name) is None:
            yield Fault(f"{name} must be authored, got none. Author it.", name)


@entering(PRIM_RULES, "BEAM-TOKEN-002", "error")
def _tokens_known(prim: Usd.Prim) -> Iterator[Fault]:
    """Every token has one of its allowed values."""
    playing = sequence_prim(prim)
    for name, allowed in {**TOKENS, **OPTIONAL_TOKENS}.items():
        holder = playing if name.startswith("beam:sequence:") else prim
        value = authored(holder, name) if holder is not None else None
        if value is not None and value not in allowed:
            yield Fault(f"{name} must be one of {', '.join(allowed)}, got {value!r}. Choose one.", name)


@entering(PRIM_RULES, "BEAM-VERSION-001", "error")
def _version_authored(prim: Usd.Prim) -> Iterator[Fault]:
    """schemaVersion is authored as major.minor."""
    version = authored(prim, "beam:schemaVersion")
    if has_material_api(prim) and _parsed(version) is None:
        yield Fault(f"the version must be major.minor, got {version!r}. Author it.", "beam:schemaVersion")


@entering(PRIM_RULES, "BEAM-VERSION-002", "error")
def _version_major(prim: Usd.Prim) -> Iterator[Fault]:
    """The schema's major version is that of this validator."""
    version = _parsed(authored(prim, "beam:schemaVersion"))
    if has_material_api(prim) and version is not None and version[0] != _KNOWN[0]:
        yield Fault(f"the major version must be {_KNOWN[0]}, got {version[0]}. Upgrade.", "beam:schemaVersion")


@entering(PRIM_RULES, "BEAM-VERSION-003", "warning")
def _version_minor(prim: Usd.Prim) -> Iterator[Fault]:
    """The schema's minor version is not newer than that of this validator."""
    version = _parsed(authored(prim, "beam:schemaVersion"))
    if has_material_api(prim) and version is not None and version[0] == _KNOWN[0] and version[1] > _KNOWN[1]:
        yield Fault(f"what is newer than {SCHEMA_VERSION} was not checked, got 1.{version[1]}. Upgrade.")


@entering(PRIM_RULES, "BEAM-SEQ-001", "error")
def _sequence_api(prim: Usd.Prim) -> Iterator[Fault]:
    """An ancestor of a relightable prim has BeamSequenceAPI, with frameCount, framesPerSecond and topology authored."""
    if not has_material_api(prim):
        return
    playing = sequence_prim(prim)
    if playing is None:
        yield Fault(f"an ancestor must have {SEQUENCE_API}, got none. Apply it to the default prim.")
        return
    for name in SEQUENCE_FACTS:
        if authored(playing, name) is None:
            yield Fault(f"{name} must be authored, got none. Author it.", name, str(playing.GetPath()))


@entering(PRIM_RULES, "BEAM-SEQ-002", "error")
def _frame_count(prim: Usd.Prim) -> Iterator[Fault]:
    """frameCount is the number of time codes in the stage's range, and framesPerSecond equals timeCodesPerSecond."""
    playing, stage = sequence_prim(prim), prim.GetStage()
    if playing is None or not stage.HasAuthoredTimeCodeRange():
        return
    count, rate = (authored(playing, name) for name in SEQUENCE_FACTS[:2])
    codes, where = stage.GetEndTimeCode() - stage.GetStartTimeCode() + 1, str(playing.GetPath())
    if count is not None and count != codes:
        message = f"frameCount must be the length of the range, {codes:g}, got {count}. Mend either."
        yield Fault(message, SEQUENCE_FACTS[0], where)
    if rate is not None and rate != stage.GetTimeCodesPerSecond():
        wanted = stage.GetTimeCodesPerSecond()
        message = f"framesPerSecond must equal timeCodesPerSecond, {wanted:g}, got {rate:g}. Mend either."
        yield Fault(message, SEQUENCE_FACTS[1], where)


@entering(PRIM_RULES, "BEAM-SEQ-003", "error")
def _same_samples(prim: Usd.Prim) -> Iterator[Fault]:
    """Unless they are keyed, all arrays that vary have the same time samples, so that each frame is complete."""
    samples = {} if is_keyed(prim) else _own_samples(prim)
    union = sorted(set().union(*samples.values())) if samples else []
    for name, times in samples.items():
        if times != union:
            gap = min(set(union) - set(times))
            yield Fault(f"samples must be those of all arrays, got none at time {gap:g}. Write every frame.", name)


@entering(PRIM_RULES, "BEAM-SEQ-004", "error")
def _contiguous_samples(prim: Usd.Prim) -> Iterator[Fault]:
    """Unless arrays are keyed, there are time samples at every whole time code of the range, and at no other time."""
    stage = prim.GetStage()
    union = sorted(set().union(*_own_samples(prim).values()))
    if not has_material_api(prim) or not union or not stage.HasAuthoredTimeCodeRange() or is_keyed(prim):
        return
    wanted = list(np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1.0))
    if union != wanted:
        strange = min(set(union) ^ set(wanted))
        yield Fault(f"samples must be every whole time code of the range, got a difference at {strange:g}. Mend them.")


@entering(PRIM_RULES, "BEAM-SEQ-009", "error")
def _capture_frames(prim: Usd.Prim) -> Iterator[Fault]:
    """captureFrames, if authored, holds one number for each frame, and none is negative."""
    playing = sequence_prim(prim)
    numbers = authored(playing, "beam:sequence:captureFrames") if playing is not None else None
    if playing is None or numbers is None:
        return
    count = authored(playing, "beam:sequence:frameCount")
    if count is not None and len(numbers) != count:
        yield Fault(f"captureFrames must hold a number for each of {count} frames, got {len(numbers)}. Mend it.")
    elif any(number < 0 for number in numbers):
        yield Fault(f"captureFrames must not be negative, got {min(numbers)}. Number the frames from 0.")


@entering(PRIM_RULES, "BEAM-SEQ-010", "error")
def _keys(prim: Usd.Prim) -> Iterator[Fault]:
    """Keyed arrays have a constant topology, and samples at whole time codes of the range, its ends among them."""
    stage = prim.GetStage()
    if not is_keyed(prim) or not stage.HasAuthoredTimeCodeRange():
        return
    if authored(sequence_prim(prim), "beam:sequence:topology") != "constant":
        yield Fault("topology must be constant with keys, got another one. Write a sample at every frame.")
    first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    for attribute in filter(None, (array_attribute(prim, channel) for channel in CHANNELS.values())):
        times = attribute.GetTimeSamples()
        whole = all((time - first).is_integer() for time in times)
        if times and not (whole and (times[0], times[-1]) == (first, last)):
            message = f"samples must be whole time codes from {first:g} to {last:g}, got {times[0]:g} to {times[-1]:g}"
            yield Fault(f"{message}. Write both ends.", attribute.GetName())


@entering(FIRST_RULES, "BEAM-CLIP-001", "error")
def _clips_resolve(prim: Usd.Prim) -> Iterator[Fault]:
    """Every layer that value clips name can be opened, and every clip that becomes active exists."""
    for clips in clip_sets(prim):
        for path in clips.missing_layers():
            yield Fault(f"a clip layer must open, got {path}, which does not. Restore it.")
        if any(not 0 <= index < len(clips.paths) for _, index in clips.active):
            yield Fault("active clips must be among the clip layers, got another index. Mend clips:active.")


@entering(PRIM_RULES, "BEAM-CLIP-002", "error")
def _clip_manifest(prim: Usd.Prim) -> Iterator[Fault]:
    """The manifest declares exactly the attributes that the clip layers sample."""
    for clips in clip_sets(prim):
        declared, sampled = clips.declared(), set().union(*(clips.sampled(index) for index in range(len(clips.paths))))
        for name in sorted(declared ^ sampled):
            got = "no samples of what it declares" if name in declared else "samples of what it does not declare"
            yield Fault(f"the manifest must declare what clips sample, got {got}. Write it anew.", name)


@entering(PRIM_RULES, "BEAM-CLIP-003", "error")
def _clips_cover(prim: Usd.Prim) -> Iterator[Fault]:
    """The active clip has a sample of every declared attribute at every time code, or, with keys, at its ends."""
    stage = prim.GetStage()
    for clips in clip_sets(prim):
        if not clips.active or not stage.HasAuthoredTimeCodeRange():
            continue
        first, last = stage.GetStartTimeCode(), stage.GetEndTimeCode()
        starts = sorted(start for start, _ in clips.active)[1:]
        ends = (first, *(time for start in starts for time in (start - 1.0, start)), last)
        for name in sorted(clips.declared() & clips.sampled(0)):
            for time in ends if is_keyed(prim) and name != "extent" else np.arange(first, last + 1.0):
                if not clips.has_sample(name, float(time)):
                    yield Fault(f"the active clip must have a sample at time {time:g}, got none. Write it.", name)
                    break


def authored_at_all(prim: Usd.Prim, name: str) -> bool:
    """Return True if an attribute has a value anywhere, also in time samples or clips."""
    attribute = prim.GetAttribute(name)
    return bool(attribute) and attribute.HasAuthoredValue()


def _beam_attributes(prim: Usd.Prim) -> list[str]:
    return [name for name in prim.GetAuthoredPropertyNames() if name.startswith("beam:")]


def _own_samples(prim: Usd.Prim) -> dict[str, list[float]]:
    """Return the sample times of every array that varies by its own time samples, not by clips."""
    clipped = set().union(*(clips.declared() for clips in clip_sets(prim)))
    samples = {}
    for channel in CHANNELS.values():
        attribute = array_attribute(prim, channel)
        if attribute is not None and attribute.GetName() not in clipped and attribute.GetNumTimeSamples():
            samples[attribute.GetName()] = attribute.GetTimeSamples()
    return samples


def _parsed(version: Any) -> tuple[int, int] | None:
    """Return major and minor of a version; None if it is not of the form major.minor."""
    major, _, minor = str(version or "").partition(".")
    return (int(major), int(minor)) if major.isdecimal() and minor.isdecimal() else None


_KNOWN = _parsed(SCHEMA_VERSION) or (0, 0)
