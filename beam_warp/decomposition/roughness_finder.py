"""Roughness of the frames of a job, estimated from what views of some frames show.

What each frame says is measured by itself, so that several workers may share the frames. Where a pilot, some Gaussians
of the first frame, finds that views say nothing of roughness, no frame is measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.seen import SeenFrame
from beam_warp.materials.roughness import LEAST_AGREEMENT, RoughnessEstimate, evenly_spread, solve_roughness
from beam_warp.materials.roughness_profile import RoughnessProfile, measure_roughness_profile

ROUGHNESS_FRAMES = 8
"""Most frames of persistent Gaussians that roughness is found from: more add little that is new."""

PILOT_GAUSSIANS = 2048
"""Gaussians by which it is told whether views say anything of roughness."""

LEAST_SAVED = 16
"""How many times as many Gaussians a frame must have for a pilot: it then costs a sixteenth of a frame at most."""


def asked_frames(count: int) -> list[int]:
    """Return the numbers of the frames that the roughness of persistent Gaussians is found from, of so many."""
    return sorted({round(place) for place in np.linspace(0, count - 1, min(count, ROUGHNESS_FRAMES))})


def find_roughness(
    positions: NDArray[np.float32], profiles: Iterable[RoughnessProfile], frame_count: int = 1
) -> RoughnessEstimate:
    """Estimate the roughness of Gaussians from what the views of some frames say, which all have them.

    Where there are more frames, the report's ``frames_left_out`` says how many, and ``change_by_all`` by how much
    roughness would change if they were asked too (root mean square), judged by what half of the frames leave out.

    Args:
        positions: Of the Gaussians in the first of these frames [m], ``(N, 3)``.
        profiles: Of the frames, taken one at a time; none where views say nothing.
        frame_count: How many frames there are.
    """
    halves = [RoughnessProfile.of_nothing(len(positions))] * 2
    for place, profile in enumerate(profiles):
        halves[place % 2] += profile
    found = solve_roughness(positions, halves[0] + halves[1])
    asked = found.report["frames"]
    if 2 <= asked < frame_count:
        # Of the variance of one frame, the other half of n frames takes 2 / n - 1 / n, and N frames take 1 / n - 1 / N.
        changes = [solve_roughness(positions, half).roughness - found.roughness for half in halves]
        change = float(np.sqrt((1.0 - asked / frame_count) * np.mean(np.square(changes))))
        found.report.update(frames_left_out=frame_count - asked, change_by_all=change)
    return found


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
