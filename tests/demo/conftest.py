"""What the demo builds is built once for all tests of it."""

from functools import cache

import pytest

from beam_warp.demo import capture
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import studio

build_figure_once, studio_once = cache(build_figure), cache(studio)


@pytest.fixture(autouse=True)
def built_once(monkeypatch):
    """Let captures share the figure and the light: a test of the figure says that it is the same every time."""
    monkeypatch.setattr(capture, "build_figure", build_figure_once)
    monkeypatch.setattr(capture, "studio", studio_once)
