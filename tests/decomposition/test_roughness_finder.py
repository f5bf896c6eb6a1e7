"""Frames that roughness is found from: some of many, and none where views say nothing of it."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from beam_warp.decomposition import roughness_finder
from beam_warp.decomposition.roughness_finder import ROUGHNESS_FRAMES, asked_frames, find_roughness, profiles_of
from beam_warp.materials.roughness import evenly_spread, solve_roughness
from beam_warp.materials.roughness_profile import CANDIDATES, RoughnessProfile

COUNT = 2000
POSITIONS = np.random.default_rng(0).uniform(size=(COUNT, 3)).astype(np.float32)
PLAN = SimpleNamespace(
    light=SimpleNamespace(prepared=None), source=SimpleNamespace(options=SimpleNamespace(gathering=None))
)


def test_frames_that_are_asked_are_spread():
    assert asked_frames(1) == [0]
    assert asked_frames(5) == [0, 1, 2, 3, 4]
    assert asked_frames(71) == [0, 10, 20, 30, 40, 50, 60, 70]


@given(st.integers(1, 500))
def test_every_frame_that_is_asked_is_another_one(count):
    found = asked_frames(count)
    assert len(found) == len(set(found)) == min(count, ROUGHNESS_FRAMES)
    assert set(found) <= set(range(count))
    assert {0, count - 1} <= set(found)


def told(seen, spread):
    """What halves of views say that see a roughness with normal errors of a spread."""
    values = np.array(CANDIDATES)
    halves = np.square((values - seen[..., None]) / spread) / 2.0
    return RoughnessProfile(np.concatenate([halves.sum(0, keepdims=True), halves]), np.ones(seen.shape[1]))


@pytest.fixture
def found(monkeypatch):
    """A function that estimates roughness from frames of the given profiles, and says which of these were read."""
    read = []

    def find(profiles):
        def measured(cloud, *_, frame, rows, **how):
            read.append((frame, COUNT if rows is None else len(rows)))
            return profiles[frame] if rows is None else profiles[frame].of(rows)

        monkeypatch.setattr(roughness_finder, "measure_roughness_profile", measured)
        log = SimpleNamespace(timer=lambda _: nullcontext(), within=lambda *_: None)
        frames = (
            SimpleNamespace(number=number, cloud=_Cloud(), scene=None, points=None, views=None, log=log)
            for number in range(len(profiles))
        )
        read.clear()
        return find_roughness(POSITIONS, profiles_of(PLAN, frames, len(profiles))), read

    return find


class _Cloud:
    positions = POSITIONS

    def __len__(self):
        return COUNT


def frames(count, spread, true=0.5):
    """Profiles of frames whose errors are independent."""
    rng = np.random.default_rng(1)
    return [told(true + spread * rng.normal(size=(2, COUNT)), spread) for _ in range(count)]


@pytest.mark.parametrize("count", [1, 2, 5])
def test_all_frames_that_are_asked_count(found, count):
    profiles = frames(count, 0.1)
    estimate, read = found(profiles)
    assert len(read) == estimate.report["frames"] == count
    total = profiles[0]
    for profile in profiles[1:]:
        total = total + profile
    whole = solve_roughness(POSITIONS, total)
    np.testing.assert_allclose(estimate.roughness, whole.roughness, rtol=1e-5)
    np.testing.assert_allclose(estimate.standard_error, whole.standard_error, rtol=1e-5)
    assert "frames_left_out" not in estimate.report


@pytest.mark.parametrize("spread", [0.1, 0.3, 0.6, 1.0])
def test_what_frames_that_are_not_asked_would_change(spread):
    profiles = frames(24, spread, 0.2 + 0.6 * POSITIONS[:, 0])
    some = find_roughness(POSITIONS, profiles[::3], 24)
    change = find_roughness(POSITIONS, profiles, 24).roughness - some.roughness
    assert some.report["frames_left_out"] == 16
    assert 0.5 < some.report["change_by_all"] / np.sqrt(np.square(change).mean()) < 2.0


class TestPilot:
    @pytest.fixture(autouse=True)
    def small_pilot(self, monkeypatch):
        monkeypatch.setattr(roughness_finder, "PILOT_GAUSSIANS", 100)

    def test_views_that_say_nothing_are_asked_by_few_gaussians_only(self, found):
        mute = RoughnessProfile(np.zeros((3, COUNT, len(CANDIDATES))), np.ones(COUNT))
        estimate, read = found([mute] * 3)
        assert read == [(0, 100)]
        assert not estimate.informed.any()
        assert estimate.report["frames"] == 0
        whole = solve_roughness(POSITIONS, mute + mute + mute)
        # Both are the prior; where all are asked it may be blurred by 0.01, the least step that is tried, beside its
        # spread of 0.21: by 0.01² / 2 / 0.21² of it.
        np.testing.assert_allclose(estimate.roughness, whole.roughness, rtol=1.2e-3)
        np.testing.assert_allclose(estimate.standard_error, whole.standard_error, rtol=1.2e-3)

    def test_views_that_say_something_are_asked_in_full(self, found):
        estimate, read = found(frames(1, 0.1))
        assert read == [(0, 100), (0, COUNT)]
        assert estimate.informed.any()

    def test_a_pilot_that_would_save_little_is_left_out(self, found, monkeypatch):
        monkeypatch.setattr(roughness_finder, "LEAST_SAVED", 21)
        assert found(frames(1, 0.1))[1] == [(0, COUNT)]


@given(st.integers(1, 3000), st.integers(1, 500))
def test_rows_of_a_pilot_are_even(count, wanted):
    rows = evenly_spread(np.random.default_rng(count).normal(size=(count, 3)), wanted)
    assert (np.diff(rows) > 0).all()
    assert min(count, wanted) <= len(rows) < 2 * wanted + 1
