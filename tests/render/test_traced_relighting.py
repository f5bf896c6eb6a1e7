"""Relighting by rays: furnace, closed forms of shadow, agreement with what decomposition takes apart."""

import numpy as np
import pytest
import warp as wp
from support.shapes import cloud_of, disc_points, sphere_points, tiles

from beam_warp.errors import InvalidArrayError
from beam_warp.light.prepared import MaterialLight
from beam_warp.render.traced_relighting import TraceOptions, traced_radiance
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap


def relightable(points, normals, spacing, base_color, roughness=0.6):
    count = len(points)
    return cloud_of(tiles(points, normals, spacing)).with_arrays(
        base_color=np.broadcast_to(np.float32(base_color), (count, 3)).copy(),
        roughness=np.full(count, roughness, np.float32),
        normals=np.asarray(normals, np.float32),
        ambient_occlusion=np.ones(count, np.float32),
    )


@pytest.fixture(scope="module")
def white():
    return MaterialLight.from_environment(EnvironmentMap.constant((1.0, 1.0, 1.0), height=32), wp.get_device("cpu"))


FRONT = Camera.look_at((0.0, -4.0, 0.5), (0.0, 0.0, 0.0), width=96, height=96, vertical_fov=40.0)
ABOVE = Camera.look_at((0.0, 0.1, 4.0), (0.0, 0.0, 0.0), width=96, height=96, vertical_fov=40.0)


def test_white_furnace(white):
    """A white convex body under light of radiance 1 sends 1 in every direction: the lobe takes what it gives."""
    points, spacing = sphere_points(1500)
    cloud = relightable(points, points, spacing, (1.0, 1.0, 1.0))
    radiance = traced_radiance(cloud, white, [FRONT], options=TraceOptions(sample_count=16))[0]
    toward = FRONT.position - points
    facing = (toward * points).sum(axis=1) / np.linalg.norm(toward, axis=1) > 0.1
    # the directional albedo and the blurred light are tables: 1 % is what they are built to
    np.testing.assert_allclose(radiance[facing], 1.0, atol=0.015)


def test_furnace_between_surfaces_needs_bounces(white):
    """In a white corner light that surfaces take from each other comes back by bounces, each by less."""
    flat = disc_points(1.0, 0.06)
    up, front = np.tile([0.0, 0.0, 1.0], (len(flat), 1)), np.tile([0.0, -1.0, 0.0], (len(flat), 1))
    wall = flat[:, [0, 2, 1]] + np.array([0.0, 0.03, 1.0])
    points, normals = np.concatenate([flat, wall]), np.concatenate([up, front])
    cloud = relightable(points, normals, 0.06, (1.0, 1.0, 1.0))
    camera = Camera.look_at((0.0, -4.0, 3.0), (0.0, 0.0, 0.3), width=128, height=128, vertical_fov=40.0)
    near = np.flatnonzero((np.abs(flat[:, 0]) < 0.3) & (flat[:, 1] > -0.3) & (flat[:, 1] < -0.1))
    means = [
        traced_radiance(cloud, white, [camera], options=TraceOptions(sample_count=64, bounces=bounces))[0, near].mean()
        for bounces in (0, 1, 2, 6)
    ]
    assert means[0] < 0.85
    assert means[0] < means[1] < means[2] < means[3]
    assert means[3] == pytest.approx(1.0, abs=0.05)


def test_a_sun_casts_a_shadow():
    """Under a sun overhead, a disc's umbra is dark and the floor beside it is not."""
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[:1] = 2e3  # a cap of 1.4 degrees around the zenith
    sun = MaterialLight.from_environment(EnvironmentMap(radiance), wp.get_device("cpu"))
    floor, disc = disc_points(1.0, 0.05), disc_points(0.4, 0.05) + np.array([0.0, 0.0, 0.5])
    points = np.concatenate([floor, disc])
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    cloud = relightable(points, normals, 0.05, (0.5, 0.5, 0.5), roughness=1.0)
    low = Camera.look_at((0.0, -4.0, 1.0), (0.0, 0.0, 0.2), width=128, height=128, vertical_fov=40.0)
    sent = traced_radiance(cloud, sun, [low, ABOVE], options=TraceOptions(bounces=0))[0, : len(floor), 0]
    radius = np.linalg.norm(floor[:, :2], axis=1)
    lit = sent[(radius > 0.6) & (radius < 0.9)]
    assert sent[radius < 0.25].max() < 0.1 * np.median(lit)
    assert lit.std() < 0.1 * lit.mean()


def test_same_seed_same_bits(white):
    points, spacing = sphere_points(300)
    cloud = relightable(points, points, spacing, (0.5, 0.5, 0.5))
    one, two = (traced_radiance(cloud, white, [FRONT], options=TraceOptions(sample_count=8)) for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_materials_are_needed(white):
    points, spacing = sphere_points(50)
    with pytest.raises(InvalidArrayError, match="base_color must be given to relight"):
        traced_radiance(cloud_of(tiles(points, points, spacing)), white, [FRONT])
