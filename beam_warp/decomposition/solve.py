"""Fifth step of the main job: base colour from the evidence of all frames, or of each by itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from beam_warp.decomposition.archive import FrameArchive, MeasuredFrame
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.tally import MaterialTally, counts_of
from beam_warp.materials.base_color import BaseColor, solve_base_color
from beam_warp.materials.changes import ChangeTest, with_changes
from beam_warp.materials.direct import ColorEvidence
from beam_warp.world.gaussians import GaussianCloud


@dataclass(frozen=True, eq=False)
class SolvedFrames:
    """Relightable frames, read one at a time.

    Attributes:
        archive: Where their measurements and solutions are.
        has_solutions: Whether base colour was solved; on the image path it was measured with everything else.
        is_varying: Whether frames have base colours of their own.
        statistics: See `beam_warp.decomposition.tally.MaterialTally.summary`.
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


def take(plan: JobPlan, frames: Iterable[MeasuredFrame]) -> SolvedFrames:
    """Take frames of the image path as they are."""
    counts = (counts_of(frame, frame.cloud) for frame in frames)
    return SolvedFrames(plan.archive, False, True, _added(counts).summary())


def solve_frame(plan: JobPlan, frame: MeasuredFrame) -> dict[str, Any]:
    """Solve a frame by itself, where its Gaussians are those of no other; return what `counts_of` says of it."""
    with plan.source.log.timer("solve"):
        solved = _solve(plan, frame, _evidence(frame))
        plan.archive.keep_solution(frame.number, solved)
    return counts_of(frame, frame.cloud.with_arrays(**solved.arrays()), solved.clipped_part)


def take_each(plan: JobPlan, counts: Iterable[Mapping[str, Any]]) -> SolvedFrames:
    """Take frames that were solved by themselves, given what `counts_of` says of each."""
    return SolvedFrames(plan.archive, True, True, _added(counts).summary())


def _added(counts: Iterable[Mapping[str, Any]]) -> MaterialTally:
    tally = MaterialTally()
    for frame in counts:
        tally.add(frame)
    return tally


def solve_jointly(plan: JobPlan, frames: Iterable[MeasuredFrame]) -> SolvedFrames:
    """Solve one base colour for all frames, and one a frame for Gaussians on which frames disagree.

    Solutions are stored. Memory does not grow with the number of frames: if some Gaussian changes, they are read again.
    """
    first, joint, test, count = None, None, ChangeTest(), 0
    for frame in frames:
        with plan.source.log.timer("solve"):
            evidence = _evidence(frame)
            first = first or frame
            joint = evidence if joint is None else joint + evidence
            test.add(evidence)
            count += 1
    assert first is not None
    assert joint is not None
    tally = MaterialTally()
    with plan.source.log.timer("solve"):
        change = test.result()
        constant = _solve(plan, first, joint, dispersion=change.dispersion)
        is_varying = bool(change.changing.any())
        for number in range(count if is_varying else 1):
            frame = first if number == 0 else plan.archive.read(number)
            solved = with_changes(constant, change, _evidence(frame))
            plan.archive.keep_solution(number, solved)
            if number == 0:
                tally.add(counts_of(first, first.cloud.with_arrays(**solved.arrays()), constant.clipped_part))
    tally.count_changes(change)
    return SolvedFrames(plan.archive, True, is_varying, tally.summary())


def _solve(plan: JobPlan, frame: MeasuredFrame, evidence: ColorEvidence, *, dispersion: float = 1.0) -> BaseColor:
    return solve_base_color(frame.cloud, evidence, plan.light.prepared.mean_irradiance, dispersion=dispersion)


def _evidence(frame: MeasuredFrame) -> ColorEvidence:
    assert frame.evidence is not None
    return frame.evidence
