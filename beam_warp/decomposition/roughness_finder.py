"""Roughness of the frames of a job, estimated from what views of some frames show.

What each frame says is measured by itself, so that several workers may share the frames. Frames count as long as they
change the answer by more than a part of its own stated error. Where a pilot, some Gaussians of the first frame, finds
that views say nothing of roughness, no frame is measured.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.seen import SeenFrame
from beam_warp.materials.roughness import (
    LEAST_AGREEMENT,
    RoughnessEstimate,
    RoughnessProfile,
    evenly_spread,
    measure_roughness_profile,
    solve_roughness,
)

ROUGHNESS_FRAMES = 8
"""Most frames of persistent Gaussians that roughness is found from: more add little that is new."""

PILOT_GAUSSIANS = 2048
"""Gaussians by which it is told whether views say anything of roughness."""

TOLD_GAUSSIANS = 16_384
"""Gaussians by which it is told whether more frames would change roughness: of fewer, weights of evidence jump, and
with 2,048 of a person's 20,000 the change that was said was a third to three times as large."""

LEAST_SAVED = 16
"""How many times as many Gaussians a frame must have for a pilot: it then costs a sixteenth of a frame at most."""

PART = 0.1
"""Part of its own stated error by which leaving out frames may change roughness: the mean square of its error then
grows by a hundredth, and its PSNR falls by 0.04 dB."""


def asked_frames(count: int) -> list[int]:
    """Return the numbers of the frames that the roughness of persistent Gaussians is found from, of so many.

    Each is as far from those before it as it can be, so that the first few are spread over the take as well.
    """
    left = sorted({round(place) for place in np.linspace(0, count - 1, min(count, ROUGHNESS_FRAMES))})
    order = [left.pop(0)]
    while left:
        distances = [min(abs(number - other) for other in order) for number in left]
        order.append(left.pop(int(np.argmax(distances))))
    return order


def find_roughness(
    positions: NDArray[np.float32], profiles: Iterable[RoughnessProfile], count: int
) -> RoughnessEstimate:
    """Estimate the roughness of Gaussians from what the views of some frames say, which all have them.

    The report also has ``frames_left_out``, and by how much these would have changed roughness, root mean square,
    as far as the frames before them tell (``left_out_change``).

    Args:
        positions: Of the Gaussians in the first of these frames [m], ``(N, 3)``.
        profiles: Of the frames, taken one at a time, as long as they are needed; none where views say nothing.
        count: How many frames there are.
    """
    asked = evenly_spread(positions, TOLD_GAUSSIANS)
    total: RoughnessProfile | None = None
    told: RoughnessEstimate | None = None
    used, change = 0, 0.0
    for profile in profiles:
        total, used = profile if total is None else total + profile, used + 1
        if used == count:
            change = 0.0
        elif count > 2:  # one change must be known before a frame is left out
            found = solve_roughness(positions[asked], total.of(asked))
            if told is not None:
                change = _change_by_more(told, found, used, count)
                if change <= PART * _size(found.standard_error):
                    break
            told = found
    estimate = solve_roughness(positions, total or RoughnessProfile.of_nothing(len(positions)))
    left_out = {"frames_left_out": count - used, "left_out_change": change}
    return replace(estimate, report={**estimate.report, **left_out})


def profiles_of(plan: JobPlan, frames: Iterable[SeenFrame], count: int) -> Iterator[RoughnessProfile]:
    """Yield what views of each frame say of its Gaussians; nothing where a pilot finds that they say nothing.

    Args:
        plan: The job.
        frames: Read one at a time.
        count: How many there are.
    """
    for place, seen in enumerate(frames):
        if place == 0 and are_silent(plan, seen, count):
            return
        yield measured_profile(plan, seen)


def measured_profile(plan: JobPlan, seen: SeenFrame, rows: NDArray[np.intp] | None = None) -> RoughnessProfile:
    """Return what views of a frame say of all of its Gaussians, or of some."""
    scene, points, views = seen.scene, seen.points, seen.views
    with seen.log.timer("roughness"):
        return measure_roughness_profile(
            seen.cloud,
            scene,
            points,
            plan.light.prepared,
            views,
            options=plan.source.options.gathering,
            frame=seen.number,
            rows=rows,
            progress=seen.log.within("roughness", seen.number),
        )


def are_silent(plan: JobPlan, seen: SeenFrame, count: int) -> bool:
    """Return whether views say so little of some Gaussians that all of them, in so many frames, would claim nothing."""
    gaussians, asked = len(seen.cloud), evenly_spread(seen.cloud.positions, PILOT_GAUSSIANS)
    if gaussians < LEAST_SAVED * len(asked):
        return False
    report = solve_roughness(seen.cloud.positions[asked], measured_profile(plan, seen, asked)).report
    agreement = max(report[scale]["agreement"] for scale in ("near", "wide"))
    return agreement * count * gaussians / len(asked) <= LEAST_AGREEMENT


def _change_by_more(before: RoughnessEstimate, after: RoughnessEstimate, used: int, count: int) -> float:
    """Return by how much more frames would change an estimate, root mean square, as the last one tells.

    A mean over k independent frames is off from that over n by as much as 1 / k - 1 / n, in the mean square.
    """
    last = _size(after.roughness - before.roughness)
    return last * math.sqrt((1.0 / used - 1.0 / count) / (1.0 / (used - 1) - 1.0 / used))


def _size(values: NDArray[Any]) -> float:
    """Return the root mean square of values."""
    return float(np.sqrt(np.mean(np.square(values), dtype=np.float64)))
