"""What the path tracer is told of a frame: a seed of its own, and where it may keep what is done."""

from pathlib import Path

import pytest

from beam_warp.render.path import PathOptions
from beam_warp.stage import renderers
from beam_warp.stage.jobs import FrameContext
from beam_warp.stage.renderers import PathFrames


class MadeUpRenderer:
    def __init__(self, options, *, device=None):
        self.options, self.device, self.drawn = options, device, []

    def draw(self, shot, *, checkpoint, report):
        self.drawn.append((shot, self.options, checkpoint))
        report(1, self.options.samples)
        return "image"


@pytest.fixture
def path_frames(monkeypatch):
    made = []

    def make(options, *, device=None):
        made.append(MadeUpRenderer(options, device=device))
        return made[-1]

    monkeypatch.setattr(renderers, "PathRenderer", make)
    return PathFrames(PathOptions(samples=8, seed=2**32 - 1), device="cpu"), made[0]


def test_every_frame_has_its_noise_and_always_the_same(path_frames):
    frames, renderer = path_frames
    heard = []
    for number in (0, 1, 2, 1000, 1, 0):
        context = FrameContext(number, Path(f"{number}.checkpoint"), lambda *said: heard.append(said))
        assert frames.draw("shot", context) == "image"
    seeds = [options.seed for _, options, _ in renderer.drawn]
    assert seeds[0] == 2**32 - 1
    assert len(set(seeds[:4])) == 4
    assert seeds[4:] == [seeds[1], seeds[0]]
    assert {options.samples for _, options, _ in renderer.drawn} == {8}
    assert [checkpoint.name for _, _, checkpoint in renderer.drawn[:2]] == ["0.checkpoint", "1.checkpoint"]
    assert heard == [(1, 8)] * 6


def test_what_decides_is_what_was_asked_for(path_frames):
    frames, _ = path_frames
    assert frames.decisive == ("path", PathOptions(samples=8, seed=2**32 - 1))
