"""Our files in viewers of the web: upright, right-handed, and in the right colour from where they are seen."""

import npm_packages
import numpy as np
import pytest
from web import probe
from web.viewers import CHROMIUM, VIEWERS, chromium, photograph, write_probe

from beam_warp import rasterize

pytest.importorskip("playwright.sync_api")

needs_a_browser = pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed (set BEAM_CHROMIUM)")

CLOSE = 2.0
"""Largest distance of a ball's middle from where it must be [pixel]. A ball's standard deviation is 6 to 9, the nearest
two balls are 70 apart, and a mirrored or upturned tripod is off by 40."""

ALIKE = 0.06
"""Largest error of the fifth ball's colour: of five bits of harmonics, as SPZ has them. An axis that is flipped for the
directions and not for the harmonics, or the reverse, changes a channel by 0.19 at least."""


@pytest.fixture(scope="module")
def browser():
    try:
        npm_packages.packages()
    except npm_packages.MissingPackagesError as error:
        pytest.skip(f"viewers cannot be had: {error}")
    with chromium() as opened:
        yield opened


def test_the_camera_separates_the_balls_and_a_mirrored_or_upturned_tripod_is_told():
    places = np.array(list(probe.pixels().values()))
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert gaps[gaps > 0].min() > 60.0
    assert ((places > 20) & (places < probe.SIDE - 20)).all()
    for flip in np.vstack([1 - 2 * np.eye(3), 2 * np.eye(3) - 1]):
        mirrored = probe.camera().project(np.array([place for place, _ in probe.BALLS.values()]) * flip)[:, :2]
        assert np.linalg.norm(mirrored - places, axis=1).max() > 20 * CLOSE
    turns = np.abs(0.8 * (probe.MOOD_RING - probe.EYE) / np.linalg.norm(probe.MOOD_RING - probe.EYE))
    assert turns.min() > 3 * ALIKE


def test_balls_are_found_where_our_own_rasteriser_draws_them():
    seen = rasterize(probe.tripod(), probe.camera(), channels=["radiance"], device="cpu")
    display = seen.channels["radiance"] * seen.alpha[..., None] + probe.BACKGROUND * (1.0 - seen.alpha[..., None])
    picture = np.rint(255.0 * np.clip(display, 0.0, 1.0)).astype(np.uint8)
    assert max(probe.shifts(picture).values()) < CLOSE
    assert probe.color_error(picture, harmonics=True) < 0.01


@pytest.mark.slow
@needs_a_browser
@pytest.mark.parametrize(
    ("name", "ending"), [(name, ending) for name, viewer in VIEWERS.items() for ending in viewer.endings()]
)
def test_a_viewer_shows_what_is_written_for_it_as_it_is(name, ending, browser, tmp_path):
    picture = photograph(browser, VIEWERS[name], write_probe(tmp_path, VIEWERS[name], ending))
    shifts = probe.shifts(picture)
    assert max(shifts.values()) < CLOSE, shifts
    if ending not in VIEWERS[name].colors_wrong:
        assert probe.color_error(picture, harmonics=ending != ".splat") < ALIKE
