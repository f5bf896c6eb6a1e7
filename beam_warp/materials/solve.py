"""Fifth step of the main job: base colour from the evidence of all frames, or of each by itself."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from beam_warp.jobs.progress import JobLog
from beam_warp.materials.archive import FrameArchive, MeasuredFrame
from beam_warp.materials.base_color import BaseColor, solve_base_color
from beam_warp.materials.changes import ChangeTest, with_changes
from beam_warp.materials.direct import ColorEvidence
from beam_warp.materials.tally import MaterialTally
from beam_warp.world.gaussians import GaussianCloud


@dataclass(frozen=True, eq=False, kw_only=True)
class SolvedFrames:
    """Relightable frames, read one at a time.

    Attributes:
        archive: Where their measurements and solutions are.
        has_solutions: Whether base colour was solved; on the image path it was measured with everything else.
        is_varying: Whether frames have base colours of their own.
        statistics: See `beam_warp.materials.tally.MaterialTally.summary`.
    """

    archive: FrameArchive
    has_solutions: bool
    is_varying: bool
    statistics: dict[str, Any]

    def cloud(self, number: int) -> GaussianCloud:
        """Read a frame."""
        cloud = self.archive.read(number).cloud
        if not self.has_solutions:
            return cloud
        return cloud.with_arrays(**self.archive.solution(number if self.is_varying else 0))


class FrameSolver:
    """Solves base colour and stores it; memory does not grow with the number of frames."""

    def __init__(self, archive: FrameArchive, key: str, mean_irradiance: float, log: JobLog) -> None:
        """Take what solving needs.

        Args:
            archive: Where solutions are stored, and where frames are read that are needed twice.
            key: Key of the job, which solutions are stored under.
            mean_irradiance: The environment's mean unshadowed irradiance [W/m^2].
            log: Told how long solving takes.
        """
        self._archive, self._key, self._mean_irradiance, self._log = archive, key, mean_irradiance, log

    def take(self, frames: Iterable[MeasuredFrame]) -> SolvedFrames:
        """Take frames of the image path as they are."""
        tally = MaterialTally()
        for frame in frames:
            tally.add(frame, frame.cloud)
        return self._solved(tally, is_varying=True, has_solutions=False)

    def solve_each(self, frames: Iterable[MeasuredFrame]) -> SolvedFrames:
        """Solve every frame by itself: its Gaussians are those of no other."""
        tally = MaterialTally()
        for frame in frames:
            with self._log.timer("solve"):
                solved = self._solve(frame, _evidence(frame))
                self._keep(frame, solved, tally)
        return self._solved(tally, is_varying=True)

    def solve_jointly(self, frames: Iterable[MeasuredFrame]) -> SolvedFrames:
        """Solve one base colour for all frames, and one a frame for Gaussians on which frames disagree."""
        first, joint, test, count = None, None, ChangeTest(), 0
        for frame in frames:
            with self._log.timer("solve"):
                evidence = _evidence(frame)
                first = first or frame
                joint = evidence if joint is None else joint + evidence
                test.add(evidence)
                count += 1
        assert first is not None
        assert joint is not None
        with self._log.timer("solve"):
            change = test.result()
            constant = self._solve(first, joint, dispersion=change.dispersion)
            is_varying = bool(change.changing.any())
            tally = MaterialTally()
            self._keep(first, with_changes(constant, change, _evidence(first)), tally)
            for number in range(1, count if is_varying else 1):
                evidence = _evidence(self._archive.read(number))
                self._archive.keep_solution(number, self._key, with_changes(constant, change, evidence))
            tally.count_changes(change)
        return self._solved(tally, is_varying=is_varying)

    def _solve(self, frame: MeasuredFrame, evidence: ColorEvidence, *, dispersion: float = 1.0) -> BaseColor:
        return solve_base_color(frame.cloud, evidence, self._mean_irradiance, dispersion=dispersion)

    def _keep(self, frame: MeasuredFrame, solved: BaseColor, tally: MaterialTally) -> None:
        """Store a solution and count its frame."""
        self._archive.keep_solution(frame.number, self._key, solved)
        tally.add(frame, frame.cloud.with_arrays(**solved.arrays()), solved.clipped_part)

    def _solved(self, tally: MaterialTally, *, is_varying: bool, has_solutions: bool = True) -> SolvedFrames:
        return SolvedFrames(
            archive=self._archive,
            has_solutions=has_solutions,
            is_varying=is_varying,
            statistics=tally.summary(),
        )


def _evidence(frame: MeasuredFrame) -> ColorEvidence:
    assert frame.evidence is not None
    return frame.evidence
