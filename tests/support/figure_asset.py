"""A relightable asset of the demo figure: discs on its surface with its materials, the same ones in every frame."""

from functools import cache

import numpy as np

from beam_warp.demo.capture import DANCE_SECONDS, FRAMES_PER_SECOND, demo_figure_for
from beam_warp.image.color import LINEAR_REC709
from beam_warp.mesh.distances import SurfaceTree
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.quaternions import turns_from_z

DISCS = 6_000
OPENNESS = 0.8

figure_for = cache(demo_figure_for)  # it takes most of the time, and tests of one run ask for one or two sizes


def figure_asset(size=48, frame_count=2, metadata=None):
    """Opaque discs; ambient occlusion is `OPENNESS` everywhere, radiance is base colour under white light."""
    figure = figure_for(size)
    faces = weights = None
    clouds = []
    for frame in range(frame_count):
        mesh = figure.at(frame / (FRAMES_PER_SECOND * DANCE_SECONDS))
        tree = SurfaceTree(mesh.vertices, mesh.faces, device="cpu")
        if faces is None:
            faces, weights = tree.sample(DISCS, seed=3)
        normals = mesh.interpolate(mesh.normals, faces, weights)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        color = np.clip(mesh.interpolate(mesh.base_color, faces, weights), 0.0, 1.0)
        clouds.append(
            GaussianCloud(
                positions=tree.at(faces, weights),
                orientations=turns_from_z(normals),
                scales=np.tile([0.010, 0.010, 1e-3], (DISCS, 1)),
                opacities=np.full(DISCS, 0.99),
                radiance=((color - 0.5) / SH_C0)[:, None, :],
                radiance_color_space=LINEAR_REC709,
                base_color=color,
                roughness=np.clip(mesh.interpolate(mesh.roughness, faces, weights), 0.0, 1.0),
                ambient_occlusion=np.full(DISCS, OPENNESS),
                normals=normals,
                ids=np.arange(DISCS),
            )
        )
    return GaussianSequence.from_clouds(clouds, metadata=metadata)


def changed(sequence, change):
    """The sequence with ``change(frame, cloud)`` in place of every cloud."""
    clouds = [change(frame, cloud) for frame, cloud in enumerate(sequence)]
    return GaussianSequence.from_clouds(clouds, metadata=sequence.metadata)
