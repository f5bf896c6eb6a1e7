"""The page of the stability suite in the docs is of the cases and texts that there are."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from beam_warp.stability.capture_cases import CAPTURE_CASES
from beam_warp.stability.material_cases import MATERIAL_CASES
from beam_warp.stability.materials import MaterialOutcome
from beam_warp.stability.page import HOW_TO_READ, OCCLUSION_TEXT, SECTIONS, StabilityResult, markdown, read_result
from beam_warp.stability.relighting_cases import RELIGHTING_CASES
from beam_warp.stability.tracing_cases import CASES

PAGE = (Path(__file__).parents[2] / "docs" / "stability.md").read_text(encoding="utf-8")
ROWS = [line.removeprefix("| ").split(" | ") for line in PAGE.splitlines() if line.startswith("| ")]


@pytest.mark.parametrize(
    "cases",
    [CASES, CAPTURE_CASES, MATERIAL_CASES, RELIGHTING_CASES],
    ids=["tracing", "captures", "materials", "relighting"],
)
def test_cases_are_those_of_the_page(cases):
    """After a change of cases: beam stability --large --out docs/stability.md."""
    assert len({case.name for case in cases}) == len(cases)
    listed = list(dict.fromkeys((name, fails) for name, fails, *_ in ROWS))
    wanted = [(case.name, case.fails) for case in cases if not case.large or (case.name, case.fails) in listed]
    assert [row for row in listed if row in wanted] == wanted


@pytest.mark.parametrize(
    "text", [HOW_TO_READ.partition("{command}")[2], OCCLUSION_TEXT, *(section.text for section in SECTIONS.values())]
)
def test_texts_are_those_of_the_page(text):
    assert text in PAGE


def test_every_part_of_the_page_says_what_measured_it():
    """Device, version, digest of the code and date."""
    stated = r"^\*Measured (on [^:\n]+: beam-warp \S+, code [0-9a-f]{12}, \d{4}-\d\d-\d\d(; |\.\*$))+"
    headings = "|".join(section.title for section in SECTIONS.values())
    for part in re.split(rf"^(?={headings})", PAGE, flags=re.MULTILINE):
        assert re.search(stated, part, re.MULTILINE), part[:80]


def test_results_of_other_devices_keep_what_measured_them(tmp_path):
    def found(device):
        outcome = MaterialOutcome(case=MATERIAL_CASES[0].name, device=device, gaussians=1, views=1)
        return StabilityResult(materials=(outcome,))

    here, there = found("cpu").measured_now(), replace(found("a GPU"), measured={"a GPU": "beam-warp 0.1"})
    (tmp_path / "there.json").write_text(json.dumps(there.as_dict()), encoding="utf-8")
    page = markdown(here.joined(read_result(tmp_path / "there.json")), "beam stability")
    assert re.search(r"\*Measured on cpu: beam-warp \S+, code \S+, \S+; on a GPU: beam-warp 0\.1\.\*", page)
    assert "on cpu: not recorded" in markdown(found("cpu"), "beam stability")
