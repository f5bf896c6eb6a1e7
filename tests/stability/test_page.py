"""The page of the stability suite in the docs is of the cases and texts that there are."""

from pathlib import Path

import pytest

from beam_warp.stability.capture_cases import CAPTURE_CASES
from beam_warp.stability.material_cases import MATERIAL_CASES
from beam_warp.stability.page import HOW_TO_READ, OCCLUSION_TEXT, SECTIONS
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
