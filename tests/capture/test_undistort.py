"""Undistortion: the lens against closed forms, its inverse to rounding, folds found, and photographs made straight."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from beam_warp.capture.lenses import Lens
from beam_warp.capture.undistort import MAX_ANGLE, Intrinsics, Undistortion
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709, linear_to_srgb
from beam_warp.image.files import Image

PHOTOGRAPH = Intrinsics(160, 120, 150.0, 140.0, 83.0, 58.0)
SHIFTED = PHOTOGRAPH._replace(center_x=PHOTOGRAPH.center_x + 0.5)
BARREL = Lens((-0.25, 0.08, -0.01, 0.002, 0.001, -0.0015))
PINCUSHION = Lens((0.2, -0.03, 0.01, 0.0, -0.002, 0.001))
FISHEYE = Lens((-0.03, 0.005, -0.002, 0.0003, 0.0, 0.0), "OPENCV_FISHEYE")
EQUIDISTANT = Lens(model="OPENCV_FISHEYE")
NEARLY_STRAIGHT = Lens((1e-12, 0, 0, 0, 0, 0))
"""No pixel moves by a float32 rounding of its position: filters run, not the shortcut of a straight lens."""

LENSES = {"barrel": BARREL, "pincushion": PINCUSHION, "fisheye": FISHEYE, "equidistant": EQUIDISTANT}


@pytest.fixture(params=LENSES)
def lens(request):
    return LENSES[request.param]


def edges_and_inside(photograph):
    """Tangents of a grid over a photograph, its edges included."""
    x, y = np.linspace(0, photograph.width, 41), np.linspace(0, photograph.height, 31)
    return photograph.to_tangents(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))


def image_of(channels, *, color_space=LINEAR_REC709, premultiplied=True):
    arrays = {name: np.asarray(array, np.float32) for name, array in channels.items()}
    return Image(Path("photo.exr"), arrays, color_space, premultiplied)


def grey(plane):
    return dict.fromkeys("RGB", plane)


def pixel_centers(intrinsics):
    x, y = np.arange(intrinsics.width) + 0.5, np.arange(intrinsics.height) + 0.5
    return np.stack(np.meshgrid(x, y), axis=-1)


def positions(undistortion):
    """Where each pixel of the undistorted image is in the photograph, in float64."""
    centers = pixel_centers(undistortion.pinhole)
    tangents = undistortion.pinhole.to_tangents(centers.reshape(-1, 2))
    return undistortion.photograph.to_pixels(undistortion.lens.distort(tangents)).reshape(centers.shape)


class TestLens:
    def test_one_coefficient_by_hand(self):
        ray = np.array([[0.3, -0.4]])  # r = 1/2
        for index, factor in enumerate((1 / 4, 1 / 16, 1 / 64, 1 / 256)):
            coefficients = [0.0] * 6
            coefficients[index] = 0.8
            np.testing.assert_allclose(Lens(tuple(coefficients)).distort(ray), ray * (1 + 0.8 * factor), rtol=1e-15)
        p1, p2 = Lens((0, 0, 0, 0, 0.1, 0)).distort(ray), Lens((0, 0, 0, 0, 0, 0.1)).distort(ray)
        np.testing.assert_allclose(p1 - ray, [[2 * 0.1 * -0.12, 0.1 * (0.25 + 0.32)]], rtol=1e-14)
        np.testing.assert_allclose(p2 - ray, [[0.1 * (0.25 + 0.18), 2 * 0.1 * -0.12]], rtol=1e-14)

    def test_a_fisheye_shows_the_angle(self):
        angle = np.radians([0.0, 30.0, 60.0, 85.0])
        rays = np.tan(angle)[:, None] * [0.6, 0.8]
        np.testing.assert_allclose(EQUIDISTANT.distort(rays), angle[:, None] * [0.6, 0.8], rtol=1e-14, atol=1e-300)
        k1 = Lens((0.1, 0, 0, 0, 0, 0), "OPENCV_FISHEYE").distort(rays)
        np.testing.assert_allclose(k1, (angle * (1 + 0.1 * angle**2))[:, None] * [0.6, 0.8], rtol=1e-14, atol=1e-300)

    def test_the_inverse_of_a_cubic(self):
        # r + k r^3 = s by Cardano: with k > 0 it has one real root.
        k, s = 0.3, np.linspace(0.0, 3.0, 50)
        root = np.sqrt((s / (2 * k)) ** 2 + 1 / (27 * k**3))
        radius = np.cbrt(s / (2 * k) + root) + np.cbrt(s / (2 * k) - root)
        found = Lens((k, 0, 0, 0, 0, 0)).undistort(np.stack([np.zeros(50), s], axis=-1))
        np.testing.assert_allclose(found[:, 1], radius, atol=1e-14)
        np.testing.assert_array_equal(found[:, 0], 0.0)

    def test_round_trip_over_the_image(self, lens):
        seen = edges_and_inside(PHOTOGRAPH)
        rays = lens.undistort(seen)
        assert np.abs(lens.distort(rays) - seen).max() < 1e-9 / 150.0  # of a pixel
        assert np.abs(lens.undistort(lens.distort(rays)) - rays).max() < 1e-9 / 150.0

    def test_random_lenses(self, rng):
        seen = edges_and_inside(PHOTOGRAPH)
        inverted = 0
        for _ in range(60):
            lens = Lens(tuple(rng.normal(size=6) * [0.3, 0.2, 0.1, 0.05, 0.02, 0.02]))
            rays = lens.undistort(seen)
            known = np.isfinite(rays).all(axis=1)
            inverted += known.all()
            # Near a fold the inverse loses half the digits, but its forward image does not.
            assert np.abs(lens.distort(rays[known]) - seen[known]).max() < 1e-11
        assert inverted > 20

    def test_the_jacobian_that_newton_uses(self, rng):
        rays, step = rng.uniform(-0.5, 0.5, (20, 2)), 1e-6
        _, jacobian = BARREL._brown(rays)
        for axis in (0, 1):
            offset = step * np.eye(2)[axis]
            central = (BARREL.distort(rays + offset) - BARREL.distort(rays - offset)) / (2 * step)
            np.testing.assert_allclose(jacobian[:, :, axis], central, atol=1e-9)  # rounding 1e-16 over the step

    def test_fold(self):
        # r - r^3 grows up to r = 1/sqrt(3), where it is 2 / (3 sqrt(3)).
        lens = Lens((-1.0, 0, 0, 0, 0, 0))
        assert lens.fold == pytest.approx(3**-0.5, rel=1e-14)
        below, above = (np.array([[2 / (3 * 3**0.5) * factor, 0.0]]) for factor in (1 - 1e-9, 1 + 1e-9))
        # Where the slope vanishes, a relative 1e-9 of the value is sqrt(2/9 1e-9) of the radius, 1.5e-5.
        assert lens.undistort(below)[0, 0] == pytest.approx(3**-0.5, abs=2e-5)
        assert np.isnan(lens.undistort(above)).all()
        assert np.isnan(lens.distort([[3**-0.5 * 1.001, 0.0]])).all()
        assert PINCUSHION.fold == np.inf
        assert Lens((0, 0, 0, -1.0, 0, 0), "OPENCV_FISHEYE").fold == pytest.approx(9 ** (-1 / 8), rel=1e-14)

    def test_the_first_of_several_folds(self):
        # Derivative (1 - u)(1 - u / 4)(1 + u) (1 + u / 9), u = r^2: folds at 1 and 2, and the first one counts.
        derivative = np.polynomial.Polynomial([1, -1]) * [1, -1 / 4] * [1, 1] * [1, 1 / 9]
        k = [c / n for c, n in zip(derivative.coef[1:], (3, 5, 7, 9), strict=True)]
        assert Lens((*k, 0, 0)).fold == pytest.approx(1.0, rel=1e-12)

    @pytest.mark.parametrize(
        ("coefficients", "model", "message"),
        [
            ((np.nan, 0, 0, 0, 0, 0), "OPENCV", "k1 must be a number in"),
            ((0, 0, 0, 0, 0, 1e7), "OPENCV", r"p2 must be a number in \[-1e\+06, 1e\+06\], got 10000000.0"),
            ((0, 0), "OPENCV", "coefficients must be k1, k2, k3, k4, p1, p2, got 2"),
            ((0,) * 6, "BROWN", "model must be one of OPENCV, OPENCV_FISHEYE, got 'BROWN'"),
            ((0, 0, 0, 0, 0.1, 0), "OPENCV_FISHEYE", "p1 and p2 must be 0 for OPENCV_FISHEYE"),
        ],
    )
    def test_broken_coefficients(self, coefficients, model, message):
        with pytest.raises(InvalidOptionError, match=message):
            Lens(coefficients, model)


class TestFit:
    def test_only_what_was_photographed(self, lens):
        undistortion = Undistortion.fit(lens, PHOTOGRAPH)
        assert undistortion.mask().all()
        assert undistortion.pinhole[:2] == PHOTOGRAPH[:2]
        ratio = undistortion.pinhole.focal_x / undistortion.pinhole.focal_y
        assert ratio == pytest.approx(150 / 140, rel=1e-14)
        # It is the largest: 1 % more of it shows what was not photographed.
        wider = undistortion.pinhole._replace(
            focal_x=0.99 * undistortion.pinhole.focal_x,
            focal_y=0.99 * undistortion.pinhole.focal_y,
            center_x=80 + 0.99 * (undistortion.pinhole.center_x - 80),
            center_y=60 + 0.99 * (undistortion.pinhole.center_y - 60),
        )
        assert not Undistortion(lens, PHOTOGRAPH, wider).mask().all()

    def test_all_of_the_photograph(self, lens):
        undistortion = Undistortion.fit(lens, PHOTOGRAPH, 1.0)
        pixels = undistortion.pinhole.to_pixels(lens.undistort(edges_and_inside(PHOTOGRAPH)))
        # Of the bow of an edge, between grid points, 1e-4 of at most the image's size is missed.
        assert pixels.min() > -0.02
        assert (pixels < np.array(PHOTOGRAPH[:2]) + 0.02).all()
        assert not undistortion.mask().all()
        some = Undistortion.fit(lens, PHOTOGRAPH, 0.5).mask().mean()
        assert undistortion.mask().mean() < some < 1.0

    def test_no_ghost_of_a_fold_is_drawn(self):
        lens = Lens((-0.5, 0, 0, 0, 0, 0))  # folds at r = 0.816; the photograph ends at 0.5
        photograph = Intrinsics(100, 100, 150.0, 150.0, 50.0, 50.0)
        wide = Undistortion(lens, photograph, Intrinsics(400, 400, 100.0, 100.0, 200.0, 200.0))
        x, y = np.moveaxis((pixel_centers(wide.pinhole) - 200) / 100, -1, 0)
        # r - r^3 / 2 returns to the image beyond r = 1.2: there the formula draws a second photograph.
        assert not wide.mask()[np.hypot(x, y) > lens.fold].any()
        assert wide.mask().sum() > 100 * 100 / 1.5**2

    def test_a_fold_within_the_photograph_is_refused(self):
        with pytest.raises(InvalidOptionError) as caught:
            Undistortion.fit(Lens((0.1, -3.0, 0, 0, 0, 0)), PHOTOGRAPH)
        message = str(caught.value)
        fold = np.sqrt((0.3 + np.sqrt(0.09 + 60)) / 30)  # of 1 + 0.3 u - 15 u^2
        assert message.startswith("k2 must let the lens be inverted over the whole photograph, got -3, with which")
        assert f"radii stop growing at {fold:.4g}, at pixel (" in message
        with pytest.raises(InvalidOptionError, match=r"p1 must let .*, got -2, with which the image folds over"):
            Undistortion.fit(Lens((-0.1, 0, 0, 0, -2.0, 0.1)), PHOTOGRAPH)  # radii fold too, far outside

    def test_a_fisheye_of_half_the_world_is_cut_at_the_largest_angle(self):
        photograph = Intrinsics(200, 200, 60.0, 60.0, 100.0, 100.0)  # 95 degrees at the sides: behind a pinhole
        undistortion = Undistortion.fit(EQUIDISTANT, photograph)
        assert undistortion.mask().all()
        corner = 100.0 * np.sqrt(2) / undistortion.pinhole.focal_x
        assert np.arctan(corner) == pytest.approx(MAX_ANGLE, abs=1e-3)  # between the grid's points of a quarter circle
        folding_outside = Lens((0, 0, 0, -0.01, 0, 0), "OPENCV_FISHEYE")  # at 77 degrees, in the photograph's corners
        assert Undistortion.fit(folding_outside, photograph).mask().all()

    def test_it_must_see_something(self):
        away = Intrinsics(100, 100, 1.0, 1.0, 1e9, 50.0)
        with pytest.raises(InvalidOptionError, match="photograph must show a rectangle within 70 degrees"):
            Undistortion.fit(EQUIDISTANT, away)
        with pytest.raises(InvalidOptionError, match="keep must be a number"):
            Undistortion.fit(BARREL, PHOTOGRAPH, np.nan)


class TestImage:
    def test_no_distortion_changes_no_bit(self, rng):
        photo = image_of({name: rng.normal(size=(120, 160)) for name in ("R", "G", "B", "A", "depth")})
        undistortion = Undistortion.fit(Lens(), PHOTOGRAPH, 0.3)
        assert undistortion.pinhole == PHOTOGRAPH
        assert undistortion.image(photo) is photo

    def test_whole_pixels_are_copied_bit_by_bit(self, rng):
        undistortion = Undistortion(NEARLY_STRAIGHT, PHOTOGRAPH, PHOTOGRAPH)
        alpha = rng.uniform(0.1, 1.0, (120, 160))
        values = rng.normal(size=(120, 160))
        result = undistortion.image(image_of({"R": values, "G": -values, "B": values**2, "A": alpha}))
        np.testing.assert_array_equal(result.channels["R"], values.astype(np.float32))
        np.testing.assert_array_equal(result.channels["A"], alpha.astype(np.float32))

    def test_linear_ramps_are_exact(self, lens):
        undistortion = Undistortion.fit(lens, PHOTOGRAPH)
        where = positions(undistortion)
        ramp = 3.0 + (pixel_centers(PHOTOGRAPH) * [0.5, -0.25]).sum(axis=-1)
        result = undistortion.image(image_of({**grey(ramp), "depth": ramp}))
        inner = ((where > 2.0) & (where < np.array(PHOTOGRAPH[:2]) - 2.0)).all(axis=-1)
        assert inner.mean() > 0.85
        expected = 3.0 + (where * [0.5, -0.25]).sum(axis=-1)
        # Positions and a sum of 16 products of up to 83 in float32.
        for name in ("R", "depth"):
            np.testing.assert_allclose(result.channels[name][inner], expected[inner], atol=16 * 83 * 2**-24)

    def test_cubic_keeps_detail_that_averaging_neighbours_loses(self):
        # Half a pixel off, the cubic leaves 0.884 of a wave of four pixels and linear interpolation 0.707.
        for samples, swing in (
            # Samples of 1.5 + 0.7071 cos at odd eighths. The cubic would go to 9/8 of the half swing, but nothing
            # leaves the range of what was read.
            ([1.0, 1.0, 2.0, 2.0], 1.0),
            ([0.0, 1.0, 0.0, -1.0], 2 * 0.625),
        ):
            wave = np.tile(samples, 40) * np.ones((120, 1))
            result = Undistortion(NEARLY_STRAIGHT, PHOTOGRAPH, SHIFTED).image(image_of({**grey(wave), "x": wave}))
            assert np.ptp(result.channels["x"][60, 4:-4]) == pytest.approx(1.0, abs=1e-4)
            assert np.ptp(result.channels["R"][60, 4:-4]) == pytest.approx(swing, abs=1e-4)

    @pytest.mark.parametrize("color_space", [LINEAR_REC709, DISPLAY_SRGB])
    @pytest.mark.parametrize("premultiplied", [True, False])
    def test_no_fringe(self, rng, color_space, premultiplied):
        # One colour behind any alpha: it stays that colour wherever there is any of it.
        alpha = np.where(rng.random((120, 160)) < 0.5, rng.random((120, 160)), 0.0)
        color = np.array([0.8, 0.4, 0.1])
        encoded = linear_to_srgb(color) if color_space == DISPLAY_SRGB else color
        hidden = 1.0 - encoded  # what straight alpha hides must not come out
        channels = {"A": alpha}
        for name, value, other in zip("RGB", encoded, hidden, strict=True):
            channels[name] = value * alpha if premultiplied else np.where(alpha > 0.0, value, other)
        photo = image_of(channels, color_space=color_space, premultiplied=premultiplied)
        result = Undistortion.fit(BARREL, PHOTOGRAPH).image(photo)
        assert (result.color_space, result.premultiplied) == (color_space, premultiplied)
        assert result.alpha is not None
        assert result.alpha.min() >= 0.0
        assert result.alpha.max() <= 1.0
        seen = result.alpha > 0.01
        assert 0.5 < seen.mean() < 1.0
        # 16 products in float32, whose sum may be a hundredth of them.
        light = result.linear_rgba()
        np.testing.assert_allclose(light[seen][:, :3] / light[seen][:, 3:], np.tile(color, (seen.sum(), 1)), rtol=3e-4)

    def test_display_colour_is_mixed_as_light(self):
        # Half of black and half of white is half the light, not half the code.
        step = np.where(np.arange(160) < 80, 0.0, 1.0) * np.ones((120, 1))
        photo = image_of({"Y": step}, color_space=DISPLAY_SRGB, premultiplied=False)
        result = Undistortion(NEARLY_STRAIGHT, PHOTOGRAPH, SHIFTED).image(photo)
        assert result.channels["Y"][60, 80] == pytest.approx(float(linear_to_srgb(0.5)), abs=1e-5)

    def test_data_are_means_over_what_is_covered(self):
        depth = np.where(np.arange(160) < 80, 2.0, 1e10) * np.ones((120, 1))
        alpha = np.where(np.arange(160) < 80, 1.0, 0.0) * np.ones((120, 1))
        result = Undistortion.fit(BARREL, PHOTOGRAPH).image(image_of({"A": alpha, "depth": depth}))
        covered = result.channels["depth"] > 0.0
        assert 0.4 < covered.mean() < 0.6
        np.testing.assert_allclose(result.channels["depth"][covered], 2.0, rtol=1e-6)

    def test_numbers_are_taken_from_the_nearest_pixel(self):
        undistortion = Undistortion.fit(FISHEYE, PHOTOGRAPH, 1.0)
        numbers = np.arange(120 * 160, dtype=np.uint32).reshape(120, 160) + 1
        photo = Image(Path("photo.exr"), {"id": numbers}, LINEAR_REC709, True)
        result = undistortion.image(photo).channels["id"]
        mask = undistortion.mask()
        assert result.dtype == np.uint32
        assert (result[~mask] == 0).all()
        column, row = np.moveaxis(positions(undistortion)[mask], -1, 0)
        assert np.abs((result[mask] - 1) % 160 + 0.5 - column).max() < 0.5 + 1e-4
        assert np.abs((result[mask] - 1) // 160 + 0.5 - row).max() < 0.5 + 1e-4

    def test_void_is_zero_and_nan_stays_local(self):
        undistortion = Undistortion.fit(BARREL, PHOTOGRAPH, 1.0)
        values = np.ones((120, 160))
        values[60, 80] = np.nan
        values[30, 40] = np.inf
        result = undistortion.image(image_of(grey(values))).channels["R"]
        assert (result[~undistortion.mask()] == 0.0).all()
        assert 2 <= (~np.isfinite(result)).sum() <= 50
        assert (result[undistortion.mask() & np.isfinite(result)] == 1.0).all()

    def test_what_is_made_smaller_is_averaged(self):
        # A board of single pixels, drawn at half its size: every pixel is a mean, none is black or white.
        board = np.indices((120, 160)).sum(axis=0) % 2
        small = PHOTOGRAPH._replace(focal_x=75.0, focal_y=70.0)
        undistortion = Undistortion(NEARLY_STRAIGHT, PHOTOGRAPH, small)
        result = undistortion.image(image_of(grey(board))).channels["R"]
        inner = undistortion.mask()
        assert 0.2 < inner.mean() < 0.3
        np.testing.assert_allclose(result[inner], 0.5, atol=1e-3)

    def test_another_size_is_refused(self):
        with pytest.raises(InvalidArrayError, match=r"image must be 160 x 120, got 8 x 6 at photo\.exr"):
            Undistortion.fit(BARREL, PHOTOGRAPH).image(image_of({"Y": np.zeros((6, 8))}))

    @pytest.mark.parametrize("shape", [(1, 1), (1, 7)])
    def test_smallest_images(self, shape):
        photograph = Intrinsics(shape[1], shape[0], 5.0, 5.0, shape[1] / 2, shape[0] / 2)
        undistortion = Undistortion.fit(BARREL, photograph)
        result = undistortion.image(image_of({"Y": np.full(shape, 0.25)}))
        np.testing.assert_array_equal(result.channels["Y"], np.full(shape, 0.25, np.float32))

    @pytest.mark.parametrize("lens", [PINCUSHION, FISHEYE], ids=["pincushion", "fisheye"])
    def test_a_board_comes_back_straight(self, lens):
        """Edges of a board, photographed through the lens, lie where the pinhole sees them, in every row.

        The photograph is blurred by a pixel, as by any real lens: where a box filter puts the level of 1/2 between
        two pixels says nothing finer than a sixth of a pixel about an edge.
        """
        n = 4  # samples per pixel and axis: with the blur they place an edge to a hundredth of a pixel
        fine = PHOTOGRAPH._replace(
            width=160 * n, height=120 * n, focal_x=150.0 * n, focal_y=140.0 * n, center_x=83.0 * n, center_y=58.0 * n
        )
        tilt = np.radians(7.0)
        edges = np.linspace(-0.6, 0.6, 13)  # tangents across, 17 pixels apart
        x, y = np.moveaxis(lens.undistort(fine.to_tangents(pixel_centers(fine).reshape(-1, 2))), -1, 0)
        bands = np.searchsorted(edges, x * np.cos(tilt) + y * np.sin(tilt)) % 2
        photo = gaussian_filter(bands.reshape(120, n, 160, n).mean(axis=(1, 3)), 1.0)
        undistortion = Undistortion.fit(lens, PHOTOGRAPH)
        result = undistortion.image(image_of(grey(photo))).channels["R"]
        pinhole = undistortion.pinhole
        found, bowed = [], []
        for values, off in ((result, found), (photo, bowed)):
            for row in range(8, 112):  # the blur of the test goes wrong at the borders
                low = np.flatnonzero((values[row, :-1] < 0.5) != (values[row, 1:] < 0.5))
                crossing = low + 0.5 + (0.5 - values[row, low]) / (values[row, low + 1] - values[row, low])
                height = (row + 0.5 - pinhole.center_y) / pinhole.focal_y
                expected = pinhole.focal_x * (edges - height * np.sin(tilt)) / np.cos(tilt) + pinhole.center_x
                inside = crossing[(crossing > 8) & (crossing < 152)]
                off.extend(np.abs(inside[:, None] - expected).min(axis=1))
        assert len(found) > 500
        assert max(found) < 0.1
        assert max(bowed) > 1.0  # and it was not straight before
