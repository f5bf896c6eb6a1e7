"""``beam render`` of sequences: which moments, from where, under which light, into which files; and how it goes on."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from support.drawn_ball import relightable

from beam_warp import converters
from beam_warp.cli.channel import DrawChannel
from beam_warp.cli.common.pages import parse
from beam_warp.cli.drawing.checks import require_consistent
from beam_warp.cli.drawing.flags import Render
from beam_warp.cli.main import main
from beam_warp.image.files import read_image, write_exr
from beam_warp.image.video import find_ffmpeg
from beam_warp.raster import resolution
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.lights import PointLight
from beam_warp.world.shot import RenderedImage

needs_ffmpeg = pytest.mark.skipif(find_ffmpeg() is None, reason="there is no ffmpeg here")

LAMP = {"type": "point", "position": [1, -2, 2], "intensity": [4, 4, 4]}


def run(*words):
    return main(["render", *map(str, words)])


def points(x, count=40):
    """Gaussians on a ball of radius 0.5 m around (x, 0, 0), the same ones in every frame."""
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places, scales = 0.5 * normals + (x, 0, 0), np.full((count, 3), 0.05)
    return relightable(places, scales=scales, opacities=np.full(count, 0.9), normals=normals, ids=np.arange(count))


def keep(monkeypatch, path, clouds, rate=30.0):
    """Let a file stand for clouds in memory: USD alone keeps ids and rates, and takes a second to be opened."""
    sequence = GaussianSequence.from_clouds(clouds, frames_per_second=rate)
    usual = converters.read
    monkeypatch.setattr(converters, "read", lambda name, **more: sequence if name == path else usual(name, **more))
    path.touch()
    return path


@pytest.fixture
def walk(tmp_path, monkeypatch):
    """Four frames at 10 a second that go 1 m a frame."""
    return keep(monkeypatch, tmp_path / "walk.ply", [points(float(x)) for x in range(4)], 10.0)


@pytest.fixture
def still(tmp_path, monkeypatch):
    return keep(monkeypatch, tmp_path / "still.ply", [points(0.0)])


@pytest.fixture
def light(tmp_path):
    path = tmp_path / "light.exr"
    write_exr(path, {name: np.full((8, 16), 0.5) for name in "RGB"})
    return path


class Recorder:
    """Stands in for both renderers: a grey of the place that the asset has, and what it was asked for."""

    def __init__(self):
        self.shots, self.contexts, self.options, self.stop_at = [], [], [], None

    def make(self, options, **more):
        self.options.append((options, more))
        self.decisive = (repr(options),)
        return self

    def draw(self, shot, context):
        if context.number == self.stop_at:
            raise KeyboardInterrupt
        self.shots.append(shot)
        self.contexts.append(context)
        size = (shot.camera.height, shot.camera.width)
        alpha = np.zeros(size, np.float32)
        alpha[: size[0] // 2] = 1.0
        place = 0.1 * (1.0 + shot.cloud.positions[:, 0].mean())
        return RenderedImage(alpha[..., None] * np.float32([place] * 3), alpha)

    def places(self):
        """Where the asset was in every image [m]."""
        at_zero = points(0.0).positions[:, 0].mean()
        return [float(shot.cloud.positions[:, 0].mean() - at_zero) for shot in self.shots]

    def azimuths(self):
        """Azimuths from which the asset was seen, by image [degree]."""
        return [float(np.degrees(np.arctan2(-s.camera.forward[0], s.camera.forward[1]))) % 360 for s in self.shots]


@pytest.fixture
def recorder(monkeypatch):
    made = Recorder()
    monkeypatch.setattr("beam_warp.cli.render.DeferredFrames", made.make)
    monkeypatch.setattr("beam_warp.cli.render.PathFrames", made.make)
    return made


@pytest.fixture
def common(walk, light):
    return [walk, "--environment", light, "--width", 8, "--height", 6, "--device", "cpu"]


@pytest.fixture
def common_still(still, light):
    return [still, "--environment", light, "--width", 8, "--height", 6, "--device", "cpu"]


POSITION = 1e-6
"""Coordinates of up to 4 m are float32, as are blends of them; so are their means."""


class TestFrames:
    def test_a_pattern_names_frames_by_their_numbers(self, common, recorder, tmp_path, capsys):
        assert run(*common, "--out", tmp_path / "f" / "%03d.exr", "--frames", "1:4:2", "--json") == 0
        said = json.loads(capsys.readouterr().out)
        assert said["outputs"] == [str(tmp_path / "f" / name) for name in ("001.exr", "003.exr")]
        assert (said["frames"], said["rendered"], said["kept"], said["mode"]) == ([1, 3], 2, 0, "deferred")
        np.testing.assert_allclose(recorder.places(), [1.0, 3.0], atol=POSITION)
        shown = read_image(tmp_path / "f" / "003.exr").channels
        np.testing.assert_allclose(shown["G"][0], 0.1 * (1 + 3.0 + points(0).positions[:, 0].mean()), rtol=1e-5)

    def test_part_of_a_sequence_is_seen_like_the_whole(self, common, recorder, tmp_path):
        assert run(*common, "--out", tmp_path / "a%d.png") == 0
        assert run(*common, "--out", tmp_path / "b%d.png", "--frames", "2:3", "--turntable", 0) == 0
        whole, part = recorder.shots[2].camera, recorder.shots[4].camera
        np.testing.assert_allclose(part.camera_to_world, whole.camera_to_world, atol=1e-9)

    def test_what_is_there_is_kept_and_what_is_missing_is_filled(self, common, recorder, tmp_path, capsys):
        words = [*common, "--out", tmp_path / "%d.png"]
        assert run(*words, "--frames", "0:2") == 0
        assert run(*words) == 0
        assert "4 images, 2 of them were there, 40 Gaussians" in capsys.readouterr().out
        (tmp_path / "1.png").unlink()
        assert run(*words) == 0
        np.testing.assert_allclose(recorder.places(), [0, 1, 2, 3, 1], atol=POSITION)

    def test_another_render_is_refused_unless_it_may_overwrite(self, common, recorder, tmp_path, refused):
        words = [*common, "--out", tmp_path / "%d.png"]
        assert run(*words) == run(*words, "--samples", 2) == 0
        for other in (["--view", "agx"], ["--samples", 1]):
            refused("render", *words, *other, says="frames that are there must be of the same render")
        assert run(*words, "--view", "agx", "--overwrite") == 0
        assert len(recorder.shots) == 8

    def test_an_interrupted_render_says_how_to_go_on(self, common, recorder, tmp_path, capsys):
        words = [*common, "--out", tmp_path / "f" / "%d.png"]
        recorder.stop_at = 2
        assert run(*words) == 130
        error = capsys.readouterr().err
        assert error.startswith("stopped: 2 of 4 images are whole in")
        assert error.endswith("the same command goes on from there\n")
        assert sorted(path.name for path in (tmp_path / "f").glob("[!.]*")) == ["0.png", "1.png"]
        recorder.stop_at = None
        assert run(*words) == 0
        np.testing.assert_allclose(recorder.places(), [0, 1, 2, 3], atol=POSITION)


@pytest.mark.parametrize(
    ("words", "places"),
    [
        ("--frames=-2:", [2, 3]),
        ("--fps 20", [0, 0.5, 1, 1.5, 2, 2.5, 3, 3]),
        ("--speed 0.5 --frames 0:2", [0, 0.5, 1, 1.5]),
        ("--seconds 0.6", [0, 1, 2, 3, 3, 3]),
        ("--seconds 0.6 --loop", [0, 1, 2, 3, 0, 1]),
    ],
    ids=["numbers from the end", "blended frames", "half speed", "the last is held", "all again"],
)
def test_moments(common, recorder, tmp_path, words, places):
    assert run(*common, "--out", tmp_path / "%d.png", *words.split()) == 0
    np.testing.assert_allclose(recorder.places(), places, atol=POSITION)


class TestCamera:
    @pytest.mark.parametrize(
        ("words", "azimuths"),
        [
            ("--turntable 90 --seconds 2 --fps 2 --orbit 10 0", [10, 55, 100, 145]),
            ("--turns 1 --seconds 2 --fps 2", [0, 90, 180, 270]),
            ("--turntable 1800", [0, 60, 120, 180, 240, 300]),  # a turn of 0.2 s at 30 a second
        ],
        ids=["so fast", "so often", "a turn"],
    )
    def test_a_turntable_goes_around(self, common_still, recorder, tmp_path, words, azimuths):
        assert run(*common_still, "--out", tmp_path / "%d.png", *words.split()) == 0
        np.testing.assert_allclose(recorder.azimuths(), azimuths, atol=1e-6)

    def test_it_goes_by_the_films_seconds(self, common, recorder, tmp_path):
        """The asset takes twice as long at half speed, and the camera goes around twice as far."""
        more = ["--turntable", 100, "--rotate-per-second", 50, "--speed", 0.5]
        assert run(*common, "--out", tmp_path / "%d.png", *more) == 0
        np.testing.assert_allclose(recorder.azimuths(), np.arange(8) * 10.0, atol=1e-6)
        rotations = [shot.environment_rotation for shot in recorder.shots]
        np.testing.assert_allclose(rotations, np.arange(8) * 5.0, atol=1e-9)
        np.testing.assert_allclose(recorder.places(), [0, 0.5, 1, 1.5, 2, 2.5, 3, 3], atol=POSITION)

    def test_a_camera_path(self, common, recorder, tmp_path):
        path = tmp_path / "path.json"
        keys = [{"time": t, "position": [4 * t, -5, 1], "target": [4 * t, 0, 1], "fov": 40} for t in (0.0, 1.0)]
        path.write_text(json.dumps({"keyframes": keys, "interpolation": "linear"}))
        for name, more in (("a", []), ("b", ["--speed", 0.5])):
            assert run(*common, "--out", tmp_path / f"{name}%d.png", "--camera", path, *more) == 0
        there = [shot.camera.position[0] for shot in recorder.shots]
        np.testing.assert_allclose(there, [0.4 * n for n in (*range(4), *range(8))], atol=1e-6)
        assert {shot.camera.width for shot in recorder.shots} == {8}

    def test_a_preview_of_one_frame_of_it(self, common, recorder, tmp_path):
        assert run(*common, "--out", tmp_path / "x.png", "--frame", 2, "--turntable", 100) == 0
        np.testing.assert_allclose(recorder.azimuths(), [20.0], atol=1e-6)
        np.testing.assert_allclose(recorder.places(), [2.0], atol=POSITION)


class TestStage:
    def test_light_turns_and_exposure_is_of_the_image(self, common, recorder, tmp_path):
        more = ["--rotate", 30, "--rotate-per-second", 100, "--exposure", 1, "--frames", "0:2"]
        assert run(*common, "--out", tmp_path / "%d.exr", *more) == 0
        assert [shot.environment_rotation for shot in recorder.shots] == pytest.approx([30.0, 40.0])
        assert recorder.shots[0].environment is recorder.shots[1].environment
        np.testing.assert_array_equal(recorder.shots[0].environment.radiance, 0.5)
        expected = 2 * 0.1 * (1 + points(0).positions[:, 0].mean())
        np.testing.assert_allclose(read_image(tmp_path / "0.exr").channels["R"][0], expected, rtol=1e-5)

    def test_lamps_need_no_environment(self, still, recorder, tmp_path):
        (tmp_path / "lamps.json").write_text(json.dumps([LAMP]))
        words = [still, "--lights", tmp_path / "lamps.json", "--width", 4, "--device", "cpu"]
        assert run(*words, "--out", tmp_path / "x.png") == 0
        assert recorder.shots[0].environment is None
        assert recorder.shots[0].lights == (PointLight(position=(1, -2, 2), intensity=(4, 4, 4)),)

    @pytest.mark.parametrize(("ground", "catches"), [("plain", False), ("shadows", True)])
    def test_a_floor(self, common_still, recorder, tmp_path, ground, catches):
        assert run(*common_still, "--out", tmp_path / "x.png", "--ground", ground) == 0
        mesh = recorder.shots[0].mesh
        assert (mesh.catches_shadows == catches).all()
        assert mesh.surface.vertices[:, 2].max() <= points(0).positions[:, 2].min()

    def test_several_assets(self, still, walk, light, recorder, tmp_path):
        words = [walk, still, "--environment", light, "--width", 4, "--device", "cpu"]
        assert run(*words, "--out", tmp_path / "%d.png") == 0
        assert [len(shot.cloud) for shot in recorder.shots] == [80] * 4
        recorder.shots.clear()
        assert run(*words, "--spacing", 3, "--frame", 0, "--out", tmp_path / "x.png") == 0
        x = recorder.shots[0].cloud.positions[:, 0]
        # the walk is centred over all its way of 3 m: it begins at its left
        assert (x[:40].mean(), x[40:].mean()) == pytest.approx((-3.0, 1.5), abs=0.1)

    def test_a_stage_and_what_is_said_instead(self, walk, light, recorder, tmp_path):
        stage = {
            "beam-stage": 1,
            "assets": [{"path": "walk.ply", "translate": [0, 0, 1], "start": 0.1}],
            "lights": [LAMP],
            "environment": {"path": "light.exr", "rotate": 10},
            "camera": {"type": "orbit", "azimuth": 45},
        }
        (tmp_path / "stage.json").write_text(json.dumps(stage))
        words = [tmp_path / "stage.json", "--width", 4, "--device", "cpu"]
        assert run(*words, "--out", tmp_path / "a%d.png") == 0
        assert len(recorder.shots) == 5
        np.testing.assert_allclose(recorder.places(), [0, 0, 1, 2, 3], atol=POSITION)
        assert recorder.azimuths() == pytest.approx([45.0] * 5)
        assert recorder.shots[0].environment_rotation == pytest.approx(10.0)
        recorder.shots.clear()
        more = ["--look-at", 0, -9, 0, 0, 0, 0, "--rotate", 5, "--frames", "0:1", "--ground", "plain"]
        assert run(*words, "--out", tmp_path / "b%d.png", *more) == 0
        (shot,) = recorder.shots
        assert (shot.camera.position[1], shot.environment_rotation) == pytest.approx((-9.0, 15.0))
        assert len(shot.lights) == 1
        assert shot.mesh is not None


class TestRenderers:
    def test_paths(self, common_still, recorder, tmp_path):
        more = ["--spp", 8, "--bounces", 2, "--denoise", "bilateral", "--seed", 7]
        assert run(*common_still, "--out", tmp_path / "x.png", "--mode", "path", *more) == 0
        options, more = recorder.options[0]
        assert (options.samples, options.bounces) == (8, 2)
        assert (options.denoiser, options.seed) == ("bilateral", 7)
        assert more == {"device": "cpu"}

    def test_deferred(self, common_still, recorder, tmp_path):
        more = ["--environment-shadows", 4, "--shadow-resolution", 256, "--bounces", 1, "--low-pass", 0.5, "--aov"]
        assert run(*common_still, "--out", tmp_path / "x.exr", *more) == 0
        options, more = recorder.options[0]
        assert (options.environment_shadows, options.light_map_size, options.bounces) == (4, 256, 1)
        assert options.samples == 2
        assert (more["raster"].low_pass, more["errors"]) == (0.5, True)

    def test_pixels_have_the_samples_of_the_fit_whichever_frame_is_asked_for(
        self, common, recorder, tmp_path, monkeypatch
    ):
        start = points(0).positions[:, 0].mean() + 0.5  # only the first frame is fine
        monkeypatch.setattr(
            resolution, "disc_spacing", lambda cloud: 1e-3 if cloud.positions[:, 0].mean() < start else 1e3
        )
        assert run(*common, "--out", tmp_path / "x.png", "--frame", 2, "--antialiased", "yes") == 0
        assert recorder.options[0][0].samples == resolution.MOST_SAMPLES
        assert run(*common, "--out", tmp_path / "y.png", "--frame", 2, "--antialiased", "yes", "--samples", 3) == 0
        assert recorder.options[1][0].samples == 3

    def test_what_is_behind(self, common_still, recorder, tmp_path):
        for name, more in (("a", []), ("b", ["--background", "environment"]), ("c", ["--background", 0, 0.5, 1])):
            assert run(*common_still, "--out", tmp_path / f"{name}.exr", *more) == 0
        lower = [read_image(tmp_path / f"{name}.exr").stack(*"RGBA")[-1, 0] for name in "abc"]
        np.testing.assert_allclose(lower[0], 0.0)
        np.testing.assert_allclose(lower[1], [0.5, 0.5, 0.5, 1.0], rtol=1e-6)
        np.testing.assert_allclose(lower[2], [0.0, 0.2140411, 1.0, 1.0], rtol=1e-5)


@needs_ffmpeg
def test_a_film(common, recorder, tmp_path, capsys):
    before = {path.name for path in tmp_path.iterdir()}
    assert run(*common, "--out", tmp_path / "x.mp4", "--crf", 10, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["outputs"] == [str(tmp_path / "x.mp4")]
    assert (said["frames"], said["rendered"]) == ([0, 1, 2, 3], 4)
    assert "a film has no transparency: its background is black" in said["notes"]
    assert {path.name for path in tmp_path.iterdir()} - before == {"x.mp4"}
    assert run(*common, "--out", tmp_path / "x.mp4") == 2
    assert "out must be a new file" in capsys.readouterr().err


def test_without_ffmpeg_there_are_images_and_a_note(common, recorder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("beam_warp.cli.render.find_ffmpeg", lambda: None)
    assert run(*common, "--out", tmp_path / "x.mp4", "--frames", "0:2") == 0
    captured = capsys.readouterr()
    assert "note: there is no ffmpeg to make x.mp4: its frames are" in captured.err
    for how in ("apt install ffmpeg", "brew install ffmpeg", "winget install ffmpeg", "pip install 'beam-warp[video]'"):
        assert how in captured.err
    assert sorted(path.name for path in (tmp_path / "x").glob("[!.]*")) == ["000000.png", "000001.png"]
    assert not (tmp_path / "x.mp4").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("x.jpg", "out must end in .png, .exr or .mp4, got x.jpg. Rename it."),
        ("%d_%d.png", "out must have one integer field in the name of an image"),
        ("area.json/no/%d.png", "output folder must be a folder, got"),
        ("area.json/x.png", "output folder must be a folder, got"),
        ("%d.png --frames 0:5", "frames must be some of the 4 that there are, 0:4, got 0:5"),
        ("%d.png --frames abc", "frames must be A:B or A:B:STEP, got abc"),
        ("%d.png --frames 0:4:2 --fps 20", "frames must have no step with seconds, fps or speed"),
        ("x.png --frame 4", "frame must be an integer in [0, 3], got 4"),
        ("x.png --frame 1 --frames 0:2", "frames must be left out with --frame, got 0:2"),
        ("x.mp4 --frame 1", "out must end in .png or .exr with --frame, got x.mp4"),
        ("x.mp4 --aov", "out must end in .exr to hold the layers of --aov, got x.mp4"),
        ("x.png --crf 10", "crf must be left out unless out ends in .mp4, got 10"),
        ("x.png --spp 9", "spp must be left out with --mode deferred, got 9"),
        ("x.png --target-error 0", "target-error must be a number in [1e-09, 1e+09], got 0.0"),
        ("x.png --mode path --environment-shadows 4", "environment-shadows must be left out with"),
        ("x.png --mode path --low-pass 1", "low-pass must be left out with --mode path, got 1.0"),
        ("x.png --low-pass 0", "low-pass must be a number in [1e-06, 1e+06], got 0.0"),
        ("x.png --mode path --spp 0", "samples must be an integer in [1, 1048576], got 0"),
        ("x.png --turntable 9 --turns 1", "got --turntable and --turns. Leave one out."),
        ("x.png --turns 1 --look-at 0 1 2 3 4 5", "got --look-at and --turns. Leave one out."),
        ("x.png --camera c.json --orbit 0 0", "got --orbit and --camera. Leave one out."),
        ("x.png --orbit 0 0 --capture c", "got --orbit and --capture. Leave one out."),
        ("x.png --camera c.json --fov 9", "fov must be left out with --camera, got 9.0"),
        ("x.png --camera none.json", "none.json"),
        ("x.png --camera nan.json", "camera_to_world must be finite, got NaN"),
        ("x.png --orbit 0 100", "elevation must be a number in [-90, 90], got 100.0"),
        ("x.png --fov nan", "--fov must be a number in"),
        ("x.png --width 0", "width must be an integer in [1, 65536], got 0"),
        ("x.png --device cuda:9", "device must be one of cpu"),
        ("x.png --exposure nan", "must be a number in"),
        ("x.png --background 0 0 2", "background must lie in [0, 1], got 2"),
        ("x.png --lights none.json", "lights must be a file, got none.json"),
        ("x.png --lights area.json", "lights[0].type must be one of directional, point, spot, got 'area'"),
        ("x.png --lights nan-light.json", "lights[0]: position must be finite, got NaN"),
        ("o --capture c --fps 9", "fps must be left out with --capture, got 9.0"),
        ("o --capture c --width 9", "width must be left out with --capture, got 9"),
        ("o --capture c --turntable 9", "camera must move in one way, got --capture and --turntable"),
        ("x.png --samples 0", "samples must be an integer in [1, 16], got 0"),
        ("x.png --mode path --samples 2", "samples must be left out with --mode path, got 2"),
        ("%d.png --seconds -1", "seconds must be a number in"),
        ("%d.png --speed 0", "speed must be a number in [0.001, 1000], got 0.0"),
        ("x.mp4 --crf 99", "crf must be an integer in [0, 51], got 99"),
    ],
)
def test_refusals_are_one_line(walk, light, tmp_path, monkeypatch, refused, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "area.json").write_text(json.dumps([{"type": "area"}]))
    lamp = {"type": "point", "position": [0, float("nan"), 0], "intensity": [1, 1, 1]}
    (tmp_path / "nan-light.json").write_text(json.dumps([lamp]))
    pose = np.eye(4).tolist()
    pose[0][3] = float("nan")
    (tmp_path / "nan.json").write_text(json.dumps([{"time": 0, "camera_to_world": pose}]))
    refused("render", walk, "--environment", light, "--out", *words.split(), says=message)


def test_one_stage_or_several_assets(walk, light, tmp_path, refused):
    stage = tmp_path / "stage.json"
    stage.write_text("{}")
    for words, says in (
        ([walk, stage, "--environment", light], "asset must be one stage, or several assets, got"),
        ([stage, "--environment", light, "--spacing", 1], "spacing must be left out with a stage, got 1.0"),
        ([walk, "--background", "environment"], "environment must be given, got none. Pass --environment with a lat"),
    ):
        refused("render", *words, "--out", tmp_path / "x.png", says=says)


def test_a_folder_that_is_closed(common, tmp_path, refused, monkeypatch):
    monkeypatch.setattr("beam_warp.stage.output.os.access", lambda *_: False)
    words = [*common, "--out", tmp_path / "x.png", "--frame", 0]
    refused("render", *words, says="output folder must be writable, got")


def test_commands_that_are_shown_are_commands(tmp_path, monkeypatch):
    """Those of the pages and of the help say nothing that contradicts itself."""
    monkeypatch.chdir(tmp_path)
    docs = Path(__file__).parents[2] / "docs"
    pages = "".join((docs / name).read_text(encoding="utf-8") for name in ("sequences.md", "materials.md"))
    for word, record, least in (("render", Render, 15), ("channel", DrawChannel, 3)):
        shown = re.findall(rf"^    beam {word} (.+)$", pages, re.MULTILINE)
        shown += re.findall(rf"Example: beam {word} (.+)$", record.__doc__, re.MULTILINE)
        assert len(shown) > least
        for words in shown:
            args = parse(record, words.split(), f"beam {word}")
            if isinstance(args, Render):
                require_consistent(args)
