"""Roughness of each frame of a job: as it is stated, or estimated from what views of some frames show."""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.decomposition.options import ESTIMATE
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.seen import SeenFrame
from beam_warp.digests import array_digest
from beam_warp.jobs.store import kept_frame
from beam_warp.materials.roughness import RoughnessProfile, measure_roughness_profile, solve_roughness
from beam_warp.materials.roughness_source import stated_roughness

ROUGHNESS_FRAMES = 8
"""Frames of persistent Gaussians that roughness is found from, evenly spread: more add little that is new."""


class RoughnessFinder:
    """Finds the roughness of frames; an estimate is made once and kept beside the finished frames.

    Attributes:
        report: How the last estimate came about, JSON-able; empty if none was made.
    """

    def __init__(self, plan: JobPlan) -> None:
        """Start with no estimate."""
        self.report: dict[str, Any] = {}
        self._plan = plan
        self._shared: dict[str, NDArray[np.float32]] | None = None

    def arrays(self, frame: SeenFrame) -> dict[str, NDArray[np.float32]]:
        """Return ``roughness`` of a frame's Gaussians, ``(N,)``, and ``roughness_error`` where it is estimated."""
        if self._plan.source.options.roughness != ESTIMATE:
            return {"roughness": stated_roughness(frame.original, self._plan.source.options.roughness)}
        if not self._plan.persistent:
            return self._estimated(frame, frame.number, [frame.number])
        if self._shared is None:
            count = len(self._plan.source.sequence)
            places = np.linspace(0, count - 1, min(count, ROUGHNESS_FRAMES))
            self._shared = self._estimated(frame, 0, sorted({round(place) for place in places}))
        return self._shared

    def _estimated(self, frame: SeenFrame, number: int, asked: list[int]) -> dict[str, NDArray[np.float32]]:
        """Return what the views of some frames show of roughness, kept under a number."""
        keys = (self._plan.source.key(self._plan.key, self._frame(n, frame)) for n in asked)

        def find() -> dict[str, NDArray[np.float32]]:
            estimate = solve_roughness(frame.cloud.positions, self._profile(frame, asked))
            self.report = estimate.report
            return {"roughness": estimate.roughness, "roughness_error": estimate.standard_error}

        key = array_digest(text=" ".join((self._plan.key, *keys)))
        return kept_frame(self._plan.archive.folder / f"roughness_{number:06d}.h5", key, find)

    def _profile(self, frame: SeenFrame, asked: list[int]) -> RoughnessProfile:
        """Measure some frames of the same Gaussians and add them up."""

        def measure(number: int) -> RoughnessProfile:
            seen = self._frame(number, frame)
            scene, points, views = seen.scene, seen.points, seen.views
            with seen.log.timer("roughness"):
                return measure_roughness_profile(
                    seen.cloud,
                    scene,
                    points,
                    self._plan.light.prepared,
                    views,
                    options=self._plan.source.options.gathering,
                    frame=number,
                    progress=seen.log.within("roughness", number),
                )

        return reduce(add, map(measure, asked))

    def _frame(self, number: int, known: SeenFrame) -> SeenFrame:
        """Return a frame, which need not be read if it is the one that is at hand."""
        return known if number == known.number else self._plan.source.frame(number)
