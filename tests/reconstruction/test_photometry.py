"""Exposures told from gloss: exact for matte points, within their errors for glossy ones, nothing where none is off."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from beam_warp.capture.exposures import RigExposures
from beam_warp.light.ggx import specular_albedo
from beam_warp.light.prefiltered import LEVEL_ROUGHNESS
from beam_warp.reconstruction import photometry
from beam_warp.reconstruction.initial import initial_gaussians
from beam_warp.reconstruction.photometry import (
    LEVELS,
    MATTE_ERRORS,
    MODEL_ERRORS,
    SolvedGains,
    find_exposures,
    highlights,
    judged,
    may_compare,
    smoothed,
    smoothest,
    solve_gains,
)
from beam_warp.world.environment import EnvironmentMap

VIEWS, POINTS = 12, 600
AXIAL = np.ones((VIEWS, POINTS))
MEAN, REST = np.full((3, 1), 1.0 / 3.0), np.eye(3) - 1.0 / 3.0


def drawn_gains(rng, stops, balance):
    """Logarithms of gains up to so many stops, and up to so much of red and blue, of mean 0."""
    logs = np.log(2.0) * stops * rng.permutation(np.linspace(-1.0, 1.0, VIEWS))[:, None] * np.ones(3)
    for hue in (0, 2):
        logs[:, hue] += balance * rng.permutation(np.linspace(-1.0, 1.0, VIEWS))
    return logs - logs.mean(axis=0)


@pytest.fixture
def lit(rng):
    """Points of a ball under a sky with a window, each of one roughness, seen by cameras around: colours, gloss."""
    radiance = np.full((32, 64, 3), 0.3) * [0.8, 0.9, 1.1]
    radiance[8:14, 10:20] = [12.0, 11.0, 9.0]
    normals = rng.normal(size=(POINTS, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angles = 2.0 * np.pi * np.arange(VIEWS) / VIEWS
    heights = np.where(np.arange(VIEWS) % 2, 0.1, 0.6)
    away = np.stack([np.cos(angles), np.sin(angles), heights], axis=1)
    away = np.broadcast_to((away / np.linalg.norm(away, axis=1, keepdims=True))[:, None], (VIEWS, POINTS, 3))
    gloss = highlights(normals, away, EnvironmentMap(radiance.astype(np.float32)), "cpu")
    shine = gloss[:, np.arange(POINTS), :, rng.integers(len(LEVELS), size=POINTS)].transpose(1, 0, 2)
    cosine = (away * normals).sum(axis=2)
    weights = np.where(cosine > 0.2, cosine**2, 0.0)
    diffuse = rng.uniform(0.05, 0.6, (POINTS, 1)) * rng.uniform(0.7, 1.0, (POINTS, 3))
    return diffuse, shine * rng.uniform(0.3, 1.0, (POINTS, 1)), weights, gloss


def seen(colors, weights, logs):
    return np.dstack([colors * np.exp(logs)[:, None], weights])


def error_of(found, true, what):
    return float(np.sqrt(np.mean(np.square((found - true) @ what))))


def test_gains_of_matte_points_are_exact(lit, rng):
    diffuse, _, weights, gloss = lit
    logs = drawn_gains(rng, 0.2, 0.05)
    colors = np.broadcast_to(diffuse, (VIEWS, POINTS, 3))
    solved = solve_gains(seen(colors, weights, logs), np.zeros_like(gloss), AXIAL)
    np.testing.assert_allclose(solved.logs, logs, atol=1e-4)
    assert solved.error(np.eye(3)) < 1e-4
    found = judged([str(view) for view in range(VIEWS)], solved)
    np.testing.assert_allclose(np.log([camera.gains for camera in found.cameras]), logs, atol=2e-4)


def test_gloss_is_told_from_gains(lit, rng):
    """Gains are found several times as well as by a model without gloss, and within a few stated errors."""
    diffuse, shine, weights, gloss = lit
    logs = drawn_gains(rng, 0.2, 0.05)
    solved = solve_gains(seen(diffuse + shine, weights, logs), gloss, AXIAL)
    matte = solved.logs - 2.0 * solved.gloss
    for what in (MEAN, REST):
        assert error_of(solved.logs, logs, what) < 0.5 * error_of(matte, logs, what)
        assert error_of(solved.logs, logs, what) < 2.0 * solved.error(what)
    assert solved.may_be_wrong()
    found = judged([str(view) for view in range(VIEWS)], solved)
    undone = np.log([camera.gains for camera in found.cameras])
    assert found.exposure_undone
    assert found.balance_undone
    assert error_of(undone - undone.mean(axis=0), logs, MEAN) < 0.02
    assert error_of(undone - undone.mean(axis=0), logs, REST) < 0.02


def test_sound_views_stay_to_the_bit(lit):
    diffuse, shine, weights, gloss = lit
    solved = solve_gains(seen(diffuse + shine, weights, np.zeros((VIEWS, 3))), gloss, AXIAL)
    assert not solved.may_be_wrong()
    found = judged([str(view) for view in range(VIEWS)], solved)
    assert (found.exposure_undone, found.balance_undone) == (False, False)
    assert {camera.gains for camera in found.cameras} == {(1.0, 1.0, 1.0)}


@pytest.mark.parametrize(("size", "is_undone"), [(1.3, False), (4.0, True)])
def test_what_a_wrong_surface_shows_is_no_exposure(rng, size, is_undone):
    """Halves of the points agree on it, however many there are: only what is larger by far is undone, and all of it."""
    logs = drawn_gains(rng, 1.0, 0.0)
    logs *= size * MODEL_ERRORS.exposure / np.sqrt(np.mean(np.square(logs)))
    found = judged([str(view) for view in range(VIEWS)], SolvedGains(logs, np.zeros_like(logs), np.zeros_like(logs)))
    assert found.exposure_undone == is_undone
    np.testing.assert_allclose(np.log([camera.gains for camera in found.cameras]), is_undone * logs, atol=1e-12)


def test_each_is_judged_by_its_own_evidence(lit, rng):
    diffuse, shine, weights, gloss = lit
    logs = drawn_gains(rng, 0.2, 0.0)
    found = judged([str(v) for v in range(VIEWS)], solve_gains(seen(diffuse + shine, weights, logs), gloss, AXIAL))
    assert (found.exposure_undone, found.balance_undone) == (True, False)
    for camera in found.cameras:
        np.testing.assert_allclose(camera.gains, camera.gains[0], rtol=1e-12)


def test_points_are_compared_where_the_surface_is_told(rng):
    """The upper half of a ball has normals that scatter, its lowest part none."""
    true = rng.normal(size=(20_000, 3))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    is_rough = true[:, 2] > 0.0
    normals = true + np.where(is_rough, 0.5, 0.02)[:, None] * rng.normal(size=true.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[true[:, 2] < -0.9] = 0.0
    mean, agreement = smoothed(true, normals)
    agreement[::7] = 0.0
    rows = smoothest(agreement)
    assert len(rows) == round(0.25 * (agreement > 0.0).sum())
    assert is_rough[rows].mean() < 0.01
    assert true[rows, 2].min() > -0.95
    assert np.degrees(np.arccos((mean[rows] * true[rows]).sum(axis=1))).max() < 4.0
    assert len(smoothest(agreement[:1500])) == (agreement[:1500] > 0.0).sum()


def test_more_points_tell_gains_better(lit, rng):
    """Eight times as many points of the same noise: about a third of the error."""
    diffuse, _, weights, gloss = lit
    logs = drawn_gains(rng, 0.2, 0.05)
    noise = 1.0 + 0.05 * rng.normal(size=(VIEWS, POINTS, 3))
    few, all_of_them = (
        solve_gains(seen(diffuse * noise, weights, logs), gloss, AXIAL, most) for most in (POINTS // 8, POINTS)
    )
    assert error_of(all_of_them.logs, logs, np.eye(3)) < 0.6 * error_of(few.logs, logs, np.eye(3))


def test_a_view_that_shares_nothing_says_nothing(lit, rng):
    diffuse, shine, weights, gloss = lit
    weights = weights * (np.arange(VIEWS) > 0)[:, None]
    solved = solve_gains(seen(diffuse + shine, weights, np.zeros((VIEWS, 3))), gloss, AXIAL)
    np.testing.assert_array_equal(solved.logs[0], 0.0)
    assert solve_gains(seen(diffuse, 0.0 * weights, np.zeros((VIEWS, 3))), gloss, AXIAL) is None


def test_a_view_that_sees_next_to_nothing_has_no_gain(lit, rng):
    """Three points in the shadow would drive its gain to 0, where all that is known of it vanishes."""
    diffuse, shine, weights, gloss = lit
    weights = weights * (np.arange(VIEWS)[:, None] > 0)
    expected = solve_gains(seen(diffuse + shine, weights, np.zeros((VIEWS, 3))), gloss, AXIAL)
    few = np.argsort(-diffuse.sum(axis=1))[:3]
    weights[0, few] = 1.0
    colors = seen(diffuse + shine, weights, np.zeros((VIEWS, 3)))
    colors[0, few, :3] *= rng.uniform(1e-4, 1e-2, (3, 3))
    solved = solve_gains(colors, gloss, AXIAL)
    np.testing.assert_array_equal(solved.logs[0], 0.0)
    np.testing.assert_allclose(solved.logs, expected.logs, atol=1e-3)
    assert solved.error(np.eye(3)) < 2.0 * expected.error(np.eye(3)) < 0.1


@pytest.mark.parametrize("size", [0.02, 0.25])
def test_without_a_light_only_what_gloss_does_not_explain_is_undone(lit, rng, size):
    diffuse, shine, weights, gloss = lit
    logs = drawn_gains(rng, 1.0, 0.0)
    logs *= size / np.sqrt(np.mean(np.square(logs)))
    solved = solve_gains(seen(diffuse + 0.3 * shine, weights, logs), gloss[..., :0], AXIAL)
    found = judged([str(view) for view in range(VIEWS)], solved)
    assert found.exposure_undone == (size > MATTE_ERRORS.exposure)
    assert not found.balance_undone
    assert error_of(solved.logs, logs, MEAN) < MATTE_ERRORS.exposure


@pytest.mark.parametrize("power", [0.0, 4.0])
def test_vignetting_is_told_from_gains_and_gloss(lit, rng, power):
    """One power for the rig: found to half of one beside gains, undone only where there is some, and never negative."""
    diffuse, shine, weights, gloss = lit
    logs = drawn_gains(rng, 0.2, 0.05)
    cosines = np.cos(np.radians(rng.uniform(0.0, 20.0, (VIEWS, POINTS))))
    colors = seen((diffuse + shine) * cosines[..., None] ** power, weights, logs)
    assert solve_gains(colors, gloss, cosines).may_vignette == (power > 0.0)
    solved = solve_gains(colors, gloss, cosines, vignetting=True)
    assert solved.vignettes == (power > 0.0)
    assert abs(solved.falloff - power) < 0.5
    assert error_of(solved.logs, logs, np.eye(3)) < 0.02
    found = judged([str(view) for view in range(VIEWS)], solved)
    assert [finding.code for finding in found.findings()].count("vignetting") == (power > 0.0)
    assert RigExposures.from_dict(found.as_dict()) == found
    brighter = solve_gains(seen((diffuse + shine) * cosines[..., None] ** -4.0, weights, logs), gloss, cosines)
    assert not brighter.may_vignette


def test_vignetting_of_matte_points_is_exact(lit, rng):
    diffuse, _, weights, gloss = lit
    cosines = np.cos(np.radians(rng.uniform(0.0, 20.0, (VIEWS, POINTS))))
    colors = seen(diffuse * cosines[..., None] ** 4.0, weights, np.zeros((VIEWS, 3)))
    solved = solve_gains(colors, np.zeros_like(gloss), cosines, vignetting=True)
    np.testing.assert_allclose(solved.falloff, 4.0, atol=0.01)
    np.testing.assert_allclose(solved.logs, 0.0, atol=1e-4)


def test_a_uniform_light_is_mirrored_as_the_albedo_says():
    tilts = np.radians([10.0, 45.0, 75.0, 120.0])
    normals = np.stack([np.sin(tilts), 0.0 * tilts, np.cos(tilts)], axis=1)
    away = np.broadcast_to([0.0, 0.0, 1.0], (1, 4, 3))
    found = highlights(normals, away, EnvironmentMap.constant([1.0, 2.0, 3.0]), "cpu")
    for kind, level in enumerate(LEVELS):
        albedo = specular_albedo(np.cos(tilts[:3]), LEVEL_ROUGHNESS[level])
        np.testing.assert_allclose(found[0, :3, :, kind], albedo[:, None] * [1.0, 2.0, 3.0], rtol=5e-3)
    np.testing.assert_array_equal(found[0, 3], 0.0)


def test_a_sound_capture_is_left_alone(tiny_capture, monkeypatch):
    """The points are those of the visual hull here, for a fit takes long; of six cameras few see one of them."""
    monkeypatch.setattr(photometry, "LEAST_VIEWS", 2)
    records = tiny_capture.select(split="train", frames=[0])
    views, names = [record.view() for record in records], [record.camera_name for record in records]
    hull = initial_gaussians(views, 1000, device="cpu")
    outward = Rotation.from_quat(hull.orientations).apply([0.0, 0.0, 1.0])
    light = EnvironmentMap.read(tiny_capture.environment_path)
    found = find_exposures(names, views, hull, outward, light, device="cpu")
    assert [camera.camera for camera in found.cameras] == names
    assert found.findings() == []
    assert may_compare(views)
    assert not may_compare(views[:5])
    assert not may_compare([*views[1:], replace(views[0], alpha=None)])
