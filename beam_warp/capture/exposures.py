"""Exposures, white balances, vignetting of a rig's cameras: what they are, how sure, where kept, what they undo.

Reconstruction finds them (`beam_warp.reconstruction.photometry`) and writes them beside its result, so that whatever
goes back to the photographs later sees the colours that the Gaussians were fitted to. Only training records change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from beam_warp.capture.capture import CaptureRecord
from beam_warp.capture.findings import Finding
from beam_warp.capture.side_file import SideFile
from beam_warp.checks import require_array, require_finite, require_number

NEUTRAL = (1.0, 1.0, 1.0)

SHOWN_DEGREES = 20
"""Angle to the optical axis at which a finding says how dark vignetting is."""


@dataclass(frozen=True)
class CameraExposure:
    """Exposure and white balance of one camera over the mean of its rig, the same in all frames.

    Attributes:
        camera: Name of the camera.
        stops: Exposure, the mean of the three channels' [stop].
        balance: Natural logarithms of the gains of red, green and blue over their mean, ``(3,)``.
        gains: Factors of red, green and blue that are undone, ``(3,)``; 1 for what is not beyond chance.
    """

    camera: str
    stops: float = 0.0
    balance: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gains: tuple[float, float, float] = NEUTRAL

    def __post_init__(self) -> None:
        """Check every number once: they come from files too."""
        for name in ("balance", "gains"):
            vector = require_array(name, getattr(self, name), (3,), np.float64)
            require_finite(name, vector)
            object.__setattr__(self, name, tuple(vector.tolist()))
        require_number("stops", self.stops, -64.0, 64.0)
        for gain in self.gains:
            require_number("gain", gain, 2.0**-64, 2.0**64)


@dataclass(frozen=True)
class RigExposures(SideFile):
    """Exposures, white balances and vignetting of the cameras of a rig.

    Vignetting is a power of the cosine of the angle to the optical axis, one for all cameras; a thin lens has the
    fourth.

    Attributes:
        cameras: One for each camera.
        exposure_error: Standard error of exposures, root mean square over the cameras [stop].
        balance_error: Likewise of white balances.
        exposure_undone: Whether differences of exposure are beyond chance, and undone.
        balance_undone: Likewise of white balance.
        falloff: Power of the cosine that images are darkened by.
        falloff_error: Its standard error.
        falloff_undone: Whether vignetting is beyond chance, and undone.
    """

    FILE = "exposures.json"
    SUBJECT = "exposures of cameras"

    cameras: tuple[CameraExposure, ...]
    exposure_error: float = 0.0
    balance_error: float = 0.0
    exposure_undone: bool = False
    balance_undone: bool = False
    falloff: float = 0.0
    falloff_error: float = 0.0
    falloff_undone: bool = False

    def put_right(self, record: CaptureRecord) -> CaptureRecord:
        """Return a record whose views are without the gains and the vignetting of its camera."""
        gains = next((found.gains for found in self.cameras if found.camera == record.camera_name), NEUTRAL)
        falloff = self.falloff if self.falloff_undone else 0.0
        return record if gains == NEUTRAL and not falloff else replace(record, gains=gains, falloff=falloff)

    def findings(self) -> list[Finding]:
        """Return what a user should know."""
        found = []
        if self.exposure_undone:
            most = max(self.cameras, key=lambda camera: abs(camera.stops))
            what = (
                f"exposures of cameras differ by {_spread([camera.stops for camera in self.cameras]):.2f} ± "
                f"{self.exposure_error:.2f} stops, at most {most.stops:+.2f}, and were matched"
            )
            found.append(Finding("warning", "camera-exposure", what, most.camera, "Match exposures before."))
        if self.balance_undone:
            most = max(self.cameras, key=lambda camera: _largest(camera.balance))
            what = (
                f"white balances of cameras differ by {100.0 * _spread([c.balance for c in self.cameras]):.1f} ± "
                f"{100.0 * self.balance_error:.1f} %, at most {100.0 * _largest(most.balance):.1f} %, and were matched"
            )
            found.append(Finding("warning", "camera-white-balance", what, most.camera, "Match white balances before."))
        if self.falloff_undone:
            what = (
                f"images darken off the axis by the cosine's power of {self.falloff:.1f} ± {self.falloff_error:.1f}, "
                f"{100.0 * (1.0 - np.cos(np.radians(SHOWN_DEGREES)) ** self.falloff):.0f} % at {SHOWN_DEGREES}°, and "
                "were brightened there"
            )
            found.append(Finding("warning", "vignetting", what, "", "Correct vignetting before."))
        return found

    @classmethod
    def from_dict(cls, content: Any) -> RigExposures:
        """Take what `as_dict` returned."""
        cameras = tuple(CameraExposure(**camera) for camera in content["cameras"])
        content = {"falloff": 0.0, "falloff_error": 0.0, "falloff_undone": False} | content  # files of 0.2 lack these
        whats = ("exposure", "balance", "falloff")
        errors = {name: require_number(name, content[name], 0.0) for name in (f"{what}_error" for what in whats)}
        undone = {name: bool(content[name]) for name in (f"{what}_undone" for what in whats)}
        return cls(cameras, falloff=require_number("falloff", content["falloff"], -64.0, 64.0), **errors, **undone)


def scale_errors(gains: ArrayLike) -> tuple[float, float, float]:
    """Return by how much light and images may differ in brightness, where the images of a rig were matched to its mean.

    The light was measured by one more camera, which nothing compares with the rig. It is taken to be off as the others
    are: of V gains whose logarithms have a standard deviation s, a further one is off from their mean by
    s sqrt(1 + 1 / V).

    Args:
        gains: Factors of red, green and blue that were undone, ``(V, 3)``; 1 for what was not beyond chance.

    Returns:
        Relative standard errors of red, green and blue; 0 where no camera was off, or there is but one.

    Source: prediction of a further observation; what is common to all is stated apart, JCGM 100:2008 (GUM), 5.2.
    """
    logs = np.log(np.asarray(gains, np.float64))
    if len(logs) < 2:
        return (0.0, 0.0, 0.0)
    red, green, blue = (logs.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / len(logs))).tolist()
    return red, green, blue


def _spread(values: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(values)))))


def _largest(balance: Sequence[float]) -> float:
    return max(abs(value) for value in balance)
