"""Validation of an asset or an open stage by every rule of ours and by OpenUSD's own validators.

`validate` runs ``python -m beam_warp.schema.validation.validator ASSET`` as a child process, which a corrupt file may
end.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence, Set
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Gf, Sdr, Tf, Usd, UsdValidation

from beam_warp.errors import AssetFormatError
from beam_warp.schema import register
from beam_warp.schema.files import require_asset_file, run_child, said_by_usd, size_around
from beam_warp.schema.layout import CHANNELS, SH_DEGREE, from_vt
from beam_warp.schema.probe import limit_memory, special_file
from beam_warp.schema.stage_queries import array_attribute, authored, frame_times, is_keyed, sequence_prim, splat_prims
from beam_warp.schema.validation.frame_rules import FRAME_RULES, FrameArrays
from beam_warp.schema.validation.report import BrokenRule, Report, Severity
from beam_warp.schema.validation.rules import FIRST_RULES, PRIM_RULES, STAGE_RULES, Rule

SECONDS = 120.0
"""Time limit of a validation, to which the time for reading the asset is added [s]."""

BYTES_PER_SECOND = 20e6
"""Lowest rate of reading and checking that the time limit allows [byte/s]."""

HOST_PLUGIN = "beam_warp.schema.validation.host_validator"
"""Plug-in of our rules among OpenUSD's validators, which are skipped because our rules run directly."""

ALL_RULES = tuple(sorted([*STAGE_RULES, *FIRST_RULES, *PRIM_RULES, *FRAME_RULES], key=lambda rule: rule.id))
"""All rules of ours, sorted by id."""


def validate(path: str | Path) -> Report:
    """Check an asset against every rule and every validator of OpenUSD.

    The asset is opened in a child process, so that a corrupt file costs an error and not this process.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: The file cannot be opened at all.
    """
    source = require_asset_file(path)
    answer = run_child("beam_warp.schema.validation.validator", source, time_limit(source))
    if "error" in answer:
        raise AssetFormatError(f"{source} must open in OpenUSD, got {answer['error']}. Export or copy the file again.")
    return Report.from_dict(answer)


def time_limit(source: Path) -> float:
    """Return how long the validation of an asset may take [s]."""
    return SECONDS + size_around(source) / BYTES_PER_SECOND


def validate_stage(stage: Usd.Stage) -> Report:
    """Check a stage that is open in this process; see `validate`."""
    register()
    report = check_rules(stage)
    findings = sorted(
        [*report.findings, *_usd_findings(stage)],
        key=lambda found: (found.severity, found.rule, found.prim, found.attribute),
    )
    return Report(report.path, tuple(findings), report.frames, report.gaussians)


def check_rules(stage: Usd.Stage) -> Report:
    """Check a stage against our own rules only; at most two frames are in memory at a time."""
    findings = [finding for rule in STAGE_RULES for finding in ask(rule, stage, "/")]
    frames = gaussians = 0
    for prim in splat_prims(stage):
        path = str(prim.GetPath())
        broken = [finding for rule in FIRST_RULES for finding in ask(rule, prim, path)]
        if broken:
            findings += broken
            continue
        findings += [finding for rule in PRIM_RULES for finding in ask(rule, prim, path)]
        found, counts = check_frames(prim, FRAME_RULES)
        findings += found
        frames, gaussians = max(frames, len(counts)), gaussians + (counts[0] if counts else 0)
    return Report(stage.GetRootLayer().identifier, tuple(findings), frames, gaussians)


def check_frames(
    prim: Usd.Prim, rules: Sequence[Rule], interval: Gf.Interval | None = None
) -> tuple[list[BrokenRule], list[int]]:
    """Check the arrays of a prim, frame by frame, against rules about frames.

    Args:
        prim: A Gaussian-splat prim whose value clips are whole.
        rules: Rules of `beam_warp.schema.validation.frame_rules`.
        interval: Time codes to check; None checks all.

    Returns:
        What is broken, each rule and attribute once, and the number of Gaussians in each frame.
    """
    seen: dict[tuple[str, str], BrokenRule] = {}
    counts = []
    reads = {name for rule in rules for name in rule.reads or CHANNELS} | {"positions"}
    for time, frame in _frames(prim, reads, interval):
        counts.append(frame.count)
        for rule in rules:
            for found in ask(rule, frame, str(prim.GetPath())):
                first = seen.get((found.rule, found.attribute))
                seen[found.rule, found.attribute] = (
                    replace(first, frames=first.frames + 1) if first else replace(found, time=time, frames=1)
                )
    return list(seen.values()), counts


def ask(rule: Rule, subject: object, path: str) -> Iterator[BrokenRule]:
    """Yield how a stage, a prim or a frame breaks a rule; ``path`` is that of the prim."""
    for fault in rule.check(subject):
        yield BrokenRule(rule.id, rule.severity, fault.message, fault.prim or path, fault.attribute)


def _frames(prim: Usd.Prim, names: Set[str], interval: Gf.Interval | None) -> Iterator[tuple[float, FrameArrays]]:
    """Read arrays of a prim frame by frame; those that do not vary are read once.

    With keys, an array is read at its own samples; between them, it is held, except for positions.
    """
    attributes = {name: array_attribute(prim, channel) for name, channel in CHANNELS.items() if name in names}
    attributes = {name: attribute for name, attribute in attributes.items() if attribute is not None}
    varying = frozenset(name for name, attribute in attributes.items() if attribute.ValueMightBeTimeVarying())
    keys = {name: set(attributes[name].GetTimeSamples()) for name in (varying if is_keyed(prim) else ())}
    playing = sequence_prim(prim)
    topology = authored(playing, "beam:sequence:topology") if playing is not None else None
    degree = authored(prim, SH_DEGREE)
    arrays: dict[str, np.ndarray] = {}
    previous = None
    for time in frame_times(prim) or [prim.GetStage().GetStartTimeCode()]:
        if interval is not None and not interval.Contains(time):
            continue
        changed = frozenset(attributes if previous is None else (n for n in varying if time in keys.get(n, (time,))))
        arrays = dict(arrays)
        for name in changed | (varying & {"positions"}):
            arrays.pop(name, None)
            value = _value(attributes[name], time)
            if value is not None:
                arrays[name] = from_vt(CHANNELS[name], value)
        if "positions" not in arrays:  # a missing clip or array, which a rule about prims reports
            previous = None
            continue
        extent = _value(prim.GetAttribute("extent"), time)
        yield (
            time,
            FrameArrays(
                arrays={name: arrays[name] for name in CHANNELS if name in arrays},
                changed=changed,
                attributes={name: attribute.GetName() for name, attribute in attributes.items()},
                extent=None if extent is None else np.asarray(extent),
                sh_degree=degree if isinstance(degree, int) else None,
                constant_topology=topology == "constant",
                previous=previous,
            ),
        )
        previous = arrays


def _value(attribute: Usd.Attribute, time: float) -> object | None:
    """Read a value; None if a clip layer is broken, which a rule about clips reports."""
    try:
        return attribute.Get(time)
    except Tf.ErrorException:
        return None


def _usd_findings(stage: Usd.Stage) -> Iterator[BrokenRule]:
    """Run all validators of OpenUSD and its plug-ins except our own."""
    registry = UsdValidation.ValidationRegistry()
    names = [data.name for data in registry.GetAllValidatorMetadata() if not data.isSuite]
    others = [name for name in names if not name.startswith(f"{HOST_PLUGIN}:")]
    # The context takes validators: lists of names or metadata are mistaken for types.
    context = UsdValidation.ValidationContext(registry.GetOrLoadValidatorsByName(others))
    try:
        errors = context.Validate(stage)
    except Tf.ErrorException as error:  # a broken clip layer
        yield BrokenRule("USD-Error", "error", f"OpenUSD must read every layer, got: {said_by_usd(error)}")
        return
    materialx = any(name.startswith("ND_") for name in Sdr.Registry().GetShaderNodeNames())
    for error in errors:
        if not materialx and error.GetName() == "MissingShaderIdInRegistry" and "'ND_" in error.GetMessage():
            continue  # usd-core comes without MaterialX, so it knows none of its nodes
        severity: Severity = "error" if error.GetType() == UsdValidation.ValidationErrorType.Error else "warning"
        site = next(iter(error.GetSites()), None)
        prim = site.GetPrim() if site is not None and site.IsPrim() else None
        path = str(prim.GetPath()) if prim else "/"
        yield BrokenRule(f"USD-{error.GetName()}", severity, " ".join(error.GetMessage().split()), path)


def main() -> None:
    """Validate the asset named on the command line; print the report, or why the asset cannot be opened."""
    limit_memory(Path(sys.argv[1]))
    register()
    try:
        if special := special_file(Path(sys.argv[1])):
            print(json.dumps({"error": f"{special}, which is no regular file"}))
            return
        stage = Usd.Stage.Open(sys.argv[1], Usd.Stage.LoadAll)
    except Tf.ErrorException as error:
        print(json.dumps({"error": said_by_usd(error)}))
        return
    report = validate_stage(stage)
    print(json.dumps(report.as_dict(), allow_nan=False))


if __name__ == "__main__":
    main()
