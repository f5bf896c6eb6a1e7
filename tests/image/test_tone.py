"""View transforms against their closed forms, and what every one of them must do."""

import numpy as np
import pytest

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import linear_to_srgb, srgb_to_linear
from beam_warp.image.files import display_image
from beam_warp.image.tone import AGX_STOPS, MIDDLE_GREY, TRANSFORMS, agx_sigmoid, display, display_linear, display_over

FLOAT32 = 8 * np.finfo(np.float32).eps
"""Everything is float32: the roundings of some operations on values up to 1."""


def row(*colors):
    return np.array([colors], np.float32)


def greys(values):
    return np.repeat(np.asarray(values, np.float32)[None, :, None], 3, axis=2)


def test_standard_is_display_image(rng):
    light = rng.uniform(-0.2, 3.0, (7, 5, 3)).astype(np.float32)
    for stops in (0.0, -1.5, 2.0):
        np.testing.assert_array_equal(display(light, "standard", stops), display_image(light, stops))
    np.testing.assert_array_equal(display(light), display_image(light))
    np.testing.assert_allclose(display_linear(light), np.clip(light, 0, 1), atol=FLOAT32)


@pytest.mark.parametrize("transform", TRANSFORMS)
class TestEveryTransform:
    def test_black_is_black_and_the_brightest_is_white(self, transform):
        shown = display(greys([-1.0, 0.0, 1e5]), transform)
        np.testing.assert_array_equal(shown[0, :2], 0)
        # Khronos' approaches white as 1 - 0.0576 / (peak - 0.52); the others reach it
        np.testing.assert_array_equal(shown[0, 2], 255)

    def test_grey_stays_grey_and_brighter_is_brighter(self, transform):
        light = greys(2.0 ** np.linspace(-14.0, 8.0, 400))
        shown = display_linear(light, transform)
        np.testing.assert_allclose(shown[..., 1:], shown[..., :1].repeat(2, axis=-1), atol=FLOAT32)
        steps = np.diff(shown[0, :, 0].astype(np.float64))
        assert (steps >= -FLOAT32).all()
        assert shown[0, 0, 0] < 0.001 < 0.9 < shown[0, -1, 0]

    @pytest.mark.parametrize("hue", [(1.0, 0.0, 0.0), (0.2, 1.0, 0.1), (0.0, 0.1, 1.0)])
    def test_every_channel_grows_with_exposure(self, transform, hue):
        shown = display_linear((np.array(hue) * 2.0 ** np.linspace(-12.0, 8.0, 300)[:, None])[None], transform)[0]
        if transform in ("agx", "neutral"):  # these trade saturation for brightness: their sum grows
            assert (np.diff(shown.astype(np.float64).sum(axis=-1)) >= -3 * FLOAT32).all()
        else:
            assert (np.diff(shown, axis=0) >= 0.0).all()

    def test_exposure_comes_before_the_curve(self, transform, rng):
        light = rng.uniform(0.0, 2.0, (3, 4, 3)).astype(np.float32)
        np.testing.assert_array_equal(display(light, transform, 2.0), display(4 * light, transform))

    def test_stays_in_range(self, transform, rng):
        light = (2.0 ** rng.uniform(-20.0, 20.0, (40, 50, 3))).astype(np.float32)
        shown = display_linear(light, transform)
        assert shown.dtype == np.float32
        assert (shown >= 0.0).all()
        assert (shown <= 1.0).all()
        huge = display(np.full((1, 1, 3), 3e38, np.float32), transform, 64.0)
        np.testing.assert_array_equal(huge, 255)


def test_aces_is_the_published_fit():
    shown = display_linear(greys([0.18, 1.0]), "aces")[0, :, 0]
    expected = [(0.18 * (2.51 * 0.18 + 0.03)) / (0.18 * (2.43 * 0.18 + 0.59) + 0.14), 2.54 / 3.16]
    np.testing.assert_allclose(shown, expected, rtol=FLOAT32)
    np.testing.assert_allclose(expected[0], 0.2669, atol=1e-4)


class TestAgx:
    def test_sigmoid_has_its_ends_pivot_and_slope(self):
        pivot = 10.0 / 16.5
        np.testing.assert_allclose(agx_sigmoid([0.0, pivot, 1.0]), [0.0, 0.5, 1.0], atol=1e-15)
        near = agx_sigmoid([pivot - 1e-4, pivot + 1e-4])
        assert (near[1] - near[0]) / 2e-4 == pytest.approx(2.0, rel=1e-6)  # the curve's third derivative, times 1e-8

    def test_sigmoid_is_the_one_that_was_published_as_a_polynomial(self):
        """Wrensch fits it with a mean square error of 3.7e-6; the two agree to less than a step of 8 bits."""
        x = np.linspace(0.0, 1.0, 1001)
        fit = np.polyval([15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232], x)
        assert np.sqrt(np.mean((agx_sigmoid(x) - fit) ** 2)) < 1.0 / 255.0

    def test_middle_grey_and_its_range(self):
        shown = display_linear(greys(MIDDLE_GREY * 2.0 ** np.array([AGX_STOPS[0], 0.0, AGX_STOPS[1]])), "agx")[0, :, 0]
        np.testing.assert_allclose(shown, [0.0, 0.5**2.2, 1.0], atol=FLOAT32)

    def test_bright_saturated_blue_fades(self):
        def saturation(blue):
            shown = display_linear(row((0.0, 0.0, blue)), "agx")[0, 0]
            return 1.0 - shown[:2].max() / shown[2]

        faded = [saturation(2.0**stops) for stops in range(-3, 7)]
        assert faded[0] > 0.95
        assert (np.diff(faded) <= 0.0).all()
        assert faded[-1] < 0.35
        assert (display_linear(row((0.0, 0.0, 64.0)))[0, 0] == [0.0, 0.0, 1.0]).all()  # where clipping shows pure blue


class TestNeutral:
    def test_dark_colours_lose_the_white_reflection_alone(self):
        color = np.array([0.5, 0.3, 0.2])
        np.testing.assert_allclose(display_linear(row(color), "neutral")[0, 0], color - 0.04, atol=FLOAT32)
        below = np.array([0.5, 0.3, 0.05])  # where less than 0.08 is left: x - 6.25 x^2
        expected = below - (0.05 - 6.25 * 0.05**2)
        np.testing.assert_allclose(display_linear(row(below), "neutral")[0, 0], expected, atol=FLOAT32)

    def test_the_specification_by_hand(self):
        """(2, 1, 0.5) has the peak 1.96, so p = 1 - 0.0576 / 1.44 = 0.96, and g = 1 - 1 / 1.15 of white is mixed in."""
        scaled = np.array([1.96, 0.96, 0.46]) * 0.96 / 1.96
        white = 1.0 - 1.0 / (0.15 * (1.96 - 0.96) + 1.0)
        shown = display_linear(row((2.0, 1.0, 0.5)), "neutral")[0, 0]
        np.testing.assert_allclose(shown, scaled * (1.0 - white) + 0.96 * white, atol=FLOAT32)


class TestAlpha:
    def test_png_alpha_is_straight_and_light_is_divided_before_it_is_shown(self):
        rgb, alpha = row((1.0, 0.5, 0.25), (0.0, 0.0, 0.0)), np.array([[0.5, 0.0]], np.float32)
        for transform in TRANSFORMS:
            shown = display_over(rgb, alpha, transform)
            np.testing.assert_array_equal(shown[0, 0, :3], display(2 * rgb, transform)[0, 0])
            np.testing.assert_array_equal(shown[..., 3], [[128, 0]])
            np.testing.assert_array_equal(shown[0, 1, :3], 0)

    def test_full_coverage_needs_no_alpha(self, rng):
        light = rng.uniform(0.0, 2.0, (3, 4, 3)).astype(np.float32)
        np.testing.assert_array_equal(display_over(light, np.ones((3, 4)), "agx", -1.0), display(light, "agx", -1.0))

    def test_a_background_is_shown_as_it_is(self):
        for transform in TRANSFORMS:
            over = display_over(row((0, 0, 0)), [[0.0]], transform, 3.0, (0.2, 0.5, 1.0))
            np.testing.assert_array_equal(over, [[np.rint([51, 127.5, 255])]])

    def test_over_is_in_the_displays_linear_light(self):
        """A highlight of 100 that covers half a pixel is white on half of it, not on all."""
        over = display_over(row((50.0, 50.0, 50.0)), [[0.5]], background=(0.0, 0.0, 0.0))
        np.testing.assert_array_equal(over, [[[np.rint(255 * linear_to_srgb(0.5))] * 3]])
        mixed = 0.5 * 0.2 + 0.5 * srgb_to_linear(0.5)
        over = display_over(row((0.1, 0.1, 0.1)), [[0.5]], background=(0.5, 0.5, 0.5))
        np.testing.assert_array_equal(over, [[[np.rint(255 * linear_to_srgb(mixed))] * 3]])

    def test_a_caught_shadow_darkens_the_background(self):
        over = display_over(row((0, 0, 0)), [[0.75]], background=(1.0, 1.0, 1.0))
        np.testing.assert_array_equal(over, [[[np.rint(255 * linear_to_srgb(0.25))] * 3]])


@pytest.mark.parametrize(
    ("call", "kind", "message"),
    [
        (lambda: display(row((np.nan, 0, 0)), "agx"), InvalidArrayError, "linear_rgb must be finite"),
        (lambda: display(np.zeros((2, 3)), "aces"), InvalidArrayError, r"linear_rgb must have shape \(N, N, 3\)"),
        (lambda: display(row((0, 0, 0)), "filmic"), InvalidOptionError, "transform must be one of standard, aces"),
        (lambda: display(row((0, 0, 0)), "agx", np.nan), InvalidOptionError, "exposure_stops must be a number in"),
        (lambda: display_over(row((0, 0, 0)), [[1.5]]), InvalidArrayError, r"alpha must lie in \[0, 1\], got 1.5"),
        (lambda: display_over(row((0, 0, 0)), [[np.nan]]), InvalidArrayError, "alpha must lie in"),
        (lambda: display_over(row((0, 0, 0)), [[1]], background=(0, 2, 0)), InvalidArrayError, "background must lie"),
    ],
)
def test_refusals(call, kind, message):
    with pytest.raises(kind, match=message):
        call()
