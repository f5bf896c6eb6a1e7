"""``beam render``: pictures of a known asset under known light, the capture's layers, and every refusal."""

import json

import numpy as np
import pytest
import tyro
from tyro.conf import FlagCreatePairsOff

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.cli.console import run_command
from beam_warp.cli.render import Render, render
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.files import read_image, write_exr
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence

SIDE = ["--width", "48"]

PLAIN = ["--environment-shadows", "0", "--bounces", "0"]
"""Where shading is not what a test is about."""

LAYERS = {"R", "G", "B", "A", "depth", "roughness", "ambient_occlusion"} | {
    f"{name}.{part}" for name, parts in (("base_color", "RGB"), ("normal", "XYZ")) for part in parts
}

CODED = 2e-3
"""A PLY keeps materials as 32-bit floats; compositing and half a hundred splats a pixel round below this."""


def run(*words):
    args = tyro.cli(Render, args=[str(word) for word in words], config=(FlagCreatePairsOff,))
    return run_command(lambda: render(args))


def sphere(center=(0.0, 0.0, 0.0), color=(0.8, 0.4, 0.2), count=10_000):
    """Opaque flat discs on a ball of radius 0.5 m."""
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    phi = np.pi * (1.0 + np.sqrt(5.0)) * index
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    turn = np.concatenate([np.cross([0.0, 0.0, 1.0], normals), 1.0 + normals[:, 2:]], axis=1)
    return GaussianCloud(
        positions=0.5 * normals + center,
        orientations=turn / np.linalg.norm(turn, axis=1, keepdims=True),
        scales=np.tile([0.015, 0.015, 1e-4], (count, 1)),
        opacities=np.full(count, 0.99),
        radiance=np.zeros((count, 1, 3)),
        radiance_color_space="lin_rec709_scene",
        base_color=np.tile(color, (count, 1)),
        roughness=np.full(count, 0.5),
        ambient_occlusion=np.ones(count),
        normals=normals,
    )


def see_ball(camera):
    """Normals and depth of the ball by intersecting its sphere; NaN where it is not seen."""
    rays = camera.directions()
    along = rays @ -camera.position
    with np.errstate(invalid="ignore"):
        distance = along - np.sqrt(along**2 - camera.position @ camera.position + 0.25)
    return (camera.position + distance[..., None] * rays) / 0.5, distance * (rays @ camera.forward)


def save(clouds, path):
    converters.write(GaussianSequence.from_clouds(clouds), path, converters.WriteOptions(profile="beam"))


@pytest.fixture
def ball(tmp_path):
    save([sphere()], tmp_path / "ball.ply")
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


def write_capture(folder, cameras, **changes):
    """A capture of one camera per (name, frame, split), without images: none are needed to draw over them."""
    folder.mkdir()
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    camera = Camera.orbit((0, 0, 0), 3.0, 30.0, 20.0, width=40, height=32, vertical_fov=30.0)
    content = {
        "w": 40, "h": 32, "fl_x": camera.focal_x, "fl_y": camera.focal_y, "cx": 20, "cy": 16,
        "frames": [
            {"file_path": f"images/{name}/{frame:04d}.exr", "camera": name, "frame": frame, "split": split,
             "transform_matrix": (camera.camera_to_world @ flip).tolist(), **changes}
            for name, frame, split in cameras
        ],
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(content))
    return camera


def test_exr_shows_the_white_furnace(ball, white_light, tmp_path):
    assert run(ball, "--environment", white_light, "--out", tmp_path / "x.exr", *SIDE, "--aov", "--device", "cpu") == 0
    layers = read_image(tmp_path / "x.exr").channels
    assert set(layers) == LAYERS
    solid = layers["A"] > 0.99
    assert 0.4 < solid.mean() < np.pi / 4
    np.testing.assert_allclose(layers["base_color.G"][solid], 0.4, atol=CODED)
    np.testing.assert_allclose(layers["roughness"][solid], 0.5, atol=CODED)
    expected_normals, expected_depth = see_ball(Camera.frame_points(sphere().positions, width=48, height=48))
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
    save([sphere()], tmp_path / "ball.usdc")
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
    ball = GaussianSequence.from_clouds([sphere()], metadata=stated)
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
    look = ["--look-at", 0, -5, 0, 0, 0, 0, "--fov", 20, "--width", 60, "--height", 30, "--aov"]
    assert run(ball, "--environment", white_light, "--out", out, *look) == 0
    image = read_image(out)
    assert (image.width, image.height) == (60, 30)
    assert image.channels["depth"][15, 30] == pytest.approx(4.5, abs=2e-3)


ERRORS = {"ambient_occlusion_error", "roughness_error", *(f"base_color_error.{part}" for part in "RGB")}


def judged(error=0.02):
    """The ball, with errors and flags; not relightable, since it has no normals."""
    return sphere().with_arrays(
        normals=None,
        ambient_occlusion_error=np.full(10_000, 0.01),
        base_color_error=np.full((10_000, 3), 0.03),
        roughness_error=np.full(10_000, error),
        observability=np.where(sphere().positions[:, 0] > 0.0, 32, 0),  # at the right of the image
    )


def test_aov_writes_the_errors_that_there_are(white_light, tmp_path):
    for name, changes, more in (
        ("all", {}, ERRORS),
        ("some", {"base_color_error": None, "ambient_occlusion_error": None}, {"roughness_error"}),
    ):
        cloud = judged().with_arrays(normals=sphere().normals, **changes)
        path = tmp_path / f"{name}.usdc"
        converters.write(GaussianSequence.from_clouds([cloud]), path, converters.WriteOptions(full_float=True))
        out = tmp_path / f"{name}.exr"
        words = ["--environment", white_light, "--out", out, *SIDE, *PLAIN, "--aov", "--device", "cpu"]
        assert run(path, *words) == 0
        layers = read_image(out).channels
        assert set(layers) == LAYERS | more
        np.testing.assert_allclose(layers["roughness_error"][layers["A"] > 0.99], 0.02, rtol=1e-5)


def test_a_channel_needs_no_light_and_no_material(tmp_path, capsys):
    converters.write(GaussianSequence.from_clouds([judged()]), tmp_path / "ball.usdc")
    common = [tmp_path / "ball.usdc", *SIDE, "--device", "cpu"]
    assert run(*common, "--channel", "base_color_error", "--out", tmp_path / "x.png") == 0
    assert "base_color_error: 0 (dark) to 0.05" in capsys.readouterr().out
    image = read_image(tmp_path / "x.png")
    assert image.alpha is None
    assert image.height > image.width == 48  # a legend below
    assert run(*common, "--channel", "base_color_error", "--out", tmp_path / "x.exr", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["channel"], said["range"]) == ("base_color_error", [0.0, 0.05])
    layers = read_image(tmp_path / "x.exr").channels
    assert set(layers) == {"A", *(f"base_color_error.{part}" for part in "RGB")}
    np.testing.assert_allclose(layers["base_color_error.G"][layers["A"] > 0.99], 0.03, rtol=2e-3)  # half has 11 bits


def test_flags_are_drawn_and_counted(tmp_path, capsys):
    converters.write(GaussianSequence.from_clouds([judged()]), tmp_path / "ball.usdc")
    common = [tmp_path / "ball.usdc", *SIDE, "--device", "cpu", "--channel", "observability"]
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
    clouds = [judged(error) for error in (0.02, 0.9)]
    converters.write(GaussianSequence.from_clouds(clouds), tmp_path / "a.usda")
    common = [tmp_path / "a.usda", *SIDE, "--channel", "roughness_error", "--out", tmp_path / "x.png"]
    assert run(*common) == 0
    assert "roughness_error: 0 (dark) to 0.02" in capsys.readouterr().out
    low, high = (read_image(tmp_path / f"x{frame:06d}.png").rgb() for frame in range(2))
    assert np.array_equal(low[48:], high[48:])  # the legend
    assert np.array_equal(low, high)  # 0.9 is beyond the end, and 0.02 is the end
    assert run(*common, "--range", 0, 1) == 0
    assert "roughness_error: 0 (dark) to 1\n" in capsys.readouterr().out
    low, high = (read_image(tmp_path / f"x{frame:06d}.png").rgb() for frame in range(2))
    assert high[24, 24] @ [1, 1, 1] > low[24, 24] @ [1, 1, 1] + 0.5


def test_a_channel_from_the_cameras_of_a_capture(tmp_path):
    converters.write(GaussianSequence.from_clouds([judged()]), tmp_path / "ball.usdc")
    write_capture(tmp_path / "capture", [("b", 0, "test"), ("c", 0, "test")])
    words = ["--channel", "base_color", "--capture", tmp_path / "capture", "--out", tmp_path / "out"]
    assert run(tmp_path / "ball.usdc", *words) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["b_0000.png", "c_0000.png"]
    image = read_image(tmp_path / "out" / "b_0000.png")
    assert (image.width, image.height) == (40, 32)
    np.testing.assert_allclose(image.rgb()[16, 20], linear_to_srgb(np.array([0.8, 0.4, 0.2])), atol=0.01)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--channel", "albedo"], "channel must be one of radiance, surface_normals, base_color,"),
        (["--channel", "roughness_error"], "channels must name arrays that the cloud holds, got 'roughness_error'"),
        (["--channel", "observability"], "channel must be one that the cloud holds, got 'observability'"),
        (
            ["--channel", "roughness", "--environment", "x.hdr"],
            "environment must be left out with --channel, got x.hdr",
        ),
        (["--channel", "roughness", "--exposure", "1"], "exposure must be left out with --channel, got 1.0"),
        (["--channel", "roughness", "--aov"], "aov must be left out with --channel, got True"),
        (["--channel", "roughness", "--range", "1", "0"], "range must be two numbers, the lower one first, got (1.0"),
        (["--channel", "roughness", "--range", "0", "nan"], "range must be two numbers, the lower one first, got (0.0"),
        (["--range", "0", "1"], "range must come with --channel, got (0.0, 1.0) without. Leave it out."),
    ],
)
def test_refusals_of_channels_are_one_line(ball, tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    assert run(ball, "--out", "x.png", *words) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.ply"]


def test_several_frames_are_numbered_and_share_a_camera(white_light, tmp_path, capsys):
    (tmp_path / "walk").mkdir()
    save([sphere((x, 0, 0)) for x in (-0.5, 0.0, 0.5)], tmp_path / "walk" / "walk.ply")
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


def test_records_are_those_that_the_asset_says_it_shows(white_light, tmp_path, capsys):
    """An asset of the frames 3 and 7 of a capture: its frame 1 is the capture's frame 7."""
    clouds = [sphere((x, 0.0, 0.0)) for x in (-0.4, 0.4)]
    sequence = GaussianSequence.from_clouds(clouds, metadata={"capture_frames": "3 7"})
    converters.write(sequence, tmp_path / "a.usda")
    write_capture(tmp_path / "capture", [("b", frame, "test") for frame in (0, 1, 3, 7)])
    common = [tmp_path / "a.usda", "--channel", "base_color", "--capture", tmp_path / "capture", "--out"]
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
    assert run(ball, "--capture", tmp_path / "capture", "--out", tmp_path / "out") == 0
    assert read_image(tmp_path / "out" / "b_0000.exr").channels["G"].max() > 0.3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "x.jpg"], "out must end in .png, .exr or .mp4, got x.jpg. Rename it."),
        (["--out", "x.png", "--aov"], "out must end in .exr to hold the layers of --aov, got x.png"),
        (["--out", "nowhere/x.png"], "out must be in a folder that exists, got nowhere"),
        (["--out", "x.png", "--orbit", "0", "0", "--capture", "c"], "got --orbit and --capture. Leave one out."),
        (["--out", "o", "--capture", "c", "--width", "9"], "width must be left out with --capture, got 9"),
        (["--out", "x.png", "--background", "0", "0", "2"], "background must lie in [0, 1], got 2"),
        (["--out", "x.png", "--frame", "3"], "frame must be an integer in [0, 0], got 3"),
        (["--out", "x.png", "--width", "0"], "width must be an integer in [1, 65536], got 0"),
        (["--out", "x.png", "--orbit", "0", "100"], "elevation must be a number in [-90, 90], got 100.0"),
        (["--out", "x.png", "--fov", "nan"], "vertical_fov must be a number in"),
        (["--out", "x.png", "--device", "cuda:9"], "device must be one of cpu"),
        (["--out", "x.png", "--exposure", "nan"], "must be a number in"),
        (["--out", "x.png", "--low-pass", "0"], "low_pass must be a number in [1e-06, 1e+06], got 0.0"),
    ],
)
def test_refusals_are_one_line(ball, white_light, tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    assert run(ball, "--environment", white_light, *words) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


def test_what_is_missing_is_named(ball, white_light, tmp_path, capsys):
    out = tmp_path / "x.png"
    assert run(ball, "--out", out) == 2
    assert "environment must be given, got none" in capsys.readouterr().err
    assert run(ball, "--environment", tmp_path / "no.exr", "--out", out) == 2
    assert "no.exr" in capsys.readouterr().err
    converters.write(GaussianSequence.from_clouds([sphere()]), tmp_path / "plain.ply")
    assert run(tmp_path / "plain.ply", "--environment", white_light, "--out", out) == 2
    error = capsys.readouterr().err
    assert (
        "asset must be relightable, got one without base_color, roughness, ambient_occlusion in frame 0 of plain"
        in error
    )
    assert "beam run" in error
    assert not out.exists()


def test_capture_refusals(ball, white_light, tmp_path, capsys):
    write_capture(tmp_path / "late", [("b", 5, "test")])
    out = tmp_path / "out"
    common = [ball, "--environment", white_light, "--out", out]
    assert run(*common, "--capture", tmp_path / "late") == 2
    assert "asset must have a frame that the records of split 'test' show, got 1 frames" in capsys.readouterr().err
    assert run(*common, "--capture", tmp_path / "late", "--split", "val") == 2
    assert "split must name records of the capture, got 'val' (it has test)" in capsys.readouterr().err
    assert not out.exists()
    out.touch()
    assert run(*common, "--capture", tmp_path / "late") == 2
    assert "out must be a folder with --capture, got the file" in capsys.readouterr().err


def test_broken_rows_are_refused_or_left_out_and_counted(ball, white_light, tmp_path, capsys):
    content = bytearray(ball.read_bytes())
    start = content.index(b"end_header\n") + len(b"end_header\n")
    content[start : start + 4] = np.float32(np.nan).tobytes()
    ball.write_bytes(content)
    words = (ball, "--environment", white_light, "--out", tmp_path / "x.png", *SIDE, "--device", "cpu")
    assert run(*words) == 2
    assert "must be finite" in capsys.readouterr().err
    assert run(*words, "--drop-invalid") == 0
    out, err = capsys.readouterr()
    assert "1 of 10000 Gaussians dropped: not finite" in err
    assert "9,999 Gaussians" in out
