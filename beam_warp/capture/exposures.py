"""Exposures and white balances of a rig's cameras: what they are, how sure, where they are kept, and what they undo.

Reconstruction finds them (`beam_warp.reconstruction.photometry`) and writes them beside its result, so that whatever
goes back to the photographs later sees the colours that the Gaussians were fitted to. Only training records change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.findings import Finding
from beam_warp.capture.inspect import SPLIT
from beam_warp.capture.records import read_json
from beam_warp.checks import require_array, require_finite, require_number
from beam_warp.errors import AssetFormatError, BeamError

FILE_NAME = "exposures.json"

MOST_BYTES = 2**26
"""Most bytes of a file of exposures; a camera has some 300."""

NEUTRAL = (1.0, 1.0, 1.0)


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
class RigExposures:
    """Exposures and white balances of the cameras of a rig.

    Attributes:
        cameras: One for each camera.
        exposure_error: Standard error of exposures, root mean square over the cameras [stop].
        balance_error: Likewise of white balances.
        exposure_undone: Whether differences of exposure are beyond chance, and undone.
        balance_undone: Likewise of white balance.
    """

    cameras: tuple[CameraExposure, ...]
    exposure_error: float = 0.0
    balance_error: float = 0.0
    exposure_undone: bool = False
    balance_undone: bool = False

    def corrected(self, records: Sequence[CaptureRecord]) -> tuple[CaptureRecord, ...]:
        """Return records whose views are without the gains of their cameras; those of other splits stay."""
        gains = {found.camera: found.gains for found in self.cameras if found.gains != NEUTRAL}
        return tuple(
            replace(record, gains=gains[record.camera_name])
            if record.split == SPLIT and record.camera_name in gains
            else record
            for record in records
        )

    def capture(self, capture: Capture) -> Capture:
        """Return the capture with its training images corrected."""
        return Capture(**{**vars(capture), "records": self.corrected(capture.records)})

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
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record, which `from_dict` reads."""
        return asdict(self)

    @classmethod
    def from_dict(cls, content: Any, where: Path) -> RigExposures:
        """Read what `as_dict` returned.

        Raises:
            AssetFormatError: A field is missing or out of range.
        """
        try:
            cameras = tuple(CameraExposure(**camera) for camera in content["cameras"])
            errors = {name: require_number(name, content[name], 0.0) for name in ("exposure_error", "balance_error")}
            undone = {name: bool(content[name]) for name in ("exposure_undone", "balance_undone")}
            return cls(cameras, **errors, **undone)
        except (BeamError, KeyError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise AssetFormatError(
                f"exposures of cameras must be as beam reconstruct wrote them, got {reason} at {where}. Delete the "
                "file to find them again."
            ) from error


def read_exposures(folder: Path) -> RigExposures | None:
    """Read the exposures beside a reconstruction.

    Args:
        folder: Folder of the reconstruction.

    Returns:
        The exposures; None if there are none.

    Raises:
        AssetFormatError: The file is damaged.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    return RigExposures.from_dict(read_json(path, "exposures of cameras", MOST_BYTES), path)


def _spread(values: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(values)))))


def _largest(balance: Sequence[float]) -> float:
    return max(abs(value) for value in balance)
