"""Gaussians on a known surface: evenly spread, along its normals, and coloured as views show."""

import numpy as np
import pytest
import trimesh

from beam_warp.capture.views import CapturedView
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.raster.gbuffer import rasterize_values
from beam_warp.raster.records import RasterOptions
from beam_warp.study.true_surface import FLATNESS, colored_by_views, gaussians_on_mesh
from beam_warp.world.camera import Camera
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.quaternions import rotation_matrices
from beam_warp.world.shapes import TANGENTIAL

SHARP = RasterOptions(antialiased=True, low_pass=0.1)


@pytest.fixture(scope="module")
def sphere():
    return trimesh.creation.icosphere(subdivisions=4, radius=0.5)


def cameras():
    return [
        Camera.orbit((0, 0, 0), 2.0, azimuth, elevation, width=40, height=32, vertical_fov=35.0)
        for azimuth, elevation in ((0, 10), (120, -20), (240, 40), (60, 80), (180, -70))
    ]


class TestPoints:
    def test_lie_on_the_surface_along_its_normals(self, sphere):
        cloud = gaussians_on_mesh(sphere.vertices, sphere.faces, 2000)
        assert len(cloud) == 2000
        radii = np.linalg.norm(cloud.positions, axis=1)
        lowest = (sphere.face_normals * sphere.triangles[:, 0]).sum(axis=1).min()  # the plane that is nearest
        assert (radii > lowest - 1e-6).all()
        assert (radii < 0.5 + 1e-6).all()
        # Interpolated normals are as far off the sphere's as the point is off the vertices': below 0.04 rad.
        cosines = np.einsum("nk,nk->n", cloud.normals, cloud.positions / radii[:, None])
        assert cosines.min() > np.cos(0.04)
        shortest = rotation_matrices(cloud.orientations)[:, :, 2]
        np.testing.assert_allclose(np.einsum("nk,nk->n", shortest, cloud.normals), 1.0, atol=1e-6)
        spacing = np.sqrt(sphere.area / 2000)
        np.testing.assert_allclose(cloud.scales[:, :2], TANGENTIAL * spacing, rtol=1e-5)
        np.testing.assert_allclose(cloud.scales[:, 2], FLATNESS * TANGENTIAL * spacing, rtol=1e-5)

    def test_are_spread_by_area_and_more_evenly_than_at_random(self, sphere):
        count = 4000
        cloud = gaussians_on_mesh(sphere.vertices, sphere.faces, count)
        # Octants have an eighth each; independent points would scatter by sqrt(count / 8 * 7 / 8) = 21.
        octant = (cloud.positions > 0.0) @ (1, 2, 4)
        shares = np.bincount(octant, minlength=8)
        assert np.abs(shares - count / 8).max() < 21
        # Smaller cells: the variance of counts is below the mean, which it is for independent points.
        cell = np.floor((cloud.positions + 0.5) / 0.125).astype(int) @ (1, 10, 100)
        area = np.bincount(
            np.floor((sphere.triangles_center + 0.5) / 0.125).astype(int) @ (1, 10, 100), sphere.area_faces
        )
        expected = area * count / sphere.area
        found = np.bincount(cell, minlength=len(expected))[: len(expected)]
        large = expected > 10.0
        assert large.sum() > 50
        assert np.square(found - expected)[large].mean() < 0.7 * expected[large].mean()

    def test_one_triangle_and_faces_without_area(self):
        vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        cloud = gaussians_on_mesh(vertices, [(0, 1, 2), (0, 0, 1)], 7)
        assert (cloud.positions[:, :2].sum(axis=1) <= 1.0 + 1e-6).all()
        np.testing.assert_allclose(cloud.normals, np.tile((0.0, 0.0, 1.0), (7, 1)), atol=1e-6)

    def test_mistakes(self):
        with pytest.raises(InvalidArrayError, match="mesh must have an area above 0"):
            gaussians_on_mesh([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)], 4)
        with pytest.raises(InvalidOptionError, match="count must be an integer"):
            gaussians_on_mesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)], 0)


class TestColors:
    def views(self, cloud, colors, device):
        found = []
        for camera in cameras():
            drawn = rasterize_values(cloud, camera, colors, options=SHARP, device=device)
            found.append(
                CapturedView(name="view", camera=camera, color=drawn.values, alpha=np.clip(drawn.alpha, 0.0, 1.0))
            )
        return found

    def test_one_color_comes_back(self, sphere, device):
        bare = gaussians_on_mesh(sphere.vertices, sphere.faces, 300)
        views = self.views(bare, np.tile(np.float32([0.2, 0.5, 1.7]), (300, 1)), device)
        cloud = colored_by_views(bare, views, options=SHARP, device=device)
        assert cloud.radiance_color_space == LINEAR_REC709
        # The mean of what pixels show is that colour, in single precision and sums of up to 500 pixels.
        np.testing.assert_allclose(0.5 + SH_C0 * cloud.radiance[:, 0], np.tile((0.2, 0.5, 1.7), (300, 1)), rtol=1e-4)

    def test_images_are_explained_far_better_than_by_their_mean(self, sphere, device, rng):
        bare = gaussians_on_mesh(sphere.vertices, sphere.faces, 300)
        truth = (0.5 + 0.4 * np.sin(8.0 * bare.positions)).astype(np.float32)
        views = self.views(bare, truth, device)

        def residual(steps):
            cloud = colored_by_views(bare, views, options=SHARP, steps=steps, device=device)
            shown = self.views(bare, (0.5 + SH_C0 * cloud.radiance[:, 0]).astype(np.float32), device)
            return np.sqrt(np.mean([np.square(a.color - b.color).mean() for a, b in zip(shown, views, strict=True)]))

        assert residual(8) < 0.35 * residual(0)
        assert residual(8) < residual(2)

    def test_what_no_view_shows_takes_the_nearest_color(self, sphere, device):
        bare = gaussians_on_mesh(sphere.vertices, sphere.faces, 300)
        camera = cameras()[0]
        view = self.views(bare, np.full((300, 3), 0.25, np.float32), device)[0]
        cloud = colored_by_views(bare, [view], options=SHARP, device=device)
        behind = cloud.positions @ camera.position < -0.5
        assert behind.sum() > 50
        np.testing.assert_allclose(0.5 + SH_C0 * cloud.radiance[behind, 0], 0.25, rtol=1e-4)

    def test_no_view(self, sphere):
        with pytest.raises(InvalidArrayError, match="views must hold at least one view"):
            colored_by_views(gaussians_on_mesh(sphere.vertices, sphere.faces, 3), [])
