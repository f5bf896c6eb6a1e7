"""Stages as takes: all that a player needs of one, made before it plays."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

from beam_warp.stage.assets import StageAsset, joined
from beam_warp.stage.discs import discs_of
from beam_warp.stage.stage import Stage
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.lights import lights_to_json

PATH_SIZE = 1600, 900
"""Size of the images that a camera path is asked for: an orbit that frames the assets looks at both sides [pixel]."""

FLOOR_RAYS, FLOOR_OFFSET = 64, 1e-3
"""Rays of each disc of a mesh that find how open it is, and how far above it they begin [m]."""


def staged_take(stage: Stage, title: str) -> tuple[GaussianSequence, dict[str, Any], dict[str, EnvironmentMap]]:
    """Return a stage as one take.

    All assets are one cloud, frame by frame at the stage's rate. Meshes are flat Gaussians, occluded by the assets.
    What only catches shadows is left out.

    Args:
        stage: The stage.
        title: What it is called.

    Returns:
        The take; what a player shows first (``state``, ``lights``, the assets' ``box``, a camera for each
        frame, as ``engines/web/player.js`` reads them); and the stage's environment by its name, if it has one.
    """
    mesh, notes = stage.mesh, stage.notes
    if mesh is not None and mesh.catches_shadows.any():
        notes = (*notes, "what only catches shadows is left out")
    floor = None if mesh is None or mesh.catches_shadows.all() else discs_of(mesh)
    stands = lru_cache(maxsize=2)(lambda cloud: cloud if floor is None else _standing(cloud, floor))
    sequence = GaussianSequence(
        stage.frame_count,
        lambda frame: stands(stage.cloud_at(stage.time_of(frame))),
        frames_per_second=stage.rate,
        topology="constant" if all(map(_keeps_its_rows, stage.assets)) else "perFrame",
        metadata={**stage.raster_metadata, "notes": "\n".join(notes)},
    )
    light = stage.environment
    name = f"{title} (stage)"
    turn = 0.0 if light is None else light.rotation_at(0.0)
    view: dict[str, Any] = {
        "state": {"environment": "none" if light is None else name, "rotation": (turn + 180.0) % 360.0 - 180.0},
        "degreesPerSecond": 0.0 if light is None else light.degrees_per_second,
        "lights": lights_to_json(stage.lights),
        "cameras": [_pose(stage, frame) for frame in range(stage.frame_count)],
    }
    if len(stage.subject):
        view["box"] = [stage.subject.min(axis=0).tolist(), stage.subject.max(axis=0).tolist()]
    return sequence, view, {} if light is None else {name: light.map}


def _standing(cloud: GaussianCloud, floor: GaussianCloud) -> GaussianCloud:
    """Return a cloud with a floor that it occludes."""
    scene = Scene.from_gaussians(cloud)
    seen = ambient_occlusion(scene, floor.positions, floor.normals, sample_count=FLOOR_RAYS, offset=FLOOR_OFFSET)
    return joined([cloud, floor.with_arrays(ambient_occlusion=seen.visibility)])


def _keeps_its_rows(asset: StageAsset) -> bool:
    return len(asset.sequence) == 1 or asset.sequence.topology == "constant" or asset.blend == "rows"


def _pose(stage: Stage, frame: int) -> dict[str, Any]:
    """Return where the camera of an image is: position, rows of its rotation, vertical field of view [degree]."""
    assert stage.camera is not None
    camera = stage.camera.camera_at(stage.time_of(frame), *PATH_SIZE)
    pose = camera.camera_to_world
    fov = 2.0 * math.degrees(math.atan(0.5 * camera.height / camera.focal_y))
    return {"position": pose[:3, 3].tolist(), "worldToCamera": pose[:3, :3].T.ravel().tolist(), "fov": fov}
