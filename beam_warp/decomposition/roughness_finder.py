"""Roughness of the frames of a job: as it is stated, or estimated from what views of some frames show."""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce
from operator import add

import numpy as np

from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.seen import SeenFrame
from beam_warp.materials.roughness import (
    RoughnessEstimate,
    RoughnessProfile,
    measure_roughness_profile,
    solve_roughness,
)

ROUGHNESS_FRAMES = 8
"""Frames of persistent Gaussians that roughness is found from, evenly spread: more add little that is new."""


def asked_frames(count: int) -> list[int]:
    """Return the numbers of the frames that the roughness of persistent Gaussians is found from, of so many."""
    return sorted({round(place) for place in np.linspace(0, count - 1, min(count, ROUGHNESS_FRAMES))})


def find_roughness(plan: JobPlan, frames: Iterable[SeenFrame]) -> RoughnessEstimate:
    """Estimate the roughness of Gaussians from what the views of some frames show, which all have them."""
    positions: list[np.ndarray] = []

    def measure(seen: SeenFrame) -> RoughnessProfile:
        positions[:] = positions or [seen.cloud.positions]
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
                progress=seen.log.within("roughness", seen.number),
            )

    profile = reduce(add, map(measure, frames))
    return solve_roughness(positions[0], profile)
