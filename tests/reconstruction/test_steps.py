"""The steps of a frame: tracked frames are drawn as their key frame, and tracks come back from their arrays."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from support.moving_ball import ball_views, rig

from beam_warp.jobs.listeners import no_progress
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.fit import FitOptions, fit_gaussians
from beam_warp.reconstruction.joint_tracking import JointOptions
from beam_warp.reconstruction.steps import FitAndTrack
from beam_warp.reconstruction.track import TrackOptions
from beam_warp.world.environment import EnvironmentMap

FITTING = FitOptions(gaussian_count=80, color_iterations=0, normal_iterations=12, refine_every=0, samples=1)

TRACKING = TrackOptions(
    joints=JointOptions(levels=(1,), iterations=(2,)),
    refinement=replace(TrackOptions().refinement, normal_iterations=2),
)


@pytest.mark.parametrize("changes", [{}, {"samples": 2}, {"raster": RasterOptions()}])
def test_a_track_begins_where_its_key_frame_ended(device, changes):
    """The same views of the same Gaussians, drawn in the same way: the same PSNR."""
    steps = FitAndTrack(fitting=replace(FITTING, **changes), tracking=TRACKING, device=device)
    track, report = steps.begin(ball_views(rig(3)), no_progress)
    assert track.baseline[0] == pytest.approx(report["psnr"], abs=1e-3)


def test_a_frame_follows_from_arrays(device):
    steps, views = FitAndTrack(fitting=FITTING, tracking=TRACKING, device=device), ball_views(rig(3))
    track, _ = steps.begin(views, no_progress)
    ends = [steps.advance(begin, views, no_progress)[0] for begin in (track, steps.restore(track.arrays()))]
    for one, other in zip(*(end.arrays().values() for end in ends), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_exposures_are_compared_where_the_frame_begins(monkeypatch):
    """The same images are fitted once, others again; what is kept does not go to another process."""
    fits = []

    def counted(views, *args, **more):
        fits.append(views)
        return fit_gaussians(views, *args, **more)

    monkeypatch.setattr("beam_warp.reconstruction.steps.fit_gaussians", counted)
    steps = FitAndTrack(
        fitting=FITTING, tracking=TRACKING, environment=EnvironmentMap.constant([1.0] * 3), device="cpu"
    )
    views = ball_views(rig(6))
    steps.find_exposures([str(number) for number in range(6)], views, no_progress)
    there = pickle.loads(pickle.dumps(steps))
    kept, _ = steps.begin(views, no_progress)
    assert len(fits) == 1
    for track in (steps.begin(views, no_progress)[0], there.begin(views, no_progress)[0]):
        np.testing.assert_array_equal(track.cloud.positions, kept.cloud.positions)
    assert len(fits) == 3
    assert steps.find_exposures(list("abc"), views[:3], no_progress) is None
    assert len(fits) == 3


@pytest.mark.parametrize(
    ("masked", "lit", "reflects"), [(True, True, True), (True, False, False), (False, True, False)]
)
def test_key_frames_of_masked_photographs_reflect_the_light(monkeypatch, masked, lit, reflects):
    """What lies around a subject without masks does not see the same environment."""
    lights = []

    def noted(views, *args, environment, **more):
        lights.append(environment)
        return fit_gaussians(views, *args, environment=environment, **more)

    monkeypatch.setattr("beam_warp.reconstruction.steps.fit_gaussians", noted)
    light = EnvironmentMap.constant([1.0] * 3) if lit else None
    views = ball_views(rig(6), with_alpha=masked)
    FitAndTrack(fitting=FITTING, tracking=TRACKING, environment=light, device="cpu").begin(views, no_progress)
    assert lights == [light if reflects else None]
