"""The judge of stress captures: what a reconstruction detected on them, and how good it still was.

A case fails if what must be detected was not, if a sound camera is blamed, if something is found where nothing is
wrong, if a frame is much worse than the first and nothing was said about it, or if the run ends in anything but a
reconstruction or a clear refusal where one is allowed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from beam_warp.capture.capture import Capture
from beam_warp.device.arrays import device_label, resolve_device
from beam_warp.errors import BeamError
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.drift import tracking_drift
from beam_warp.reconstruction.scores import read_truth_mesh, score_frame
from beam_warp.stability.capture_cases import CAPTURE_CASES
from beam_warp.stability.capture_cases.alterations import training_cameras
from beam_warp.stability.capture_cases.case import NEW_SURFACE, TRACKING_LOST, CaptureStress, Detection, in_words
from beam_warp.stability.capture_cases.studio import StressStudio
from beam_warp.stability.suite import CaseOutcome, StabilityCase, attempt
from beam_warp.world.gaussians import GaussianSequence

SILENT_LOSS_DB = 3.0
"""A last frame that is worse than the first by more than this was lost, and that must have been said [dB]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Reconstructed:
    """The result of reconstructing a capture.

    Attributes:
        sequence: One cloud for each of the capture's frames, in their order, with persistent ids within a segment.
        detections: What the reconstruction noticed.
        done: What it did about that, in words.
        key_frames: Indices into the sequence at which a segment starts; the first is 0.
        raster: How its Gaussians are drawn; None for the defaults.
    """

    sequence: GaussianSequence
    detections: Sequence[Detection] = ()
    done: Sequence[str] = ()
    key_frames: Sequence[int] = (0,)
    raster: RasterOptions | None = None


Reconstruct = Callable[[Capture], Reconstructed]
"""Reconstructs the training views of a capture. Raises `BeamError` before it optimises if it refuses the capture."""


@dataclass(frozen=True, kw_only=True)
class CaptureOutcome(CaseOutcome):
    """The outcome of reconstructing one case.

    Attributes:
        frames: Number of frames of the capture.
        cameras: Number of training cameras.
        size: Width and height of the images [pixel].
        gaussians: Number of Gaussians in the last frame.
        detected: What the reconstruction found, in words.
        done: What it did about that, in words.
        missed: What it must find and did not, in words.
        refused: The error by which the capture was refused; empty if it was reconstructed.
        key_frames: Frames at which segments start.
        first: Scores of the first frame that has test views; empty without one.
        last: Scores of the last frame that has test views; empty without one.
        drift: Drift of the first segment's last frame against its first; empty if the truth changes topology there.
    """

    frames: int
    cameras: int
    size: tuple[int, ...] = ()
    gaussians: int = 0
    detected: tuple[str, ...] = ()
    done: tuple[str, ...] = ()
    missed: tuple[str, ...] = ()
    refused: str = ""
    key_frames: tuple[int, ...] = ()
    first: Mapping[str, Any] = field(default_factory=dict)
    last: Mapping[str, Any] = field(default_factory=dict)
    drift: Mapping[str, Any] = field(default_factory=dict)


def run_capture_case(
    reconstruct: Reconstruct, studio: StressStudio, case: StabilityCase[CaptureStress]
) -> CaptureOutcome:
    """Reconstruct one case and judge it.

    Args:
        reconstruct: The reconstruction that is tried.
        studio: The source of the captures; scores are computed on its device too.
        case: From `CAPTURE_CASES`; those of `TRACED_CASES` do not use a given capture.
    """
    stress = case.build(studio)
    capture = stress.capture
    tried = attempt(lambda: reconstruct(capture))
    outcome = CaptureOutcome(
        case=case.name,
        device=device_label(resolve_device(studio.device)),
        frames=len(capture.frames),
        cameras=len(training_cameras(capture)),
        size=(capture.records[0].camera.width, capture.records[0].camera.height),
        refused=tried.refused,
        faults=() if tried.refused and stress.may_refuse else tried.faults,
        seconds=tried.seconds,
    )
    result = tried.result
    if result is None:
        return outcome
    first, last = end_scores(capture, result.sequence, options=result.raster, device=studio.device)
    missed = tuple(str(need) for need in stress.required if not any(found.covers(need) for found in result.detections))
    return replace(
        outcome,
        gaussians=len(result.sequence[len(result.sequence) - 1]),
        detected=in_words(result.detections),
        done=tuple(result.done),
        missed=missed,
        key_frames=tuple(result.key_frames),
        first=first,
        last=last,
        drift=segment_drift(capture, result, device=studio.device),
        faults=tuple(_faults(stress, result, missed, first, last)),
    )


def end_scores(
    capture: Capture, sequence: GaussianSequence, *, options: RasterOptions | None = None, device: str | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the scores of the first and of the last frame that has test views; empty ones without any."""
    frames = [
        (index, records)
        for index, frame in enumerate(capture.frames)
        if (records := capture.select(split="test", frames=[frame])) and index < len(sequence)
    ]
    if not frames:
        return {}, {}
    scores = {
        index: score_frame(sequence[index], records, options=options, device=device).as_dict()
        for index, records in (frames[0], frames[-1])
    }
    return scores[frames[0][0]], scores[frames[-1][0]]


def segment_drift(capture: Capture, result: Reconstructed, *, device: str | None = None) -> dict[str, Any]:
    """Return the drift at the end of the first segment; empty where there is no truth of one topology, or no ids."""
    end = min([key for key in result.key_frames if key > 0] + [len(capture.frames), len(result.sequence)])
    try:
        meshes = [read_truth_mesh(capture, frame) for frame in capture.frames[:end]]
        if any(len(mesh.vertices) != len(meshes[0].vertices) for mesh in meshes):
            return {}
        clouds = (result.sequence[index] for index in range(end))
        vertices = [mesh.vertices for mesh in meshes]
        cameras = [record.camera for record in capture.select(split="train", frames=capture.frames[:1])]
        return tracking_drift(clouds, vertices, meshes[0].faces, cameras=cameras, device=device)[-1].as_dict()
    except BeamError as error:  # no truth, no ids: what is there is scored without drift, and says why
        return {"none": str(error)}


def _faults(
    stress: CaptureStress,
    result: Reconstructed,
    missed: Sequence[str],
    first: Mapping[str, Any],
    last: Mapping[str, Any],
) -> list[str]:
    """Return the reasons why a case fails."""
    faults = [f"not detected: {need}" for need in missed]
    if len(result.sequence) != len(stress.capture.frames):
        faults.append(f"{len(stress.capture.frames)} frames must come out, got {len(result.sequence)}")
    wrong = {need.camera for need in stress.required}
    blamed = sorted({found.camera for found in result.detections if found.camera is not None} - wrong)
    faults += [f"{camera} is blamed" for camera in blamed if not stress.may_blame]
    if stress.is_sound and not blamed:
        faults += [f"found where nothing is wrong: {found}" for found in result.detections]
    said = any(found.code in (TRACKING_LOST, NEW_SURFACE) for found in result.detections)
    # Phrased so that NaN fails.
    if first and not first["psnr"] - last["psnr"] <= SILENT_LOSS_DB and not said:
        faults.append(f"lost without a word: {first['psnr']:.1f} dB in the first frame, {last['psnr']:.1f} in the last")
    return faults


TITLES = (
    "case",
    "a reconstruction without precautions",
    "must",
    "detected",
    "done",
    "PSNR first, last [dB]",
    "against the sound capture",
    "normals first, last [°]",
    "depth first, last [mm]",
    "drift per vertex [mm], over frames",
    "verdict",
)


def cells(outcome: CaptureOutcome, outcomes: Sequence[CaptureOutcome]) -> tuple[str, ...]:
    """Return the cells of a case from *detected* on; the sound capture is looked for among all outcomes."""
    sound = next((other for other in outcomes if other.case == CAPTURE_CASES[0].name), None)
    return (
        "refused: " + outcome.refused if outcome.refused else ", ".join(outcome.detected) or "nothing",
        ", ".join(outcome.done) or "nothing",
        _pair(outcome, "psnr", ".2f"),
        _against(outcome, sound),
        _pair(outcome, "normals_median_degrees", ".1f"),
        _pair(outcome, "depth_median_mm", ".1f"),
        _drift(outcome),
        "; ".join(outcome.faults) or "ok",
    )


def _drift(outcome: CaptureOutcome) -> str:
    """Return the drift and its number of frames, for a table."""
    frames = min([key for key in outcome.key_frames if key > 0] + [outcome.frames])
    return f"{outcome.drift['vertices']['mean_mm']:.1f} over {frames}" if "vertices" in outcome.drift else "–"


def _against(outcome: CaptureOutcome, sound: CaptureOutcome | None) -> str:
    """Return how far PSNR is from the sound capture's, in the first and the last frame, for a table."""
    if sound is None or not (sound.first and outcome.first):
        return "–"
    pairs = ((outcome.first, sound.first), (outcome.last, sound.last))
    return ", ".join(f"{mine['psnr'] - other['psnr']:+.2f}" for mine, other in pairs)


def _pair(outcome: CaptureOutcome, name: str, form: str) -> str:
    """Return a score of the first and the last frame, for a table."""
    found = [format(scores[name], form) for scores in (outcome.first, outcome.last) if name in scores]
    return ", ".join(found) or "–"
