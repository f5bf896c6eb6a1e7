"""Stress captures with a camera at fault, or with few cameras: nothing is written, records change as they are read."""

from __future__ import annotations

from dataclasses import replace

from beam_warp.capture.capture import Capture
from beam_warp.stability.capture_cases.alterations import evenly, training_cameras, with_altered, with_cameras
from beam_warp.stability.capture_cases.case import (
    BLACK_IMAGE,
    CAMERA_EXPOSURE,
    EMPTY_MASK,
    FEW_CAMERAS,
    FRAME_LACKS_CAMERAS,
    MISSING_IMAGE,
    CaptureStress,
    Detection,
)
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.suite import stability_case

WRONG_EXPOSURE = 2.0
SLIGHTLY_WRONG_EXPOSURE = 2.0**-0.5
"""Gains of a camera whose exposure is off by a whole stop, and by half a stop."""


def _victim(capture: Capture) -> str:
    """Return the camera that something happens to: one of the middle."""
    names = training_cameras(capture)
    return names[len(names) // 2]


def _altered(at: StressStudio, code: str, *, gain: float, coverage: float = 1.0) -> CaptureStress:
    """Alter the images of one camera, which must be detected under a code."""
    base = at.brief()
    name = _victim(base)
    return CaptureStress(
        capture=with_altered(base, name, gain=gain, coverage=coverage), required=(Detection(code, name),)
    )


@stability_case(
    "black camera", "black is trained into every Gaussian that the camera sees", "the camera detected and left out"
)
def black_camera(at: StressStudio) -> CaptureStress:
    """One camera's images are black, its masks are right."""
    return _altered(at, BLACK_IMAGE, gain=0.0)


@stability_case(
    "empty camera",
    "one mask of nothing carves all of the subject out of the visual hull",
    "the camera detected and left out",
)
def empty_camera(at: StressStudio) -> CaptureStress:
    """One camera's images and masks are empty."""
    return _altered(at, EMPTY_MASK, gain=0.0, coverage=0.0)


@stability_case(
    "camera without files",
    "the run ends with a stack trace after minutes, when the file is first opened",
    "refused before anything is optimised, or the camera detected and left out",
)
def camera_without_files(at: StressStudio) -> CaptureStress:
    """One camera is listed, its image files are absent."""
    base = at.brief()
    name = _victim(base)
    gone = tuple(
        replace(r, image_path=r.image_path.with_name(f"absent_{r.image_path.name}")) if r.camera_name == name else r
        for r in base.records
    )
    return CaptureStress(
        capture=replace(base, records=gone), required=(Detection(MISSING_IMAGE, name),), may_refuse=True
    )


@stability_case(
    "camera that stops",
    "loops over cameras that were counted in the first frame read another camera's image",
    "the camera's absence detected from the second frame on",
)
def camera_that_stops(at: StressStudio) -> CaptureStress:
    """One camera has an image of the first frame only."""
    base = at.brief()
    name, first = _victim(base), base.frames[0]
    kept = tuple(r for r in base.records if r.camera_name != name or r.frame == first)
    return CaptureStress(capture=replace(base, records=kept), required=(Detection(FRAME_LACKS_CAMERAS, name),))


@stability_case(
    "wrong exposure",
    "one camera is twice as bright: colour that depends on direction takes it up, floaters stand before the camera",
    "the camera's exposure detected, and corrected or left out",
)
def wrong_exposure(at: StressStudio) -> CaptureStress:
    """One camera is exposed a stop more than the others."""
    return _altered(at, CAMERA_EXPOSURE, gain=WRONG_EXPOSURE)


@stability_case(
    "exposure half a stop off",
    "the same, where no histogram shows it: light from one side makes views differ by more",
    "the camera's exposure detected, and corrected",
)
def slightly_wrong_exposure(at: StressStudio) -> CaptureStress:
    """One camera is exposed half a stop less than the others."""
    return _altered(at, CAMERA_EXPOSURE, gain=SLIGHTLY_WRONG_EXPOSURE)


@stability_case(
    "4 cameras",
    "training views are matched by Gaussians that no other view confirms",
    "few views detected; geometry held by the hull and by smoothness",
)
def four_cameras(at: StressStudio) -> CaptureStress:
    """Four training cameras, evenly spread."""
    base = at.base()
    return CaptureStress(
        capture=with_cameras(base, evenly(training_cameras(base), 4)), required=(Detection(FEW_CAMERAS),)
    )


@stability_case(
    "8 cameras",
    "concave parts that two cameras at most see bulge to the hull",
    "reconstructed; what is lost against all cameras is told",
)
def eight_cameras(at: StressStudio) -> CaptureStress:
    """Eight training cameras, evenly spread."""
    base = at.base()
    return CaptureStress(capture=with_cameras(base, evenly(training_cameras(base), 8)))
