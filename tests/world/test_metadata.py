"""What metadata say of drawing and of frames: there and back, fallbacks, and what is refused."""

import pytest

from beam_warp.errors import InvalidOptionError
from beam_warp.raster.records import RasterOptions
from beam_warp.world.metadata import (
    UNSTATED_RASTER,
    capture_frames_metadata,
    numbers_of_frames,
    stated_capture_frames,
    stated_raster,
)


@pytest.mark.parametrize(("antialiased", "low_pass"), [(True, 0.1), (False, 1e-4), (True, 12.5)])
def test_options_survive(antialiased, low_pass):
    options = RasterOptions(antialiased=antialiased, low_pass=low_pass)
    assert RasterOptions.from_metadata(options.as_metadata()) == options


def test_filters_are_stated_as_text_and_near_and_depth_are_not():
    stated = RasterOptions(antialiased=True, low_pass=0.1, near=2.0, depth="exact").as_metadata()
    assert stated == {"raster_antialiased": "true", "raster_low_pass": "0.1"}


def test_nothing_stated_is_the_default():
    assert stated_raster({"producer": "somebody"}) is None
    assert RasterOptions.from_metadata({}) == RasterOptions()
    assert UNSTATED_RASTER == (False, 0.3)  # a part of the format: SPEC.md says so
    assert stated_raster({"raster_antialiased": "true"}) == (True, 0.3)
    assert stated_raster({"raster_low_pass": "0.1"}) == (False, 0.1)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"raster_antialiased": "yes"}, r"raster_antialiased must be one of true, false, got 'yes'"),
        ({"raster_low_pass": "wide"}, r"raster_low_pass must be a number in .*, got 'wide'"),
        ({"raster_low_pass": "0"}, r"raster_low_pass must be a number in .*, got '0'"),
    ],
)
def test_filters_that_are_none_are_refused(stated, message):
    with pytest.raises(InvalidOptionError, match=message):
        RasterOptions.from_metadata(stated)


@pytest.mark.parametrize("frames", [(0,), (3, 5, 1), tuple(range(1000, 1300))])
def test_frames_survive(frames):
    assert stated_capture_frames(capture_frames_metadata(frames), len(frames)) == frames


def test_frames_may_be_unstated():
    assert stated_capture_frames({}, 3) is None
    assert numbers_of_frames({}, 3) == (0, 1, 2)
    assert numbers_of_frames({"capture_frames": "4 7 9"}, 3) == (4, 7, 9)


@pytest.mark.parametrize("text", ["0", "0 1 2", "0 -1", "0 1.0", "0 ²"])
def test_frames_that_do_not_fit_are_refused(text):
    with pytest.raises(InvalidOptionError, match="capture_frames must be a number for each of 2 frames, got"):
        stated_capture_frames({"capture_frames": text}, 2)
