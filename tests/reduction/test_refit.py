"""Refits: views are drawn again without waiting, with as much room as their splats take."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from reduction.test_job import LIGHTS, QUICK, ball
from scipy.spatial.transform import Rotation

from beam_warp.device.arrays import resolve_device
from beam_warp.reduction import refit as module
from beam_warp.reduction import sensitivity
from beam_warp.reduction.job import Reducer
from beam_warp.reduction.refit import _Refit, refit
from beam_warp.world.clusters import Clusters
from beam_warp.world.gaussians import GaussianSequence


@pytest.fixture(params=["cpu", "cuda"])
def merged(request):
    """A reducer and what it merges, on each device that is there."""
    if request.param == "cuda" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    reducer = Reducer(ball(), LIGHTS, replace(QUICK, height=64, device=request.param))
    cloud = Clusters(ball()[0], reducer._order.labels(60), reducer.sensitivity.visible).cloud(ball()[0])
    return reducer, cloud


def squares(forms):
    """Forms of 9 x 9 from their lower triangles."""
    rows, columns = np.tril_indices(9)
    whole = np.zeros((len(forms), 9, 9))
    whole[:, rows, columns] = whole[:, columns, rows] = forms
    return whole


def test_forms_leave_no_change_of_a_pixel_free(monkeypatch):
    """A pixel's form of two lights alone is singular; with the mean of all as a third one it is not. Occlusion below 1
    has room to rise, so that images depend on it."""
    shaded = GaussianSequence.from_clouds([ball()[0].with_arrays(ambient_occlusion=np.full(300, 0.8))])
    blended = Reducer(shaded, LIGHTS, QUICK).sensitivity
    monkeypatch.setattr(sensitivity, "MEAN_LIGHTS", 0.0)
    alone = Reducer(shaded, LIGHTS, QUICK).sensitivity
    forms = [np.concatenate([view.forms.numpy() for view in each.views]) for each in (blended, alone)]
    least = [np.linalg.eigvalsh(squares(each))[:, 0] for each in forms]
    assert np.abs(least[1]).max() < 1e-6
    assert least[0].min() > 1e-5
    np.testing.assert_allclose(forms[0].mean(axis=0), forms[1].mean(axis=0), rtol=1e-3, atol=1e-6)


def slopes_of(work: _Refit, view: int) -> list[np.ndarray]:
    work.differentiate(view)
    return [array.numpy().copy() for array in work.slopes]


def test_splats_that_outgrow_their_room_are_noticed_and_get_more(merged):
    reducer, cloud = merged
    device = resolve_device(reducer.options.device)
    work = _Refit({0: (cloud, Rotation.identity(len(cloud)))}, reducer.sensitivity, reducer.raster, device)
    assert work.lacks_room()
    work.make_room()
    assert not work.lacks_room()
    work.changes[2].fill_(wp.vec3(1.5, 1.5, 1.5))
    cut = slopes_of(work, 0)
    assert work.lacks_room()
    work.make_room()
    whole = slopes_of(work, 0)
    assert not work.lacks_room()
    assert not all(np.array_equal(*pair) for pair in zip(cut, whole, strict=True))
    fresh = _Refit({0: (cloud, Rotation.identity(len(cloud)))}, reducer.sensitivity, reducer.raster, device)
    fresh.changes[2].fill_(wp.vec3(1.5, 1.5, 1.5))
    fresh.make_room()
    for ours, theirs in zip(whole, slopes_of(fresh, 0), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_recorded_steps_give_the_bits_of_those_that_are_taken_one_by_one(merged, monkeypatch):
    reducer, cloud = merged
    how = {"steps": 24, "raster": reducer.raster, "device": reducer.options.device}
    frames = {0: (cloud, Rotation.identity(len(cloud)))}
    recorded = refit(frames, reducer.sensitivity, **how)
    monkeypatch.setattr(module.StepGraphs, "run", lambda _, key, step: step())
    taken = refit(frames, reducer.sensitivity, **how)
    for ours, theirs in zip(vars(recorded).values(), vars(taken).values(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
