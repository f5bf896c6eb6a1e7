"""Reports in SARIF 2.1.0, the format in which build systems collect findings of checkers.

Source: OASIS, Static Analysis Results Interchange Format (SARIF) Version 2.1.0 Plus Errata 01.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from beam_warp._version import __version__
from beam_warp.image.files import replacing
from beam_warp.schema.validation.report import BrokenRule, Report

SCHEMA = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"


def sarif_log(report: Report, texts: Mapping[str, str]) -> dict[str, Any]:
    """Return a report as a SARIF log of one run.

    Args:
        report: What was found. What was mended is there as results that are absent now, as SARIF calls them.
        texts: Text of each rule that was checked, by its id; rules of OpenUSD need none.
    """
    found = [*report.findings, *report.mended]
    ids = list(dict.fromkeys([*texts, *(each.rule for each in found)]))
    rules = [{"id": rule, **({"shortDescription": {"text": texts[rule]}} if rule in texts else {})} for rule in ids]
    artifact = {"uri": _uri(Path(report.path))}
    results = [_result(each, ids.index(each.rule), artifact) for each in found]
    if report.mended:  # then every result says what has become of it
        for number, result in enumerate(results):
            result["baselineState"] = "unchanged" if number < len(report.findings) else "absent"
    driver = {"name": "beam-validate", "version": __version__, "semanticVersion": __version__, "rules": rules}
    run = {"tool": {"driver": driver}, "artifacts": [{"location": artifact}], "results": results}
    return {"$schema": SCHEMA, "version": "2.1.0", "runs": [run]}


def write_sarif(report: Report, texts: Mapping[str, str], path: Path) -> None:
    """Write a report as a SARIF file; readers see the old file or the complete new one.

    Raises:
        OutputError: The file cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(sarif_log(report, texts), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _result(found: BrokenRule, index: int, artifact: Mapping[str, str]) -> dict[str, Any]:
    name = found.prim + (f".{found.attribute}" if found.attribute else "")
    properties = {} if found.time is None else {"time": found.time, "frames": found.frames}
    return {
        "ruleId": found.rule,
        "ruleIndex": index,
        "level": found.severity,
        "message": {"text": found.message},
        "locations": [
            {"physicalLocation": {"artifactLocation": artifact}, "logicalLocations": [{"fullyQualifiedName": name}]}
        ],
        **({"properties": properties} if properties else {}),
    }


def _uri(path: Path) -> str:
    """Return the address of a file: relative below the working folder, as build systems want it, else absolute."""
    whole = path.absolute()
    return quote(whole.relative_to(Path.cwd()).as_posix()) if whole.is_relative_to(Path.cwd()) else whole.as_uri()
