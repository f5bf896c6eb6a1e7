"""SARIF: what the standard requires of a log, and what of a report is in it."""

from pathlib import Path

import pytest

from beam_warp.errors import OutputError
from beam_warp.schema.validation.report import BrokenRule, Report
from beam_warp.schema.validation.sarif import sarif_log, write_sarif

TEXTS = {"BEAM-GEO-004": "extent is authored.", "BEAM-GEO-012": "Orientations are unit quaternions."}
LENGTH = BrokenRule("BEAM-GEO-012", "error", "vectors must have unit length.", "/A", "orientations", 3.0, 2)
EXTENT = BrokenRule("BEAM-GEO-004", "error", "extent must be authored.", "/A", "extent")
STYLE = BrokenRule("USD-Style", "warning", "prims should be tidy.", "/")


def run_of(report):
    log = sarif_log(report, TEXTS)
    assert log["version"] == "2.1.0"
    (run,) = log["runs"]
    return run


def test_what_the_standard_requires_is_there(tmp_path):
    run = run_of(Report(str(tmp_path / "ü 1.usda"), (LENGTH, STYLE)))
    driver = run["tool"]["driver"]
    assert driver["name"]
    ids = [rule["id"] for rule in driver["rules"]]
    assert ids == ["BEAM-GEO-004", "BEAM-GEO-012", "USD-Style"]
    assert driver["rules"][1]["shortDescription"] == {"text": TEXTS["BEAM-GEO-012"]}
    for result in run["results"]:
        assert result["message"]["text"]
        assert result["level"] in ("none", "note", "warning", "error")
        assert ids[result["ruleIndex"]] == result["ruleId"]
    assert run["artifacts"] == [{"location": {"uri": (tmp_path / "ü 1.usda").as_uri()}}]


def test_place_time_and_frames_are_there():
    (result,) = run_of(Report("a.usda", (LENGTH,)))["results"]
    (location,) = result["locations"]
    assert location["logicalLocations"] == [{"fullyQualifiedName": "/A.orientations"}]
    assert location["physicalLocation"]["artifactLocation"]["uri"] == "a.usda"
    assert result["properties"] == {"time": 3.0, "frames": 2}
    assert "baselineState" not in result


def test_what_was_mended_is_absent_now():
    run = run_of(Report("a.usda", (STYLE,), mended=(EXTENT,)))
    assert [(result["ruleId"], result["baselineState"]) for result in run["results"]] == [
        ("USD-Style", "unchanged"),
        ("BEAM-GEO-004", "absent"),
    ]


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(OutputError, match="must be a writable file, got"):
        write_sarif(Report("a.usda", ()), TEXTS, Path(tmp_path / "none" / "a.sarif"))
