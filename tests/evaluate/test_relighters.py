"""Relighters: every name makes a renderer, and the deferred one draws as it is told."""

import numpy as np
import pytest
from support.figure_asset import figure_asset

from beam_warp.evaluate import relighters
from beam_warp.evaluate.relighters import RELIGHTERS
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.shot import Shot

RASTER = RasterOptions(antialiased=True, low_pass=0.1)


@pytest.fixture(scope="module")
def shot():
    cloud = figure_asset(frame_count=1)[0]
    camera = Camera.frame_cloud(cloud.positions, azimuth=70.0, width=20, height=30)
    return Shot(cloud=cloud, camera=camera, environment=EnvironmentMap.constant((0.5, 0.7, 0.9)))


@pytest.mark.parametrize("name", RELIGHTERS)
def test_every_relighter_makes_a_renderer(shot, device, name, monkeypatch):
    monkeypatch.setattr(relighters, "PATHS_PER_PIXEL", 4)
    image = RELIGHTERS[name](RASTER, 1, device).draw(shot)
    assert image.rgb.shape == (30, 20, 3)
    assert np.isfinite(image.rgb).all()
    assert image.rgb[image.alpha == 0.0].max(initial=0.0) == 0.0


def test_the_deferred_one_draws_splats_and_samples_as_it_is_told(shot, device):
    found = RELIGHTERS["deferred"](RASTER, 2, device).draw(shot)
    expected = DeferredRenderer(DeferredOptions(samples=2), raster=RASTER, device=device).draw(shot)
    np.testing.assert_array_equal(found.rgb, expected.rgb)
    np.testing.assert_array_equal(found.alpha, expected.alpha)
