"""Silhouettes of one subject agree; those of another one, or from elsewhere, are told."""

from dataclasses import replace

import numpy as np
import pytest
from support.moving_ball import ball_views, rig

from beam_warp.capture.silhouettes import contradicting


@pytest.fixture(scope="module")
def views():
    return ball_views(rig(9, 48))


def test_silhouettes_of_one_subject_agree(views):
    assert not contradicting(views).any()


def test_a_cropped_subject_contradicts_nothing(views):
    cropped = [replace(view, camera=view.camera) for view in views]
    cropped[2] = views[2].cropped(0, 0, 48, 24)
    assert not contradicting(cropped).any()


@pytest.mark.parametrize("wrong", [[3], [0, 5]])
def test_silhouettes_of_another_subject_are_told(views, wrong):
    others = ball_views(rig(9, 48), center=(0.0, 0.0, 0.45))
    mixed = [others[k] if k in wrong else view for k, view in enumerate(views)]
    np.testing.assert_array_equal(np.flatnonzero(contradicting(mixed)), wrong)


def test_empty_silhouettes_contradict_and_alone_they_say_nothing(views):
    empty = [replace(view, alpha=np.zeros((48, 48), np.float32)) for view in views]
    np.testing.assert_array_equal(np.flatnonzero(contradicting([*views[:8], empty[8]])), [8])
    assert not contradicting(empty).any()
