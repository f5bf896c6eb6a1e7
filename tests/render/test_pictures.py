"""What files hold of a rendered image: layers, exposure, backgrounds, views."""

import numpy as np
import pytest

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import linear_to_srgb, srgb_to_linear
from beam_warp.image.files import read_image
from beam_warp.image.tone import display, display_over
from beam_warp.render.backdrops import Backdrop
from beam_warp.render.pictures import PictureOptions, PictureWriter
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.shot import RenderedImage, Shot


@pytest.fixture
def shot():
    none = np.zeros((0, 3), np.float32)
    cloud = GaussianCloud(positions=none, orientations=np.zeros((0, 4)), scales=none, opacities=none[:, 0])
    camera = Camera.look_at((0, -3, 0), (0, 0, 0), width=6, height=4, vertical_fov=30.0)
    light = EnvironmentMap(np.random.default_rng(1).uniform(0, 3, (8, 16, 3)).astype(np.float32))
    return Shot(cloud=cloud, camera=camera, environment=light, environment_rotation=40.0)


@pytest.fixture
def image(rng):
    alpha = rng.uniform(0, 1, (4, 6)).astype(np.float32)
    alpha[0] = (0, 1, 0, 1, 0.5, 0.5)
    rgb = rng.uniform(0, 2, (4, 6, 3)).astype(np.float32) * alpha[..., None]
    layers = {
        "depth": rng.uniform(1, 2, (4, 6)).astype(np.float32),
        "normals": rng.normal(size=(4, 6, 3)).astype(np.float32),
        "base_color": rng.uniform(0, 1, (4, 6, 3)).astype(np.float32),
    }
    return RenderedImage(rgb, alpha, layers)


def test_exr_is_scene_linear_and_exposed(shot, image, tmp_path):
    options = PictureOptions(exposure=1.0, view="agx")  # a view is none of its business
    PictureWriter(options).write(tmp_path / "x.exr", shot, image)
    found = read_image(tmp_path / "x.exr")
    assert set(found.channels) == set("RGBA")
    np.testing.assert_array_equal(found.stack("R", "G", "B"), 2 * image.rgb)
    np.testing.assert_array_equal(found.alpha, image.alpha)


def test_layers_by_their_names(shot, image):
    layers = PictureWriter(PictureOptions(layers=True)).exr_layers(shot, image)
    assert set(layers) == {*"RGBA", "depth", *(f"normal.{p}" for p in "XYZ"), *(f"base_color.{p}" for p in "RGB")}
    np.testing.assert_array_equal(layers["normal.Y"], image.layers["normals"][..., 1])
    np.testing.assert_array_equal(layers["base_color.B"], image.layers["base_color"][..., 2])
    np.testing.assert_array_equal(layers["depth"], image.layers["depth"])


def test_png_is_the_view(shot, image, tmp_path):
    PictureWriter(PictureOptions(view="agx", exposure=-1.0)).write(tmp_path / "x.png", shot, image)
    found = read_image(tmp_path / "x.png").stack(*"RGBA")
    np.testing.assert_allclose(255 * found, display_over(image.rgb, image.alpha, "agx", -1.0), atol=1e-4)


def test_a_colour_behind(shot, image):
    writer = PictureWriter(PictureOptions(background=(0.2, 0.5, 1.0), exposure=2.0))
    np.testing.assert_array_equal(writer.pixels(shot, image)[0, 0], np.rint(255 * np.array([0.2, 0.5, 1.0])))
    layers = writer.exr_layers(shot, image)
    assert (layers["A"] == 1.0).all()
    expected = 4 * image.rgb[..., 1] + (1 - image.alpha) * srgb_to_linear(0.5)
    np.testing.assert_allclose(layers["G"], expected, rtol=1e-6)


def test_the_environment_behind_is_light_of_the_scene(shot, image):
    options = PictureOptions(background="environment", exposure=1.0, view="neutral")
    behind = Backdrop(shot.environment).seen(shot.camera, 40.0)
    light = image.rgb + (1 - image.alpha[..., None]) * behind
    writer = PictureWriter(options)
    layers = writer.exr_layers(shot, image)
    np.testing.assert_allclose(np.stack([layers[part] for part in "RGB"], axis=-1), 2 * light, rtol=1e-6)
    np.testing.assert_array_equal(layers["A"], 1.0)
    np.testing.assert_array_equal(writer.pixels(shot, image), display(light, "neutral", 1.0))
    dark = Shot(cloud=shot.cloud, camera=shot.camera)
    assert writer.pixels(dark, image).shape[-1] == 4  # nothing is behind


def test_a_caught_shadow_lets_less_of_the_environment_through(shot):
    shadow = RenderedImage(np.zeros((4, 6, 3), np.float32), np.full((4, 6), 0.75, np.float32))
    nothing = RenderedImage(np.zeros((4, 6, 3), np.float32), np.zeros((4, 6), np.float32))
    writer = PictureWriter(PictureOptions(background="environment"))
    shaded, open_ = (writer.exr_layers(shot, seen)["R"] for seen in (shadow, nothing))
    np.testing.assert_allclose(shaded, 0.25 * open_, rtol=1e-6)


def test_not_finite_is_an_error(shot, image, tmp_path):
    image.rgb[0, 1, 0] = np.nan
    with pytest.raises(InvalidArrayError, match="must be finite"):
        PictureWriter(PictureOptions()).write(tmp_path / "x.png", shot, image)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"view": "filmic"}, InvalidOptionError, "view must be one of standard, aces, agx, neutral, got 'filmic'"),
        ({"exposure": np.nan}, InvalidOptionError, "exposure must be a number in"),
        ({"background": (0.0, 0.0, 2.0)}, InvalidArrayError, r"background must lie in \[0, 1\], got 2"),
        ({"background": "sky"}, InvalidOptionError, "background must be one of transparent, environment"),
    ],
)
def test_options_are_checked(options, kind, message):
    with pytest.raises(kind, match=message):
        PictureOptions(**options)


def test_half_covered_pixel_over_black_is_half_as_bright(shot):
    image = RenderedImage(np.full((4, 6, 3), 0.25, np.float32), np.full((4, 6), 0.5, np.float32))
    pixels = PictureWriter(PictureOptions(background=(0.0, 0.0, 0.0))).pixels(shot, image)
    np.testing.assert_array_equal(pixels, np.rint(255 * linear_to_srgb(0.25)).astype(np.uint8))
