"""Camera paths over time: fixed, around a subject, along key frames; and the files that hold them.

Every path answers ``camera_at(time, width, height)``, the time in seconds, the image in pixels. Angles of view are
vertical: an image of another shape sees more or less at its sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from beam_warp.checks import require_array, require_choice, require_finite, require_number, require_path
from beam_warp.errors import AssetFormatError, InvalidOptionError
from beam_warp.stage.fields import Fields, placed, read_json, shown
from beam_warp.world.camera import OPENGL_TO_OPENCV, Camera, focal_length
from beam_warp.world.quaternions import matrix_of, quaternion_of, slerp

DEFAULT_FOV = 35.0
"""Vertical angle of view where none is stated [degree]."""

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")

MAX_KEYFRAMES = 1_000_000

NERFSTUDIO_RATE = 24.0
"""Images a second of a nerfstudio path that states none."""

NERFSTUDIO_FOV = 50.0
"""Vertical angle of view of a nerfstudio path that states none [degree]."""

AIM_STEPS = 32
"""Places between two key frames at which a gaze is checked."""

LEVEL_SINE = 0.05
"""Below this sine between the gaze and the vertical, a camera that is kept level would spin."""

POSE_FIELDS = ("position", "target", "camera_to_world", "fov")
"""Fields of a camera that stands somewhere: a position and a target, or a pose; and its angle of view."""

Interpolation = Literal["smooth", "linear"]


class CameraPath(Protocol):
    """A camera over time."""

    @property
    def duration(self) -> float | None:
        """Time at which the camera has arrived [s]; None if it never does, or does not move."""
        ...

    def camera_at(self, time: float, width: int, height: int) -> Camera:
        """Return the camera at a time [s], for images of a size [pixel]."""
        ...


@dataclass(frozen=True, eq=False)
class FixedCamera:
    """A camera that stays.

    Attributes:
        camera: Camera at its own size; other sizes keep its vertical angle of view and relative principal point.
    """

    camera: Camera

    @property
    def duration(self) -> float | None:
        """None: a fixed camera never arrives."""
        return None

    def camera_at(self, time: float, width: int, height: int) -> Camera:
        """Return the camera for images of a size [pixel], at any time."""
        require_number("time", time, -1e9, 1e9)
        own = self.camera
        if (own.width, own.height) == (width, height):
            return own
        factor = height / own.height
        return Camera(
            width,
            height,
            own.focal_x * factor,
            own.focal_y * factor,
            0.5 * width + (own.center_x - 0.5 * own.width) * factor,
            0.5 * height + (own.center_y - 0.5 * own.height) * factor,
            own.camera_to_world,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class OrbitPath:
    """A camera that goes around a place on a level circle and looks at it.

    Attributes:
        center: Place that the camera looks at [m]; the middle of the subject if None.
        distance: Distance from the centre [m]; if None, the least one at which the subject fits the image. A camera
            that moves takes the least one that fits all the way round.
        subject: Points to frame [m], ``(N, 3)``; needed without ``center`` or ``distance``.
        azimuth: Azimuth at time 0 [degree]; see `Camera.orbit`.
        elevation: Height above the horizon [degree].
        degrees_per_second: Counter-clockwise seen from above; 0 stays.
        turns: Whole turns in a duration that `lasting` states, instead of ``degrees_per_second``.
        fov: Vertical angle of view [degree].
        margin: Half the image over the half that the subject may fill.

    Raises:
        InvalidArrayError: The centre or the subject is not finite.
        InvalidOptionError: A number is out of range.
    """

    center: tuple[float, float, float] | None = None
    distance: float | None = None
    subject: NDArray[np.float64] | None = field(default=None, repr=False)
    azimuth: float = 0.0
    elevation: float = 0.0
    degrees_per_second: float = 0.0
    turns: float | None = None
    fov: float = DEFAULT_FOV
    margin: float = 1.1

    def __post_init__(self) -> None:
        """Check every field, and keep only the points that bound the subject."""
        require_number("azimuth", self.azimuth, -3600.0, 3600.0)
        require_number("elevation", self.elevation, -90.0, 90.0)
        require_number("degrees_per_second", self.degrees_per_second, -36_000.0, 36_000.0)
        require_number("fov", self.fov, 0.01, 179.0)
        if self.turns is not None:
            require_number("turns", self.turns, -1000.0, 1000.0)
            if self.degrees_per_second:
                raise InvalidOptionError(
                    f"turns must be left out beside degrees_per_second, got {self.turns}. Leave one of them out."
                )
        require_number("margin", self.margin, 1.0, 100.0)
        if self.center is not None:
            center = require_array("center", self.center, (3,), np.float64)
            require_finite("center", center)
            object.__setattr__(self, "center", tuple(center.tolist()))
        if self.distance is not None:
            require_number("distance", self.distance, 1e-6, 1e9)
        if self.subject is not None:
            points = require_array("subject", self.subject, (None, 3), np.float64)
            require_finite("subject", points)
            object.__setattr__(self, "subject", outline(points))

    @property
    def frames_subject(self) -> bool:
        """Whether the path needs points to frame."""
        return self.center is None or self.distance is None

    def lasting(self, duration: float) -> OrbitPath:
        """Return the same path with its turns spread over a duration [s]."""
        if self.turns is None:
            return self
        return replace(self, turns=None, degrees_per_second=360.0 * self.turns / duration)

    @property
    def duration(self) -> float | None:
        """A whole turn [s]."""
        return abs(360.0 / self.degrees_per_second) if self.degrees_per_second else None

    def camera_at(self, time: float, width: int, height: int) -> Camera:
        """Return the camera at a time [s], for images of a size [pixel]."""
        seconds = require_number("time", time, -1e9, 1e9)
        azimuth = float(np.fmod(self.azimuth + self.degrees_per_second * seconds, 360.0))
        lens: dict[str, Any] = {"width": width, "height": height, "vertical_fov": self.fov}
        if self.center is not None and self.distance is not None:
            return Camera.orbit(self.center, self.distance, azimuth, self.elevation, **lens)
        if self.subject is None or not len(self.subject):
            raise InvalidOptionError(
                "camera must have a center and a distance where there is nothing to frame, got no point. State both."
            )
        box = 0.5 * (self.subject.min(axis=0) + self.subject.max(axis=0))
        center = box if self.center is None else np.asarray(self.center)
        if self.distance is not None:
            return Camera.orbit(center, self.distance, azimuth, self.elevation, **lens)
        if not self.degrees_per_second and self.center is None:
            return Camera.frame_points(
                self.subject, azimuth=azimuth, elevation=self.elevation, margin=self.margin, **lens
            )
        distance = self._framing_distance(self.subject - center, width, height)
        return Camera.orbit(center, distance, azimuth, self.elevation, **lens)

    def _framing_distance(self, offset: NDArray[np.float64], width: int, height: int) -> float:
        """Return the least distance at which the subject fits from every azimuth.

        A point at radius r and height z around the axis is, from azimuth φ, r sin φ aside, z cos e - r cos φ sin e up
        and r cos φ cos e + z sin e near. It fits if the distance is at least its nearness plus its offset times
        focal length over half the image; the largest of that over φ is in closed form.
        """
        radius, z = np.hypot(offset[:, 0], offset[:, 1]), offset[:, 2]
        sine, cosine = np.sin(np.radians(self.elevation)), np.cos(np.radians(self.elevation))
        across = self.margin * focal_length(height, self.fov) / (0.5 * width)
        along = self.margin * focal_length(height, self.fov) / (0.5 * height)
        needed = np.maximum.reduce(
            [
                radius * np.hypot(across, cosine) + z * sine,
                radius * np.abs(cosine - along * sine) + z * (sine + along * cosine),
                radius * np.abs(cosine + along * sine) + z * (sine - along * cosine),
            ]
        )
        nearest = 1.05 * (radius * cosine + z * sine).max()
        distance = float(max(needed.max(), nearest))
        return distance if distance > 0.0 else 1.0  # a single point: any distance frames it


@dataclass(frozen=True, eq=False, kw_only=True)
class Keyframe:
    """Where a camera is at a time.

    Attributes:
        time: Time of the key frame [s].
        camera_to_world: Rigid pose, ``(4, 4)`` float64, in `Camera`'s axes (x right, y down, z forward).
        fov: Vertical angle of view [degree].
        target: Place that the camera looks at, level [m]; None if only the pose was stated.

    Raises:
        InvalidArrayError: The pose is not rigid, or something is not finite.
        InvalidOptionError: The time or the angle is out of range.
    """

    time: float
    camera_to_world: NDArray[np.float64]
    fov: float = DEFAULT_FOV
    target: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        """Check every field once."""
        object.__setattr__(self, "time", require_number("time", self.time, -1e9, 1e9))
        object.__setattr__(self, "fov", require_number("fov", self.fov, 0.01, 179.0))
        object.__setattr__(
            self, "camera_to_world", Camera(1, 1, 1.0, 1.0, 0.5, 0.5, self.camera_to_world).camera_to_world
        )
        if self.target is not None:
            target = require_array("target", self.target, (3,), np.float64)
            require_finite("target", target)
            object.__setattr__(self, "target", target)

    @property
    def position(self) -> NDArray[np.float64]:
        """Where the camera is [m], ``(3,)``."""
        return self.camera_to_world[:3, 3]

    @classmethod
    def looking_at(cls, time: float, position: ArrayLike, target: ArrayLike, fov: float = DEFAULT_FOV) -> Keyframe:
        """Return the key frame of a level camera that looks at a place."""
        pose = Camera.look_at(position, target, width=1, height=1, vertical_fov=fov).camera_to_world
        return cls(time=time, camera_to_world=pose, fov=fov, target=np.asarray(target, np.float64))


@dataclass(frozen=True, eq=False)
class KeyframePath:
    """A camera that goes from key frame to key frame, and stays before the first and after the last.

    Positions follow a Catmull-Rom spline whose knots are the square roots of the distances (centripetal: it neither
    overshoots nor loops), or straight lines. Between two key frames that both name a target, the target moves in the
    same way and the camera looks at it, level; elsewhere, and where that gaze would come near the vertical,
    orientations are turned by `slerp`. Angles of view go linearly.

    Attributes:
        keyframes: One or more, times ascending.
        interpolation: ``smooth`` or ``linear``.

    Raises:
        InvalidOptionError: There is none, times do not ascend, or the interpolation is no such word.

    Source: Barry and Goldman 1988; Yuksel, Schaefer and Keyser 2011.
    """

    keyframes: tuple[Keyframe, ...]
    interpolation: Interpolation = "smooth"
    _aimed: tuple[bool, ...] = field(init=False, repr=False, default=())

    def __post_init__(self) -> None:
        """Check the order, and find out where a gaze can be followed."""
        require_choice("interpolation", self.interpolation, ("smooth", "linear"))
        object.__setattr__(self, "keyframes", tuple(self.keyframes))
        if not 0 < len(self.keyframes) <= MAX_KEYFRAMES:
            raise InvalidOptionError(
                f"keyframes must be 1 to {MAX_KEYFRAMES}, got {len(self.keyframes)}. Give at least one."
            )
        times = [keyframe.time for keyframe in self.keyframes]
        for index in range(1, len(times)):
            if not times[index] > times[index - 1]:
                raise InvalidOptionError(
                    f"keyframes[{index}].time must be after the one before ({times[index - 1]:g}), got "
                    f"{times[index]:g}. Sort the key frames by time."
                )
        object.__setattr__(self, "_aimed", tuple(self._can_aim(index) for index in range(len(times) - 1)))

    @property
    def duration(self) -> float | None:
        """Time of the last key frame [s]."""
        return self.keyframes[-1].time if self.keyframes[-1].time > 0.0 else None

    def camera_at(self, time: float, width: int, height: int) -> Camera:
        """Return the camera at a time [s], for images of a size [pixel]."""
        seconds = require_number("time", time, -1e9, 1e9)
        times = [keyframe.time for keyframe in self.keyframes]
        after = int(np.searchsorted(times, seconds, side="right"))
        if after in (0, len(times)) or seconds == times[after - 1]:
            keyframe = self.keyframes[max(after - 1, 0)]
            pose, fov = keyframe.camera_to_world, keyframe.fov
        else:
            start, end = self.keyframes[after - 1], self.keyframes[after]
            share = (seconds - start.time) / (end.time - start.time)
            pose, fov = self._pose(after - 1, share), start.fov + share * (end.fov - start.fov)
        focal = focal_length(height, fov)
        return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, pose)

    def _pose(self, index: int, share: float) -> NDArray[np.float64]:
        """Return the pose between a key frame and the next one."""
        start, end = self.keyframes[index], self.keyframes[index + 1]
        position = self._between([keyframe.position for keyframe in self.keyframes], index, share)
        if self._aimed[index]:
            target = self._between([keyframe.target for keyframe in self.keyframes], index, share)
            return Camera.look_at(position, target, width=1, height=1, vertical_fov=start.fov).camera_to_world
        first, second = (quaternion_of(keyframe.camera_to_world[:3, :3]) for keyframe in (start, end))
        pose = np.eye(4)
        pose[:3, :3] = matrix_of(slerp(first[None], second[None], share)[0])
        pose[:3, 3] = position
        return pose

    def _between(self, points: Sequence[Any], index: int, share: float) -> NDArray[np.float64]:
        """Return a place between one of some points and the next; neighbours that are not there do not count."""
        start, end = points[index], points[index + 1]
        if self.interpolation == "linear":
            return start + share * (end - start)
        before = points[index - 1] if index > 0 else None
        following = points[index + 2] if index + 2 < len(points) else None
        return catmull_rom(before, start, end, following, share)

    def _can_aim(self, index: int) -> bool:
        """Say whether the camera can look at its target from one key frame to the next without spinning."""
        if self.keyframes[index].target is None or self.keyframes[index + 1].target is None:
            return False
        positions, targets = zip(*[(keyframe.position, keyframe.target) for keyframe in self.keyframes], strict=True)
        for share in np.linspace(0.0, 1.0, AIM_STEPS + 1):
            gaze = self._between(targets, index, share) - self._between(positions, index, share)
            if not np.hypot(gaze[0], gaze[1]) > LEVEL_SINE * np.linalg.norm(gaze):
                return False
        return True


def catmull_rom(
    before: NDArray[np.float64] | None,
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    following: NDArray[np.float64] | None,
    share: float,
) -> NDArray[np.float64]:
    """Return a place on the centripetal Catmull-Rom spline between two of its points.

    Args:
        before: The point before ``start``; where there is none, or the same, ``end`` mirrored at ``start``.
        start: Position at share 0, ``(3,)``.
        end: Position at share 1.
        following: The point after ``end``; without, ``start`` mirrored at ``end``.
        share: Part of the way, in [0, 1].
    """
    if np.array_equal(start, end):
        return start
    if before is None or np.array_equal(before, start):
        before = 2.0 * start - end
    if following is None or np.array_equal(following, end):
        following = 2.0 * end - start
    points = [before, start, end, following]
    knots = np.cumsum([0.0, *(np.sqrt(np.linalg.norm(b - a)) for a, b in pairwise(points))])
    place = knots[1] + share * (knots[2] - knots[1])

    def mixed(low: int, high: int, first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
        weight = (place - knots[low]) / (knots[high] - knots[low])
        return (1.0 - weight) * first + weight * second

    one, two, three = (mixed(i, i + 1, points[i], points[i + 1]) for i in range(3))
    return mixed(1, 2, mixed(0, 2, one, two), mixed(1, 3, two, three))


def read_camera_path(path: str | Path, *, prim_path: str | None = None) -> CameraPath:
    """Read a camera path: key frames of ours or of nerfstudio's viewer as ``.json``, or the camera of a USD stage.

    Args:
        path: The file.
        prim_path: Which camera of a USD stage that has several.

    Raises:
        MissingFileError: It cannot be read.
        AssetFormatError: It is malformed; names the file and the key frame.
    """
    path = require_path("path", path)
    if path.suffix.lower() in USD_SUFFIXES:
        from beam_warp.schema.cameras import read_usd_camera  # brings OpenUSD along, which no other path needs

        return read_usd_camera(path, prim_path=prim_path)
    if prim_path is not None:
        raise InvalidOptionError(f"prim must be left out for a camera path in JSON, got {prim_path!r}. Leave it out.")
    content = read_json(path, "camera path")
    if isinstance(content, dict) and "camera_path" in content:
        return nerfstudio_path(content, path.name)
    return keyframe_path({"keyframes": content} if isinstance(content, list) else content, f"{path.name}:")


def keyframe_path(record: Any, where: str) -> KeyframePath:
    """Return the path of a JSON object: ``keyframes``, and perhaps ``interpolation`` and a ``type`` that is not read.

    Raises:
        AssetFormatError: It is malformed; names the key frame.
    """
    fields = Fields(record, where, ("type", "keyframes", "interpolation"))
    interpolation: Any = fields.text("interpolation") if "interpolation" in fields else "smooth"
    listed = fields.items("keyframes")
    if not 0 < len(listed) <= MAX_KEYFRAMES:
        raise fields.error("keyframes", f"a list of 1 to {MAX_KEYFRAMES} key frames", "Give at least one.")
    place = fields.place("keyframes")
    keyframes = tuple(_keyframe(entry, f"{place}[{index}]") for index, entry in enumerate(listed))
    with fields.placed():
        return KeyframePath(keyframes, interpolation)


def nerfstudio_path(content: Any, name: str) -> KeyframePath:
    """Return the path that nerfstudio's viewer exported: one pose an image, ``fps`` images a second.

    Poses are camera to world in OpenGL's axes, by rows, as ``ns-render`` takes them; they are of nerfstudio's own
    world, which it has turned, moved and scaled: what they look at must have been exported from there.

    Raises:
        AssetFormatError: It is malformed, or not a perspective camera's.
    """
    poses = content.get("camera_path")
    if not isinstance(poses, list) or not 0 < len(poses) <= MAX_KEYFRAMES:
        raise AssetFormatError(
            f"{name}: camera_path must be a list of 1 to {MAX_KEYFRAMES} cameras, got {shown(poses)}. Export it again."
        )
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise AssetFormatError(f"{name}: camera_type must be perspective, got {shown(kind)}. Export it as that.")
    seconds = content.get("seconds")
    fps: Any = content.get("fps", len(poses) / seconds if seconds else NERFSTUDIO_RATE)
    with placed(f"{name}:", ()):
        rate = require_number("fps", fps, 1e-3, 1e6)
    keyframes = []
    for index, entry in enumerate(poses):
        where = f"{name}: camera_path[{index}]"
        if not isinstance(entry, dict):
            raise AssetFormatError(f"{where} must be an object, got {shown(entry)}. Export it again.")
        value = entry.get("camera_to_world")
        with placed(where, ("camera_to_world", "fov")):
            if isinstance(value, list) and len(value) == 16:
                value = [value[start : start + 4] for start in range(0, 16, 4)]
            pose = require_array("camera_to_world", value, (4, 4), np.float64) @ OPENGL_TO_OPENCV  # type: ignore[arg-type]
            keyframes.append(Keyframe(time=index / rate, camera_to_world=pose, fov=entry.get("fov", NERFSTUDIO_FOV)))
    return KeyframePath(tuple(keyframes), "linear")


def _keyframe(record: Any, where: str) -> Keyframe:
    """Return one key frame of JSON."""
    fields = Fields(record, where, ("time", *POSE_FIELDS))
    return keyframe_of(fields, fields.number("time"))


def keyframe_of(fields: Fields, time: float) -> Keyframe:
    """Return the key frame that `POSE_FIELDS` of an object state, at a time [s].

    Raises:
        AssetFormatError: A field is malformed, or the pose is stated twice.
    """
    fov = fields.number("fov") if "fov" in fields else DEFAULT_FOV
    with fields.placed():
        if "camera_to_world" not in fields:
            return Keyframe.looking_at(time, fields.numbers("position", 3), fields.numbers("target", 3), fov)
        for name in ("position", "target"):
            if name in fields:
                raise fields.error(name, "left out beside camera_to_world", "Leave one of them out.")
        return Keyframe(time=time, camera_to_world=fields.value("camera_to_world"), fov=fov)


def outline(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners of the convex hull of points ``(N, 3)``: they fit in an image if and only if all do."""
    try:
        return points[np.sort(ConvexHull(points).vertices)]
    except (QhullError, ValueError):  # flat, or too few
        return points
