"""Means over the samples of a pixel: closed forms."""

import numpy as np
from support.shapes import cloud_of, sphere_points, tiles

from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.pixel_means import PixelMeans, mean_where_covered
from beam_warp.world.camera import Camera


def test_means_are_over_the_samples_that_are_covered():
    alpha = np.float32([[1.0, 0.5, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0]])
    values = np.float32([[1.0, 3.0, 9.0, 9.0], [9.0, 5.0, 9.0, 9.0]])
    np.testing.assert_allclose(mean_where_covered(values, alpha, 2), [[2.5, 0.0]])
    colors = np.stack([values, 2.0 * values], axis=-1)
    np.testing.assert_allclose(mean_where_covered(colors, alpha, 2), [[[2.5, 5.0], [0.0, 0.0]]])
    unit = mean_where_covered(colors, alpha, 2, unit=True)
    np.testing.assert_allclose(unit, [[[0.2**0.5, 0.8**0.5], [0.0, 0.0]]], rtol=1e-6)
    assert mean_where_covered(values, alpha, 1) is values


def test_a_cloud_of_one_colour_keeps_it_and_normals_are_of_unit_length():
    points, spacing = sphere_points(400)
    cloud = cloud_of(tiles(points, points, spacing), base_color=np.full((400, 3), 0.3), normals=points)
    camera = Camera.orbit((0.0, 0.0, 0.0), 4.0, 20.0, 10.0, width=24, height=18, vertical_fov=40.0)
    samples = rasterize(cloud, camera.supersampled(3), channels=("base_color", "normals"), device="cpu")
    seen, there = PixelMeans.of(samples, 3), samples.alpha.reshape(18, 3, 24, 3).max(axis=(1, 3)) > 0.0
    np.testing.assert_array_equal(seen.alpha > 0.0, there)
    np.testing.assert_allclose(seen.channels["base_color"], 0.3 * there[..., None].repeat(3, axis=-1), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(seen.channels["normals"], axis=-1), there, rtol=1e-5)
    nearest = samples.depth.reshape(18, 3, 24, 3)
    assert (seen.depth[there] <= nearest.max(axis=(1, 3))[there] + 1e-5).all()
    assert not seen.depth[~there].any()
