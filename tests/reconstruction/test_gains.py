"""Exposures of views against each other: exact where differences are, found and undone on path-traced images."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beam_warp.reconstruction.gains import EXPOSURE_STOPS, agree_exposures, judge_gains, matched, view_gains
from beam_warp.reconstruction.initial import initial_gaussians
from beam_warp.reconstruction.track import outward_normals


class TestAgreement:
    def test_exposures_of_sums_are_exact(self, rng):
        """Levels that are rows plus columns leave nothing, whichever of them are there, as long as all are linked."""
        rows, columns = rng.normal(size=7), rng.normal(size=200)
        weights = rng.uniform(0.1, 1.0, (7, 200)) * (rng.random((7, 200)) < 0.4)
        stops, residuals = agree_exposures(rows[:, None] + columns, weights)
        np.testing.assert_allclose(stops, rows - np.median(rows), atol=1e-9)
        np.testing.assert_allclose(residuals, 0.0, atol=1e-9)

    def test_outliers_of_a_minority_do_not_count(self, rng):
        """A tenth of all samples is anything: least absolute error returns the rows but for what counts squared."""
        rows, columns = rng.normal(size=9), rng.normal(size=400)
        levels = rows[:, None] + columns
        wrong = rng.random(levels.shape) < 0.1
        stops, _ = agree_exposures(levels + wrong * rng.normal(0.0, 3.0, levels.shape), np.ones_like(levels))
        assert np.abs(stops - (rows - np.median(rows))).max() < 0.02  # LEAST_RESIDUAL, below which differences average

    def test_rows_that_share_nothing_are_unknown(self):
        weights = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        levels = np.array([[1.0, 2.0, 0.0], [1.5, 2.5, 0.0], [0.0, 0.0, 9.0]])
        stops, residuals = agree_exposures(levels, weights)
        np.testing.assert_allclose(stops, [-0.25, 0.25, np.nan], atol=1e-12)
        assert np.isnan(residuals[2])

    @pytest.mark.parametrize("shape", [(1, 5), (3, 1), (3, 0)])
    def test_the_smallest_ones(self, shape):
        stops, residuals = agree_exposures(np.zeros(shape), np.ones(shape))
        known = shape[0] > 1 and shape[1] > 0
        assert np.array_equal(stops, np.zeros(shape[0])) if known else np.isnan(stops).all()
        assert len(residuals) == shape[0]


@pytest.fixture(scope="module")
def seen(tiny_capture):
    """The views of a moment, and Gaussians on their hull; of some, which side is out is not known."""
    views = [record.view() for record in tiny_capture.select(split="train", frames=[0])]
    cloud = initial_gaussians(views, 1000, device="cpu")
    normals = outward_normals(cloud, Rotation.from_quat(cloud.orientations).apply([0.0, 0.0, 1.0]))
    normals[::50] = 0.0
    return views, cloud, normals


class TestViews:
    def test_sound_views_are_not_blamed(self, seen, device):
        views, cloud, normals = seen
        gains = view_gains(cloud, normals, views, device=device)
        assert np.abs(gains.stops).max() < EXPOSURE_STOPS
        assert judge_gains(gains, views) == []
        assert all(a is b for a, b in zip(matched(views, gains), views, strict=True))
        assert gains.views_of_points.shape == (1000,)
        assert gains.views_of_points.max() <= len(views)

    @pytest.mark.parametrize("stops", [-1.0, 1.0])
    def test_each_wrong_view_is_found_and_undone(self, seen, stops):
        """A gain that was put in is found but for what the view was off by before, which is below what is reported."""
        views, cloud, normals = seen
        for index in range(len(views)):
            wrong = list(views)
            wrong[index] = replace(wrong[index], color=wrong[index].color * np.float32(2.0**stops))
            gains = view_gains(cloud, normals, wrong, device="cpu")
            (finding,) = judge_gains(gains, wrong)
            assert finding.where == views[index].name
            assert finding.code == "camera-exposure"
            assert ("brighter" if stops > 0.0 else "darker") in finding.what
            assert judge_gains(view_gains(cloud, normals, matched(wrong, gains), device="cpu"), wrong) == []

    def test_views_that_show_nothing_in_common_say_nothing(self, seen):
        views, cloud, normals = seen
        gains = view_gains(cloud, normals, views[:1], device="cpu")
        assert np.isnan(gains.stops).all()
        assert judge_gains(gains, views[:1]) == []
        assert matched(views[:1], gains)[0] is views[0]
