"""Jobs of many images with a renderer that is made up: what is rendered, kept, left by an interruption, encoded."""

from dataclasses import replace

import numpy as np
import pytest
from support.changed_code import changed_code
from support.drawn_ball import relightable

from beam_warp.errors import OutputError
from beam_warp.image.files import read_image
from beam_warp.image.video import VideoOptions, find_ffmpeg
from beam_warp.render.pictures import PictureOptions, PictureWriter
from beam_warp.stage.jobs import FrameRequest, RenderInterruptedError, RenderJob
from beam_warp.stage.output import Film, FramePattern
from beam_warp.world.camera import Camera
from beam_warp.world.shot import RenderedImage, Shot

FFMPEG = find_ffmpeg()
needs_ffmpeg = pytest.mark.skipif(FFMPEG is None, reason="there is no ffmpeg here")


class MadeUpStage:
    """A point that moves along x."""

    def __init__(self, pace=1.0):
        self.pace = pace
        self.asked = []

    def shot(self, time, width, height):
        self.asked.append(time)
        count = 1 + round(time)
        cloud = relightable(np.tile([self.pace * time, 0.0, 0.0], (count, 1)))
        camera = Camera.look_at((0, -3, 0), (0, 0, 0), width=width, height=height, vertical_fov=30)
        return Shot(cloud=cloud, camera=camera)


class MadeUpRenderer:
    """A grey that grows with x; may be stopped at a frame."""

    def __init__(self, decisive=("made up",), stop_at=None):
        self.decisive = decisive
        self.stop_at = stop_at
        self.numbers = []

    def draw(self, shot, context):
        if context.number == self.stop_at:
            raise KeyboardInterrupt
        self.numbers.append(context.number)
        context.report(1, 1)
        size = shot.camera.height, shot.camera.width
        light = np.full((*size, 3), 0.1 * shot.cloud.positions[0, 0], np.float32)
        return RenderedImage(light, np.ones(size, np.float32))


def frames(count=5, **changes):
    return [replace(FrameRequest(number=n, time=float(n), width=8, height=6), **changes) for n in range(count)]


def job(renderer, stage=None, heard=None, **options):
    def report(stage, done, total, note=""):
        if heard is not None:
            heard.append((stage, done, total))

    return RenderJob(stage or MadeUpStage(), renderer, PictureWriter(PictureOptions(**options)), report)


@pytest.fixture
def pattern(tmp_path):
    return FramePattern(tmp_path / "out", "f", 3, ".exr")


def values(pattern, count=5):
    return [float(read_image(pattern.path(n)).channels["G"][0, 0]) for n in range(count)]


EXPECTED = [np.float32(0.1) * n for n in range(5)]


def test_frames_are_rendered_once(pattern):
    first, heard = MadeUpRenderer(), []
    tally = job(first, heard=heard).render_frames(pattern, frames())
    assert (tally.rendered, tally.kept, tally.gaussian_count) == ([0, 1, 2, 3, 4], [], 5)
    np.testing.assert_allclose(values(pattern), EXPECTED, rtol=1e-6)
    assert [entry for entry in heard if entry[0] == "render"] == [("render", n, 5) for n in range(6)]
    again, stage = MadeUpRenderer(), MadeUpStage()
    tally = job(again, stage).render_frames(pattern, frames())
    assert (tally.rendered, tally.kept, again.numbers) == ([], [0, 1, 2, 3, 4], [])


def test_an_interrupted_sequence_goes_on(pattern):
    message = r"2 of 5 images are whole in .*f%03d.exr; the same command goes on"
    with pytest.raises(RenderInterruptedError, match=message):
        job(MadeUpRenderer(stop_at=2)).render_frames(pattern, frames())
    assert sorted(path.name for path in pattern.folder.iterdir()) == [".f#.exr.frames.jsonl", "f000.exr", "f001.exr"]
    second = MadeUpRenderer()
    tally = job(second).render_frames(pattern, frames())
    assert (second.numbers, tally.kept) == ([2, 3, 4], [0, 1])
    np.testing.assert_allclose(values(pattern), EXPECTED, rtol=1e-6)


@pytest.mark.parametrize(
    "other",
    [
        {"renderer": MadeUpRenderer(("other",))},
        {"stage": MadeUpStage(pace=2.0)},
        {"exposure": 1.0},
        {"background": (0.0, 0.0, 0.0)},
        {"layers": True},
    ],
)
def test_whatever_changes_images_is_noticed(pattern, other):
    job(MadeUpRenderer()).render_frames(pattern, frames())
    changed = job(other.pop("renderer", MadeUpRenderer()), other.pop("stage", None), **other)
    with pytest.raises(OutputError, match="frames that are there must be of the same render"):
        changed.render_frames(pattern, frames())
    assert changed.render_frames(pattern, frames(), overwrite=True).rendered[-1] == 4
    with pytest.raises(OutputError, match="must be of the same render"):
        job(MadeUpRenderer()).render_frames(pattern, frames())


def test_frames_of_other_code_are_refused(pattern):
    job(MadeUpRenderer()).render_frames(pattern, frames())
    with changed_code(), pytest.raises(OutputError, match="must be of the same render"):
        job(MadeUpRenderer()).render_frames(pattern, frames())
    assert job(MadeUpRenderer()).render_frames(pattern, frames()).rendered == []


def test_a_camera_of_its_own(pattern):
    seen = []

    class Looking(MadeUpRenderer):
        def draw(self, shot, context):
            seen.append(shot.camera)
            return super().draw(shot, context)

    camera = Camera.look_at((0, 0, 5), (0, 0.1, 0), width=4, height=4, vertical_fov=30)
    job(Looking()).render_frames(pattern, frames(1, camera=camera))
    assert seen == [camera]


def test_stills_are_written_over(tmp_path):
    path = tmp_path / "x.png"
    path.write_bytes(b"old")
    tally = job(MadeUpRenderer()).render_stills([(frames()[3], path)])
    assert tally.rendered == [3]
    assert read_image(path).rgb().max() > 0.3
    with pytest.raises(RenderInterruptedError, match="0 of 1 images are written"):
        job(MadeUpRenderer(stop_at=3)).render_stills([(frames()[3], path)])
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.png"]


@needs_ffmpeg
class TestFilm:
    def film(self, tmp_path, renderer, heard=None, **options):
        work = job(renderer, heard=heard)
        return work.render_film(Film(tmp_path / "x.mp4"), frames(), VideoOptions(crf=1), ffmpeg=FFMPEG, **options)

    def test_a_film_is_its_frames(self, tmp_path):
        heard = []
        self.film(tmp_path, MadeUpRenderer(), heard)
        assert [path.name for path in tmp_path.iterdir()] == ["x.mp4"]
        assert [entry for entry in heard if entry[0] == "encode"] == [("encode", n, 5) for n in range(1, 6)]
        with pytest.raises(OutputError, match=r"out must be a new file, got .*x.mp4, which is there. Pass --overwrite"):
            self.film(tmp_path, MadeUpRenderer())
        self.film(tmp_path, MadeUpRenderer(), overwrite=True)

    @pytest.mark.parametrize(("decisive", "kept"), [("made up", [0, 1, 2]), ("other", [])])
    def test_an_interrupted_film_goes_on_and_another_begins_again(self, tmp_path, decisive, kept):
        with pytest.raises(RenderInterruptedError, match="3 of 5 images are whole"):
            self.film(tmp_path, MadeUpRenderer(stop_at=3))
        assert [path.name for path in tmp_path.iterdir()] == [".x.mp4.frames"]
        second = MadeUpRenderer((decisive,))
        assert self.film(tmp_path, second).kept == kept
        assert second.numbers == [number for number in range(5) if number not in kept]


def test_a_film_that_cannot_be_encoded_is_refused_before_it_is_rendered(tmp_path):
    renderer = MadeUpRenderer()
    with pytest.raises(OutputError, match="ffmpeg must run"):
        job(renderer).render_film(Film(tmp_path / "x.mp4"), frames(), VideoOptions(), ffmpeg=str(tmp_path / "none"))
    assert renderer.numbers == []
    assert not list(tmp_path.iterdir())
