"""What reconstructions cost and how wrong they are in views that they did not see: a study of ``beam chart``."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import warp as wp

from beam_warp._version import __version__
from beam_warp.capture.capture import Capture
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidOptionError
from beam_warp.jobs.listeners import no_progress
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.scores import score_frame
from beam_warp.reconstruction.steps import FitAndTrack
from beam_warp.reconstruction.track import TrackOptions
from beam_warp.study.table import Axis, Interval, Metric, Row, Settings, Study, StudySubject
from beam_warp.study.tracing import device_name
from beam_warp.world.environment import EnvironmentMap

COLOR, NORMALS = "color_error", "normal_error"


def reconstruction_study(
    capture: Capture,
    frame: int,
    *,
    name: str,
    gaussians: Sequence[int],
    schedules: Sequence[str] = ("draft", "fast"),
    shares: Sequence[float] = (1.0, 0.5),
    device: str | None = None,
) -> Study:
    """Prepare the reconstruction study: Gaussians, schedules and cameras of a key frame.

    Args:
        capture: Images and cameras; its split ``test`` is the truth.
        frame: Number of the frame.
        name: What to call the capture.
        gaussians: Most Gaussians, rising.
        schedules: Presets of `FitOptions`, the cheapest first.
        shares: Parts of the cameras that are used, all of them first.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        InvalidOptionError: The capture has no views of the frame for training or for tests.
    """
    target = resolve_device(device)
    train, test = (capture.select(split=split, frames={frame}) for split in ("train", "test"))
    if not train or not test:
        raise InvalidOptionError(
            f"capture must have views of frame {frame} of the splits train and test, got {len(train)} and {len(test)}. "
            "Keep some of its cameras for the test."
        )
    counts = tuple(dict.fromkeys(max(2, round(share * len(train))) for share in shares))
    views = [record.view() for record in train]
    fits = {each: FitOptions.of_preset(each) for each in schedules}
    steps = {each: fit.color_iterations + fit.normal_iterations for each, fit in fits.items()}
    is_true = any(record.truth_path is not None for record in test)
    truth = f"{len(test)} photographs of test cameras, which are not used"
    subject = StudySubject(
        name="reconstruct",
        title=f"Error against time of reconstruction: {name}, frame {frame}, {device_name(target)}",
        axes=(
            Axis("gaussians", "Gaussians", tuple(sorted(gaussians)), sentence="Most Gaussians of the frame."),
            Axis("steps", "Steps", tuple(steps.values()), "steps", f"Of the presets {', '.join(steps)}."),
            Axis("cameras", "Cameras", counts, "cameras", "Training cameras that are used, evenly chosen."),
        ),
        metrics=(
            Metric(
                COLOR,
                "RMS error of novel views",
                color="cameras",
                marker="steps",
                sentence=f"Against {truth}; display values in the subject's box.",
            ),
            *([Metric(NORMALS, "Median error of normals", "degree", "cameras", "steps")] if is_true else []),
        ),
        cost="Time of a key frame",
        cost_unit="s",
        ladder="gaussians",
        notes={
            "Truth": truth,
            "Time": "one fit, with its start from images; the first one's also has compilation",
            "Error bars": "95 %, bootstrap over test views; of normals, none",
            "Versions": f"beam-warp {__version__}, Warp {wp.__version__}",
        },
    )
    presets = {count: preset for preset, count in steps.items()}

    light = None if capture.environment_path is None else EnvironmentMap.read(capture.environment_path)

    def measure(settings: Settings) -> Row:
        chosen = np.linspace(0, len(views) - 1, int(settings["cameras"])).round().astype(int)
        preset = presets[int(settings["steps"])]
        fitting = FitOptions.of_preset(preset, gaussian_count=settings["gaussians"])
        work = FitAndTrack(
            fitting=fitting,
            tracking=TrackOptions.of_preset(preset),
            points=capture.points(),
            environment=light,
            device=str(target),
        )
        started = time.perf_counter()
        track, report = work.begin([views[index] for index in chosen], no_progress)
        seconds = time.perf_counter() - started
        scores = score_frame(
            track.cloud, test, options=fitting.raster, samples=int(report["samples"]), device=str(target)
        )
        squares = [10.0 ** (-view.novel_view.psnr / 10.0) for view in scores.views]
        errors = {COLOR: Interval.of_root_mean_square(squares)}
        if scores.normals_median_degrees is not None:
            errors[NORMALS] = Interval.of_median([scores.normals_median_degrees])
        return Row(settings, Interval.of_median([seconds]), errors)

    plan: list[Settings] = [
        {"gaussians": most, "steps": count, "cameras": used}
        for used in counts
        for count in steps.values()
        for most in sorted(gaussians)
    ]
    return Study(subject, plan, measure, lambda settings: int(settings["steps"]) * (2000 + int(settings["gaussians"])))
