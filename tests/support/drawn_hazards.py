"""Hazards drawn by the code under test, and how exact they can be."""

import numpy as np
import warp as wp
from reference.raster_splats import see
from reference.rasterizing import RasterImage
from support.raster_clouds import set_upstream

from beam_warp.device.arrays import upload
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions

STABILITY = 10.0
"""Factor of the spread under one rounding of the inputs: a few dozen roundings in a chain, as their root sum."""

APPROXIMATIONS = 8.0
"""Errors of what CUDA approximates at each splat, in roundings of 2^-24: 4 of `quick_exp2` and 4 of `quick_divide`, by
the PTX ISA for ex2.approx.ftz and rcp.approx.ftz."""


class Drawn:
    """A scene drawn by the code under test: values, and the normals of its geometry."""

    def __init__(self, scene, device):
        self.scene = scene
        self.rasterizer = Rasterizer(
            len(scene.positions),
            [scene.camera],
            value_count=scene.values.shape[1],
            normals=True,
            options=RasterOptions(
                antialiased=scene.antialiased, low_pass=scene.low_pass, near=scene.near, depth=scene.depth_mode
            ),
            device=device,
            checkpoints=True,
        )
        kinds = {"positions": wp.vec3, "orientations": wp.quat, "scales": wp.vec3, "opacities": float, "values": float}
        arrays = {name: array.astype(np.float32) for name, array in scene.arrays().items()}
        self.images = self.rasterizer.draw(
            GaussianArrays(*(upload(arrays[name], kind, device) for name, kind in kinds.items()))
        )

    def image(self):
        shape = (self.scene.camera.height, self.scene.camera.width)
        rows = np.concatenate([array.numpy() for array in self.images.channels], axis=1).reshape(*shape, -1)
        return RasterImage(
            alpha=self.images.alpha.numpy().reshape(shape),
            depth=self.images.depth.numpy().reshape(shape),
            median_depth=self.images.median_depth.numpy().reshape(shape),
            channels=rows[..., list(self.rasterizer.value_channels)],
            normals=rows[..., list(self.rasterizer.normal_channels)],
            last=self.rasterizer.gaussian_ids.numpy().reshape(shape),
        )

    def gradients(self, upstream):
        set_upstream(self.rasterizer, upstream)
        found = self.rasterizer.backward()
        return {name: getattr(found, name).numpy() for name in self.scene.arrays()}


def remoteness(scene, decisions):
    """How many images the farthest centre that counts is away: responses and depths are forms about it.

    What a pixel sees is then a small difference of large numbers, and so are its derivatives.
    """
    if not len(decisions.splat):
        return 1.0
    centers = see(scene, decisions.splats).center[np.unique(decisions.splat)]
    sides = np.array([scene.camera.width, scene.camera.height])
    return max(1.0, float((np.abs(centers - 0.5 * sides) / sides).max()))
