"""Initial Gaussians: how even, how opaque, which way, what colour; given points; no masks at all; refusals; threads."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from support.capture_scenes import ball_view, ball_views, cameras_around

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.raster.gbuffer import rasterize
from beam_warp.reconstruction.initial import (
    BALL_OPACITY,
    DISC_THICKNESS,
    DISC_WIDTH,
    HEXAGONAL,
    even_surface_points,
    initial_gaussians,
)
from beam_warp.world.gaussians import WORLD_AXES
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.quaternions import rotation_matrices

RADIUS = 0.5


def colors_of(cloud):
    return 0.5 + SH_C0 * cloud.radiance[:, 0]


class TestEvenPoints:
    @pytest.mark.parametrize("count", [1, 2, 3, 255, 1500])
    def test_exact_count_on_the_surface(self, device, count):
        ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
        positions, normals, spacing = even_surface_points(ball, count, device=device)
        assert positions.shape == normals.shape == (count, 3)
        assert spacing == pytest.approx(np.sqrt(ball.area / count))
        radii = np.linalg.norm(positions, axis=1)
        inner = np.linalg.norm(ball.triangles_center, axis=1).min()
        assert (radii >= inner - 1e-6).all()
        assert (radii <= RADIUS + 1e-6).all()
        # Normals of the mesh's corners are radial but for its facets' own tilt, half an edge over the radius.
        tilt = 0.5 * ball.edges_unique_length.max() / RADIUS
        assert ((normals * positions).sum(axis=1) / radii >= np.cos(tilt)).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, rtol=0, atol=1e-6)

    def test_more_even_than_chance(self, device):
        # Of random points, one in ten has its nearest within sqrt(-ln(0.9) / pi) = 0.18 of the spacing; of the densest
        # arrangement, none within HEXAGONAL = 1.07.
        sheet = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
        positions, _, spacing = even_surface_points(sheet, 3000, device=device)
        nearest = np.sort(cKDTree(positions).query(positions, k=2)[0][:, 1] / spacing)
        assert nearest[300] > 0.6
        assert nearest[-1] < 2.0 * HEXAGONAL  # no holes: a missing point leaves its neighbours at most twice as far

    def test_areas_get_their_share(self, device):
        # A long box of unequal faces, large triangles: each face has points in proportion to its area.
        box = trimesh.creation.box((1.0, 0.5, 0.1))
        count = 2600
        positions, _, _ = even_surface_points(box, count, device=device)
        top = np.isclose(positions[:, 2], 0.05, atol=1e-6).sum()
        share = 0.5 / box.area * count
        # Points leave or enter a face only over its edges: a row of them along the rim.
        assert abs(top - share) <= 3.0 / np.sqrt(box.area / count)

    def test_both_sides_of_a_thin_sheet(self, device):
        sheet = trimesh.creation.box((1.0, 1.0, 0.002))
        positions, normals, _ = even_surface_points(sheet, 1000, device=device)
        upper = normals[:, 2] > 0.0
        assert (positions[upper, 2] > 0.0).mean() > 0.9
        assert abs(upper.mean() - 0.5) < 0.05


class TestDiscs:
    def test_a_ball_of_one_color(self, device):
        views = ball_views(16)
        cloud = initial_gaussians(views, 1200, device=device)
        assert len(cloud) == 1200
        assert cloud.sh_degree == 0
        assert (cloud.axes, cloud.radiance_color_space) == (WORLD_AXES, LINEAR_REC709)
        np.testing.assert_array_equal(cloud.ids, np.arange(1200))
        spacing = cloud.scales[0, 0] / DISC_WIDTH
        parts = np.tile([DISC_WIDTH, DISC_WIDTH, DISC_THICKNESS], (1200, 1))
        np.testing.assert_allclose(cloud.scales, parts * spacing, rtol=1e-6)
        outward = cloud.positions / np.linalg.norm(cloud.positions, axis=1, keepdims=True)
        facing = (rotation_matrices(cloud.orientations)[:, :, 2] * outward).sum(axis=1)
        assert (facing > 0.5).all()
        assert np.median(facing) > 0.95
        # What is seen is (0.6, 0.3, 0.1) wherever coverage is at least a half, exactly but for the division.
        np.testing.assert_allclose(colors_of(cloud), np.tile([0.6, 0.3, 0.1], (1200, 1)), rtol=0, atol=1e-6)

    @pytest.mark.parametrize("count", [400, 3000])
    def test_opaque_inside_and_clear_outside(self, device, count):
        views = ball_views(16)
        cloud = initial_gaussians(views, count, device=device)
        reach = cloud.scales.max() * 3.4 * views[0].camera.focal_x / (2.0 - RADIUS)  # where alpha is 1/255 [pixel]
        for view, drawn in zip(views[:4], rasterize(cloud, [v.camera for v in views[:4]], channels=()), strict=True):
            assert drawn.alpha[view.alpha == 1.0].min() > 0.95
            y, x = np.mgrid[:64, :64] + 0.5
            away = np.hypot(x - 32.0, y - 32.0) > view.camera.focal_x * 0.6 / 1.9 + reach
            assert (drawn.alpha[away] == 0.0).all()

    def test_outliers_are_outvoted(self, device):
        # A point of the ball is seen by some seven of 24 views; these two are on opposite sides of it.
        views = list(ball_views(24))
        for i in (0, 23):
            views[i] = replace(views[i], color=5.0 * np.repeat(views[i].alpha[..., None], 3, axis=2))
        cloud = initial_gaussians(views, 800, device=device)
        error = np.abs(colors_of(cloud) - [0.6, 0.3, 0.1]).max(axis=1)
        # An outlier's weight is below (spread / 5)^2 of an inlier's but for facing, of which it moves the mean by 5.
        spread = 0.1 * np.linalg.norm([0.6, 0.3, 0.1])
        assert np.quantile(error, 0.95) < 5.0 * (spread / 5.0) ** 2

    def test_same_seed_same_bits_for_any_threads(self, monkeypatch):
        def cloud(threads, seed):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            return initial_gaussians(ball_views(6), 700, device="cpu", seed=seed)

        one, other = cloud("1", 3), cloud("4", 3)
        for name, array in one.arrays().items():
            np.testing.assert_array_equal(array, other.arrays()[name])
        assert (cloud("1", 4).positions != one.positions).any()


GRID = np.stack(np.meshgrid(*[np.arange(5) * 0.1 - 0.2] * 3), axis=-1).reshape(-1, 3)


class TestPoints:
    def test_balls_as_large_as_the_distance(self, device):
        colors = np.linspace(0.0, 2.0, GRID.size).reshape(-1, 3)
        cloud = initial_gaussians(ball_views(3), 125, points=GRID, point_colors=colors, device=device)
        np.testing.assert_allclose(cloud.positions, GRID, rtol=0, atol=1e-7)
        np.testing.assert_allclose(cloud.scales, 0.1, rtol=1e-5)
        np.testing.assert_allclose(colors_of(cloud), colors, rtol=0, atol=1e-6)
        assert (cloud.opacities == np.float32(BALL_OPACITY)).all()

    def test_fewer_and_more(self, device):
        fewer = initial_gaussians(ball_views(3), 40, points=GRID, device=device)
        assert len(np.unique(fewer.positions, axis=0)) == 40
        assert cKDTree(GRID).query(fewer.positions)[0].max() < 1e-6
        more = initial_gaussians(ball_views(3), 300, points=GRID, device=device)
        np.testing.assert_allclose(more.positions[:125], GRID, rtol=0, atol=1e-7)
        assert len(np.unique(more.positions, axis=0)) == 300
        assert np.linalg.norm(more.positions[125:250] - GRID, axis=1).max() < 5.0 * 0.05 * np.sqrt(3.0)

    def test_colors_come_from_the_views(self, device):
        views = [ball_view(f"v{i}", camera, color=(0.2, 0.5, 0.7)) for i, camera in enumerate(cameras_around(6))]
        cloud = initial_gaussians(views, 125, points=GRID, device=device)
        np.testing.assert_allclose(colors_of(cloud), np.tile([0.2, 0.5, 0.7], (125, 1)), rtol=0, atol=1e-6)

    @pytest.mark.parametrize("points", [np.zeros((1, 3)), np.zeros((7, 3))])
    def test_one_place(self, device, points):
        cloud = initial_gaussians(ball_views(3), 5, points=points, device=device)
        assert (cloud.scales > 0.0).all()

    def test_no_masks_fall_back_to_what_all_see(self, device):
        views = [replace(view, alpha=None) for view in ball_views(8)]
        cloud = initial_gaussians(views, 500, device=device)
        assert len(cloud) == 500
        for view in views:
            x, y, z = view.camera.project(cloud.positions).T
            assert (z > 0.0).all()
            assert ((x >= 0) & (x <= 64) & (y >= 0) & (y <= 64)).all()


class TestRefusals:
    def test_counts_and_arrays(self):
        views = ball_views(3)
        for count in (0, -1, 2.5):
            with pytest.raises(InvalidOptionError, match="count must be"):
                initial_gaussians(views, count, device="cpu")
        with pytest.raises(InvalidArrayError, match="views must be at least one, got none"):
            initial_gaussians([], 5, device="cpu")
        for points, colors, message in (
            (np.zeros((0, 3)), None, "points must be at least one, got none"),
            ([[0.0, np.nan, 0.0]], None, "points must be finite"),
            (np.zeros((2, 3)), np.zeros((3, 3)), "point_colors must have as many rows as points"),
            (None, np.zeros((3, 3)), "point_colors need points"),
        ):
            with pytest.raises(InvalidArrayError, match=message):
                initial_gaussians(views, 5, points=points, point_colors=colors, device="cpu")


def test_walker_is_opaque_and_of_its_colors(walker_views, device):
    views = [view.reduced(2) for view in walker_views]
    cloud = initial_gaussians(views, 6000, device=device)
    for view in views[:3]:
        drawn = rasterize(cloud, view.camera, channels=("radiance",), device=device)
        inside = view.alpha > 0.99
        assert drawn.alpha[inside].min() > 0.95
        guess = np.abs(drawn.channels["radiance"][inside] - view.color[inside]).mean()
        # Better than the best single colour: the median of what is there.
        assert guess < 0.5 * np.abs(view.color[inside] - np.median(view.color[inside], axis=0)).mean()
