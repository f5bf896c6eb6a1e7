"""``beam render``: pictures of a known asset under known light, the capture's layers, and every refusal."""

import json

import numpy as np
import pytest
from support.drawn_ball import drawn_ball, judged_ball, save, write_capture

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.cli.main import main
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.files import read_image, write_exr
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import WORLD_AXES, GaussianSequence

SIDE = ["--width", "48"]

PLAIN = ["--environment-shadows", "0", "--bounces", "0", "--samples", "1"]
"""Where shading is not what a test is about."""

LAYERS = {"R", "G", "B", "A", "depth", "roughness", "ambient_occlusion"} | {
    f"{name}.{part}" for name, parts in (("base_color", "RGB"), ("normal", "XYZ")) for part in parts
}

CODED = 2e-3
"""A PLY keeps materials as 32-bit floats; compositing and half a hundred splats a pixel round below this."""


def run(*words):
    return main(["render", *map(str, words)])


def see_ball(camera):
    """Normals and depth of the ball by intersecting its sphere; NaN where it is not seen."""
    rays = camera.directions()
    along = rays @ -camera.position
    with np.errstate(invalid="ignore"):
        distance = along - np.sqrt(along**2 - camera.position @ camera.position + 0.25)
    return (camera.position + distance[..., None] * rays) / 0.5, distance * (rays @ camera.forward)


@pytest.fixture
def ball(tmp_path):
    save([drawn_ball()], tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


@pytest.fixture
def white_light(tmp_path):
    path = tmp_path / "white.exr"
    write_exr(path, {name: np.ones((8, 16)) for name in "RGB"})
    return path


@pytest.fixture
def sided_light(tmp_path):
    """Light from +x alone, which is the middle of the image."""
    path = tmp_path / "sided.exr"
    texels = np.zeros((16, 32))
    texels[6:10, 14:18] = 100.0
    write_exr(path, dict.fromkeys("RGB", texels))
    return path


def test_exr_shows_the_white_furnace(ball, white_light, tmp_path):
    assert run(ball, "--environment", white_light, "--out", tmp_path / "x.exr", *SIDE, "--aov", "--device", "cpu") == 0
    layers = read_image(tmp_path / "x.exr").channels
    assert set(layers) == LAYERS
    solid = layers["A"] > 0.99
    assert 0.4 < solid.mean() < np.pi / 4
    np.testing.assert_allclose(layers["base_color.G"][solid], 0.4, atol=CODED)
    np.testing.assert_allclose(layers["roughness"][solid], 0.5, atol=CODED)
    expected_normals, expected_depth = see_ball(Camera.frame_points(drawn_ball().positions, width=48, height=48))
    facing = solid & (expected_depth < 1.5)  # where the surface is turned by 53 degrees at most
    normals = np.stack([layers[f"normal.{part}"] for part in "XYZ"], axis=-1)
    # A disc's deviation is 0.015 m, the low-pass's 0.55 pixel or 0.01 m, 0.017 m on the turned surface: 0.023 together.
    # Discs nearer to the camera cover others up to three of these away, and the ball's radius is 0.5 m: 0.14 rad.
    assert (normals * expected_normals).sum(axis=-1)[facing].min() > np.cos(0.14)
    np.testing.assert_allclose(layers["depth"][facing], expected_depth[facing], atol=0.01)
    # Under uniform light of 1, the reflected light lies between the base colour and 1, and follows the colour.
    for part, low in (("R", 0.8), ("G", 0.4), ("B", 0.2)):
        radiance = layers[part][solid] / layers["A"][solid]
        assert radiance.min() > low - 1e-2
        assert radiance.max() < 1.0
    assert (layers["R"][solid] > layers["G"][solid]).all()


def test_light_from_the_right_lights_the_right_and_turns(ball, sided_light, tmp_path):
    def sides(*more):
        words = [ball, "--environment", sided_light, "--out", tmp_path / "x.exr", *SIDE, *PLAIN]
        assert run(*words, *more) == 0
        green = read_image(tmp_path / "x.exr").channels["G"]
        return green[:, 30:].mean(), green[:, :18].mean()

    right, left = sides()
    assert right > 5 * left
    _, turned_left = sides("--rotate", 180, "--exposure", 1)
    assert turned_left == pytest.approx(2 * right, rel=0.02)  # the ball's discs are not laid out symmetrically
    right, left = sides("--orbit", 180, 0)
    assert left > 5 * right


def test_png_is_display_encoded_with_straight_alpha(ball, white_light, tmp_path):
    common = [ball, "--environment", white_light, *SIDE, *PLAIN]
    assert run(*common, "--out", tmp_path / "x.exr") == 0
    assert run(*common, "--out", tmp_path / "x.png") == 0
    linear, coded = read_image(tmp_path / "x.exr").channels, read_image(tmp_path / "x.png").channels
    solid = linear["A"] > 0.99
    expected = linear_to_srgb(linear["G"][solid] / linear["A"][solid])
    np.testing.assert_allclose(coded["G"][solid], expected, atol=0.51 / 255)
    np.testing.assert_allclose(coded["A"], linear["A"], atol=0.51 / 255)
    assert run(*common, "--out", tmp_path / "y.png", "--background", 0, 0.5, 1) == 0
    picture = read_image(tmp_path / "y.png")
    assert picture.alpha is None
    np.testing.assert_allclose(picture.rgb()[0, 0], [0, 0.5, 1], atol=0.51 / 255)


def test_usd_shows_the_same_picture(ball, sided_light, tmp_path):
    save([drawn_ball()], tmp_path / "ball.usdc")
    look = ["--environment", sided_light, *SIDE, *PLAIN, "--look-at", 2, -2, 1, 0, 0, 0]
    assert run(ball, "--out", tmp_path / "ply.png", *look) == 0
    assert run(tmp_path / "ball.usdc", "--out", tmp_path / "usd.png", *look) == 0
    ply, usd = (read_image(tmp_path / name) for name in ("ply.png", "usd.png"))
    assert ply.rgb().max() > 0.5
    # USD keeps half floats: 11 bits, and thin discs tilted by their rounding trade places in the depth order.
    for part in "RGBA":
        assert np.abs(ply.channels[part] - usd.channels[part]).mean() < 1 / 255


def test_it_is_drawn_as_the_asset_says_unless_told_otherwise(white_light, tmp_path):
    stated = {"raster_antialiased": "true", "raster_low_pass": "2.0"}
    ball = GaussianSequence.from_clouds([drawn_ball()], metadata=stated)
    for name, options in (("ball.ply", {"profile": "beam"}), ("ball.usdc", {"full_float": True})):
        converters.write(ball, tmp_path / name, converters.WriteOptions(**options))

    def alpha(*more, asset="ball.ply"):
        words = [tmp_path / asset, "--environment", white_light, *SIDE, *PLAIN, "--device", "cpu", *more]
        assert run(*words, "--out", tmp_path / "x.exr") == 0
        return read_image(tmp_path / "x.exr").channels["A"]

    def expected(antialiased, low_pass, asset="ball.ply"):
        cloud = change_axes(converters.read(tmp_path / asset)[0], WORLD_AXES)
        camera = Camera.frame_cloud(cloud.positions, cloud.opacities, width=48, height=48)
        options = RasterOptions(antialiased=antialiased, low_pass=low_pass)
        return rasterize(cloud, camera, channels=(), options=options, device="cpu").alpha

    for asset in ("ball.ply", "ball.usdc"):
        np.testing.assert_array_equal(alpha(asset=asset), expected(True, 2.0, asset))
    np.testing.assert_array_equal(alpha("--antialiased", "no"), expected(False, 2.0))
    np.testing.assert_array_equal(alpha("--low-pass", 0.1), expected(True, 0.1))
    np.testing.assert_array_equal(alpha("--low-pass", 0.3, "--antialiased", "no"), expected(False, 0.3))
    assert np.abs(expected(True, 2.0) - expected(False, 0.3)).max() > 0.1


def test_look_at_and_size(ball, white_light, tmp_path):
    out = tmp_path / "x.exr"
    look = ["--look-at", 0, -5, 0, 0, 0, 0, "--fov", 20, "--width", 60, "--height", 30, *PLAIN, "--aov"]
    assert run(ball, "--environment", white_light, "--out", out, *look) == 0
    image = read_image(out)
    assert (image.width, image.height) == (60, 30)
    assert image.channels["depth"][15, 30] == pytest.approx(4.5, abs=2e-3)


ERRORS = {"ambient_occlusion_error", "roughness_error", *(f"base_color_error.{part}" for part in "RGB")}


def test_aov_writes_the_errors_that_there_are(white_light, tmp_path):
    for name, changes, more in (
        ("all", {}, ERRORS),
        ("some", {"base_color_error": None, "ambient_occlusion_error": None}, {"roughness_error"}),
    ):
        cloud = judged_ball().with_arrays(normals=drawn_ball().normals, **changes)
        path = tmp_path / f"{name}.usdc"
        converters.write(GaussianSequence.from_clouds([cloud]), path, converters.WriteOptions(full_float=True))
        out = tmp_path / f"{name}.exr"
        words = ["--environment", white_light, "--out", out, *SIDE, *PLAIN, "--samples", 2, "--aov", "--device", "cpu"]
        assert run(path, *words) == 0
        layers = read_image(out).channels
        assert set(layers) == LAYERS | more
        np.testing.assert_allclose(layers["roughness_error"][layers["A"] > 0.99], 0.02, rtol=1e-5)


def test_several_frames_are_numbered_and_share_a_camera(white_light, tmp_path, capsys):
    (tmp_path / "walk").mkdir()
    save([drawn_ball((x, 0, 0)) for x in (-0.5, 0.0, 0.5)], tmp_path / "walk" / "walk.ply")
    common = [tmp_path / "walk", "--environment", white_light, *SIDE, *PLAIN, "--height", 24, "--json"]
    assert run(*common, "--out", tmp_path / "x.png") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["outputs"] == [str(tmp_path / f"x{n:06d}.png") for n in range(3)]
    assert result["frames"] == [0, 1, 2]
    assert result["gaussian_count"] == 10_000
    middles = []
    for n in range(3):
        alpha = read_image(tmp_path / f"x{n:06d}.png").channels["A"]
        middles.append((alpha * np.arange(48)).sum() / alpha.sum())
    assert middles[0] < middles[1] - 3 < middles[2] - 6
    assert run(*common, "--out", tmp_path / "one.png", "--frame", 2) == 0
    np.testing.assert_array_equal(read_image(tmp_path / "one.png").channels["A"].shape, (24, 48))
    assert not (tmp_path / "one000002.png").exists()


def test_capture_gives_a_file_for_each_record(ball, white_light, tmp_path, capsys):
    cameras = [("a", 0, "train"), ("b", 0, "test"), ("c", 0, "test"), ("b", 7, "test")]
    camera = write_capture(tmp_path / "capture", cameras)
    out = tmp_path / "out"
    common = [ball, "--capture", tmp_path / "capture", "--environment", white_light, *PLAIN, "--out", out]
    assert run(*common, "--aov") == 0
    assert sorted(path.name for path in out.iterdir()) == ["b_0000.exr", "c_0000.exr"]
    assert "1 records are of frames that the asset lacks (7): not drawn" in capsys.readouterr().err
    layers = read_image(out / "b_0000.exr").channels
    assert set(layers) == LAYERS
    assert layers["A"].shape == (32, 40)
    assert layers["depth"][16, 20] == pytest.approx(2.5, abs=2e-3)
    toward = -camera.forward  # the ball's nearest point faces the camera
    found = [layers[f"normal.{part}"][15:17, 19:21].mean() for part in "XYZ"]
    np.testing.assert_allclose(found, toward, atol=0.03)
    assert run(*common, "--split", "train", "--frame", 0, "--quiet") == 0
    assert (out / "a_0000.exr").exists()
    assert set(read_image(out / "a_0000.exr").channels) == set("RGBA")


def test_bent_photographs_are_drawn_as_their_undistorted_images(ball, white_light, tmp_path, capsys):
    write_capture(tmp_path / "bent", [("b", 0, "test")], k1=0.1)
    pinhole = Capture.read(tmp_path / "bent").records[0].camera
    same = {"fl_x": pinhole.focal_x, "fl_y": pinhole.focal_y, "cx": pinhole.center_x, "cy": pinhole.center_y}
    write_capture(tmp_path / "straight", [("b", 0, "test")], **same)
    common = (ball, "--environment", white_light, *PLAIN, "--out")
    assert run(*common, tmp_path / "x", "--capture", tmp_path / "bent") == 0
    assert "1 records were photographed through a lens that bends lines" in capsys.readouterr().err
    assert run(*common, tmp_path / "y", "--capture", tmp_path / "straight") == 0
    assert "lens" not in capsys.readouterr().err
    bent, straight = (read_image(tmp_path / name / "b_0000.exr").channels for name in ("x", "y"))
    for part in "RGBA":
        np.testing.assert_array_equal(bent[part], straight[part])


def test_the_capture_brings_its_light(ball, white_light, tmp_path):
    write_capture(tmp_path / "capture", [("b", 0, "test")])
    white_light.rename(tmp_path / "capture" / "environment.exr")
    assert run(ball, "--capture", tmp_path / "capture", "--out", tmp_path / "out", *PLAIN) == 0
    assert read_image(tmp_path / "out" / "b_0000.exr").channels["G"].max() > 0.3


def test_what_is_missing_is_named(ball, white_light, tmp_path, refused):
    converters.write(GaussianSequence.from_clouds([drawn_ball()]), tmp_path / "plain.ply")
    lacking = "one without base_color, roughness, ambient_occlusion in frame 0 of plain"
    for words, says in (
        ([ball], "environment must be given, got none"),
        ([ball, "--environment", tmp_path / "no.exr"], "no.exr"),
        ([tmp_path / "plain.ply", "--environment", white_light], f"asset must be relightable, got {lacking}"),
        ([tmp_path / "plain.ply", "--environment", white_light], "beam run"),
    ):
        refused("render", *words, "--out", tmp_path / "x.png", says=says)


def test_capture_refusals(ball, white_light, tmp_path, refused):
    write_capture(tmp_path / "late", [("b", 5, "test")])
    (tmp_path / "file").touch()
    for words, says in (
        (["out"], "asset must have a frame that the records of split 'test' show, got 1 frames"),
        (["out", "--split", "val"], "split must name records of the capture, got 'val' (it has test)"),
        (["file"], "out must be a folder with --capture, got the file"),
    ):
        common = [ball, "--environment", white_light, "--capture", tmp_path / "late"]
        refused("render", *common, "--out", tmp_path / words[0], *words[1:], says=says)


def test_broken_rows_are_refused_or_left_out_and_counted(ball, white_light, tmp_path, capsys):
    content = bytearray(ball.read_bytes())
    start = content.index(b"end_header\n") + len(b"end_header\n")
    content[start : start + 4] = np.float32(np.nan).tobytes()
    ball.write_bytes(content)
    words = (ball, "--environment", white_light, "--out", tmp_path / "x.png", *SIDE, *PLAIN, "--device", "cpu")
    assert run(*words) == 2
    assert "must be finite" in capsys.readouterr().err
    assert run(*words, "--drop-invalid") == 0
    out, err = capsys.readouterr()
    assert "1 of 10000 Gaussians dropped: 1 not finite" in err
    assert "9,999 Gaussians" in out
