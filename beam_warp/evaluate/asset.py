"""The evaluation of an asset: its scores, and the files that show and repeat them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beam_warp.capture.capture import Capture
from beam_warp.capture.matching import match_frames, scored_frames
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.materials import EvaluateOptions, score_materials
from beam_warp.evaluate.scores import MaterialScores
from beam_warp.evaluate.sheet import evaluation_sheet
from beam_warp.evaluate.views import ScoredView
from beam_warp.image.files import write_exr, write_png
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.jobs.report import device_facts, versions, write_json
from beam_warp.jobs.store import make_folders
from beam_warp.reconstruction.preview import opposite_cameras
from beam_warp.world.gaussians import GaussianSequence

REPORT_NAME = "evaluation.json"
SHEET_NAME = "evaluation.png"


@dataclass(frozen=True)
class Evaluation:
    """Scores of an asset and their report.

    Attributes:
        scores: The scores.
        report: The same with versions, device and seconds, JSON-able.
    """

    scores: MaterialScores
    report: dict[str, Any]


def evaluate_asset(
    sequence: GaussianSequence,
    capture: Capture,
    options: EvaluateOptions | None = None,
    *,
    out: Path | None = None,
    renders: Path | None = None,
    progress: StageProgress = no_progress,
) -> Evaluation:
    """Score an asset; write a report and a picture, and the images that were scored, as far as they are asked for.

    Args:
        sequence: See `score_materials`.
        capture: See `score_materials`.
        options: See `EvaluateOptions`.
        out: Folder for ``evaluation.json`` and ``evaluation.png``; made if it does not exist.
        renders: Folder for the images: ``CAMERA_FRAME.exr`` with the layers of the capture's truth, R, G, B being the
            captured colour, and ``RELIGHTER_LIGHT/CAMERA_FRAME.exr``; made if it does not exist.
        progress: Called with (stage, done, total).

    Raises:
        BeamError: As `score_materials`.
        OutputError: A folder cannot be made or written.
    """
    started = time.perf_counter()
    chosen = options or EvaluateOptions()
    device = resolve_device(chosen.device)
    frames = scored_frames(capture, match_frames(sequence, chosen.frames), split=chosen.split)
    shown = _shown_views(capture, frames, chosen.split)
    for folder in (out, renders):
        if folder is not None:
            make_folders(folder)
    kept: dict[str, ScoredView] = {}

    def observe(view: ScoredView) -> None:
        if renders is not None:
            _write_renders(renders, view)
        if out is not None and view.record.name in shown:
            kept[view.record.name] = view

    scores = score_materials(sequence, capture, chosen, observe=observe, progress=progress)
    report = {
        **scores.as_dict(),
        "capture": str(capture.folder),
        "device": device_facts(device),
        "versions": versions(),
        "seconds": round(time.perf_counter() - started, 3),
    }
    if out is not None:
        write_png(out / SHEET_NAME, evaluation_sheet([kept[name] for name in shown]))
        write_json(out / REPORT_NAME, report)
    return Evaluation(scores, report)


def _shown_views(capture: Capture, frames: Sequence[int], split: str) -> list[str]:
    """Return the names of the views that are drawn: two from opposite sides, of the frame in the middle."""
    frame = frames[len(frames) // 2]
    records = [r for r in capture.select(split=split, frames={frame}) if r.truth_path is not None]
    return [records[index].name for index in opposite_cameras([record.camera for record in records])]


def _write_renders(folder: Path, view: ScoredView) -> None:
    """Write the images of one view, in the layout of a capture's truth."""
    name = f"{view.record.name}.exr"
    write_exr(folder / name, view.drawn.layers())
    for relighter, by_light in view.relit.items():
        for light, image in by_light.items():
            (place,) = make_folders(folder, f"{relighter}_{light}")
            layers = {part: image.rgb[..., index] for index, part in enumerate("RGB")}
            write_exr(place / name, {**layers, "A": image.alpha})
