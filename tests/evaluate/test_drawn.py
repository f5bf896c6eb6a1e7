"""A pixel is the mean over its samples of what they see, each weighted by its coverage."""

import numpy as np
import pytest
from support.figure_asset import OPENNESS, figure_asset

from beam_warp.evaluate.drawn import draw_materials
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera

RASTER = RasterOptions(antialiased=True, low_pass=0.1)


@pytest.fixture(scope="module")
def cloud():
    return figure_asset(frame_count=1)[0]


@pytest.fixture(scope="module")
def camera(cloud):
    return Camera.frame_cloud(cloud.positions, azimuth=30.0, width=21, height=34)


@pytest.mark.parametrize("samples", [1, 3])
def test_pixels_are_means_of_samples(cloud, camera, samples, device):
    drawn = draw_materials(cloud, camera, radiance=True, raster=RASTER, samples=samples, device=device)
    names = ("base_color", "roughness", "ambient_occlusion", "normals", "radiance")
    fine = rasterize(cloud, camera.supersampled(samples), channels=names, options=RASTER, device=device)

    def blocks(image):
        """All samples of a pixel behind each other, in float64."""
        shape = (34, samples, 21, samples, *image.shape[2:])
        return np.moveaxis(image.astype(np.float64).reshape(shape), 2, 1).reshape(34, 21, samples**2, *image.shape[2:])

    alpha = blocks(fine.alpha)
    np.testing.assert_allclose(drawn.alpha, alpha.mean(axis=2), rtol=1e-6)
    for name in ("base_color", "roughness", "ambient_occlusion", "normals"):
        values = blocks(fine.channels[name])
        weights = alpha.reshape(alpha.shape + (1,) * (values.ndim - 3))
        sums = (values * weights).sum(axis=2)
        total = np.linalg.norm(sums, axis=-1, keepdims=True) if name == "normals" else weights.sum(axis=2)
        expected = np.divide(sums, total, out=np.zeros_like(sums), where=total > 0.0)
        np.testing.assert_allclose(drawn.channels[name], expected, atol=2e-6)
    seen = np.maximum(fine.channels["radiance"] * fine.alpha[..., None], 0.0)
    np.testing.assert_allclose(drawn.radiance, blocks(seen).mean(axis=2), atol=1e-6)
    depth = np.divide(
        (blocks(fine.depth) * alpha).sum(axis=2), alpha.sum(axis=2), out=np.zeros((34, 21)), where=drawn.alpha > 0.0
    )
    np.testing.assert_allclose(drawn.depth, depth, rtol=1e-6)


def test_layers_are_those_of_the_truth(cloud, camera):
    drawn = draw_materials(cloud, camera, raster=RASTER, device="cpu")
    assert drawn.radiance is None
    layers = drawn.layers()
    assert set(layers) == {
        "A", "depth", "ambient_occlusion", "roughness", "base_color.R", "base_color.G", "base_color.B", "normal.X",
        "normal.Y", "normal.Z",
    }  # fmt: skip
    covered = drawn.alpha > 0.0
    np.testing.assert_allclose(layers["ambient_occlusion"][covered], OPENNESS, rtol=1e-5)
    assert layers["ambient_occlusion"][~covered].max() == 0.0
