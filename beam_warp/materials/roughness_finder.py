"""Roughness of each frame of a job: as it is stated, or estimated from what views of some frames show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.digests import array_digest
from beam_warp.jobs.progress import JobLog
from beam_warp.jobs.store import kept_frame
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.options import ESTIMATE, RunOptions
from beam_warp.materials.roughness import RoughnessProfile, measure_roughness_profile, solve_roughness
from beam_warp.materials.roughness_source import stated_roughness
from beam_warp.materials.seen import SeenFrame
from beam_warp.materials.source import Source

ROUGHNESS_FRAMES = 8
"""Frames of persistent Gaussians that roughness is found from, evenly spread: more add little that is new."""


class RoughnessFinder:
    """Finds the roughness of frames; an estimate is made once and kept in a folder.

    Attributes:
        report: How the last estimate came about, JSON-able; empty if none was made.
    """

    def __init__(
        self,
        source: Source,
        light: PreparedEnvironment,
        options: RunOptions,
        *,
        persistent: bool,
        key: str,
        folder: Path,
        log: JobLog,
    ) -> None:
        """Take what roughness is estimated from.

        Args:
            source: The frames.
            light: The light of the capture.
            options: What roughness is asked for, and rays.
            persistent: Whether row i is the same Gaussian in every frame, so that one estimate serves all.
            key: Key of the job.
            folder: Where estimates are kept.
            log: Told how far and how long steps take.
        """
        self.report: dict[str, Any] = {}
        self._source, self._light, self._options = source, light, options
        self._persistent, self._key, self._folder, self._log = persistent, key, folder, log
        self._shared: dict[str, NDArray[np.float32]] | None = None

    def arrays(self, frame: SeenFrame) -> dict[str, NDArray[np.float32]]:
        """Return ``roughness`` of a frame's Gaussians, ``(N,)``, and ``roughness_error`` where it is estimated."""
        if self._options.roughness != ESTIMATE:
            return {"roughness": stated_roughness(frame.original, self._options.roughness)}
        if not self._persistent:
            return self._estimated(frame, frame.number, [frame.number])
        if self._shared is None:
            count = len(self._source.sequence)
            places = np.linspace(0, count - 1, min(count, ROUGHNESS_FRAMES))
            self._shared = self._estimated(frame, 0, sorted({round(place) for place in places}))
        return self._shared

    def _estimated(self, frame: SeenFrame, number: int, asked: list[int]) -> dict[str, NDArray[np.float32]]:
        """Return what the views of some frames show of roughness, kept under a number."""
        keys = (self._source.key(self._key, self._frame(n, frame)) for n in asked)

        def find() -> dict[str, NDArray[np.float32]]:
            estimate = solve_roughness(frame.cloud.positions, self._profile(frame, asked))
            self.report = estimate.report
            return {"roughness": estimate.roughness, "roughness_error": estimate.standard_error}

        key = array_digest(text=" ".join((self._key, *keys)))
        return kept_frame(self._folder / f"roughness_{number:06d}.h5", key, find)

    def _profile(self, frame: SeenFrame, asked: list[int]) -> RoughnessProfile:
        """Measure some frames of the same Gaussians and add them up."""
        total = None
        for number in asked:
            seen = self._frame(number, frame)
            scene, points, views = seen.scene, seen.points, seen.views
            with self._log.timer("roughness"):
                found = measure_roughness_profile(
                    seen.cloud,
                    scene,
                    points,
                    self._light,
                    views,
                    options=self._options.materials,
                    frame=number,
                    progress=self._log.within("roughness", number),
                )
            total = found if total is None else total + found
        assert total is not None
        return total

    def _frame(self, number: int, known: SeenFrame) -> SeenFrame:
        """Return a frame, which need not be read if it is the one that is at hand."""
        return known if number == known.number else self._source.frame(number)
