"""Pictures of the web renderer: those of the deferred renderer, and the same on WebGPU and WebGL2."""

import numpy as np
import pytest
from engines.probes import ENVIRONMENTS, PROBES, REGIONS, goldens
from engines.web.pages import GREY, drawing_pages, drawn
from web.viewers import CHROMIUM

from beam_warp.image.metrics import psnr
from beam_warp.image.tone import display_over

pytest.importorskip("playwright.sync_api")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium is installed (set BEAM_CHROMIUM)"),
]

LEAST = {"figure": 38.0}
"""Least agreement of a probe with the deferred renderer [dB], over grey."""


@pytest.fixture(scope="module")
def stands():
    """What pages may fetch, and a page with a renderer for each backend, which keeps its environments."""
    with drawing_pages() as found:
        yield found


@pytest.mark.parametrize("name", list(PROBES))
def test_a_probe_looks_as_the_deferred_renderer_draws_it_on_both_backends(name, stands, tmp_path):
    for golden in goldens([name]):
        check(golden, stands, tmp_path)


@pytest.mark.parametrize("name", list(PROBES))
def test_regions_of_an_environment_cast_the_deferred_renderer_s_shadows(name, stands, tmp_path):
    for golden in goldens([name], ENVIRONMENTS, REGIONS):
        check(golden, stands, tmp_path)


def check(golden, stands, folder):
    """Fail unless both backends draw a case as the deferred renderer does, and alike."""
    name = golden.probe
    truth = display_over(golden.image.rgb, np.minimum(golden.image.alpha, 1.0), background=GREY)
    pictures = {}
    for backend, lit, picture in drawn(golden, stands, folder):
        shown = display_over(np.maximum(lit[..., :3], 0.0), np.clip(lit[..., 3], 0.0, 1.0), background=GREY)
        off_by_one = np.abs(shown.astype(int) - picture[..., :3]).max()
        assert off_by_one <= 1, "the display pass is the view transform of beam_warp"
        pictures[backend] = picture[..., :3].astype(int)
        found = psnr(truth / 255.0, picture[..., :3] / 255.0)
        assert found >= LEAST.get(name, 40.0), (golden.lighting, backend, found)
    apart = np.abs(pictures["webgl2"] - pictures["webgpu"]).max(axis=-1)
    assert (apart <= 1).mean() >= 0.999, golden.lighting
