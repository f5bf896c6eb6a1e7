"""Scenes of schema/samples as shots: the asset, the camera, the size and the lights that a scene.usda states."""

from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdLux, UsdRender

from beam_warp.schema import register
from beam_warp.schema.cameras import read_usd_camera
from beam_warp.schema.reader import read_asset
from beam_warp.schema.stage_queries import stage_axes
from beam_warp.world.axes import axes_matrix, change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import WORLD_AXES
from beam_warp.world.lights import DirectionalLight
from beam_warp.world.shot import Shot

SAMPLES = Path(__file__).parents[2] / "schema" / "samples"

NAMES = ("furnace", "roughness", "still_life", "tripod", "rolling")

GOLDEN_SAMPLES = 512
"""Paths of a pixel of a golden image."""


def opened(name, file="scene.usda"):
    """A file of a sample as a stage of a USD that knows our schema."""
    register()
    return Usd.Stage.Open(str(SAMPLES / name / file))


def shot_of(name):
    """What the golden image of a scene shows, in the world's axes."""
    path = SAMPLES / name / "scene.usda"
    stage = opened(name)
    frame = stage.GetPrimAtPath("/World").GetCustomDataByKey("beam:shownFrame")
    cloud = change_axes(read_asset(path, trusted=True)[frame], WORLD_AXES)
    width, height = UsdRender.Settings(stage.GetPrimAtPath("/Render/Settings")).GetResolutionAttr().Get()
    lights = [_distant(prim) for prim in stage.Traverse() if prim.IsA(UsdLux.DistantLight)]
    (dome,) = (_power(UsdLux.DomeLight(prim)) for prim in stage.Traverse() if prim.IsA(UsdLux.DomeLight))
    camera = read_usd_camera(path, trusted=True).camera_at(0.0, width, height)
    return Shot(cloud=cloud, camera=camera, environment=EnvironmentMap.constant(dome), lights=tuple(lights))


def _power(light):
    return np.array(light.GetColorAttr().Get()) * light.GetIntensityAttr().Get()


def _distant(prim):
    """A normalised distant light: its intensity is the irradiance on a plane that faces it."""
    light = UsdLux.DistantLight(prim)
    assert light.GetNormalizeAttr().Get()
    to_world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))
    axes = axes_matrix(stage_axes(prim.GetStage(), SAMPLES), WORLD_AXES)
    return DirectionalLight(
        direction=tuple(axes @ -to_world[2, :3]),
        irradiance=tuple(_power(light)),
        angular_diameter=light.GetAngleAttr().Get(),
    )
