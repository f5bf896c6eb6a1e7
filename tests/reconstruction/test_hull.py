"""The visual hull: distances to silhouettes, balls between two bounds, empty masks, crops, refusals, a capture."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial import cKDTree
from support.capture_scenes import EDGE_ERROR, ball_view, ball_views, cameras_around
from support.shapes import sphere_points

from beam_warp.capture.capture import Capture
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.reconstruction.silhouettes import launch_measure_silhouette
from beam_warp.reconstruction.hull import viewing_focus, visual_hull
from beam_warp.reconstruction.scores import read_truth_mesh

RADIUS = 0.5


def distances(alpha, device, limit=40.0):
    out = wp.empty(alpha.size, dtype=float, device=device)
    gaps = [wp.empty(alpha.shape, dtype=float, device=device) for _ in range(2)]
    launch_measure_silhouette(wp.array(alpha, dtype=float, device=device), limit, *gaps, 0, out, device)
    return out.numpy().reshape(alpha.shape)


class TestSilhouettes:
    @pytest.mark.parametrize("angle", [0.0, 20.0, 200.0])
    def test_straight_edge(self, device, angle):
        size, s = 33, 8
        x = (np.arange(size * s) + 0.5) / s - 16.3
        c, d = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        inside = c * x + d * x[:, None] > 0.0
        alpha = inside.reshape(size, s, size, s).mean(axis=(1, 3), dtype=np.float32)
        found = distances(alpha, device)
        centers = np.arange(size) + 0.5 - 16.3
        true = c * centers + d * centers[:, None]
        near = np.hypot(centers, centers[:, None]) < 10.0  # the nearest point of the edge is in the image
        off = np.abs(found) - np.abs(true)
        assert (np.sign(found) == np.sign(true))[np.abs(true) > EDGE_ERROR].all()
        # Crossings lie at most a pixel apart: half of it across.
        most = np.sqrt(true**2 + 0.25) - np.abs(true) + EDGE_ERROR
        assert (off[near] >= -EDGE_ERROR).all()
        assert (off[near] <= most[near]).all()

    @pytest.mark.parametrize(("value", "sign"), [(0.0, -1.0), (1.0, 1.0)])
    @pytest.mark.parametrize("shape", [(1, 1), (20, 70)])
    def test_no_edge(self, device, shape, value, sign):
        np.testing.assert_array_equal(distances(np.full(shape, value, np.float32), device, 30.0), sign * 30.0)

    def test_equals_the_nearest_of_all_crossings(self, device, rng):
        alpha = rng.random((23, 31)).astype(np.float32)
        pixels, points = np.moveaxis(np.mgrid[:23, :31], 0, -1), []
        for step, here, there in (((1, 0), alpha[:-1], alpha[1:]), ((0, 1), alpha[:, :-1], alpha[:, 1:])):
            crossed = (here >= 0.5) != (there >= 0.5)
            one, other = here[crossed].astype(float), there[crossed].astype(float)
            points.append(np.argwhere(crossed) + ((0.5 - one) / (other - one))[:, None] * step)
        nearest = cKDTree(np.concatenate(points)).query(pixels)[0]
        # The quotient loses digits where neighbours are alike: 1e-6 over the least difference, of random ones 1e-3.
        np.testing.assert_allclose(np.abs(distances(alpha, device)), nearest, rtol=0, atol=1e-3)


def widest(views, unit):
    """Reach of a hull along unit vectors, of a ball of radius 1, at most.

    A view's cone touches the ball on the circle of directions at acos(R / D) from the camera's. Along a direction at
    the angle e from the nearest of those the tangent plane there is met at 1 / cos(e).
    """
    gaps = []
    for view in views:
        distance = np.linalg.norm(view.camera.position)
        angle = np.arccos(np.clip(unit @ (view.camera.position / distance), -1.0, 1.0))
        gaps.append(np.abs(angle - np.arccos(RADIUS / distance)))
    gap = np.min(gaps, axis=0)
    return np.where(gap < 1.5, 1.0 / np.cos(np.minimum(gap, 1.5)), np.inf)


def slack(hull, views):
    """Distance by which masks and voxels may move the surface [m]: the edge's error at the ball, and a part of a voxel.

    Interpolated between points at a pixel's distance, where the distances' own error is largest (1.41 to 1), a crossing
    moves by 0.09 voxel.
    """
    pixel = 2.0 / views[0].camera.focal_x
    return EDGE_ERROR * pixel + 0.1 * hull.voxel


def require_between_the_ball_and_its_planes(hull, views, looked_at):
    """The hull holds the ball and stays within its tangent planes, but for the slack of the masks ``looked_at``."""
    radii = np.linalg.norm(hull.mesh.vertices, axis=1)
    # Where cones meet, the chord of a concave function that falls by at most its way cuts at most half a voxel.
    assert radii.min() >= RADIUS - 0.5 * hull.voxel - slack(hull, looked_at)
    reach = widest(views, hull.mesh.vertices / radii[:, None])
    assert (radii <= RADIUS * reach + slack(hull, looked_at) * reach).all()


class TestBall:
    @pytest.mark.parametrize("count", [4, 24])
    def test_lies_between_the_ball_and_its_tangent_planes(self, device, count):
        views = ball_views(count)
        hull = visual_hull(views, resolution=48, quorum=count, device=device)
        require_between_the_ball_and_its_planes(hull, views, views)
        assert hull.mesh.is_watertight
        assert hull.mesh.volume > 0.0

    def test_converges_to_the_ball(self, device):
        volume = 4.0 / 3.0 * np.pi * RADIUS**3
        excess = []
        for count in (6, 12, 24):
            views = ball_views(count)
            hull = visual_hull(views, resolution=64, device=device)
            bound = (np.minimum(widest(views, sphere_points(4000)[0]), 3.0) ** 3).mean()
            thickness = 3.0 * (slack(hull, views) + 0.5 * hull.voxel) / RADIUS  # relative volume of the slack's shell
            assert 1.0 - thickness <= hull.mesh.volume / volume <= bound + thickness
            excess.append(hull.mesh.volume / volume - 1.0)
        assert excess[0] > excess[1] > excess[2]

    def test_is_sharper_than_its_pixels(self, device):
        views = ball_views(24, size=48)
        hull = visual_hull(views, resolution="auto", device=device)
        points, _ = trimesh.sample.sample_surface(hull.mesh, 5000, seed=1)
        lowest = np.quantile(np.linalg.norm(points, axis=1), 0.05)
        assert abs(lowest - RADIUS) <= slack(hull, views) + 0.1 * hull.voxel

    def test_large_masks_are_reduced_to_what_voxels_tell(self, device):
        views = ball_views(9, size=140)  # a voxel of 1 / 16 of the ball is 4 pixels
        hull = visual_hull(views, resolution=16, quorum=9, device=device)
        require_between_the_ball_and_its_planes(hull, views, [view.reduced(2) for view in views])

    def test_off_center(self, device):
        center = np.array([40.0, -30.0, 7.0])
        cameras = cameras_around(8, center=center)
        views = [ball_view(f"v{i}", camera, center=center) for i, camera in enumerate(cameras)]
        hull = visual_hull(views, resolution=32, device=device)
        np.testing.assert_allclose(hull.mesh.bounds.mean(axis=0), center, rtol=0, atol=hull.voxel)
        focus, reach = viewing_focus(views)
        # Middles of masks are whole or half pixels.
        np.testing.assert_allclose(focus, center, rtol=0, atol=0.5 * 2.0 / cameras[0].focal_x)
        assert abs(reach - 2.0) < 0.05


def blackened(view):
    return replace(view, color=0.0 * view.color, alpha=0.0 * view.alpha)


class TestMasks:
    def test_empty_and_missing_ones_are_ignored(self, device):
        views = ball_views(10)
        kept = visual_hull(views[2:], resolution=32, device=device)
        silent = blackened(views[0]), replace(views[1], alpha=None)
        hull = visual_hull([*silent, *views[2:]], resolution=32, device=device)
        np.testing.assert_array_equal(hull.mesh.vertices, kept.mesh.vertices)

    def test_what_a_view_crops_is_left_to_others(self, device):
        views = ball_views(16)
        close = [views[0].cropped(0, 0, 32, 64), views[1].cropped(20, 0, 24, 30), *views[2:]]
        hull = visual_hull(close, resolution=32, device=device)
        radii = np.linalg.norm(hull.mesh.vertices, axis=1)
        assert radii.min() >= RADIUS - 0.5 * hull.voxel - slack(hull, views)
        assert hull.mesh.volume < 1.3 * 4.0 / 3.0 * np.pi * RADIUS**3


class TestRefusals:
    def test_too_few_masks(self):
        views = ball_views(3)
        black = [blackened(view) for view in views[1:]]
        with pytest.raises(InvalidArrayError, match=r"two masks that show something, got 1 of 3.*view_1, view_2"):
            visual_hull([views[0], *black], device="cpu")
        with pytest.raises(InvalidArrayError, match="at least two masks that show something, got 0 of 0"):
            visual_hull([], device="cpu")

    def test_cones_that_do_not_meet(self):
        cameras = cameras_around(5)
        views = [ball_view(f"cam{i}", camera) for i, camera in enumerate(cameras)]
        views[2] = ball_view("cam2", cameras[2], radius=0.1, center=(0.0, 0.0, 0.62))
        with pytest.raises(InvalidArrayError, match="share no volume unless cam2 is left out"):
            visual_hull(views, device="cpu")
        views = [ball_view("a", cameras[0], radius=0.1), ball_view("b", cameras[1], radius=0.1, center=(0.0, 0.0, 0.6))]
        with pytest.raises(InvalidArrayError, match="share no volume: a, b"):
            visual_hull(views, device="cpu")

    def test_options(self):
        for options in ({"resolution": 8}, {"quorum": 1}):
            with pytest.raises(InvalidOptionError):
                visual_hull(ball_views(3), device="cpu", **options)


def test_walker_contains_the_truth(data_dir, walker_views, device):
    hull = visual_hull(walker_views, resolution=128, device=device)
    surface = read_truth_mesh(Capture.read(data_dir / "captures" / "walker"), 0)
    assert hull.mesh.is_watertight

    def depths(mesh, points):
        """Signed distance to a mesh, positive inside."""
        corners, places = (wp.array(array, dtype=wp.vec3, device=device) for array in (mesh.vertices, points))
        shape = wp.Mesh(corners, wp.array(mesh.faces.ravel(), dtype=int, device=device))
        out = wp.empty(len(points), dtype=float, device=device)
        wp.launch(signed_depth_kernel, len(points), inputs=[shape.id, places], outputs=[out], device=device)
        return out.numpy()

    inside = depths(hull.mesh, surface.vertices)
    assert inside.min() > -hull.voxel
    points, _ = trimesh.sample.sample_surface(hull.mesh, 20000, seed=0)
    outward = np.abs(depths(surface, points)).mean()
    back, _ = trimesh.sample.sample_surface(surface, 20000, seed=0)
    chamfer = 0.5 * (outward + np.abs(depths(hull.mesh, back)).mean())
    print(f"walker: Chamfer {1e3 * chamfer:.2f} mm, truth at most {-1e3 * inside.min():.2f} mm outside")
    # A pixel is 6.1 mm at the subject: what 24 silhouettes leave undecided is less than that.
    assert chamfer < 2.7 / walker_views[0].camera.focal_x


@wp.kernel(enable_backward=False)
def signed_depth_kernel(mesh: wp.uint64, points: wp.array[wp.vec3], out_depths: wp.array[float]):
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], 10.0)
    nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
    out_depths[i] = -query.sign * wp.length(points[i] - nearest)
