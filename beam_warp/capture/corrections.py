"""Corrections of a rig's cameras: what they are, how sure, where they are kept, and the capture that they make.

Reconstruction finds them (`beam_warp.reconstruction.rig`) and writes them beside its result, so that whatever goes back
to the photographs later looks through the cameras that the Gaussians were fitted with. Only training records are
corrected: a rig's mean holds the world in its place, and what is rendered for other cameras is to be where they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from beam_warp.capture.capture import CaptureRecord
from beam_warp.capture.findings import Finding, count_of, names_of
from beam_warp.capture.side_file import SideFile
from beam_warp.checks import require_array, require_finite, require_number
from beam_warp.world.camera import Camera


@dataclass(frozen=True)
class CameraCorrection:
    """A correction of one camera of a rig, the same in all frames.

    Attributes:
        camera: Name of the camera.
        turn: Rotation vector in the camera's axes (right, down, forward) [rad], ``(3,)``.
        shift: Shift in the same axes [m], ``(3,)``: a point p in them comes to be at turn(p) + shift.
        log_focal: Natural logarithm of the factor of both focal lengths.
        pixels: How far this moves the surface in the image, root mean square [pixel].
        error: Standard error of that [pixel].
        psnr: Quality that the camera's image was met with [dB].
        is_used: False for a camera that could not be reconciled with the others, and is left out.
        center: Way of the principal point, right and down [focal length], ``(2,)``.
        place_error: Standard error with which the images tell the camera's place, whether it is moved or not [m].
    """

    camera: str
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    log_focal: float = 0.0
    pixels: float = 0.0
    error: float = 0.0
    psnr: float = 0.0
    is_used: bool = True
    center: tuple[float, float] = (0.0, 0.0)
    place_error: float = 0.0

    def __post_init__(self) -> None:
        """Check every number once: they come from files too."""
        for name, size in (("turn", 3), ("shift", 3), ("center", 2)):
            vector = require_array(name, getattr(self, name), (size,), np.float64)
            require_finite(name, vector)
            object.__setattr__(self, name, tuple(vector.tolist()))
        for name, low, high in (
            ("log_focal", -1.0, 1.0),
            ("pixels", 0.0, 1e6),
            ("error", 0.0, 1e6),
            ("place_error", 0.0, 1e6),
        ):
            require_number(name, getattr(self, name), low, high)

    def summary(self) -> str:
        """Return how far the camera was moved, and how sure that is, in a few characters."""
        return f"{self.pixels:.2f} ± {self.error:.2f} px" if self.is_used else "contradicts"

    def applied(self, camera: Camera) -> Camera:
        """Return the corrected camera."""
        return moved_camera(camera, (*self.turn, *self.shift, self.log_focal, *self.center))


@dataclass(frozen=True)
class RigCorrection(SideFile):
    """Corrections of the cameras of a rig.

    Attributes:
        cameras: One for each camera, moved or not.
        is_applied: False where what was found is no more than chance and the method's own error: then nothing moves.
        confidence: Ratio of the mean squares of what was found and of its standard errors.
        kinds: Kinds of numbers that were moved: turn, focal, shift, center.
        world: The motion of the world that was taken out of the corrections, because no photograph tells it: turn
            [rad], shift [m] and the logarithm of scale, about the subject's middle, ``(7,)``.
        distortion: How far lenses move the subject in images beyond what is stated, root mean square [pixel], which
            nothing undoes; 0 where that is no more than chance.
        explained: Part of the variance of the middle photograph's colours that the others explain where it is so little
            that cameras may not be where they are stated; else 1.
    """

    FILE = "cameras.json"
    SUBJECT = "corrections of cameras"

    cameras: tuple[CameraCorrection, ...]
    is_applied: bool
    confidence: float
    kinds: tuple[str, ...] = ()
    world: tuple[float, ...] = (0.0,) * 7
    distortion: float = 0.0
    explained: float = 1.0

    def ways(self, cameras: Mapping[str, Camera], point: ArrayLike) -> dict[str, NDArray[np.float64]]:
        """Return which way corrections move a point in the images of cameras that were moved [pixel], ``(2,)`` each.

        Args:
            cameras: Cameras as they are stated, by name.
            point: A point of the subject [m], ``(3,)``.
        """
        where = np.asarray(point, np.float64)[None]
        moved = [camera for camera in self.cameras if camera.camera in cameras and camera.is_used and self.is_applied]
        pairs = {camera.camera: (cameras[camera.camera], camera.applied(cameras[camera.camera])) for camera in moved}
        return {name: (after.project(where) - before.project(where))[0, :2] for name, (before, after) in pairs.items()}

    @property
    def pixels(self) -> float:
        """Root mean square over the cameras of what was found [pixel]."""
        return _root_mean_square([camera.pixels for camera in self.cameras])

    @property
    def error(self) -> float:
        """Root mean square over the cameras of the standard errors [pixel]."""
        return _root_mean_square([camera.error for camera in self.cameras])

    def put_right(self, record: CaptureRecord) -> CaptureRecord | None:
        """Return a record with its camera corrected; None if the camera is left out, itself if the rig has it not."""
        found = next((camera for camera in self.cameras if camera.camera == record.camera_name), None)
        if found is not None and not found.is_used:
            return None
        return record if found is None or not self.is_applied else replace(record, camera=found.applied(record.camera))

    def summary(self) -> str:
        """Return what was moved, and how sure that is, in one line."""
        known = f"{self.pixels:.2f} ± {self.error:.2f} pixels"
        if not self.is_applied:
            return f"cameras agree to {known}, and are as stated"
        place = 1e3 * _root_mean_square([camera.place_error for camera in self.cameras])
        told = f"; images tell places to ± {place:.1f} mm" if place else ""
        return f"cameras moved by {known} ({', '.join(self.kinds)}){told}"

    def findings(self) -> list[Finding]:
        """Return what a user should know about the cameras."""
        found = []
        moved = [camera for camera in self.cameras if camera.is_used and camera.pixels > 0.0]
        if self.is_applied and moved:
            most = max(moved, key=lambda camera: camera.pixels)
            found.append(
                Finding(
                    "warning",
                    "camera-poses",
                    f"cameras contradict each other by {self.pixels:.2f} ± {self.error:.2f} pixels, at most "
                    f"{most.pixels:.2f}, and were moved to agree",
                    most.camera,
                    "Calibrate the rig again.",
                )
            )
        if self.distortion > 0.0:
            what = (
                f"photographs show the subject {self.distortion:.2f} pixels from where pinholes do, as lenses that "
                "nobody states distort, and are taken as they are"
            )
            found.append(Finding("warning", "lens-distortion", what, "", "State the lenses, or undistort the images."))
        if self.explained < 1.0:
            what = (
                f"photographs explain {self.explained:.0%} of each other's colours: cameras are not where they are "
                "stated, or the subject shows each of them something else, as a mirror does"
            )
            remedy = "Check which camera took which photograph, and that no two captures are mixed."
            found.append(Finding("warning", "photographs-unlike", what, "", remedy))
        left_out = [camera.camera for camera in self.cameras if not camera.is_used]
        if left_out:
            found.append(
                Finding(
                    "warning",
                    "camera-contradicts",
                    f"{count_of(len(left_out), 'camera')} cannot be reconciled with the others, and "
                    f"{'is' if len(left_out) == 1 else 'are'} left out",
                    names_of(left_out),
                    "Check their calibration and their images.",
                )
            )
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record, which `from_dict` takes."""
        return {
            "is_applied": self.is_applied,
            "confidence": self.confidence,
            "pixels": self.pixels,
            "error": self.error,
            "kinds": list(self.kinds),
            "world": list(self.world),
            "distortion": self.distortion,
            "explained": self.explained,
            "cameras": [asdict(camera) for camera in self.cameras],
        }

    @classmethod
    def from_dict(cls, content: Any) -> RigCorrection:
        """Take what `as_dict` returned."""
        world = require_array("world", content.get("world", (0.0,) * 7), (7,), np.float64)
        require_finite("world", world)
        return cls(
            tuple(CameraCorrection(**camera) for camera in content["cameras"]),
            bool(content["is_applied"]),
            require_number("confidence", content["confidence"], 0.0),
            tuple(str(kind) for kind in content.get("kinds", ())),
            tuple(world.tolist()),
            require_number("distortion", content.get("distortion", 0.0), 0.0),
            require_number("explained", content.get("explained", 1.0), 0.0, 1.0),
        )


def moved_camera(camera: Camera, move: ArrayLike) -> Camera:
    """Return a camera after a motion in its own axes and a change of its focal lengths.

    Args:
        camera: The camera.
        move: Turn [rad], shift [m], the logarithm of the factor of the focal lengths and the principal point's way
            [focal length], ``(9,)``, as in `CameraCorrection`.
    """
    numbers = np.asarray(move, np.float64)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(numbers[:3]).as_matrix(), numbers[3:6]
    factor = float(np.exp(numbers[6]))
    return replace(
        camera,
        focal_x=camera.focal_x * factor,
        focal_y=camera.focal_y * factor,
        center_x=camera.center_x + camera.focal_x * float(numbers[7]),
        center_y=camera.center_y + camera.focal_y * float(numbers[8]),
        camera_to_world=camera.camera_to_world @ np.linalg.inv(motion),
    )


def move_between(camera: Camera, other: Camera) -> NDArray[np.float64]:
    """Return the move, ``(9,)``, with which `moved_camera` makes one camera the other, of the same pixel's shape."""
    motion = np.linalg.inv(other.camera_to_world) @ camera.camera_to_world
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    center = ((other.center_x - camera.center_x) / camera.focal_x, (other.center_y - camera.center_y) / camera.focal_y)
    return np.array([*turn, *motion[:3, 3], np.log(other.focal_x / camera.focal_x), *center])


def _root_mean_square(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else 0.0
