"""Options that state a target instead of settings, and pilots of the main job."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from tyro.conf import arg

from beam_warp.cli.common.pages import SECOND_PAGE
from beam_warp.study.targets import Rung, Target, cheapest, fitted, in_words, outcome

PILOT_RAYS = (16, 64)
"""Rays a Gaussian of the two pilots of materials; the first one compiles what is not compiled yet.

Of the demo figure they predict the errors of 256 and 1024 rays to 2.5 %; 8 and 32 rays are 15 % too low."""

LADDER_OF_RAYS = tuple(2**power for power in range(2, 13))
"""Rays a Gaussian that a target may choose: those that `MaterialOptions` takes."""


@dataclass(frozen=True)
class TargetFlags:
    """What is asked of the result: settings that are not given follow from a pilot (docs/targets.md)."""

    target_error: Annotated[
        float | None,
        arg(
            metavar="E",
            help="Take the cheapest settings of this error: of base colour (run, decompose), of display values "
            "(render), of colour in the photographs (reconstruct).",
        ),
    ] = None
    target_seconds: Annotated[
        float | None,
        arg(metavar="S", help="Take the most exact settings that are done in this time; with an error, the cheapest."),
        SECOND_PAGE,
    ] = None
    target_fps: Annotated[
        float | None, arg(metavar="F", help="The same for frames a second, without the pilot's time."), SECOND_PAGE
    ] = None

    @property
    def target(self) -> Target | None:
        """The target; None if nothing is asked.

        Raises:
            InvalidOptionError: A number is not positive.
        """
        asked = Target(error=self.target_error, seconds=self.target_seconds, fps=self.target_fps)
        return asked if asked.asked() else None


Pilot = Callable[[Path, int, int], Mapping[str, Any]]
"""Decomposes into a folder with this many rays a Gaussian, of this many frames; returns the report."""


def chosen_rays(
    target: Target, pilot: Pilot, stated: int | None, frame_count: int, elapsed: Callable[[], float]
) -> Rung:
    """Choose the rays of a decomposition by pilots of one frame, and of two where there are more.

    Errors are those that the job states of base colour: a part that rays do not mend, and noise, whose square falls as
    1 / rays. Tracing takes time in proportion to rays, all else takes the same.

    Args:
        target: What is asked.
        pilot: Does a part of the job.
        stated: Rays that the user asks for; None for any.
        frame_count: Frames of the job.
        elapsed: Returns the time since the command began [s].

    Raises:
        InvalidOptionError: The target cannot be reached.
    """
    errors, traced, rest = list[float](), 0.0, list[float]()
    frames = min(2, frame_count)
    runs = [(PILOT_RAYS[0], 1), (PILOT_RAYS[1], 1), *([(PILOT_RAYS[0], 2)] if frames == 2 else [])]
    with TemporaryDirectory() as folder:
        for rays, count in runs:
            started = time.perf_counter()
            report = pilot(Path(folder) / f"{rays}_{count}", rays, count)
            seconds, tracing = time.perf_counter() - started, report["seconds"].get("materials", 0.0)
            errors.append(report["materials"]["mean_base_color_error_where_measured"])
            rest.append(seconds - tracing)
            traced = tracing if (rays, count) == runs[1] else traced
    floor, noise = fitted([[1.0, 1.0 / rays] for rays in PILOT_RAYS], [error**2 for error in errors[:2]])
    more = max(rest[2] - rest[1], 0.0) * (frame_count - 1) if frames == 2 else 0.0

    def rung(rays: int) -> Rung:
        seconds = rest[1] + more + frame_count * traced * rays / PILOT_RAYS[1]
        return Rung(
            settings={"samples": rays},
            seconds=seconds,
            frame_seconds=seconds / frame_count,
            error=float(floor + noise / rays) ** 0.5,
            spent=elapsed(),
        )

    return cheapest([rung(rays) for rays in (LADDER_OF_RAYS if stated is None else (stated,))], target)


def state(
    report: dict[str, Any], folder: Path, target: Target, chosen: Rung, error: float | None, frames: int, seconds: float
) -> None:
    """Write into a job's report what was asked, chosen, predicted and reached; warn where the target was missed.

    Args:
        report: The report, written to ``folder/report.json`` already.
        folder: Folder of the job.
        target: What was asked.
        chosen: What it chose.
        error: Error that was reached; None where it is not known.
        frames: Frames of the job.
        seconds: Time since the command began [s].
    """
    from beam_warp.jobs.report import write_report

    reached = {"error": error, "seconds": seconds, "fps": frames / max(seconds - chosen.spent, 1e-12)}
    report["target"] = outcome(target, chosen, reached)
    if not report["target"]["met"]:
        report["warnings"].append(in_words(report["target"]))
    write_report(folder, report)
