"""The part of an image that is drawn: it holds every splat, and looks as it does in the whole image."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.shapes import aligned, random_cloud

from beam_warp.raster.drawn_part import REACH, STEPS, ImagePart, drawn_part
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera

OPTIONS = RasterOptions()
ACROSS = Camera.orbit((0.0, 0.0, 0.0), 4.0, 0.0, 0.0, width=160, height=96, vertical_fov=40.0)
WHOLE = ImagePart(0, 0, 160, 96)


def test_one_ball_in_the_middle():
    cloud = aligned([[0.0, 0.0, 0.0]], scales=0.05)
    part = drawn_part(cloud, ACROSS, OPTIONS)
    deviation = np.hypot(ACROSS.focal_x * 0.05 / 4.0, np.sqrt(OPTIONS.low_pass))
    for start, size, side in ((part.left, part.width, 160), (part.top, part.height, 96)):
        step = side // STEPS
        assert start <= side / 2 - REACH * deviation < start + step
        assert size % step == 0
        assert start + size >= side / 2 + REACH * deviation


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), samples=st.sampled_from([1, 2]), azimuth=st.floats(-180.0, 180.0))
def test_it_holds_all_that_the_whole_image_shows(seed, samples, azimuth):
    rng = np.random.default_rng(seed)
    cloud = random_cloud(rng, 30)
    cloud = replace(cloud, positions=0.2 * cloud.positions + rng.uniform(-0.3, 0.3, 3).astype(np.float32))
    camera = Camera.orbit((0.0, 0.0, 0.0), 6.0, azimuth, 20.0, width=80, height=64, vertical_fov=50.0)
    part = drawn_part(cloud, camera, OPTIONS)
    whole = rasterize(cloud, camera.supersampled(samples), channels=(), options=OPTIONS, device="cpu")
    own = rasterize(cloud, camera.cropped(*part).supersampled(samples), channels=(), options=OPTIONS, device="cpu")
    fine, place = camera.supersampled(samples), ImagePart(*(samples * number for number in part))
    np.testing.assert_allclose(place.placed(own.alpha, fine), whole.alpha, atol=2e-5)


@pytest.mark.parametrize(
    "position",
    [(1.0, 0.0, 2.1), (0.0, -3.9, 0.0), (0.0, -40.0, 0.0)],
    ids=["beyond the edge", "at the camera", "behind it"],
)
def test_otherwise_all_is_drawn(position):
    cloud = aligned([[0.0, 0.0, 0.0]], scales=0.05)
    strays = aligned([position], scales=0.5)
    both = replace(
        cloud, **{name: np.concatenate([array, getattr(strays, name)]) for name, array in cloud.arrays().items()}
    )
    is_behind = position[1] < -4.0
    assert drawn_part(strays, ACROSS, OPTIONS) == WHOLE
    assert (drawn_part(both, ACROSS, OPTIONS) == WHOLE) != is_behind


def test_channels_lie_where_they_were():
    image = np.arange(12.0, dtype=np.float32).reshape(2, 3, 2)
    whole = ImagePart(4, 1, 3, 2).placed(image, ACROSS)
    assert whole.shape == (96, 160, 2)
    np.testing.assert_array_equal(whole[1:3, 4:7], image)
    assert whole.sum() == image.sum()
