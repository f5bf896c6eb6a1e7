"""Merged Gaussians keep the moments of their members, and move as these do."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from beam_warp.reduction.changes import Changes, changed
from beam_warp.world.clusters import Clusters, optical_mass
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import rotation_matrices


def random_cloud(rng: np.random.Generator, count: int, opacity: float) -> GaussianCloud:
    """Gaussians of any shape, some metres apart, with all materials."""
    normals = rng.normal(size=(count, 3))
    return GaussianCloud(
        positions=rng.normal(size=(count, 3)),
        orientations=Rotation.random(count, random_state=int(rng.integers(2**31))).as_quat(),
        scales=rng.uniform(0.1, 1.0, (count, 3)),
        opacities=np.full(count, opacity),
        base_color=rng.uniform(size=(count, 3)),
        roughness=rng.uniform(size=count),
        ambient_occlusion=rng.uniform(size=count),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
    )


def covariances(cloud: GaussianCloud) -> np.ndarray:
    axes = rotation_matrices(cloud.orientations) * cloud.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_two_equal_gaussians_absorb_as_one_of_both_depths():
    one = random_cloud(np.random.default_rng(1), 1, 0.4)
    merged = Clusters(one.select([0, 0]), np.zeros(2, int), np.ones(2)).cloud(one.select([0, 0]))
    assert merged.opacities[0] == pytest.approx(1.0 - 0.6**2, rel=1e-6)
    np.testing.assert_allclose(merged.positions, one.positions, rtol=1e-6)
    np.testing.assert_allclose(covariances(merged), covariances(one), rtol=1e-5, atol=1e-7)
    for name in ("base_color", "roughness", "ambient_occlusion", "normals"):
        np.testing.assert_allclose(getattr(merged, name), getattr(one, name), rtol=1e-6, atol=1e-7)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 12), st.integers(1, 4))
def test_mass_mean_and_covariance_are_those_of_the_members(seed, count, clusters):
    rng = np.random.default_rng(seed)
    cloud = random_cloud(rng, count, 0.01)  # so thin that no sum of depths meets the limit
    labels = np.concatenate([np.arange(min(clusters, count)), rng.integers(min(clusters, count), size=count)])[:count]
    seen = rng.uniform(0.5, 1.0, count)
    merged = Clusters(cloud, labels, seen).cloud(cloud)
    mass = optical_mass(cloud)
    np.testing.assert_allclose(optical_mass(merged), np.bincount(labels, mass), rtol=1e-4)
    for label in range(len(merged)):
        rows = labels == label
        share = mass[rows] / mass[rows].sum()
        mean = share @ cloud.positions[rows]
        away = cloud.positions[rows] - mean
        spread = np.einsum("n,nij->ij", share, covariances(cloud)[rows] + away[:, :, None] * away[:, None, :])
        np.testing.assert_allclose(merged.positions[label], mean, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(covariances(merged)[label], spread, rtol=1e-3, atol=1e-4)
        color = np.average(cloud.base_color[rows], axis=0, weights=seen[rows])
        np.testing.assert_allclose(merged.base_color[label], color, rtol=1e-3, atol=1e-4)


def test_what_is_opaque_grows_instead():
    cloud = random_cloud(np.random.default_rng(2), 1, 0.9).select([0] * 50)
    merged = Clusters(cloud, np.zeros(50, int), np.ones(50)).cloud(cloud)
    assert merged.opacities[0] == pytest.approx(0.99, abs=1e-6)
    ratio = np.sort(merged.scales[0]) / np.sort(cloud.scales[0])
    assert ratio[0] == pytest.approx(1.0, rel=1e-5)  # its thickness stays
    assert ratio[1] ** 2 == pytest.approx(50 * np.log(0.1) / np.log(0.01), rel=1e-4)


def test_clusters_follow_a_rigid_motion_and_so_do_the_changes_of_a_refit():
    rng = np.random.default_rng(3)
    cloud, turn, shift = random_cloud(rng, 40, 0.5), Rotation.from_rotvec([0.4, -0.7, 1.1]), np.array([1.0, 2.0, 3.0])

    def moved(still: GaussianCloud) -> GaussianCloud:
        return still.with_arrays(
            positions=turn.apply(still.positions) + shift,
            orientations=(turn * Rotation.from_quat(still.orientations)).as_quat(),
            normals=turn.apply(still.normals),
        )

    clusters = Clusters(cloud, np.arange(40) % 7, rng.uniform(size=40))
    changes = Changes(
        shift=rng.normal(size=(7, 3)),
        turn=Rotation.random(7, random_state=4).as_quat(),
        stretch=rng.normal(size=(7, 3)),
        logit=rng.normal(size=7),
        materials=0.1 * rng.normal(size=(7, 8)),
    )
    there = moved(cloud)
    expected = moved(changed(clusters.cloud(cloud), Rotation.identity(7), changes))
    found = changed(clusters.cloud(there), clusters.motion(there)[0], changes)
    for name in ("positions", "scales", "opacities", "base_color", "normals"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(covariances(found), covariances(expected), rtol=1e-3, atol=1e-3)


def test_a_gaussian_by_itself_stays_as_it_is():
    cloud = random_cloud(np.random.default_rng(5), 9, 0.7)
    merged = Clusters(cloud, np.arange(9), np.ones(9)).cloud(cloud)
    for name, array in cloud.arrays().items():
        np.testing.assert_allclose(getattr(merged, name), array, rtol=1e-6, atol=1e-7)
