"""Normals: exact where Gaussians are flat, close where they are not, oriented to the open side, honest about doubt."""

import numpy as np
from support.shapes import cloud_of, random_cloud, sphere_points, tiles

from beam_warp import GaussianCloud, Scene
from beam_warp.materials.base_color import UNCERTAIN_NORMAL
from beam_warp.materials.normals import estimate_normals


def angles(found, truth):
    return np.degrees(np.arccos(np.clip((found * truth).sum(axis=1), -1.0, 1.0)))


def normals_of(cloud, device="cpu"):
    return estimate_normals(cloud, Scene.from_gaussians(cloud, device))


def test_flat_gaussians_give_their_own_axis(device):
    points, spacing = sphere_points(2000)
    surface = normals_of(cloud_of(tiles(points, points, spacing)), device)
    assert surface.from_shape.all()
    # neighbours on a sphere lean by a spacing, 4.5 degrees: certain normals hardly move towards their mean
    assert angles(surface.normals, points).max() < 0.5
    assert surface.confidence.min() > 0.5


def test_round_gaussians_take_their_neighbourhood(device):
    points, spacing = sphere_points(2000)
    cloud = cloud_of(tiles(points, points, spacing, flatness=1.0))
    surface = normals_of(cloud, device)
    assert not surface.from_shape.any()
    assert np.median(angles(surface.normals, points)) < 3.0
    assert (angles(surface.normals, points) < 90.0).all()  # all point outwards


def test_axes_that_point_inwards_are_turned(device):
    points, spacing = sphere_points(2000)
    inward = cloud_of(tiles(points, -points, spacing))
    assert (angles(normals_of(inward, device).normals, points) < 1.0).all()


def test_noise_in_the_axes_is_smoothed_but_certainty_is_kept(rng):
    points, spacing = sphere_points(3000)
    tilted = points + 0.15 * rng.normal(size=points.shape)  # 8.6 degrees per axis
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    cloud = cloud_of(tiles(points, tilted, spacing, flatness=0.25, opacity=0.6))
    before, after = angles(tilted, points), angles(normals_of(cloud).normals, points)
    assert np.median(after) < 0.7 * np.median(before)


def test_fog_has_no_confident_normal(rng):
    fog = random_cloud(rng, 1500, scale=(-2.0, 0.1), opacity=(0.05, 0.2))
    surface = normals_of(fog)
    assert np.median(surface.confidence) < UNCERTAIN_NORMAL
    assert np.isfinite(surface.normals).all()


def test_few_gaussians_and_coincident_ones():
    one = GaussianCloud(positions=[[0, 0, 0]], orientations=[[0, 0, 0, 1.0]], scales=[[0.1, 0.1, 0.1]], opacities=[0.9])
    pile = one.select(np.zeros(40, int))
    for cloud in (one.select(np.zeros(0, int)), one, pile):
        surface = normals_of(cloud)
        assert surface.normals.shape == (len(cloud), 3)
        assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1.0, atol=1e-5)
        assert np.isfinite(surface.confidence).all()
