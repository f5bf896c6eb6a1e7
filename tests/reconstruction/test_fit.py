"""Fits: margins over the start, budgets, targets, rows without a Gaussian, bits, captures of every kind, refusals."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import warp as wp
from support.moving_ball import ball_cloud, ball_view, ball_views, rig
from support.threads import require_same_on_any_threads

from beam_warp.capture.quality import noise_of_views
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.jobs.listeners import no_progress
from beam_warp.raster.resolution import MOST_SAMPLES
from beam_warp.reconstruction import fit as fit_module
from beam_warp.reconstruction.fit import PRESETS, FitOptions, Fitter, LearningRates, chosen_dropout, fit_gaussians
from beam_warp.reconstruction.initial import initial_gaussians
from beam_warp.reconstruction.parameters import GaussianParameters
from beam_warp.reconstruction.targets import LossWeights
from beam_warp.reconstruction.total_variation import RadianceVariation


@pytest.fixture(scope="module")
def views():
    return ball_views(rig())


def few_steps(**changes):
    """Without refinements unless they are asked for."""
    kept = {"color_iterations": 0, "normal_iterations": 12, "refine_every": 0, "samples": 1, "gaussian_count": 300}
    return FitOptions(**{**kept, **changes})


def fitted(views, start, device, progress=no_progress, **changes):
    return fit_gaussians(views, start, few_steps(**changes), device=device, progress=progress)


def fitter_of(views, cloud, options, device):
    return Fitter(views, cloud, options, wp.get_device(device))


class TestProgress:
    def test_a_grey_ball_takes_on_its_paint(self, device, views):
        """8 dB is two and a half times closer; 6 dB, twice, in views that no step saw."""
        grey, options = ball_cloud(300, painted=False), few_steps(color_iterations=30, normal_iterations=50)
        fitter = fitter_of(views, grey, options, device)
        before = fitter.psnr()
        fitter.run()
        assert (fitter.psnr() > before + 8.0).all()
        assert (fitter.gaps() == 0.0).all()
        between = [ball_view(camera) for camera in rig(6, size=44, vertical_fov=35.0)]
        at_first, now = (
            fitter_of(between, cloud, few_steps(), device).psnr() for cloud in (grey, fitter.parameters.cloud())
        )
        assert (now > at_first + 6.0).all()

    def test_the_hull_is_where_it_begins(self, device, tiny_capture):
        """The demo figure: 60 steps make of its hull's discs what is a third closer to the photographs, 3.5 dB."""
        views = [record.view() for record in tiny_capture.select(split="train", frames=[0])]
        start = initial_gaussians(views, 400, device=device)
        before = fitter_of(views, start, few_steps(), device).psnr()
        steps = {"color_iterations": 30, "normal_iterations": 30, "refine_every": 20}
        fit = fitted(views, start, device, gaussian_count=400, **steps)
        assert fit.report["psnr"] > before.mean() + 3.5
        assert fit.report["view_psnr"] > before.min() + 3.5

    def test_everybody_hears_of_it(self, device, views):
        heard = []

        def listen(done, total, facts):
            heard.append((done, total, dict(facts)))

        fitted(views, ball_cloud(60), device, listen, normal_iterations=60, refine_every=20)
        assert [done for done, _, _ in heard] == [0, 50, 60]
        assert {total for _, total, _ in heard} == {60}
        assert heard[0][2] == {"gaussians": 60.0}
        assert set(heard[-1][2]) == {"gaussians", "psnr"}

    def test_without_steps_nothing_moves(self, device, views):
        start = ball_cloud(60)
        fit = fitted(views, start, device, normal_iterations=0, sampling_filter=False)
        np.testing.assert_array_equal(fit.cloud.positions, start.positions)
        assert fit.report["iterations"] == 0

    def test_positions_come_to_rest(self, device, views):
        """Late steps move them far less than early ones, with a last rate far below the first."""
        rates = LearningRates(1e-3, 1e-7, 0.0, 0.0, 0.0, 0.0, 0.0)
        options = few_steps(normal_iterations=100, rates=rates, sampling_filter=False)
        fitter = fitter_of(views, ball_cloud(40), options, device)
        places = []
        fitter.run(lambda done, total, facts: places.append(fitter.parameters.positions.numpy().copy()))
        early, late = (np.abs(b - a).max() for a, b in pairwise(places))
        assert late < 0.02 * early


OFTEN = {"refine_every": 6, "refine_until": 1.0}

UNSPLIT = {"gaussian_count": 60, "split_fraction": 0.0, **OFTEN}


class TestBudget:
    def test_it_is_filled_and_never_exceeded(self, device, views):
        """Splits of 20 % a time: 60 Gaussians become 90 and no more."""
        counts = []

        def count(done, total, facts):
            counts.append(facts["gaussians"])

        changes = {"gaussian_count": 90, "normal_iterations": 60, "hidden_share": 0.0, **OFTEN}
        fit = fitted(views, ball_cloud(60), device, count, **changes)
        assert fit.report["gaussians"] == len(fit.cloud) == 90
        assert max(counts) <= 90

    def test_a_start_that_is_too_large_is_thinned_evenly(self, device, views):
        fit = fitted(views, ball_cloud(200), device, gaussian_count=50, normal_iterations=0)
        assert len(fit.cloud) == 50
        np.testing.assert_array_equal(fit.cloud.positions[[0, -1]], ball_cloud(200).positions[[0, -1]])

    def test_what_nobody_sees_is_dropped(self, device, views):
        """High above every image; its row is then free for a split."""
        start = ball_cloud(60)
        start = start.with_arrays(positions=np.where(np.arange(60)[:, None] < 5, (0.0, 0.0, 50.0), start.positions))
        assert len(fitted(views, start, device, hidden_share=1e-9, **UNSPLIT).cloud) == 55
        cloud = fitted(views, start, device, hidden_share=1e-9, **{**UNSPLIT, "split_fraction": 1.0}).cloud
        assert len(cloud) == 60
        assert np.abs(cloud.positions).max() < 1.0

    def test_what_is_faint_is_dropped(self, device, views):
        start = ball_cloud(60).with_arrays(opacities=np.where(np.arange(60) < 5, 0.005, 0.8))
        changes = {"hidden_share": 0.0, "rates": LearningRates(opacities=0.0), **UNSPLIT}
        assert len(fitted(views, start, device, normal_iterations=6, **changes).cloud) == 55

    def test_nobody_is_dropped_if_all_would_be(self, device, views):
        assert len(fitted(views, ball_cloud(60), device, dead_opacity=1.0, **UNSPLIT).cloud) == 60


class TestRowsWithoutAGaussian:
    def test_they_never_move_and_never_count(self, device, views):
        options = few_steps(gaussian_count=90, normal_iterations=20, refine_every=1000)
        fitter = fitter_of(views, ball_cloud(60), options, device)
        before = {name: array[60:].copy() for name, array in fitter.parameters.rows().items()}
        fitter.run()
        for name, array in fitter.parameters.rows().items():
            np.testing.assert_array_equal(array[60:], before[name])
        assert fitter.report()["gaussians"] == len(fitter.parameters.cloud()) == 60

    def test_the_start_does_not_call_them_back(self, device, views):
        """A dropped Gaussian is no longer held to the start, nor is the half that took its row."""
        options = few_steps(
            gaussian_count=150,
            normal_iterations=60,
            refine_every=10,
            refine_until=0.5,
            split_fraction=0.02,
            hidden_share=0.3,
            temporal=0.1,
            rates=LearningRates(opacities=1.0),
        )
        fitter = fitter_of(views, ball_cloud(120), options, device)
        fitter.run()
        logits = fitter.parameters.logits.numpy()
        dead = ~fitter.parameters.alive()
        assert dead.any()
        assert (logits[dead] == logits[dead][0]).all()
        assert len(fitter.parameters.cloud()) == 150 - dead.sum()


def fitted_arrays(views, device, **changes):
    return fitted(views, ball_cloud(60, painted=False), device, **changes).cloud.arrays().values()


class TestBits:
    def test_same_bits_every_time_for_every_number_of_threads(self, device, monkeypatch):
        views = ball_views(rig(2, 48))  # 9,216 samples, 1,100 rows: several chunks of every kernel
        changes = {"gaussian_count": 1100, "normal_iterations": 4, "refine_every": 2, "refine_until": 1.0, "samples": 2}
        require_same_on_any_threads(monkeypatch, lambda: fitted_arrays(views, device, **changes))
        changes |= {"dropout": 0.1, "total_variation": 0.01}
        require_same_on_any_threads(monkeypatch, lambda: fitted_arrays(views, device, **changes))

    def test_another_seed_is_another_order(self, device, views):
        pairs = zip(fitted_arrays(views, device), fitted_arrays(views, device, seed=1), strict=True)
        assert any((one != other).any() for one, other in pairs)


def noisy(view, rng, deviation):
    """A photograph with photon noise: a variance of ``deviation`` squared, over the value."""
    noise = deviation * np.sqrt(view.color) * rng.normal(size=view.color.shape)
    return replace(view, color=(view.color + noise).astype(np.float32))


def dropout_of(count, views):
    """What the photographs ask for, of so many Gaussians."""
    return chosen_dropout("auto", count, *noise_of_views(views))


class TestDropout:
    def test_as_much_as_noise_asks_for(self, rng):
        """Twice the noise's variance over the level, for each of three Gaussians a pixel beyond two; or the most."""
        clean = ball_views(rig(6, size=96))
        solid = [view.alpha > 0.999 for view in clean]
        level = np.median([np.median(view.color[inside]) for view, inside in zip(clean, solid, strict=True)])
        count = 5 * int(np.median([inside.sum() for inside in solid]))
        for deviation in (0.02, 0.05):
            found = dropout_of(count, [noisy(view, rng, deviation) for view in clean])
            assert found[1] == pytest.approx(2.0 * 3.0 * deviation**2 / level, rel=0.1)
            assert found[0] == max(found[1], 0.1)
        assert dropout_of(count, [noisy(view, rng, 0.2) for view in clean]) == (0.2, 0.2)

    def test_nothing_where_nothing_asks_for_it(self, rng, views):
        """Clean photographs, or too small to tell noise, after half of the steps; fewer Gaussians than pixels."""
        clean = ball_views(rig(6, size=96))
        assert dropout_of(100_000, clean) == (0.1, 0.0)
        assert dropout_of(100_000, [noisy(view, rng, 0.05) for view in views]) == (0.1, 0.0)
        assert dropout_of(300, [noisy(view, rng, 0.05) for view in clean]) == (0.0, 0.0)
        assert chosen_dropout(0.07, 100_000, *noise_of_views(clean)) == (0.07, 0.07)

    def test_at_first_as_many_as_can_be_spared(self):
        """Half of the most, where a pixel has half as many beyond what it needs as it needs: three for two."""
        clean = ball_views(rig(6, size=96))
        pixels = int(np.median([np.count_nonzero(view.alpha > 0.999) for view in clean]))
        assert dropout_of(3 * pixels, clean)[0] == pytest.approx(0.05, rel=0.05)
        assert dropout_of(2 * pixels, clean)[0] <= 0.005

    def test_the_second_half_has_its_own(self, device, views, monkeypatch):
        heard = []
        monkeypatch.setattr(GaussianParameters, "drop_out", lambda self, part, seed: heard.append(part))
        for parts in ((0.1, 0.05), (0.1, 0.0)):
            monkeypatch.setattr(fit_module, "chosen_dropout", lambda *_, found=parts: found)
            heard.clear()
            report = fitted(views, ball_cloud(60), device, normal_iterations=9).report
            assert report["dropout"] == parts
            if device == "cpu":  # steps that a GPU recorded are not told of again
                assert heard == [0.1] * 4 + [0.05] * (5 if parts[1] else 0)
            assert list(dict.fromkeys(heard)) == [part for part in parts if part]

    def test_many_gaussians_paint_less_for_each_photograph_alone(self, device, rng):
        """More than two for a pixel, 12 photographs: others in between are met better by .2 dB and more (.4 found)."""
        seen = [noisy(view, rng, 0.1) for view in ball_views(rig(12))]
        between = [ball_view(camera) for camera in rig(6, size=44, vertical_fov=35.0)]
        start = ball_cloud(1_500, painted=False)

        def met(**changes):
            fit = fitted(seen, start, device, gaussian_count=1_500, normal_iterations=400, **changes)
            return fit.report, fitter_of(between, fit.cloud, few_steps(), device).psnr().mean()

        (plain, before), (dropped, after) = met(dropout=0.0), met(dropout=0.1)
        assert (plain["dropout"], dropped["dropout"]) == ((0.0, 0.0), (0.1, 0.1))
        assert dropped["psnr"] < plain["psnr"]
        assert after > before + 0.2

    def test_none_is_taken_for_hidden_because_it_was_left_out(self, device, views):
        """A fifth is left out of the last step before a refinement, which drops what shows nothing: nobody here."""
        fit = fitted(views, ball_cloud(60), device, hidden_share=1e-9, dropout=0.2, **UNSPLIT)
        assert len(fit.cloud) == 60


class TestTotalVariation:
    def test_noise_is_not_taken_for_paint(self, device, rng):
        """12 noisy photographs: others in between are met better by .1 dB and more (.25 found), these ones worse."""
        seen = [noisy(view, rng, 0.1) for view in ball_views(rig(12))]
        between = [ball_view(camera) for camera in rig(6, size=44, vertical_fov=35.0)]
        start, steps = ball_cloud(1_500, painted=False), {"gaussian_count": 1_500, "normal_iterations": 400}
        fits = [fitted(seen, start, device, dropout=0.0, total_variation=weight, **steps) for weight in (0.0, 0.003)]
        assert [fit.report["total_variation"] for fit in fits] == [0.0, 0.003]
        assert fits[1].report["psnr"] < fits[0].report["psnr"]
        before, after = (fitter_of(between, fit.cloud, few_steps(), device).psnr().mean() for fit in fits)
        assert after > before + 0.1

    def test_photographs_decide(self, device, rng):
        """Clean ones ask for none, noisy ones for the variance over the level, or the most; a draft does not ask."""
        clean = ball_views(rig(6, size=96))
        level = np.median([np.median(view.color[view.alpha > 0.999]) for view in clean])
        draft = FitOptions.of_preset("draft", gaussian_count=300)
        for deviation, weight in ((0.0, 0.0), (0.02, 0.02**2 / level), (0.1, 0.003)):
            views = [noisy(view, rng, deviation) for view in clean]
            asking, quick = (fitter_of(views, ball_cloud(60), chosen, device) for chosen in (few_steps(), draft))
            assert asking.total_variation == pytest.approx(weight, rel=0.1)
            assert quick.total_variation == 0.0

    def test_halves_have_neighbors_of_their_own(self, device, views, monkeypatch):
        """Neighbours are found at the start, and again after each of two refinements."""
        found, find = [], RadianceVariation.find_neighbors

        def noted(self):
            find(self)
            found.append(int(self._parameters.alive().sum()))

        monkeypatch.setattr(RadianceVariation, "find_neighbors", noted)
        fitted(views, ball_cloud(60), device, total_variation=1e-3, **SOON | {"normal_iterations": 6})
        assert found == [60] * 3


SOON = {**UNSPLIT, "hidden_share": 0.0, "refine_every": 3}


class TestReset:
    @pytest.fixture(autouse=True)
    def few_steps_are_enough(self, monkeypatch):
        monkeypatch.setattr(fit_module, "RESET_STEPS", 3)

    def test_opacities_are_lowered_once(self, device, views):
        """Three steps end in a refinement; six in a second one, after three steps upwards."""
        reset, later, never = (
            fitted(views, ball_cloud(60), device, normal_iterations=steps, reset_below=below, **SOON).cloud.opacities
            for steps, below in ((3, 24), (6, 24), (3, len(views)))
        )
        assert reset.max() <= 0.1001 < later.max()
        assert never.min() > 0.2

    def test_where_coverage_is_not_known_they_stay(self, device, views):
        bare = [replace(view, alpha=None) for view in views]
        assert fitted(bare, ball_cloud(60), device, normal_iterations=3, **SOON).cloud.opacities.min() > 0.2

    def test_where_steps_are_too_few_they_stay(self, device, views, monkeypatch):
        monkeypatch.setattr(fit_module, "RESET_STEPS", 4)
        assert fitted(views, ball_cloud(60), device, normal_iterations=3, **SOON).cloud.opacities.min() > 0.2

    def test_few_photographs_agree_on_more(self, device):
        """Six, and 1,500 Gaussians from their visual hull: others in between are met better by .7 dB (1.5 found)."""
        seen = ball_views(rig(6, size=64))
        between = [ball_view(camera) for camera in rig(6, size=44, vertical_fov=35.0)]
        start = initial_gaussians(seen, 1_500, device=device)
        steps = {"color_iterations": 100, "normal_iterations": 200, "refine_every": 25, "dropout": 0.0}

        def met(below):
            fit = fitted(seen, start, device, gaussian_count=1_500, reset_below=below, **steps)
            return fitter_of(between, fit.cloud, few_steps(), device).psnr().mean()

        assert met(24) > met(0) + 0.7


class TestTarget:
    @pytest.fixture(autouse=True)
    def begin_with_few(self, monkeypatch):
        monkeypatch.setattr(fit_module, "FEWEST_GAUSSIANS", 40)

    def test_it_is_met_at_once(self, device, views):
        report = fitted(views, ball_cloud(160), device, target_psnr=5.0, gaussian_count=160).report
        assert [entry["gaussians"] for entry in report["growth"]] == [40]
        assert report["psnr"] >= 5.0

    def test_the_budget_ends_it(self, device, views, monkeypatch):
        monkeypatch.setattr(fit_module, "LEAST_GAIN", -100.0)
        fit = fitted(views, ball_cloud(150, painted=False), device, target_psnr=100.0, gaussian_count=150)
        assert [entry["gaussians"] for entry in fit.report["growth"]] == [40, 80, 150]
        assert len(fit.cloud) == fit.report["gaussians"] == 150
        # all steps for the first, half of them for what is split from there
        assert fit.report["iterations"] == 12 + 6 + 6

    def test_what_does_not_pay_is_not_gone_on_with(self, device, views, monkeypatch):
        monkeypatch.setattr(fit_module, "LEAST_GAIN", 100.0)
        report = fitted(views, ball_cloud(300), device, target_psnr=100.0, gaussian_count=300).report
        assert [entry["gaussians"] for entry in report["growth"]] == [40, 80]

    def test_fewer_at_the_start_than_it_begins_with(self, device, views):
        report = fitted(views, ball_cloud(20), device, target_psnr=5.0).report
        assert [entry["gaussians"] for entry in report["growth"]] == [20]


CAPTURES = {
    "one view": lambda: ball_views(rig(1)),
    "without alpha": lambda: ball_views(rig(3), with_alpha=False),
    "some without alpha": lambda: [*ball_views(rig(2)), *ball_views(rig(1), with_alpha=False)],
    "of two sizes": lambda: [*ball_views(rig(2)), *ball_views(rig(1, 56))],
    "of a pixel": lambda: ball_views(rig(2, 1)),
    "the ball beside the image": lambda: ball_views(rig(3), (30.0, 0.0, 0.0)),
}


class TestCaptures:
    @pytest.mark.parametrize(
        ("name", "count"), [*((name, 40) for name in CAPTURES), ("one view", 1), ("of a pixel", 1)]
    )
    def test_nothing_but_finite_comes_out(self, device, name, count):
        """`GaussianCloud` refuses what is not; the report is finite too."""
        changes = {"gaussian_count": count + 10, "samples": "auto", **OFTEN}
        fit = fitted(CAPTURES[name](), ball_cloud(count), device, **changes)
        assert 1 <= len(fit.cloud) <= count + 10
        assert np.isfinite([fit.report["psnr"], fit.report["view_psnr"]]).all()

    def test_a_start_without_extent(self, device, views):
        """Gaussians that are points: samples as fine as there are."""
        start = ball_cloud(20).with_arrays(scales=np.zeros((20, 3)))
        fit = fitted(views, start, device, samples="auto", normal_iterations=2)
        assert fit.report["samples"] == MOST_SAMPLES

    def test_black_photographs_make_black_gaussians(self, device, views):
        """Or none that show: an empty mask is met by what does not cover."""
        black = [replace(view, color=0.0 * view.color, alpha=0.0 * view.alpha) for view in views]
        changes = {"normal_iterations": 60, "refine_every": 10, "rates": LearningRates(opacities=0.5)}
        fit = fitted(black, ball_cloud(60), device, **changes)
        assert len(fit.cloud) >= 1
        assert fit.report["psnr"] > 40.0


OUT_OF_RANGE = {
    FitOptions: {
        "gaussian_count": (0, 2**24 + 1, 1.5, None),
        "target_psnr": (0.5, 121.0, np.nan, "high"),
        "color_iterations": (-1, 0.5),
        "normal_iterations": (-1, True),
        "refine_every": (-1,),
        "seed": (-1, 0.5),
        "sh_degree": (-1, 5),
        "samples": (0, 9, "many", None),
        "temporal": (-0.1, np.nan),
        "dropout": (-0.1, 0.3, np.nan, "much", None),
        "total_variation": (-0.1, np.nan, "much", None),
        **dict.fromkeys(("refine_until", "split_fraction", "hidden_share", "dead_opacity"), (-0.1, 1.1, np.nan)),
    },
    LearningRates: dict.fromkeys(
        ("positions", "final_positions", "orientations", "scales", "color", "bands"), (-0.1, np.nan, "fast")
    ),
    LossWeights: dict.fromkeys(("l1", "ssim", "alpha", "normal", "estimated"), (-0.1, np.nan, "much")),
}


class TestOptions:
    @pytest.mark.parametrize("options", OUT_OF_RANGE)
    def test_what_is_out_of_range_is_refused(self, options):
        for name, values in OUT_OF_RANGE[options].items():
            for value in values:
                with pytest.raises(InvalidOptionError, match=f"{name} must be"):
                    options(**{name: value})

    @pytest.mark.parametrize("preset", PRESETS)
    def test_presets_and_what_is_changed_of_them(self, preset):
        options = FitOptions.of_preset(preset, gaussian_count=7, seed=3)
        assert (options.gaussian_count, options.seed) == (7, 3)
        expected = {"fast": (1_000, 2_000), "draft": (150, 300), "paper": (7_000, 5_000), "rade": (6_000, 6_000)}
        assert (options.color_iterations, options.normal_iterations) == expected[preset]
        assert FitOptions.of_preset("fast") == FitOptions()

    def test_an_unknown_preset(self):
        with pytest.raises(InvalidOptionError, match="preset must be one of fast, draft, paper, rade, got 'best'"):
            FitOptions.of_preset("best")


class TestRefusals:
    def test_nothing_to_fit(self, device, views):
        with pytest.raises(InvalidArrayError, match="got 0 views and 60 Gaussians"):
            fitted([], ball_cloud(60), device)
        with pytest.raises(InvalidArrayError, match="got 6 views and 0 Gaussians"):
            fitted(views, ball_cloud(60).select(np.zeros(0, int)), device)
