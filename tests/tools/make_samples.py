"""Make the sample assets of schema/samples and their golden images: ``python -P tests/tools/make_samples.py``.

Shapes are tiled with Gaussians whose materials are chosen, so everything about them is known. Occlusion and images are
traced by the package, on CUDA where there is a device. ``--only NAME`` makes one sample.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdRender

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from support.sample_scenes import GOLDEN_SAMPLES, NAMES, SAMPLES, shot_of

import beam_warp as beam
from beam_warp.image.color import DISPLAY_SRGB, linear_to_srgb
from beam_warp.image.files import display_image, write_png
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.schema.writer import write_asset
from beam_warp.world.axes import axes_matrix, change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.shapes import TiledSurface, rectangle, sphere_zone, tile

WIDTH, HEIGHT = 192, 144
FOV = 30.0
OCCLUSION_RAYS = 1024
SH_C1 = np.sqrt(3.0 / (4.0 * np.pi))
X, Y, Z = np.eye(3)
LICENCE = {"license": "CC0-1.0", "source": "beam-warp sample"}

Part = tuple[TiledSurface, tuple[float, float, float], float]
"""A surface with its base colour and roughness."""


@dataclass(frozen=True)
class Sample:
    """One sample.

    Attributes:
        frames: Relightable Gaussians of each frame, right-forward-up, in metres.
        eye: Position of the camera.
        target: Where it looks.
        dome: Radiance of the uniform environment.
        sun: Direction in which the distant light travels, and its irradiance; None for none.
        axes: Axes of the stage.
        shown: Frame of the golden image.
    """

    frames: list[GaussianCloud]
    eye: NDArray[np.float64]
    target: NDArray[np.float64]
    dome: float
    sun: tuple[NDArray[np.float64], float] | None = None
    axes: str = "rub"
    shown: int = 0


def surface(*parts: Part) -> GaussianCloud:
    """Tile surfaces and give them their materials; occlusion is traced."""
    cloud = tile(tuple(part[0] for part in parts))
    counts = [len(part[0].points) for part in parts]
    scene = beam.Scene.from_gaussians(cloud)
    found = beam.ambient_occlusion(scene, cloud.positions, cloud.normals, sample_count=OCCLUSION_RAYS)
    return cloud.with_arrays(
        base_color=np.repeat([part[1] for part in parts], counts, axis=0),
        roughness=np.repeat([part[2] for part in parts], counts),
        ambient_occlusion=found.visibility,
    )


def ball(middle: NDArray[np.float64], radius: float, spacing: float) -> TiledSurface:
    """Return a whole sphere."""
    return sphere_zone(middle, radius, -1.0, 1.0, spacing)


def rod(start: NDArray[np.float64], along: NDArray[np.float64], length: float, radius: float, spacing: float):
    """Return the side of a cylinder."""
    side = np.roll(along, 1)
    around, rows = round(2.0 * np.pi * radius / spacing), round(length / spacing)
    angle = 2.0 * np.pi * np.arange(around) / around
    normals = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(along, side)
    heights = (np.arange(rows) + 0.5) * length / rows
    points = start + radius * normals[:, None] + heights[None, :, None] * along
    return TiledSurface(points.reshape(-1, 3), np.repeat(normals, rows, axis=0), spacing)


def furnace() -> Sample:
    """A white ball in uniform light: it reflects all of it, so that every solid pixel has the radiance of the light."""
    return Sample([surface((ball(np.zeros(3), 0.5, 0.05), (1.0, 1.0, 1.0), 0.4))], -2.4 * Y, np.zeros(3), dome=0.5)


def roughness() -> Sample:
    """Five balls of one base colour, from smooth to rough."""
    levels = (0.25, 0.4, 0.55, 0.7, 0.9)
    balls = [(ball(0.3 * (i - 2) * X, 0.14, 0.024), (0.35, 0.08, 0.05), level) for i, level in enumerate(levels)]
    return Sample([surface(*balls)], -2.35 * Y + 0.4 * Z, np.zeros(3), dome=0.15, sun=(Y - 0.5 * X - 1.2 * Z, 1.2))


def still_life() -> Sample:
    """A wall, a ball and a bowl on a floor, with occlusion; the stage is z up."""
    bowl = sphere_zone(-0.4 * X - 0.3 * Y + 0.36 * Z, 0.36, -1.0, -0.1, 0.06)
    parts: list[Part] = [
        (rectangle(np.zeros(3), X, Y, 0.08), (0.6, 0.6, 0.6), 0.6),
        (rectangle(Y + 0.5 * Z, X, 0.5 * Z, 0.08), (0.15, 0.3, 0.6), 0.8),
        (ball(0.4 * X + 0.2 * Y + 0.4 * Z, 0.4, 0.06), (0.75, 0.3, 0.08), 0.5),
        (TiledSurface(bowl.points, -bowl.normals, bowl.spacing), (0.15, 0.5, 0.2), 0.5),
    ]
    eye, target = np.array([-1.1, -4.3, 2.1]), np.array([0.0, 0.1, 0.35])
    return Sample([surface(*parts)], eye, target, dome=0.45, sun=(0.6 * X + 0.7 * Y - Z, 0.9), axes="rfu")


def tripod() -> Sample:
    """Rods to the right (red), forward (green) and up (blue), of different lengths; the hub shows directions."""
    hub = ball(np.zeros(3), 0.09, 0.018)
    rods = [
        (rod(np.zeros(3), axis, length, 0.03, 0.016), tuple(0.05 + 0.6 * axis), 0.5)
        for axis, length in ((X, 0.55), (Y, 0.4), (Z, 0.3))
    ]
    tip = ball(0.55 * X, 0.05, 0.016)
    cloud = surface((hub, (0.5, 0.5, 0.5), 0.5), *rods, (tip, (0.7, 0.6, 0.1), 0.5))
    radiance = np.zeros((len(cloud), 4, 3))
    radiance[:, 0] = (linear_to_srgb(cloud.base_color) - 0.5) / SH_C0
    # Basis -y, z, -x: seen along +x the hub is 0.9 red, along +y 0.9 green, along +z 0.9 blue, and 0.5 otherwise.
    radiance[: len(hub.points)] = 0.0
    for band, channel, sign in ((1, 1, -1.0), (2, 2, 1.0), (3, 0, -1.0)):
        radiance[: len(hub.points), band, channel] = 0.4 * sign / SH_C1
    shown = cloud.with_arrays(radiance=radiance, radiance_color_space=DISPLAY_SRGB)
    eye, target = np.array([-0.5, -1.5, 0.8]), np.array([0.16, 0.1, 0.08])
    return Sample([shown], eye, target, dome=0.4, sun=(0.4 * X + Y - 0.8 * Z, 1.0))


def rolling() -> Sample:
    """A two-coloured ball that rolls to the right over a floor, in four frames; rows keep their identity."""
    radius, floor = 0.16, rectangle(np.zeros(3), 0.5 * X, 0.3 * Y, 0.04)
    start = ball(np.zeros(3), radius, 0.032)
    lower = start.points[:, 2] < 0.0
    halves = [TiledSurface(start.points[rows], start.normals[rows], start.spacing) for rows in (lower, ~lower)]
    frames = []
    for frame in range(4):
        turn, shift = frame * np.pi / 8.0, (-0.22 + radius * frame * np.pi / 8.0) * X + radius * Z
        rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
        moved = [
            TiledSurface(half.points @ rotation.T + shift, half.normals @ rotation.T, half.spacing) for half in halves
        ]
        cloud = surface(
            (floor, (0.5, 0.5, 0.45), 0.7), (moved[0], (0.7, 0.1, 0.1), 0.5), (moved[1], (0.8, 0.75, 0.6), 0.5)
        )
        frames.append(cloud.with_arrays(ids=np.arange(len(cloud))))
    eye, target = np.array([0.0, -1.7, 0.75]), np.array([0.0, 0.0, 0.1])
    return Sample(frames, eye, target, dome=0.4, sun=(0.5 * X + 0.5 * Y - Z, 1.0), shown=2)


def write_scene(name: str, sample: Sample) -> None:
    """Write the asset and the scene around it."""
    folder = SAMPLES / name
    folder.mkdir(parents=True, exist_ok=True)
    stated = {**LICENCE, "source_axes": WORLD_AXES, "normal_source": "authored", "roughness_source": "texture"}
    frames = [change_axes(cloud, sample.axes) for cloud in sample.frames]
    write_asset(GaussianSequence.from_clouds(frames, frames_per_second=24.0, metadata=stated), folder / "asset.usdc")
    path = folder / "scene.usda"
    path.unlink(missing_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    to_stage = axes_matrix(WORLD_AXES, sample.axes)
    UsdGeom.SetStageUpAxis(stage, {"rub": "Y", "rfu": "Z"}[sample.axes])
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(24.0)
    stage.SetFramesPerSecond(24.0)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(len(frames) - 1.0)
    root = UsdGeom.Xform.Define(stage, "/World").GetPrim()
    stage.SetDefaultPrim(root)
    root.SetCustomDataByKey("beam:shownFrame", sample.shown)
    stage.DefinePrim("/World/Asset").GetReferences().AddReference("./asset.usdc", Sdf.Path("/Asset"))
    pose = Camera.look_at(sample.eye, sample.target, width=WIDTH, height=HEIGHT, vertical_fov=FOV).camera_to_world
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    focal = 50.0
    vertical = 2.0 * focal * np.tan(np.radians(0.5 * FOV))
    camera.CreateFocalLengthAttr(focal)
    camera.CreateVerticalApertureAttr(vertical)
    camera.CreateHorizontalApertureAttr(vertical * WIDTH / HEIGHT)
    _place(camera, to_stage @ pose[:3, :3] @ np.diag([1.0, -1.0, -1.0]), to_stage @ pose[:3, 3])
    UsdLux.DomeLight.Define(stage, "/World/Dome").CreateIntensityAttr(sample.dome)
    if sample.sun is not None:
        sun = UsdLux.DistantLight.Define(stage, "/World/Sun")
        sun.CreateIntensityAttr(sample.sun[1])
        sun.CreateNormalizeAttr(True)
        sun.CreateAngleAttr(20.0)  # a wide disc, so that no highlight is brighter than a display
        back = -to_stage @ sample.sun[0] / np.linalg.norm(sample.sun[0])  # a distant light shines along its -z
        side = np.cross(to_stage @ Z, back)
        side /= np.linalg.norm(side)
        _place(sun, np.stack([side, np.cross(back, side), back], axis=1), np.zeros(3))
    UsdGeom.Scope.Define(stage, "/Render")
    settings = UsdRender.Settings.Define(stage, "/Render/Settings")
    settings.CreateResolutionAttr(Gf.Vec2i(WIDTH, HEIGHT))
    settings.CreateCameraRel().SetTargets(["/World/Camera"])
    stage.SetMetadata("renderSettingsPrimPath", "/Render/Settings")
    stage.GetRootLayer().Save()


def _place(prim: UsdGeom.Xformable, rotation: NDArray[np.float64], position: NDArray[np.float64]) -> None:
    """Author a pose whose rotation's columns are the prim's axes on the stage."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = rotation.T, position
    prim.AddTransformOp().Set(Gf.Matrix4d(np.round(matrix, 9).tolist()))


def write_golden(name: str, sample: Sample) -> None:
    """Path trace what the scene on disk shows, over black."""
    image = PathRenderer(PathOptions(samples=GOLDEN_SAMPLES)).draw(shot_of(name))
    write_png(SAMPLES / name / "golden.png", display_image(image.rgb))


MAKERS: dict[str, Callable[[], Sample]] = {
    "furnace": furnace,
    "roughness": roughness,
    "still_life": still_life,
    "tripod": tripod,
    "rolling": rolling,
}


def main() -> None:
    """Make the samples that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=NAMES, help="the sample to make")
    only = parser.parse_args().only
    for name in [only] if only else NAMES:
        sample = MAKERS[name]()
        write_scene(name, sample)
        write_golden(name, sample)
        print(name, len(sample.frames[0]), "Gaussians")


if __name__ == "__main__":
    main()
