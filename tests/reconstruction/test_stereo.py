"""Depth from photographs alone: planes of a scene whose depth is known, exposures, one thread or more, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from support.textured_scene import RADIUS, arc_cameras, known_view

from beam_warp.errors import InvalidArrayError
from beam_warp.reconstruction.stereo import LARGEST_COST, agreed_surface, find_planes

EXPOSURES = (1.0, 0.5, 1.0, 1.6, 1.0)


@pytest.fixture(scope="module")
def scene():
    """Five photographs, some of them darker or brighter."""
    pairs = zip(arc_cameras(5), EXPOSURES, strict=True)
    return [known_view(f"v{i}", camera, exposure=exposure) for i, (camera, exposure) in enumerate(pairs)]


@pytest.fixture(scope="module")
def planes(scene):
    return find_planes([known.view for known in scene], 72 * 48)


def test_planes_are_where_the_scene_is(scene, planes):
    for known, found in zip(scene[1:-1], planes[1:-1], strict=True):
        sure = known.is_ball & (found.costs < LARGEST_COST)
        assert sure.sum() > 0.6 * known.is_ball.sum()
        # Views 15 degrees apart see a pixel of parallax for a pixel / tan(15 degrees) of depth.
        pixel = known.depth / known.view.camera.focal_x
        off = np.abs(found.depth - known.depth) / pixel
        assert np.median(off[sure]) < 0.5 / np.tan(np.radians(15.0))
        cosines = (found.normals * known.normals).sum(axis=-1)
        assert np.median(cosines[sure]) > np.cos(np.radians(20.0))


def test_the_surface_is_the_ball_on_its_floor(planes):
    surface = agreed_surface(planes)
    assert surface is not None
    mesh = surface.mesh
    height = mesh.vertices[:, 2]
    on_ball = height > -0.2
    assert on_ball.sum() > 200
    off = np.abs(np.linalg.norm(mesh.vertices[on_ball], axis=1) - RADIUS)
    assert np.median(off) < 0.03  # a pixel of the images is 0.034 wide
    assert np.quantile(off, 0.9) < 0.1


def test_same_seed_same_bits_for_any_threads(monkeypatch, scene):
    views = [known.view.reduced(3) for known in scene[:3]]

    def found(threads):
        monkeypatch.setenv("BEAM_WARP_THREADS", threads)
        return find_planes(views, 24 * 16, device="cpu", seed=3)

    for one, other in zip(found("1"), found("3"), strict=True):
        np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_array_equal(one.costs, other.costs)


def test_nothing_in_common_is_no_surface(scene):
    rng = np.random.default_rng(0)
    small = [known.view.reduced(2) for known in scene[:3]]
    noise = [replace(view, color=rng.random(view.color.shape).astype(np.float32)) for view in small]
    assert agreed_surface(find_planes(noise, 36 * 24)) is None


def test_one_view_shows_no_depth(scene):
    with pytest.raises(InvalidArrayError, match="at least two"):
        find_planes([scene[0].view], 100)
