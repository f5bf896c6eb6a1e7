"""The stage that ``beam render`` shows: assets or a stage's file, with the overrides of the command line."""

from __future__ import annotations

from dataclasses import dataclass, replace

from beam_warp.capture.capture import Capture
from beam_warp.checks import require_count, require_number
from beam_warp.cli.drawing.flags import LightFlags, Render
from beam_warp.cli.drawing.views import still_camera
from beam_warp.errors import InvalidOptionError
from beam_warp.stage.camera_paths import DEFAULT_FOV, CameraPath, FixedCamera, OrbitPath, read_camera_path
from beam_warp.stage.environments import StageEnvironment
from beam_warp.stage.frame_times import SECONDS_RANGE, SPEED_RANGE
from beam_warp.stage.meshes import Ground
from beam_warp.stage.stage import Stage
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.lights import read_lights

_NO_CAMERA = FixedCamera(Camera.look_at((0, -1, 0), (0, 0, 0), width=1, height=1, vertical_fov=DEFAULT_FOV))
"""Stand-in for the camera that is to come: a stage without a camera would read frames to make one."""


@dataclass(frozen=True, eq=False)
class PacedPath:
    """A camera path by the film's seconds, on a stage that plays at another speed.

    Attributes:
        path: Camera path by the film's seconds.
        speed: Seconds of the stage in one of the film.
    """

    path: CameraPath
    speed: float

    @property
    def duration(self) -> float | None:
        """Time at which the camera has arrived, in seconds of the stage."""
        return None if self.path.duration is None else self.path.duration * self.speed

    def camera_at(self, time: float, width: int, height: int) -> Camera:
        """Return the camera at a time of the stage [s]."""
        return self.path.camera_at(time / self.speed, width, height)


def staged(args: Render, capture: Capture | None) -> tuple[Stage, int]:
    """Read what is rendered; rates of the command line are by the film's seconds, whatever ``--speed`` says.

    Returns:
        The stage, and how many frames it has without ``--seconds``.

    Raises:
        BeamError: Something cannot be read or is no asset that can be lit, or there is no light.
    """
    time, assets = args.time, args.assets
    pace = 1.0 if time.speed is None else require_number("speed", time.speed, *SPEED_RANGE)
    if time.seconds is not None:
        require_number("seconds", time.seconds, *SECONDS_RANGE)
    if args.is_stage:
        stage = Stage.read(assets.asset[0])
    else:
        stage = Stage.of(
            assets.asset,
            camera=_NO_CAMERA,
            source_axes=assets.source_axes,
            meters_per_unit=assets.meters_per_unit,
            drop_invalid=assets.drop_invalid,
            on_ground=assets.on_ground,
            spacing=assets.spacing,
            loop=time.loop,
        )
    environment = _environment(args.light, capture, stage, pace)
    lights = stage.lights if args.light.lights is None else read_lights(args.light.lights)
    if environment is None and not lights:
        raise InvalidOptionError(
            "environment must be given, got none. Pass --environment with a lat-long .exr or .hdr image, or --lights."
        )
    if args.output.background == "environment" and environment is None:
        raise InvalidOptionError("background must be a colour or transparent without an environment, got environment.")
    ground = () if assets.ground is None else (Ground(catches_shadows=assets.ground == "shadows"),)
    camera = _camera(args, stage, pace)
    whole = replace(
        stage,
        environment=environment,
        lights=lights,
        meshes=(*stage.meshes, *ground),
        camera=camera,
        duration=stage.duration if args.is_stage else None,
    )
    frame_count = whole.frame_count
    if time.seconds is not None:
        whole = replace(whole, camera=camera, duration=time.seconds * pace)
    return whole, frame_count


def _environment(light: LightFlags, capture: Capture | None, stage: Stage, pace: float) -> StageEnvironment | None:
    """Return the light that is asked for: named, the stage's own, or the capture's."""
    path = light.environment or (None if capture is None else capture.environment_path)
    rate = light.rotate_per_second / pace
    if path is not None:
        return StageEnvironment(map=EnvironmentMap.read(path), rotate=light.rotate, degrees_per_second=rate)
    given = stage.environment
    if given is None or not (light.rotate or rate):
        return given
    return replace(given, rotate=given.rotate + light.rotate, degrees_per_second=rate or given.degrees_per_second)


def _camera(args: Render, stage: Stage, pace: float) -> CameraPath | None:
    """Return the camera that is asked for, else that of the stage's file."""
    flags, number = args.camera, args.time.frame
    if flags.capture is not None:
        return _NO_CAMERA  # every record brings its own
    if flags.camera is not None:
        path = read_camera_path(flags.camera)
        return path if pace == 1.0 else PacedPath(path, pace)
    azimuth, elevation = flags.orbit or (0.0, 0.0)
    if flags.turntable is not None or flags.turns is not None:
        if not len(stage.subject):
            raise InvalidOptionError(
                "asset must hold Gaussians to go around, got none. Place the camera with --look-at."
            )
        return OrbitPath(
            subject=stage.subject,
            azimuth=azimuth,
            elevation=elevation,
            degrees_per_second=(flags.turntable or 0.0) / pace,
            turns=flags.turns,
            fov=DEFAULT_FOV if flags.fov is None else flags.fov,
        )
    if args.is_stage and flags.orbit is None and flags.look_at is None:
        if flags.fov is not None:
            raise InvalidOptionError(f"fov must come with a camera, got {flags.fov} for a stage. Add --orbit.")
        return stage.camera
    if number is None:
        frames = range(stage.frame_count)
    else:
        frames = range(number, require_count("frame", number, 0, stage.frame_count - 1) + 1)
    return FixedCamera(still_camera(flags, frames, lambda frame: stage.cloud_at(stage.time_of(frame))))
