"""The page of the architecture and its picture are those of the packages that there are."""

import re
import runpy
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def script():
    return runpy.run_path(str(ROOT / "docs" / "draw_architecture.py"))


@pytest.fixture(scope="module")
def packages(script):
    return script["Packages"]()


def test_picture_is_that_of_the_imports(script, packages):
    with Image.open(script["PICTURE"]) as picture:
        assert picture.info["xmp"].decode() == packages.data(), "run python docs/draw_architecture.py"
        assert picture.width == 1200


def test_picture_can_be_drawn(script, packages, tmp_path):
    script["draw"](tmp_path / "picture.png", packages)
    with Image.open(tmp_path / "picture.png") as picture:
        assert picture.info["xmp"].decode() == packages.data()


def test_arrows_point_down_and_leave_out_what_others_imply(packages):
    assert all(packages.floor[low] < packages.floor[high] for high, low in packages.arrows)
    assert ("cli", "stability") in packages.arrows
    assert packages.imports["cli", "world"] > 0
    assert ("cli", "world") not in packages.arrows


def test_every_package_has_its_paragraph_and_color(script, packages):
    names = set(packages.floor)
    assert set(re.findall(r"^#### (\w+)$", PAGE, flags=re.MULTILINE)) == names
    assert {name for group in script["COLORS"].values() for name in group} == names
