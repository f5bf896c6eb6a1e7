"""Small takes for tests of players."""

import numpy as np
from scipy.spatial.transform import Rotation
from support.radiant_cloud import radiant_cloud

from beam_warp.world.gaussians import GaussianSequence


def walk(count, frames, *, noise, degree=None):
    """A cloud that turns and shakes."""
    rng = np.random.default_rng(count)
    radiance = {} if degree is not None else {"radiance": None, "radiance_color_space": None}
    cloud = radiant_cloud(count, degree or 0, materials=True, **radiance)
    clouds = []
    for frame in range(frames):
        turn = Rotation.from_euler("z", 0.1 * frame) * Rotation.from_rotvec(noise * rng.normal(size=(count, 3)))
        clouds.append(
            cloud.with_arrays(
                positions=turn.apply(cloud.positions) + 0.1 * frame,
                orientations=(turn * Rotation.from_quat(cloud.orientations)).as_quat(),
                normals=turn.apply(cloud.normals),
                ambient_occlusion=np.clip(cloud.ambient_occlusion + noise * rng.normal(size=count), 0.0, 1.0),
            )
        )
    return GaussianSequence.from_clouds(clouds, frames_per_second=24.0, metadata={"producer": "nobody"})
