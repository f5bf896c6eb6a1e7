"""Certificates: their arithmetic, and what stands in a file that strangers made."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.stats import binom

from beam_warp.errors import AssetFormatError, InvalidOptionError
from beam_warp.evaluate.certificate import KEY, Certificate, least_bound, least_share
from beam_warp.evaluate.relit import loss_of
from beam_warp.evaluate.trials import DIMMED, RelitTrials
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

GREY = EnvironmentMap.constant((1.0, 1.0, 1.0))

SOUND = Certificate(
    measure="loss",
    bound=0.5,
    share=0.95,
    confidence=0.95,
    pairs=200,
    within=198,
    first=0,
    mean=(0.2, 0.19, 0.21),
    psnr=47.0,
    asset_psnr=35.0,
    distribution={"environments": ["00"], "height": 64, "seed": 0},
    original="a",
    asset="b",
)


def asset(text: str) -> GaussianSequence:
    one = GaussianCloud(
        positions=np.zeros((1, 3)), orientations=[[0, 0, 0, 1]], scales=np.ones((1, 3)), opacities=np.ones(1)
    )
    return GaussianSequence.from_clouds([one], metadata={KEY: text})


def test_the_least_share_is_that_of_a_binomial_law():
    assert least_share(200, 200, 0.95) == pytest.approx(0.05 ** (1 / 200))
    share = least_share(190, 200, 0.9)
    assert binom.sf(189, 200, share) == pytest.approx(0.1)  # so many or more, were the share no larger


def test_shares_are_covered_as_often_as_is_stated():
    rng, true = np.random.default_rng(0), 0.97
    within, times = np.unique(rng.binomial(200, true, 2000), return_counts=True)
    held = np.array([least_share(int(count), 200, 0.95) <= true for count in within])
    assert held @ times / 2000 >= 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / 2000)


@pytest.mark.parametrize(("count", "confidence"), [(59, 0.95), (200, 0.95), (200, 0.997), (31, 0.5)])
def test_the_least_bound_is_certified_and_nothing_below_it(count, confidence):
    errors = np.random.default_rng(count).exponential(size=count)
    bound = least_bound(errors, 0.95, confidence)
    within = int(np.count_nonzero(errors <= bound))
    assert least_share(within, count, confidence) >= 0.95 > least_share(within - 1, count, confidence)
    assert bound == np.sort(errors)[within - 1]


def test_too_few_draws_certify_no_bound():
    assert least_bound(np.zeros(58), 0.95, 0.95) == np.inf  # 0.95^58 > 0.05


def test_independent_errors_as_large_as_those_there_cost_three_decibels():
    assert loss_of(np.array([35.0]))[0] == pytest.approx(10.0 * np.log10(2.0))
    assert loss_of(np.array([29.0]), 29.0)[0] == pytest.approx(10.0 * np.log10(2.0))


def test_a_certificate_reads_back():
    assert Certificate.of(asset(SOUND.as_metadata()[KEY])) == SOUND
    assert Certificate.of(replace(asset(""), metadata={})) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"pairs": 10**9},
        {"pairs": "many"},
        {"bound": float("nan")},
        {"measure": "ssim"},
        {"mean": [1.0]},
        {"mean": None},
        {"distribution": {}},
        {"distribution": 3},
        {"first": -1},
        {"confidence": 1.0},
        {"more": 1},
    ],
)
def test_damaged_certificates_are_refused(changes):
    with pytest.raises(AssetFormatError, match="relit_certificate must be a certificate"):
        Certificate.of(asset(json.dumps({**asdict(SOUND), **changes})))


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 5000, "null"])
def test_what_is_no_certificate_is_refused(text):
    with pytest.raises(AssetFormatError, match="relit_certificate must be a certificate"):
        Certificate.of(asset(text))


class TestTrials:
    def test_halves_share_no_draw_and_numbers_repeat(self):
        trials = RelitTrials([GREY], seed=3)
        search, other = (trials.draw(half, range(50), range(7)) for half in ("search", "certificate"))
        assert not set(search) & set(other)
        assert trials.draw("search", range(10, 50), range(7)) == search[10:]

    def test_lights_are_those_of_the_page(self):
        draws = RelitTrials([GREY, GREY.scaled(5.0)]).draw("search", range(4000), range(3))
        lamps = [draw.lamp for draw in draws]
        for lamp, share in (("none", 0.5), ("sun", 0.25), ("sphere", 0.25)):
            assert lamps.count(lamp) / 4000 == pytest.approx(share, abs=4.0 * np.sqrt(share * (1 - share) / 4000))
        height = np.sin(np.radians([draw.elevation for draw in draws]))
        low, high = np.sin(np.radians([-20.0, 75.0]))
        assert height.mean() == pytest.approx((low + high) / 2, abs=4.0 * (high - low) / np.sqrt(12 * 4000))

    def test_irradiance_is_integrated_once_for_each_light(self, monkeypatch):
        """What exposes a light also shades by it, exposed and dimmed."""
        made, integrate = [], EnvironmentMap.irradiance_map
        monkeypatch.setattr(EnvironmentMap, "irradiance_map", lambda *given: made.append(given) or integrate(*given))
        white, *_, dim = RelitTrials([EnvironmentMap.constant((2.0, 1.0, 1.0)), GREY.resized(8, 16)]).prepared
        whitest, dimmest = (light.environment.default_irradiance.max() for light in (white, dim))
        assert dimmest == pytest.approx(DIMMED * whitest)
        assert len(made) == 2

    @pytest.mark.parametrize("lights", [[], [GREY] * 5, [EnvironmentMap.constant((0.0, 0.0, 0.0))]])
    def test_no_light_and_too_many_are_refused(self, lights):
        with pytest.raises(InvalidOptionError, match="environment must"):
            RelitTrials(lights)
