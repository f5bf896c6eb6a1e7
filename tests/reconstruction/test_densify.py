"""Densification: halves in closed form, the image that they leave, what is hidden, ties of gradients."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from support.float32 import EPSILON
from support.moving_ball import ball_cloud
from support.shapes import aligned, colored

from beam_warp.raster.gbuffer import rasterize
from beam_warp.reconstruction.densify import SPLIT_OFFSET, SPLIT_SHRINK, hidden, largest_gradients, prune, split
from beam_warp.reconstruction.parameters import DEAD_LOGIT, GaussianParameters
from beam_warp.world.camera import Camera


def rows_of(rng, count):
    return {
        "positions": rng.normal(size=(count, 3)).astype(np.float32),
        "orientations": (rng.normal(size=(count, 4)) * rng.uniform(0.5, 2.0, (count, 1))).astype(np.float32),
        "radiance": rng.normal(size=(count, 4, 3)).astype(np.float32),
        "log_scales": rng.uniform(-5.0, -1.0, (count, 3)).astype(np.float32),
        "logits": rng.normal(size=count).astype(np.float32),
    }


def copied(rows):
    return {name: array.copy() for name, array in rows.items()}


def moments(profile):
    """Mean and variance of a distribution over pixels."""
    x = np.arange(len(profile)) + 0.5
    mean = (profile * x).sum() / profile.sum()
    return mean, (profile * (x - mean) ** 2).sum() / profile.sum()


class TestSplit:
    def test_halves_lie_on_the_longest_axis(self):
        """Turned by 90 degrees about z, local x is the world's y."""
        rows = rows_of(np.random.default_rng(0), 2)
        rows["positions"][0] = (1.0, 2.0, 3.0)
        rows["orientations"][0] = 3.0 * Rotation.from_euler("z", 90, degrees=True).as_quat()
        rows["log_scales"][0] = np.log([0.5, 0.1, 0.01])
        split(rows, np.array([0]), np.array([1]))
        found = rows["positions"][np.argsort(rows["positions"][:, 1])]
        np.testing.assert_allclose(found, [[1, 2 - 0.5 * SPLIT_OFFSET, 3], [1, 2 + 0.5 * SPLIT_OFFSET, 3]], rtol=1e-6)
        np.testing.assert_allclose(np.exp(rows["log_scales"]), [[0.5 * SPLIT_SHRINK, 0.1, 0.01]] * 2, rtol=1e-6)
        assert pytest.approx(0.8, abs=0.02) == SPLIT_OFFSET**2 + SPLIT_SHRINK**2  # of the variance along that axis

    def test_mean_position_stays_and_nothing_else_changes(self, rng):
        rows = rows_of(rng, 30)
        before = copied(rows)
        sources, targets = np.array([3, 7, 29]), np.array([0, 20, 11])
        split(rows, sources, targets)
        middle = 0.5 * (rows["positions"][sources].astype(np.float64) + rows["positions"][targets])
        bound = 4 * EPSILON * np.abs(rows["positions"]).max()  # two sums of floats
        np.testing.assert_allclose(middle, before["positions"][sources], atol=bound)
        for name in ("orientations", "radiance", "logits"):
            np.testing.assert_array_equal(rows[name][sources], before[name][sources])
            np.testing.assert_array_equal(rows[name][targets], before[name][sources])
        others = np.setdiff1d(np.arange(30), np.concatenate([sources, targets]))
        for name, array in rows.items():
            np.testing.assert_array_equal(array[others], before[name][others])

    @pytest.mark.parametrize("opacity", [0.1, 0.5, 0.9])
    def test_the_image_of_a_disc_hardly_changes(self, device, opacity):
        """The image keeps its middle and its height; it gets up to 1.3 times as bright: halves hold 2 x 0.65 of it.

        Where they overlap, in the middle, one hides a part of the other: less light, and more of it outside. So the
        variance is at least that of their sum, offset^2 + shrink^2 of what it was, and below what it was.
        """
        disc = colored(aligned([[0.0, 0.0, 0.0]], opacity, [0.2, 0.1, 0.1]), np.ones((1, 3)))
        parameters = GaussianParameters(disc, wp.get_device(device), row_count=2)
        rows = copied(parameters.rows())
        split(rows, np.array([0]), np.array([1]))
        parameters.set_rows(rows)
        camera = Camera.orbit((0, 0, 0), 2.0, 0.0, 0.0, width=128, height=96, vertical_fov=40.0)
        one, two = images = [
            rasterize(cloud, camera, channels=(), device=device).alpha.astype(float)
            for cloud in (disc, parameters.cloud())
        ]
        assert one.sum() < two.sum() <= 2.0 * SPLIT_SHRINK * one.sum()
        for axis in range(2):
            (middle, spread), (split_middle, split_spread) = (moments(image.sum(axis=axis)) for image in images)
            assert split_middle == pytest.approx(middle, abs=1e-3)
            if axis == 0:
                assert SPLIT_OFFSET**2 + SPLIT_SHRINK**2 <= split_spread / spread < 1.0
            else:
                # What is hidden, at most 0.3 of the light there was, is half as high: (1.3 - 0.15) / (1.3 - 0.3).
                assert 0.99 <= split_spread / spread <= 1.15


SHARES = [50.0, 1.0, 10.0, 2.0, 36.0, 1.0]


class TestHidden:
    @pytest.mark.parametrize(
        ("shares", "part", "dropped"),
        [
            (SHARES, 0.05, [1, 3, 5]),  # at most 5 of 100: 1 + 1 + 2 are 4, and the next would make it 14
            (SHARES, 0.01, [1]),  # of the equal ones, the first
            ([0.0, 3.0, 0.0], 0.0, [0, 2]),  # what shows nothing is hidden at once
            ([1.0, np.nan, 2.0], 0.5, []),  # what is not a number hides nothing
        ],
    )
    def test_those_that_show_least(self, shares, part, dropped):
        assert np.flatnonzero(hidden(np.array(shares), part)).tolist() == dropped

    def test_never_more_than_the_part(self, rng):
        shares = rng.gamma(0.2, 1.0, 1000)
        for part in (0.0, 0.01, 0.5, 1.0):
            assert shares[hidden(shares, part)].sum() <= part * shares.sum() * (1.0 + 1e-12)


def test_largest_gradients_come_first_and_ties_by_row():
    gradients, everyone = np.array([1.0, 5.0, 3.0, 5.0, 3.0, 3.0]), np.ones(6, bool)
    assert largest_gradients(gradients, everyone, 4).tolist() == [1, 3, 2, 4]
    assert largest_gradients(gradients, everyone, 0).tolist() == []
    assert len(largest_gradients(gradients, everyone, 100)) == 6
    # Only the eligible, and those that have a gradient.
    gradients = np.array([0.0, 9.0, np.nan, 2.0])
    assert largest_gradients(gradients, np.array([True, False, True, True]), 4).tolist() == [3]


def test_pruned_rows_are_no_gaussians(device):
    cloud = ball_cloud(40)
    parameters = GaussianParameters(cloud, wp.get_device(device))
    rows = copied(parameters.rows())
    unused = np.arange(40) % 3 == 0
    prune(rows, unused)
    assert (rows["logits"][unused] == np.float32(DEAD_LOGIT)).all()
    parameters.set_rows(rows)
    assert (parameters.alive() == ~unused).all()
    left = parameters.cloud()
    assert left.ids.tolist() == np.flatnonzero(~unused).tolist()
    np.testing.assert_array_equal(left.positions, cloud.positions[~unused])
