"""A few Gaussians of all shapes that move from frame to frame, as files."""

import numpy as np
from scipy.spatial.transform import Rotation
from support.drawn_ball import relightable

from beam_warp import converters
from beam_warp.converters import WriteOptions
from beam_warp.world.gaussians import GaussianSequence

COUNT = 40


def clouds(frames=3, axes="rfu", seed=0):
    """Gaussians of all shapes that move a little, row by row the same."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(COUNT, random_state=seed)
    unit, scales = rng.normal(size=(COUNT, 3)), rng.uniform(0.1, 0.4, (COUNT, 3))
    for frame in range(frames):
        yield relightable(
            unit + 0.1 * frame,
            orientations=(Rotation.from_euler("z", 0.2 * frame) * turns).as_quat(),
            scales=scales,
            opacities=rng.uniform(0.1, 0.9, COUNT),
            base_color=rng.uniform(0.0, 1.0, (COUNT, 3)),
            roughness=rng.uniform(0.0, 1.0, COUNT),
            normals=unit / np.linalg.norm(unit, axis=1, keepdims=True),
            ids=np.arange(COUNT),
            axes=axes,
        )


def written(path, frames=3, **options):
    sequence = GaussianSequence.from_clouds(list(clouds(frames)), frames_per_second=10.0)
    converters.write(sequence, path, WriteOptions(**options))
    return path
