"""One channel as a picture: what colours stand for, what a pixel's flags are, scales that do not depend on the view."""

import numpy as np
import pytest
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709, srgb_to_linear
from beam_warp.image.files import display_image
from beam_warp.image.panels import over_background
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.render.channels import DRAWABLE, FLAG_COLORS, OBSERVED_COLOR, VIRIDIS, channel_range, see_channel
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import Observability

COUNT = 400
WORDS = [word for word, _ in FLAG_COLORS.values()]


def ball(**changes):
    points, spacing = sphere_points(COUNT)
    rng = np.random.default_rng(3)
    arrays = {
        "radiance": rng.normal(0.0, 0.3, (COUNT, 4, 3)),
        "radiance_color_space": LINEAR_REC709,
        "base_color": rng.random((COUNT, 3)),
        "roughness": rng.random(COUNT),
        "ambient_occlusion": rng.random(COUNT),
        "normals": points,
        "normal_confidence": rng.random(COUNT),
        "ambient_occlusion_error": 0.03 * rng.random(COUNT),
        "base_color_error": 0.2 * rng.random((COUNT, 3)),
        "roughness_error": 0.4 * rng.random(COUNT),
        "observability": rng.integers(0, 64, COUNT),
    }
    return cloud_of(tiles(points, points, spacing), **(arrays | changes))


def camera(width=40, height=30):
    return Camera.orbit((0.0, 0.0, 0.0), 4.0, 20.0, 10.0, width=width, height=height, vertical_fov=40.0)


def rgb(color):
    return np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)])


def test_the_colour_map_is_viridis_and_gets_brighter():
    anchors = np.stack([rgb(color) for color in VIRIDIS])
    luminance = srgb_to_linear(anchors / 255.0) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) > 0.0).all()
    matplotlib = pytest.importorskip("matplotlib")
    expected = matplotlib.colormaps["viridis"](np.linspace(0.0, 1.0, len(VIRIDIS)))[:, :3]
    np.testing.assert_array_equal(anchors, np.rint(255.0 * expected))


def test_every_flag_has_a_colour_of_its_own():
    assert set(FLAG_COLORS) == set(Observability) - {Observability.OBSERVED}
    assert len({color for _, color in FLAG_COLORS.values()} | {OBSERVED_COLOR}) == len(FLAG_COLORS) + 1


@pytest.mark.parametrize("name", DRAWABLE)
@pytest.mark.parametrize(("width", "height"), [(40, 30), (1, 1), (300, 2)])
def test_every_channel_is_a_picture_and_layers(device, name, width, height):
    seen = see_channel(ball(), camera(width, height), name, device=device)
    picture = seen.picture(channel_range(ball(), name))
    assert picture.dtype == np.uint8
    assert picture.shape[1:] == (width, 3)
    assert (picture.shape[0] > height) == (seen.is_mapped or name == "observability")
    layers = seen.layers()
    assert np.array_equal(layers.pop("A"), seen.alpha)
    assert all(layer.shape == (height, width) for layer in layers.values())
    expected = seen.values.reshape(height, width, -1)
    assert np.array_equal(np.stack(list(layers.values()), axis=-1), expected)


def test_names_of_layers():
    def names(channel):
        return set(see_channel(ball(), camera(), channel, device="cpu").layers()) - {"A"}

    assert names("roughness_error") == {"roughness_error"}
    assert names("ambient_occlusion_error") == {"ambient_occlusion_error"}
    assert names("base_color_error") == {f"base_color_error.{part}" for part in "RGB"}
    assert names("surface_normals") == {f"surface_normal.{part}" for part in "XYZ"}
    assert names("observability") == {f"observability.{word.replace(' ', '_')}" for word in WORDS}


def test_values_are_those_of_the_g_buffer(device):
    options = RasterOptions(antialiased=True, low_pass=0.1)
    seen = see_channel(ball(), camera(), "base_color_error", options=options, device=device)
    buffer = rasterize(ball(), camera(), channels=("base_color_error",), options=options, device=device)
    assert np.array_equal(seen.values, buffer.channels["base_color_error"])
    assert np.array_equal(seen.alpha, buffer.alpha)


@pytest.mark.parametrize("name", ["roughness", "normals", "radiance", "observability"])
def test_a_pixel_is_the_mean_of_what_its_samples_cover(name):
    """Float64, pixel by pixel: means are weighted by coverage, directions are of unit length."""
    width, height, side = 12, 9, 3
    fine = see_channel(ball(), camera(width * side, height * side), name, device="cpu")
    seen = see_channel(ball(), camera(width, height), name, samples=side, device="cpu")
    for row in range(height):
        for column in range(width):
            block = np.s_[row * side : (row + 1) * side, column * side : (column + 1) * side]
            weights = fine.alpha[block].astype(np.float64)
            assert seen.alpha[row, column] == pytest.approx(weights.mean(), abs=1e-6)
            values = fine.values[block].astype(np.float64).reshape(side * side, -1)
            expected = weights.reshape(-1) @ values / max(weights.sum(), 1e-12)
            if name == "normals":
                expected /= max(np.linalg.norm(expected), 1e-12)
            np.testing.assert_allclose(np.ravel(seen.values[row, column]), expected, atol=2e-5)


def test_colours_and_directions_are_shown_as_they_are():
    buffer = rasterize(ball(), camera(), channels=("base_color", "normals", "radiance"))
    alpha, found = buffer.alpha[..., None], buffer.channels
    for cloud, name, expected in (
        (ball(), "base_color", display_image(found["base_color"]) / 255.0),
        (ball(), "normals", 0.5 * found["normals"] + 0.5),
        (ball(), "radiance", display_image(found["radiance"]) / 255.0),
        (ball(radiance_color_space=DISPLAY_SRGB), "radiance", np.clip(found["radiance"], 0.0, 1.0)),
    ):
        picture = see_channel(cloud, camera(), name).picture()
        np.testing.assert_array_equal(picture, over_background(expected, alpha))


def test_ends_of_the_range_have_the_colours_of_the_ends():
    for value, color in ((0.25, VIRIDIS[0]), (0.5, VIRIDIS[8]), (0.75, VIRIDIS[16]), (5.0, VIRIDIS[16])):
        seen = see_channel(ball(roughness_error=np.full(COUNT, value)), camera(), "roughness_error", device="cpu")
        solid = seen.alpha > 0.999
        assert solid.any()
        shown = seen.picture((0.25, 0.75))[: len(solid)][solid].astype(int)
        assert np.abs(shown - rgb(color)).max() <= 1  # coverage of 0.999 lets the grey behind through


def test_three_errors_are_their_root_mean_square():
    one = ball(base_color_error=np.tile([0.3, 0.0, 0.0], (COUNT, 1)))
    seen = see_channel(one, camera(), "base_color_error", device="cpu")
    same = see_channel(ball(roughness_error=np.full(COUNT, np.sqrt(0.03))), camera(), "roughness_error", device="cpu")
    first, second = (image.picture((0.0, 0.5))[:30].astype(int) for image in (seen, same))
    assert np.abs(first - second).max() <= 1
    assert channel_range(one, "base_color_error") == (0.0, 0.2)


def test_the_legend_is_the_colour_map_between_the_numbers_at_its_ends():
    seen = see_channel(ball(), camera(), "roughness_error", device="cpu")
    numbers = []
    for value_range in ((0.25, 0.75), (0.75, 0.25)):
        line = seen.legend(300, value_range)[:26]
        middle = line[16].astype(int)
        first, last = (int(np.flatnonzero((middle == rgb(VIRIDIS[end])).all(axis=1))[end]) for end in (0, -1))
        places = np.linspace(0.0, len(VIRIDIS) - 1, last + 1 - first)
        expected = [np.interp(places, range(len(VIRIDIS)), column) for column in zip(*map(rgb, VIRIDIS), strict=True)]
        np.testing.assert_allclose(middle[first : last + 1].T, expected, atol=0.5)
        for part in (line[:, :first, 0], line[:, last + 1 :, 0]):
            drawn = np.flatnonzero(part.max(axis=0) > part.min())
            numbers.append(part[:, drawn[0] : drawn[-1] + 1])
    low, high, other_low, other_high = numbers
    assert np.array_equal(low, other_high)
    assert np.array_equal(high, other_low)
    assert not np.array_equal(low, high)
    np.testing.assert_array_equal(seen.picture()[30:], seen.legend(40))


@pytest.mark.parametrize(
    ("largest", "end"), [(0.0, 1.0), (1e-6, 1e-6), (0.011, 0.02), (0.02, 0.02), (0.3, 0.5), (0.7, 1.0), (7.0, 10.0)]
)
def test_a_range_ends_at_a_round_number(largest, end):
    cloud = ball(roughness_error=np.full(COUNT, largest))
    assert channel_range(cloud, "roughness_error") == (0.0, pytest.approx(end))


def test_a_range_passes_over_outliers_and_keeps_limits():
    errors = np.full(COUNT, 0.04)
    errors[: COUNT // 100] = 3.0
    assert channel_range(ball(ambient_occlusion_error=errors), "ambient_occlusion_error") == (0.0, 0.05)
    assert channel_range(ball(roughness=np.full(COUNT, 0.1)), "roughness") == (0.0, 1.0)
    assert channel_range(ball().select(np.arange(0)), "roughness_error") == (0.0, 1.0)


class TestFlags:
    def see(self, flags, width=40, height=30):
        return see_channel(ball(observability=flags), camera(width, height), "observability", device="cpu")

    def colors(self, seen):
        solid = seen.alpha > 0.999
        return seen.picture()[: len(solid)][solid].astype(int)

    @pytest.mark.parametrize("flag", FLAG_COLORS)
    def test_one_flag_everywhere(self, flag):
        seen = self.see(np.full(COUNT, flag))
        word, color = FLAG_COLORS[flag]
        assert seen.flag_shares() == {other: pytest.approx(float(other == word), abs=1e-6) for other in WORDS}
        assert np.abs(self.colors(seen) - rgb(color)).max() <= 1

    def test_none(self):
        seen = self.see(np.zeros(COUNT))
        assert set(seen.flag_shares().values()) == {0.0}
        assert np.abs(self.colors(seen) - rgb(OBSERVED_COLOR)).max() <= 1

    def test_nothing_in_view(self):
        away = Camera.look_at((0.0, -4.0, 0.0), (0.0, -8.0, 0.0), width=8, height=6, vertical_fov=40.0)
        seen = see_channel(ball(), away, "observability", device="cpu")
        assert set(seen.flag_shares().values()) == {0.0}
        assert len(np.unique(seen.picture()[:6].reshape(-1, 3), axis=0)) == 1

    def test_the_gravest_of_several_is_shown_and_all_are_counted(self):
        seen = self.see(np.full(COUNT, Observability.FILLED | Observability.UNLIT | Observability.SATURATED))
        assert np.abs(self.colors(seen) - rgb(FLAG_COLORS[Observability.UNLIT][1])).max() <= 1
        shares = seen.flag_shares()
        assert [word for word in WORDS if shares[word] > 0.5] == ["unlit", "saturated", "filled"]

    def test_what_less_than_half_of_a_pixel_has_is_counted_and_not_shown(self):
        """One Gaussian in front of another: of opacity 0.4, so that it is two fifths of what is seen."""
        two = ball(observability=np.zeros(COUNT)).select([0, 1])
        for opacity, expected in ((0.4, OBSERVED_COLOR), (0.6, FLAG_COLORS[Observability.GRAZING][1])):
            layers = two.with_arrays(
                positions=[[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]],
                orientations=[[0.0, 0.0, 0.0, 1.0]] * 2,
                scales=[[9.0, 1e-3, 9.0]] * 2,
                opacities=[opacity, 0.99],
                observability=[Observability.GRAZING, 0],
            )
            front = Camera.look_at((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), width=3, height=3, vertical_fov=5.0)
            seen = see_channel(layers, front, "observability", device="cpu")
            total = opacity + (1.0 - opacity) * 0.99
            # Within 0.2 m of the middle of a Gaussian of 9 m: 1 - exp(-(0.2 / 9)^2 / 2) is below 3e-4.
            assert seen.flag_shares()["grazing"] == pytest.approx(opacity / total, abs=1e-3)
            shown = seen.picture()[1, 1].astype(int)
            np.testing.assert_allclose(shown, total * rgb(expected) + (1.0 - total) * 0.13 * 255.0, atol=1.0)

    def test_pixels_are_counted_by_what_they_see(self):
        seen = self.see(np.random.default_rng(5).integers(0, 64, COUNT))
        for index, word in enumerate(WORDS):
            weighed = float((seen.values[..., index] * seen.alpha).sum() / seen.alpha.sum())
            assert seen.flag_shares()[word] == pytest.approx(weighed, abs=1e-5)
        assert (seen.values >= 0.0).all()
        assert (seen.values <= 1.0 + 1e-5).all()

    @pytest.mark.parametrize("width", [1, 60, 200, 900])
    def test_the_legend_has_as_many_lines_as_it_needs(self, width):
        lines = (len(self.see(np.zeros(COUNT), width, 4).picture()) - 4 - 12) // 20
        assert (lines > 1) == (width < 900)
        assert lines <= len(WORDS) + 1


def test_errors_name_the_contract():
    with pytest.raises(InvalidOptionError, match=r"channel must be one of radiance, .*observability, got 'albedo'"):
        see_channel(ball(), camera(), "albedo")
    with pytest.raises(InvalidOptionError, match=r"samples must be an integer in \[1, 16\], got 0"):
        see_channel(ball(), camera(), "roughness", samples=0)
    with pytest.raises(InvalidArrayError, match=r"got 'observability', which it lacks \(it has positions"):
        see_channel(ball(observability=None), camera(), "observability")
    with pytest.raises(InvalidArrayError, match=r"got 'roughness_error', which it lacks \(it has positions"):
        see_channel(ball(roughness_error=None), camera(), "roughness_error")
    with pytest.raises(InvalidOptionError, match=r"cloud must be in the axes 'rfu'"):
        see_channel(ball(axes="rub"), camera(), "observability")
