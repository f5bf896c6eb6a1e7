"""Relighters: all behind one call; the deferred one is the deferred renderer."""

import numpy as np
import pytest
from support.figure_asset import figure_asset

from beam_warp.evaluate.relighters import RELIGHTERS, DeferredRelighter
from beam_warp.light.prefiltered import EnvironmentLighting
from beam_warp.raster.records import RasterOptions
from beam_warp.render import arriving
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.shot import Shot

LIGHT = EnvironmentMap.constant((0.5, 0.7, 0.9))
RASTER = RasterOptions(antialiased=True, low_pass=0.1)


@pytest.fixture(scope="module")
def cloud():
    return figure_asset(frame_count=1)[0]


def cameras(cloud, count):
    size = {"width": 20, "height": 30}
    return [Camera.frame_cloud(cloud.positions, azimuth=70.0 * index, **size) for index in range(count)]


def test_every_relighter_can_be_made_and_called(cloud, device):
    for make in RELIGHTERS.values():
        images = make()(cloud, LIGHT, cameras(cloud, 2), raster=RASTER, samples=1, device=device)
        assert [image.rgb.shape for image in images] == [(30, 20, 3)] * 2
        for image in images:
            assert np.isfinite(image.rgb).all()
            assert image.rgb[image.alpha == 0.0].max(initial=0.0) == 0.0


def test_deferred_is_what_the_renderer_draws(cloud, device):
    views = cameras(cloud, 2)
    options = DeferredOptions(samples=2)
    found = DeferredRelighter()(cloud, LIGHT, views, raster=RASTER, samples=2, device=device)
    for image, camera in zip(found, views, strict=True):
        shot = Shot(cloud=cloud, camera=camera, environment=LIGHT)
        expected = DeferredRenderer(options, raster=RASTER, device=device).draw(shot)
        np.testing.assert_array_equal(image.rgb, expected.rgb)
        np.testing.assert_array_equal(image.alpha, expected.alpha)


def test_a_light_is_made_ready_once(cloud, monkeypatch):
    made = []
    usual = EnvironmentLighting.from_environment

    class Counting:
        @staticmethod
        def from_environment(environment, *, device):
            made.append(environment)
            return usual(environment, device=device)

    monkeypatch.setattr(arriving, "EnvironmentLighting", Counting)
    deferred = DeferredRelighter()
    for _ in range(2):
        deferred(cloud, LIGHT, cameras(cloud, 1), raster=RASTER, samples=1, device="cpu")
    assert made == [LIGHT]
