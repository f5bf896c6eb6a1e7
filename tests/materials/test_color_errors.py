"""Base colour from evidence: standard errors that few views and few frames cannot make small, and honest flags."""

import numpy as np
import pytest
from support.color_evidence import color_evidence
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.materials.base_color import SPECULAR_PART, UNKNOWN, least_squares, solve_base_color
from beam_warp.materials.direct import ColorEvidence
from beam_warp.world.gaussians import Observability

IRRADIANCE = 3.0


def bare(count):
    points, _ = sphere_points(count)
    cloud = cloud_of(tiles(points, points, 0.1))
    return cloud.with_arrays(normal_confidence=np.ones(count, np.float32))


def evidence(targets, *, noise=0.0):
    """Evidence of views of equal weight under light of radiance 1, whose targets are ``(V, N, 3)``."""
    views, count = targets.shape[:2]
    sums = {"numerator": targets.sum(0), "denominator": views, "observed": (targets**2).sum(0), "views": views}
    return color_evidence(count, irradiance=IRRADIANCE, noise=noise**2, **sums)


def hidden(count, rows):
    """A frame in which some Gaussians are not measured, and the others are as dull as can be."""
    found = evidence(np.full((4, count, 3), 0.4), noise=0.1)
    for name in set(ColorEvidence.ARRAYS) - {"saturated", "unseen"}:
        getattr(found, name)[rows] = 0.0
    found.unseen[rows] = 1.0
    return found


class TestStandardError:
    @pytest.mark.parametrize("views", [2, 3, 8, 32])
    def test_it_is_that_of_a_mean_of_views(self, rng, views):
        """Views off by 0.05 each: the mean's error is 0.05 / sqrt(views), and the stated one says so on average."""
        targets = 0.5 + rng.normal(0.0, 0.05, (views, 4000, 3))
        raw, error = least_squares(evidence(targets))
        np.testing.assert_allclose(raw, targets.mean(0), atol=1e-12)
        # 12,000 variances of one degree or more are known to sqrt(2 / 12,000); Wilson and Hilferty are 4 % off at one
        assert np.sqrt((error**2).mean()) / (0.05 / np.sqrt(views)) == pytest.approx(1.0, abs=0.05)
        assert ((np.abs(raw - 0.5) < 2.0 * error).mean(0) > 0.90).all()  # Student's t of 2 degrees has 82 %

    def test_views_that_agree_on_the_impossible_disagree_with_what_it_is_cut_to(self, rng):
        """Views of 1.6, 0.05 off each: without bounds the error is that of their mean; cut to 1, they are 0.6 off."""
        impossible = evidence(1.6 + rng.normal(0.0, 0.05, (8, 4000, 3)))
        _, free = least_squares(impossible, bounds=(-np.inf, np.inf))
        assert np.sqrt((free**2).mean()) == pytest.approx(0.05 / np.sqrt(8), rel=0.05)
        _, cut = least_squares(impossible)
        assert cut.min() > 0.5 / np.sqrt(8)

    def test_one_view_alone_is_as_uncertain_as_views_are_elsewhere(self, rng):
        """A single view has no residual; its error is what views typically differ by, not 0."""
        many = evidence(0.5 + rng.normal(0.0, 0.05, (16, 1000, 3)))
        one = 0.5 + rng.normal(0.0, 0.05, (200, 3))
        many.numerator[:200], many.denominator[:200], many.observed[:200], many.views[:200] = one, 1.0, one**2, 1.0
        _, error = least_squares(many)
        # the median of 800 estimates of 15 degrees each: 1.25 sqrt(2 / 15 / 800) of a variance, thrice that to be safe
        np.testing.assert_allclose(error[:200], 0.05, rtol=0.03)

    def test_light_that_is_noisy_in_every_frame_averages_out_over_those_that_are_measured(self):
        """Nine frames, one of which shows the first half: its noise is that of one frame, not a ninth of it."""
        frame = evidence(np.full((4, 10, 3), 0.4), noise=0.1)
        total = frame
        for _ in range(8):
            total = total + hidden(10, slice(0, 5))
        _, error = least_squares(total)
        once = (0.4 + SPECULAR_PART) * 0.1  # of what is diffuse and of the highlight that is subtracted
        np.testing.assert_allclose(error[:5], once, rtol=1e-6)
        np.testing.assert_allclose(error[5:], once / 3.0, rtol=1e-6)

    def test_of_black_is_that_of_the_highlight(self, rng):
        """A light wrong by 20 %: black under a highlight of 0.05 comes out wrong by 0.01."""
        error = rng.normal(0.0, 0.2, 4000)
        shown = 0.05 * (1.0 + error)  # radiance, all of it specular; the model subtracts 0.05
        raw, _ = least_squares(evidence(np.tile((shown - 0.05)[None, :, None], (4, 1, 3)), noise=0.2))
        assert np.sqrt((raw**2).mean()) == pytest.approx(0.01, rel=0.05)  # 4000 samples: 1.1 %
        _, stated = least_squares(evidence(np.zeros((4, 10, 3)), noise=0.2))
        np.testing.assert_allclose(stated, 0.01, rtol=1e-6)

    def test_what_gaussians_cannot_show_stays_however_many_views_and_frames_there_are(self):
        frame = evidence(np.full((16, 10, 3), 0.4))
        frame.misfit[5:] = 0.03**2
        solved = solve_base_color(bare(10), frame + frame, IRRADIANCE)
        np.testing.assert_allclose(solved.standard_error[:5], 0.0, atol=1e-6)
        np.testing.assert_allclose(solved.standard_error[5:], 0.03, rtol=1e-5)


class TestFlags:
    def test_only_what_errors_do_not_explain_is_called_cut(self, rng):
        """A base colour of 0.95 that is known to 0.05 is above 1 one time in six, and one of 1.2 always is."""
        for color, least, most in ((0.95, 0.0, 0.1), (1.2, 0.98, 1.0)):
            noisy = color + 0.05 * np.sqrt(16) * rng.normal(size=(16, 400, 1)) * np.ones(3)
            solved = solve_base_color(bare(400), evidence(noisy), IRRADIANCE)
            assert least <= solved.clipped_part <= most

    def test_what_one_frame_of_many_shows_is_measured(self):
        total = evidence(np.full((4, 10, 3), 0.4), noise=0.1)
        for _ in range(150):
            total = total + hidden(10, slice(0, 5))
        solved = solve_base_color(bare(10), total, IRRADIANCE)
        assert (solved.observability == 0).all()
        np.testing.assert_allclose(solved.base_color, 0.4, rtol=1e-6)

    def test_where_nothing_is_known_nothing_is_claimed(self):
        solved = solve_base_color(bare(6), hidden(6, slice(None)), IRRADIANCE)
        np.testing.assert_array_equal(solved.base_color, np.float32(UNKNOWN[0]))
        np.testing.assert_array_equal(solved.standard_error, np.float32(UNKNOWN[1]))
        assert (solved.observability & np.uint8(Observability.FILLED) != 0).all()
        assert solved.clipped_part == 0.0
