"""Grey balls on the true surface of every frame of a capture, which follow it: a made-up reconstruction."""

import numpy as np
import trimesh

from beam_warp.image.color import LINEAR_REC709
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0


def tracked_balls(meshes, count, radius, levels=None):
    """One cloud a mesh, all of one topology; ``levels`` are the greys by frame, 0.2 without."""
    _, faces, weights = trimesh.sample.sample_surface(meshes[0], count, return_barycentric=True, seed=2)
    return [
        GaussianCloud(
            positions=np.einsum("nk,nkc->nc", weights, mesh.triangles[faces]),
            orientations=np.tile((0.0, 0.0, 0.0, 1.0), (count, 1)),
            scales=np.full((count, 3), radius),
            opacities=np.full(count, 0.95),
            radiance=np.full((count, 1, 3), (level - 0.5) / SH_C0),
            radiance_color_space=LINEAR_REC709,
            ids=np.arange(count),
        )
        for mesh, level in zip(meshes, levels or [0.2] * len(meshes), strict=True)
    ]
