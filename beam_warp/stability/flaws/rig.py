"""What is wrong with each camera of a rig: drawn once, constant over time, its mean over the rig held at nothing."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.stability.flaws.optics import radial_coefficient
from beam_warp.world.camera import Camera

EXPOSURE_STOPS = 0.2
WHITE_BALANCE = 0.05
POSE_PIXELS = 0.3
POSE_METRES = 1e-3
MASK_PIXELS = 1.0
DISTORTION_PIXELS = 0.5
WRONG_TURN = 20.0
"""Nominal sizes: exposure [stop] and the gains of red and blue at most, a pose's rotation by what it moves the middle
of the image and its shift, masks, the edge of a distorted image, and the turn of a wrong camera about the subject
[degree]."""


@dataclass(frozen=True, kw_only=True)
class CameraFlaws:
    """What is wrong with a camera.

    Attributes:
        exposure_stops: How much brighter its images are [stop].
        white_balance: Gains of red and blue over green, less 1.
        mask_pixels: How far the outline of its masks is outside of the subject's [pixel].
        rotation: Rotation vector in the camera's axes that the stated pose was turned by [rad].
        shift: What was added to its stated position [m].
        k1: Radial distortion of its images, which the capture does not state.
        turn_degrees: Turn of its stated pose about the vertical through the subject.
    """

    exposure_stops: float = 0.0
    white_balance: tuple[float, float] = (0.0, 0.0)
    mask_pixels: float = 0.0
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    k1: float = 0.0
    turn_degrees: float = 0.0

    @property
    def gains(self) -> NDArray[np.float64]:
        """Factors of red, green and blue, ``(3,)``."""
        red, blue = self.white_balance
        return 2.0**self.exposure_stops * np.array([1.0 + red, 1.0, 1.0 + blue])

    def as_dict(self) -> dict[str, Any]:
        """Return what is not as it should be; JSON-able."""
        return {name: value for name, value in asdict(self).items() if np.any(value)}

    def stated(self, camera: Camera, center: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pose that the capture states for a camera, ``(4, 4)``.

        Args:
            camera: The camera as it is.
            center: What a wrong camera is turned about [m], ``(3,)``.
        """
        pose = camera.camera_to_world.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(self.rotation).as_matrix()
        pose[:3, 3] += self.shift
        turn = Rotation.from_euler("z", self.turn_degrees, degrees=True).as_matrix()
        pose[:3] = turn @ pose[:3]
        pose[:3, 3] += center - turn @ center
        return pose


def stream(seed: int, *names: str) -> np.random.Generator:
    """Return a generator of its own for every purpose, so that one flaw's draws do not depend on the others."""
    return np.random.default_rng([seed, *(zlib.crc32(name.encode()) for name in names)])


def levels(count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return numbers evenly spaced from -1 to 1 in random order: their mean is 0, their largest is known."""
    return generator.permutation(np.linspace(-1.0, 1.0, count))


def draw_camera_flaws(
    cameras: Mapping[str, Camera], flaws: Collection[str], size: float, seed: int
) -> dict[str, CameraFlaws]:
    """Draw what is wrong with each camera; see `CameraFlaws`.

    Args:
        cameras: The cameras as they are, by name; at least two.
        flaws: Names of flaws, of which those of cameras are taken.
        size: Factor of the nominal sizes.
        seed: Same seed, same flaws.
    """
    count, names = len(cameras), list(cameras)
    drawn: dict[str, dict[str, Any]] = {name: {} for name in names}

    def put(field: str, values: Sequence[Any]) -> None:
        for name, value in zip(names, values, strict=True):
            drawn[name][field] = value

    if "exposure" in flaws:
        put("exposure_stops", (EXPOSURE_STOPS * size * levels(count, stream(seed, "exposure"))).tolist())
        red, blue = (WHITE_BALANCE * size * levels(count, stream(seed, hue)) for hue in ("red", "blue"))
        put("white_balance", list(zip(red.tolist(), blue.tolist(), strict=True)))
    if "masks" in flaws or "cutouts" in flaws:
        put("mask_pixels", (MASK_PIXELS * size * _signs(count, stream(seed, "masks"))).tolist())
    if "poses" in flaws:
        generator = stream(seed, "poses")
        angles, ways = generator.uniform(0.0, 2.0 * np.pi, count), generator.normal(size=(count, 3))
        turns = [np.arctan(POSE_PIXELS * size / camera.focal_x) for camera in cameras.values()]
        put("rotation", [(t * np.cos(a), t * np.sin(a), 0.0) for t, a in zip(turns, angles.tolist(), strict=True)])
        shifts = POSE_METRES * size * ways / np.linalg.norm(ways, axis=1, keepdims=True)
        put("shift", [tuple(shift) for shift in shifts.tolist()])
    if "distortion" in flaws:
        signs = _signs(count, stream(seed, "distortion")) * DISTORTION_PIXELS * size
        put("k1", [radial_coefficient(c, s) for c, s in zip(cameras.values(), signs.tolist(), strict=True)])
    if "wrong-camera" in flaws:
        victim = names[stream(seed, "wrong-camera").integers(count)]
        drawn[victim]["turn_degrees"] = WRONG_TURN * size
    return {name: CameraFlaws(**fields) for name, fields in drawn.items()}


def _signs(count: int, generator: np.random.Generator) -> NDArray[np.float64]:
    """Return 1 for half of the cameras and -1 for the others, in random order."""
    return np.where(levels(count, generator) > 0.0, 1.0, -1.0)
