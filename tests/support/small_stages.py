"""Small stages, in memory and from a file: relightable Gaussians at given places, still and moving."""

import json

import numpy as np
from scipy.spatial.transform import Rotation

from beam_warp.stage.assets import StageAsset
from beam_warp.stage.camera_paths import FixedCamera
from beam_warp.stage.stage import Stage
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

STILL = FixedCamera(Camera.look_at((0, -5, 1), (0, 0, 1), width=4, height=3, vertical_fov=40.0))


def cloud(positions=((0.0, 0.0, 0.0),), seed=3, **changes):
    """Relightable Gaussians at given places; everything else is random but fixed."""
    rng = np.random.default_rng(seed)
    count = len(positions)
    normals = rng.normal(size=(count, 3))
    arrays = {
        "positions": np.asarray(positions, np.float32).reshape(count, 3),
        "orientations": Rotation.random(count, rng=rng).as_quat() if count else np.zeros((0, 4)),
        "scales": 0.01 + 0.1 * rng.random((count, 3)),
        "opacities": 0.5 + 0.5 * rng.random(count),
        "normals": normals / np.linalg.norm(normals, axis=1, keepdims=True),
        "base_color": rng.random((count, 3)),
        "roughness": rng.random(count),
        "ambient_occlusion": rng.random(count),
        "ids": np.arange(count),
    }
    return GaussianCloud(**(arrays | changes))


def sequence(*clouds, fps=10.0, **options):
    return GaussianSequence.from_clouds(clouds, frames_per_second=fps, **options)


def moving(frames=3, fps=10.0, step=1.0, **changes):
    """One Gaussian that moves along x."""
    return sequence(*(cloud([(step * frame, 0.0, 0.0)], **changes) for frame in range(frames)), fps=fps)


def stage(*assets, camera=STILL, **options):
    return Stage(assets=assets, camera=camera, **options)


def asset(source=None, **options):
    return StageAsset(sequence=source or sequence(cloud()), **options)


def read(folder, content, name="stage.json", version=True):
    path = folder / name
    content = {"beam-stage": 1} | content if version else content
    path.write_text(json.dumps(content), encoding="utf-8")
    return Stage.read(path)
