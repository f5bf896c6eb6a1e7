"""What ``beam render`` puts on the stage: assets or a stage's file, and what the command line says instead."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_count, require_number
from beam_warp.cli.render_checks import is_stage
from beam_warp.cli.render_views import DEFAULT_FOV, still_camera
from beam_warp.errors import InvalidOptionError
from beam_warp.stage.camera_paths import CameraPath, FixedCamera, OrbitPath, read_camera_path
from beam_warp.stage.environments import StageEnvironment
from beam_warp.stage.frame_times import SECONDS_RANGE, SPEED_RANGE
from beam_warp.stage.meshes import Ground
from beam_warp.stage.stage import Stage
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.lights import read_lights

if TYPE_CHECKING:
    from beam_warp.capture.capture import Capture
    from beam_warp.cli.render import Render


_NO_CAMERA = FixedCamera(Camera.look_at((0, -1, 0), (0, 0, 0), width=1, height=1, vertical_fov=DEFAULT_FOV))
"""Holds the place of the one that is to come: a stage without a camera would read frames to make one."""


@dataclass(frozen=True, eq=False)
class PacedPath:
    """A camera path by the film's seconds, on a stage that plays at another speed.

    Attributes:
        path: By the film's seconds.
        speed: Seconds of the stage in one of the film.
    """

    path: CameraPath
    speed: float

    @property
    def duration(self) -> float | None:
        """When it has arrived, in seconds of the stage."""
        return None if self.path.duration is None else self.path.duration * self.speed

    def camera_at(self, time: float, width: int, height: int) -> Camera:
        """Return the camera at a time of the stage [s]."""
        return self.path.camera_at(time / self.speed, width, height)


@dataclass(frozen=True, eq=False)
class Staged:
    """What is rendered.

    Attributes:
        stage: Assets, lights and camera over time.
        frame_count: Of it as it is, whatever ``--seconds`` says.
    """

    stage: Stage
    frame_count: int


def staged(args: Render, capture: Capture | None) -> Staged:
    """Read what is rendered; rates of the command line are by the film's seconds, whatever ``--speed`` says.

    Raises:
        BeamError: Something cannot be read or is no asset that can be lit, or there is no light.
    """
    pace = 1.0 if args.speed is None else require_number("speed", args.speed, *SPEED_RANGE)
    if args.seconds is not None:
        require_number("seconds", args.seconds, *SECONDS_RANGE)
    if is_stage(args):
        stage = Stage.read(args.asset[0])
    else:
        stage = Stage.of(
            args.asset,
            camera=_NO_CAMERA,
            source_axes=args.source_axes,
            drop_invalid=args.drop_invalid,
            on_ground=args.on_ground,
            spacing=args.spacing,
            loop=args.loop,
        )
    environment = _environment(args, capture, stage, pace)
    lights = stage.lights if args.lights is None else read_lights(args.lights)
    if environment is None and not lights:
        raise InvalidOptionError(
            "environment must be given, got none. Pass --environment with a lat-long .exr or .hdr image, or --lights."
        )
    if args.background == "environment" and environment is None:
        raise InvalidOptionError("background must be a colour or transparent without an environment, got environment.")
    ground = () if args.ground is None else (Ground(catches_shadows=args.ground == "shadows"),)
    camera = _camera(args, stage, pace)
    whole = replace(
        stage,
        environment=environment,
        lights=lights,
        meshes=(*stage.meshes, *ground),
        camera=camera,
        duration=stage.duration if is_stage(args) else None,
    )
    if args.seconds is None:
        return Staged(whole, whole.frame_count)
    return Staged(replace(whole, camera=camera, duration=args.seconds * pace), whole.frame_count)


def _environment(args: Render, capture: Capture | None, stage: Stage, pace: float) -> StageEnvironment | None:
    """Return the light that is asked for: named, the stage's own, or the capture's."""
    path = args.environment or (None if capture is None else capture.environment_path)
    rate = args.rotate_per_second / pace
    if path is not None:
        return StageEnvironment(map=EnvironmentMap.read(path), rotate=args.rotate, degrees_per_second=rate)
    given = stage.environment
    if given is None or not (args.rotate or rate):
        return given
    return replace(given, rotate=given.rotate + args.rotate, degrees_per_second=rate or given.degrees_per_second)


def _camera(args: Render, stage: Stage, pace: float) -> CameraPath | None:
    """Return the camera that is asked for, else that of the stage's file."""
    if args.capture is not None:
        return _NO_CAMERA  # every record brings its own
    if args.camera is not None:
        path = read_camera_path(args.camera)
        return path if pace == 1.0 else PacedPath(path, pace)
    azimuth, elevation = (0.0, 0.0) if args.orbit is None else args.orbit
    if args.turntable is not None or args.turns is not None:
        return OrbitPath(
            subject=_subject(stage),
            azimuth=azimuth,
            elevation=elevation,
            degrees_per_second=(args.turntable or 0.0) / pace,
            turns=args.turns,
            fov=DEFAULT_FOV if args.fov is None else args.fov,
        )
    if is_stage(args) and args.orbit is None and args.look_at is None:
        if args.fov is not None:
            raise InvalidOptionError(f"fov must come with a camera, got {args.fov} for a stage. Add --orbit.")
        return stage.camera
    if args.frame is None:
        frames = range(stage.frame_count)
    else:
        frames = range(args.frame, require_count("frame", args.frame, 0, stage.frame_count - 1) + 1)
    return FixedCamera(still_camera(args, frames, lambda frame: stage.cloud_at(stage.time_of(frame))))


def _subject(stage: Stage) -> NDArray[np.float64]:
    """Return what a camera goes around."""
    if not len(stage.subject):
        raise InvalidOptionError("asset must hold Gaussians to go around, got none. Place the camera with --look-at.")
    return stage.subject
