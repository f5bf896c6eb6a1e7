"""Fifth step of the main job: base colour from the evidence of all frames, or of each by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.decomposition.archive import FrameArchive, MeasuredFrame
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.tally import changes_of, counts_of
from beam_warp.materials.base_color import BaseColor, solve_base_color
from beam_warp.materials.changes import ChangeTest, ColorChange, with_changes
from beam_warp.materials.direct import ColorEvidence
from beam_warp.world.gaussians import GaussianCloud

AT_A_TIME = 4
"""Frames whose evidence is looked at by a thread each."""


@dataclass(frozen=True, eq=False)
class SolvedFrames:
    """Relightable frames, read one at a time.

    Attributes:
        archive: Where their measurements and solutions are.
        has_solutions: Whether base colour was solved; on the image path it was measured with everything else.
        is_varying: Whether frames have base colours of their own.
    """

    archive: FrameArchive
    has_solutions: bool
    is_varying: bool

    def cloud(self, number: int) -> GaussianCloud:
        """Read a frame."""
        cloud = self.archive.read(number).cloud
        if not self.has_solutions:
            return cloud
        return cloud.with_arrays(**self.archive.solution(number if self.is_varying else 0))


def solve_frame(plan: JobPlan, frame: MeasuredFrame) -> dict[str, Any]:
    """Solve a frame by itself, where its Gaussians are those of no other; return what `counts_of` says of it."""
    with plan.source.log.timer("solve"):
        solved = _solve(plan, frame, _evidence(frame))
        plan.archive.keep_solution(frame.number, solved)
    return counts_of(frame, frame.cloud.with_arrays(**solved.arrays()), solved.clipped_part)


@dataclass(frozen=True, eq=False)
class JointColor:
    """Base colour of Gaussians that are the same in all frames.

    Attributes:
        constant: Solved over all frames.
        change: On which Gaussians frames disagree, so that each has a colour of its own.
    """

    constant: BaseColor
    change: ColorChange

    @property
    def is_varying(self) -> bool:
        """Whether frames disagree on any."""
        return bool(self.change.changing.any())

    def of_frame(self, evidence: ColorEvidence) -> BaseColor:
        """Return the base colour of a frame, given its evidence."""
        return with_changes(self.constant, self.change, evidence)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all of it as arrays to be stored."""
        return {name: np.asarray(array) for part in (self.constant, self.change) for name, array in vars(part).items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> JointColor:
        """Return what was stored."""
        values: dict[str, Any] = {name: array if array.ndim else array.item() for name, array in arrays.items()}
        constant, change = (
            {field.name: values[field.name] for field in fields(kind)} for kind in (BaseColor, ColorChange)
        )
        return cls(BaseColor(**constant), ColorChange(**change))


def solve_jointly(
    plan: JobPlan, first: MeasuredFrame, read: Callable[[int], ColorEvidence], others: Sequence[int]
) -> tuple[JointColor, dict[str, Any]]:
    """Solve one base colour for all frames, and find the Gaussians on which frames disagree.

    The solution of the first frame is stored; without such Gaussians it is that of all. Memory does not grow with the
    number of frames.

    Args:
        plan: The job.
        first: The first frame.
        read: Returns the evidence of a frame, by its number; called by threads.
        others: Numbers of the other frames.

    Returns:
        The colour, and facts: what `counts_of` says of the first frame, and `changes_of` of all.
    """

    def look(number: int) -> tuple[ColorEvidence, NDArray[np.float64]]:
        evidence = read(number)
        return evidence, ChangeTest.terms(evidence)

    with plan.source.log.timer("solve"), ThreadPoolExecutor(AT_A_TIME) as pool:
        joint, test = _evidence(first), ChangeTest()
        test.add(joint)
        for start in range(0, len(others), AT_A_TIME):
            for evidence, terms in pool.map(look, others[start : start + AT_A_TIME]):
                joint += evidence
                test.add_terms(terms)
        change = test.result()
        constant = _solve(plan, first, joint, dispersion=change.dispersion)
        color = JointColor(constant, change)
        solved = color.of_frame(_evidence(first))
        plan.archive.keep_solution(first.number, solved)
        shown = first.cloud.with_arrays(**solved.arrays())
    return color, {"counts": [counts_of(first, shown, constant.clipped_part)], "changes": changes_of(change)}


def _solve(plan: JobPlan, frame: MeasuredFrame, evidence: ColorEvidence, *, dispersion: float = 1.0) -> BaseColor:
    return solve_base_color(frame.cloud, evidence, plan.light.prepared.mean_irradiance, dispersion=dispersion)


def _evidence(frame: MeasuredFrame) -> ColorEvidence:
    assert frame.evidence is not None
    return frame.evidence
