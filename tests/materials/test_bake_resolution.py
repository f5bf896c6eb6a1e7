"""How far images are reduced for baking: the factor, the blocks, and that the bake comes out the same."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp import Camera
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.materials.bake import BakeTarget
from beam_warp.materials.bake_resolution import reduced_target
from beam_warp.raster.gbuffer import rasterize_values
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import reduced_options, reduction_factor

NEAR = 0.01


def ball(count=200):
    points, spacing = sphere_points(count)
    return cloud_of(tiles(points, points, spacing, opacity=0.95))


def around(azimuth, width, height, distance=4.0):
    return Camera.orbit((0, 0, 0), distance, azimuth, 15.0, width=width, height=height, vertical_fov=34.0)


class TestFactor:
    CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, np.eye(4))
    POINTS = np.array([(x, y, 5.0) for x in range(-2, 3) for y in range(-2, 3)])

    @pytest.mark.parametrize(
        ("pixels", "wanted"), [(0.4, 1), (3.99, 1), (4.01, 2), (5.99, 2), (6.01, 3), (15.0, 7), (5000.0, 640)]
    )
    def test_a_pixel_is_at_most_half_as_wide_as_a_splat(self, pixels, wanted):
        """Tiles of one size in a plane that faces the camera: all deviations are ``pixels``.

        At most, the largest image becomes one pixel.
        """
        flat = tiles(self.POINTS, np.tile((0.0, 0.0, -1.0), (25, 1)), 1.0)
        flat["scales"] = np.tile([0.01 * pixels, 0.02 * pixels, 1e-4], (25, 1))  # the middle one is 5 / 500 a pixel
        smaller = replace(self.CAMERA, width=32, height=24)
        assert reduction_factor(cloud_of(flat), [self.CAMERA, smaller], near=NEAR) == wanted

    def test_the_view_that_sees_splats_smallest_decides(self):
        near, far = around(0.0, 400, 400, 3.0), around(90.0, 400, 400, 9.0)
        alone = [reduction_factor(ball(), [camera], near=NEAR) for camera in (near, far)]
        assert alone[0] > alone[1] > 1
        assert reduction_factor(ball(), [near, far], near=NEAR) == alone[1]

    def test_what_lies_behind_does_not_count(self):
        camera = around(0.0, 400, 400)
        away = replace(camera, camera_to_world=camera.camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0]))
        assert reduction_factor(ball(), [away], near=NEAR) == 1
        assert reduction_factor(ball(), [away, camera], near=NEAR) == reduction_factor(ball(), [camera], near=NEAR) > 1

    def test_many_small_splats_keep_pixels_small(self):
        """More than a quarter of the tiles is 5 pixels wide, the others 12."""
        flat = tiles(self.POINTS, np.tile((0.0, 0.0, -1.0), (25, 1)), 0.12 / 0.65)
        flat["scales"][::3] *= 5.0 / 12.0
        assert reduction_factor(cloud_of(flat), [self.CAMERA], near=NEAR) == 2


class TestBlocks:
    @pytest.mark.parametrize("factor", [1, 3, 16])
    @pytest.mark.parametrize("shape", [(1, 7, 1), (8, 11, 5)])
    def test_means_and_sums(self, device, rng, factor, shape):
        height, width, columns = shape
        where = resolve_device(device)
        targets = rng.uniform(-1, 2, shape).astype(np.float32)
        weights = (rng.integers(0, 2, shape) * rng.uniform(0.5, 2.0, shape)).astype(np.float32)
        weights[: height // 2] = 0.0  # whole blocks of nothing
        held = np.where(weights > 0.0, targets, np.nan).astype(np.float32)
        camera = around(0.0, width, height)
        target = BakeTarget(camera, upload(held, float, where), upload(weights, float, where))
        found = reduced_target(target, factor, where)
        if factor == 1:
            np.testing.assert_array_equal(found.weights.numpy(), weights)
            return
        rows, places = -(-height // factor), -(-width // factor)
        assert (found.camera.height, found.camera.width) == (rows, places)
        means, sums = found.targets.numpy(), found.weights.numpy()
        assert means.shape == sums.shape == (rows, places, columns)
        for y in range(rows):
            for x in range(places):
                block = np.s_[y * factor : (y + 1) * factor, x * factor : (x + 1) * factor]
                total = weights[block].astype(np.float64).sum(axis=(0, 1))
                shown = (weights[block].astype(np.float64) * targets[block]).sum(axis=(0, 1))
                # at most 256 additions of numbers up to 4
                np.testing.assert_allclose(sums[y, x], total, rtol=256 * 6e-8)
                np.testing.assert_allclose(means[y, x] * total, shown, atol=256 * 256 * 4 * 6e-8)
                assert not means[y, x][total == 0.0].any()

    @pytest.mark.parametrize("options", [RasterOptions(), RasterOptions(antialiased=True, low_pass=0.1)])
    def test_reduced_views_sample_the_same_picture(self, device, options):
        """The centre of three by three pixels is that of the middle one; sizes are no multiples of three."""
        made, camera = ball(60), around(30.0, 52, 40)
        where = resolve_device(device)
        zeros = wp.zeros((40, 52, 1), dtype=float, device=where)
        reduced = reduced_target(BakeTarget(camera, zeros, zeros), 3, where).camera
        values = np.random.default_rng(0).uniform(0, 1, (60, 2)).astype(np.float32)
        whole = rasterize_values(made, camera, values, options=options, device=device)
        found = rasterize_values(made, reduced, values, options=reduced_options(options, 3), device=device)
        # Centres of pixels, up to 52, are rounded to 2e-6 of a pixel; where a splat ends at 1/255 it steps by that
        # much, and up to a tenth of the splats end within a rounding of some pixel's centre.
        difference = np.abs(found.values[:13, :17] - whole.values[1::3, 1::3])
        assert np.quantile(difference, 0.99) < 2e-5
        assert difference.max() < 1.5 / 255
