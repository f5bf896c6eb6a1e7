"""``beam channel``: pictures of one array of a known asset, legends, flags, records of a capture, and every refusal."""

import json

import numpy as np
import pytest
from support.drawn_ball import drawn_ball, judged_ball, save, write_capture

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.cli.main import main
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.files import read_image
from beam_warp.raster.gbuffer import rasterize
from beam_warp.world.gaussians import GaussianSequence

SIDE = ["--width", "48"]


def run(*words):
    return main(["channel", *map(str, words)])


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    path = tmp_path_factory.mktemp("judged") / "ball.usdc"
    converters.write(GaussianSequence.from_clouds([judged_ball()]), path)
    return path


def test_a_channel_needs_no_light_and_no_material(judged, tmp_path, capsys):
    common = [judged, *SIDE, "--device", "cpu"]
    assert run(*common, "base_color_error", "--out", tmp_path / "x.png") == 0
    assert "base_color_error: 0 (dark) to 0.05" in capsys.readouterr().out
    image = read_image(tmp_path / "x.png")
    assert image.alpha is None
    assert image.height > image.width == 48  # a legend below
    assert run(*common, "base_color_error", "--out", tmp_path / "x.exr", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["channel"], said["range"]) == ("base_color_error", [0.0, 0.05])
    layers = read_image(tmp_path / "x.exr").channels
    assert set(layers) == {"A", *(f"base_color_error.{part}" for part in "RGB")}
    np.testing.assert_allclose(layers["base_color_error.G"][layers["A"] > 0.99], 0.03, rtol=2e-3)  # half has 11 bits


def test_flags_are_drawn_and_counted(judged, tmp_path, capsys):
    common = [judged, "observability", *SIDE, "--device", "cpu"]
    assert run(*common, "--out", tmp_path / "x.png", "--json") == 0
    flags = json.loads(capsys.readouterr().out)["flags"]
    assert flags.pop("grazing") == pytest.approx(0.5, abs=0.02)  # a half of the ball's disc
    assert set(flags.values()) == {0.0}
    assert run(*common, "--out", tmp_path / "x.exr") == 0
    assert "observability: unseen 0.0%, unlit 0.0%, grazing " in capsys.readouterr().out
    layers = read_image(tmp_path / "x.exr").channels
    picture = np.rint(255.0 * read_image(tmp_path / "x.png").rgb())[:48]
    for columns, share, color in ((np.s_[27:], 1.0, [0x00, 0x9E, 0x73]), (np.s_[:21], 0.0, [0xD9, 0xD9, 0xD9])):
        solid = layers["A"][:, columns] > 0.999
        assert solid.sum() > 100
        np.testing.assert_allclose(layers["observability.grazing"][:, columns][solid], share, atol=1e-5)
        assert np.abs(picture[:, columns][solid] - color).max() <= 1


def test_all_frames_have_one_range(tmp_path, capsys):
    clouds = [judged_ball(error) for error in (0.02, 0.9)]
    converters.write(GaussianSequence.from_clouds(clouds), tmp_path / "a.usda")
    common = [tmp_path / "a.usda", "roughness_error", *SIDE, "--out", tmp_path / "x.png"]
    assert run(*common) == 0
    assert "roughness_error: 0 (dark) to 0.02" in capsys.readouterr().out
    low, high = (read_image(tmp_path / f"x{frame:06d}.png").rgb() for frame in range(2))
    assert np.array_equal(low[48:], high[48:])  # the legend
    assert np.array_equal(low, high)  # 0.9 is beyond the end, and 0.02 is the end
    assert run(*common, "--range", 0, 1) == 0
    assert "roughness_error: 0 (dark) to 1\n" in capsys.readouterr().out
    low, high = (read_image(tmp_path / f"x{frame:06d}.png").rgb() for frame in range(2))
    assert high[24, 24] @ [1, 1, 1] > low[24, 24] @ [1, 1, 1] + 0.5


def test_a_channel_from_the_cameras_of_a_capture(judged, tmp_path):
    write_capture(tmp_path / "capture", [("b", 0, "test"), ("c", 0, "test")])
    assert run(judged, "base_color", "--capture", tmp_path / "capture", "--out", tmp_path / "out") == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["b_0000.png", "c_0000.png"]
    image = read_image(tmp_path / "out" / "b_0000.png")
    assert (image.width, image.height) == (40, 32)
    np.testing.assert_allclose(image.rgb()[16, 20], linear_to_srgb(np.array([0.8, 0.4, 0.2])), atol=0.01)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["albedo"], "channel must be one of radiance, surface_normals, base_color,"),
        (["roughness_error"], "channels must name arrays that the cloud holds, got 'roughness_error'"),
        (["observability"], "channel must be one that the cloud holds, got 'observability'"),
        (["roughness", "--range", "1", "0"], "range must be two numbers, the lower one first, got (1.0"),
        (["roughness", "--range", "0", "nan"], "range must be two numbers, the lower one first, got (0.0"),
        (["roughness", "--orbit", "0", "0", "--capture", "c"], "got --orbit and --capture. Leave one out."),
        (["roughness", "--capture", "c", "--width", "9"], "width must be left out with --capture, got 9"),
        (["roughness", "--frame", "1"], "frame must be an integer in [0, 0], got 1"),
        (["roughness", "--out", "x.mp4"], "out must end in .png or .exr for a channel, got x.mp4"),
        (["roughness", "--out", "ball.ply/x.png"], "output folder must be a folder, got"),
    ],
)
def test_refusals_are_one_line(tmp_path, monkeypatch, refused, words, message):
    monkeypatch.chdir(tmp_path)
    save([drawn_ball()], tmp_path / "ball.ply")
    refused("channel", "ball.ply", "--out", "x.png", *words, says=message)


def test_the_option_that_it_was_names_the_command(tmp_path, refused):
    says = "error: channel must be drawn by a command of its own. Use beam channel ASSET NAME --out FILE."
    for words in (["--channel", "roughness"], ["--channel=roughness"]):
        refused("render", "x.ply", *words, "--out", tmp_path / "x.png", says=says)


def test_records_are_those_that_the_asset_says_it_shows(tmp_path, capsys):
    """An asset of the frames 3 and 7 of a capture: its frame 1 is the capture's frame 7."""
    clouds = [drawn_ball((x, 0.0, 0.0)) for x in (-0.4, 0.4)]
    sequence = GaussianSequence.from_clouds(clouds, metadata={"capture_frames": "3 7"})
    converters.write(sequence, tmp_path / "a.usda")
    write_capture(tmp_path / "capture", [("b", frame, "test") for frame in (0, 1, 3, 7)])
    common = [tmp_path / "a.usda", "base_color", "--samples", 1, "--capture", tmp_path / "capture", "--out"]
    assert run(*common, tmp_path / "x") == 0
    assert "2 records are of frames that the asset lacks (0, 1): not drawn" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "x").iterdir()) == ["b_0003.png", "b_0007.png"]
    assert run(*common, tmp_path / "y", "--frame", 1, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["frames"] == [1]
    assert said["outputs"] == [str(tmp_path / "y" / "b_0007.png")]
    first, second, same = (
        read_image(tmp_path / name).rgb() for name in ("x/b_0003.png", "x/b_0007.png", "y/b_0007.png")
    )
    np.testing.assert_array_equal(second, same)
    camera = Capture.read(tmp_path / "capture").records[0].camera
    for image, cloud in ((first, clouds[0]), (second, clouds[1])):
        alpha = rasterize(cloud, camera, channels=(), device="cpu").alpha
        there = image[..., 0] > 0.4  # red of the ball, not the grey behind
        assert (there[alpha > 0.9]).all()
        assert not there[alpha < 0.1].any()
