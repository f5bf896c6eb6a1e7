"""Random clouds and cameras around them, for tests of the rasteriser."""

import numpy as np

from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.sources import upload_gaussians
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud


def around(width=40, height=36, azimuth=20.0):
    return Camera.orbit((0, 0, 0), 2.5, azimuth, 10.0, width=width, height=height, vertical_fov=50.0)


def cloud(rng, count=200, **more):
    orientations = rng.normal(size=(count, 4))
    return GaussianCloud(
        positions=rng.uniform(-1, 1, (count, 3)),
        orientations=orientations / np.linalg.norm(orientations, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-2.5, 0.6, (count, 3))),
        opacities=rng.uniform(0.05, 0.95, count),
        **more,
    )


def drawn(made, cameras, device, values=None, **options):
    """A rasteriser that has drawn a cloud, with values, and the arrays that it drew."""
    width = 0 if values is None else values.shape[1]
    drawer = Rasterizer(len(made), cameras, value_count=width, device=device, **options)
    arrays = upload_gaussians(made, drawer.device, values=values)
    drawer.draw(arrays)
    return drawer, arrays


def set_upstream(drawer, upstream):
    """Write the oracle's derivatives of alpha, depths, channels and normals where a rasteriser reads them."""
    adjoints = drawer.adjoints()
    for name in ("alpha", "depth", "median_depth"):
        getattr(adjoints, name).assign(getattr(upstream, name).astype(np.float32).ravel())
    columns = np.zeros((len(drawer.images.alpha), 16 * len(adjoints.channels)), np.float32)
    columns[:, list(drawer.color_channels or drawer.value_channels)] = upstream.channels.reshape(len(columns), -1)
    columns[:, list(drawer.normal_channels)] = upstream.normals.reshape(len(columns), -1)
    for i, rows in enumerate(adjoints.channels):
        rows.assign(np.ascontiguousarray(columns[:, 16 * i : 16 * i + rows.shape[1]]))
