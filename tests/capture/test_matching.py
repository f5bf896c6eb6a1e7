"""Which frame of an asset shows which frame of a capture: stated, given or counted, and what is refused."""

import numpy as np
import pytest
from support.shapes import aligned

from beam_warp.capture.matching import match_frames, scored_frames
from beam_warp.errors import InvalidOptionError
from beam_warp.world.gaussians import GaussianSequence


def sequence(frame_count, **metadata):
    return GaussianSequence.from_clouds([aligned(np.zeros((1, 3)))] * frame_count, metadata=metadata)


def test_frames_are_counted_stated_or_given():
    assert match_frames(sequence(3)) == {0: 0, 1: 1, 2: 2}
    stated = sequence(3, capture_frames="4 0 9")
    assert match_frames(stated) == {4: 0, 0: 1, 9: 2}
    assert match_frames(stated, (1, 2, 3)) == {1: 0, 2: 1, 3: 2}


@pytest.mark.parametrize(
    ("stated", "given", "said"),
    [
        ("0 1", None, "capture_frames must be a number for each of 3 frames, got 2"),
        ("0 2 2", None, "capture-frames must name each frame of the capture once, got 0 2 2"),
        ("0 1 2", (0, 1), "one number for each of 3 frames of the asset, got 2"),
    ],
)
def test_numbers_that_are_none_are_refused(stated, given, said):
    with pytest.raises(InvalidOptionError, match=said):
        match_frames(sequence(3, capture_frames=stated), given)


def test_frames_with_truth_that_are_shown(tiny_capture):
    assert scored_frames(tiny_capture, {1: 0, 7: 1}) == (1,)
    assert scored_frames(tiny_capture, {0: 0, 1: 1}) == (0, 1)
    many = {frame: frame - 10 for frame in range(10, 20)}
    with pytest.raises(InvalidOptionError, match=r"\(0, 1\), got one of the frames 10, 11, 12, 13, …, 19\. Say with"):
        scored_frames(tiny_capture, many)
    with pytest.raises(InvalidOptionError, match="whose train views have exact channels, got none"):
        scored_frames(tiny_capture, {0: 0}, split="train")
