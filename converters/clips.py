"""Long USD assets, whose value clips are steps of a plan: workers write them, and only small layers are left to do.

A clip must be written in the precision that is safe for the whole sequence, and hold what varies in it. So the frames
of each clip are surveyed first, as soon as they are made; the surveys are added up; and then the clips are written, in
any order. The result has the same bytes as `beam_warp.converters.write` of the whole sequence. OpenUSD is loaded by the
steps alone: whoever hands them out, and workers that do others, start without it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, reduce
from operator import add
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beam_warp.converters.common.options import WriteOptions
from beam_warp.digests import code_digest
from beam_warp.jobs.listeners import NotedProgress
from beam_warp.plan.steps import Plan, Rank, Receipt, Step, Task
from beam_warp.schema.clips import CLIP_FRAMES, MAX_FRAMES_IN_ONE_LAYER, clip_name
from beam_warp.world.gaussians import GaussianSequence

if TYPE_CHECKING:
    from beam_warp.schema.survey import Survey

FOLDER = "clips"
"""Folder of the clips, in that of the asset; the asset's own are second names of the same files."""


@dataclass(eq=False)
class ClipWork:
    """Steps that survey a sequence part by part, add the surveys up, and write the clips to ``folder/clips``.

    Attributes:
        folder: Folder of the asset.
        stem: Name of the asset without its suffix; names of steps and stages begin with it.
        read: Returns the sequence, to be read when its frames are made; its topology is not constant. Picklable.
        makers: Names of the steps that make each frame; the results of a frame follow from their keys alone.
        numbers: What the frames are called.
    """

    folder: Path
    stem: str
    read: Callable[[], GaussianSequence]
    makers: Sequence[tuple[str, ...]]
    numbers: Sequence[int]

    def plan(self) -> Plan:
        """Return the steps; none for a sequence that is written without clips."""
        if len(self.makers) <= MAX_FRAMES_IN_ONE_LAYER:
            return Plan(self.folder, (), {})
        (self.folder / FOLDER).mkdir(parents=True, exist_ok=True)
        parts, clips = list[Step](), list[Step]()
        for start in range(0, len(self.makers), CLIP_FRAMES):
            made = tuple(name for names in self.makers[start : start + CLIP_FRAMES] for name in names)
            first, label = self.numbers[start], f"{start:06d}"
            parts.append(Step(f"{self._survey}-{label}", self._survey, first, made, Rank.PREVIEW))
            clips.append(Step(f"{self._clip}-{label}", self._clip, first, (self._whole, *made), Rank.PREVIEW))
        whole = Step(self._whole, self._whole, None, tuple(part.name for part in parts), Rank.SHARED)
        steps = (*parts, whole, *clips)
        return Plan(self.folder, steps, dict.fromkeys((step.stage for step in steps), self))

    def write(self, sequence: GaussianSequence, path: Path, receipts: Mapping[str, Receipt]) -> list[Path]:
        """Write an asset, or what is left of it to write when all steps are done; return its files, the root last."""
        from beam_warp.converters import usd
        from beam_warp.schema.writer import WrittenClips

        known = receipts.get(self._whole)
        clips = None if known is None else WrittenClips(_survey_of(known.facts), self.folder / FOLDER)
        return usd.write(sequence, path, WriteOptions(), clips)

    @property
    def _survey(self) -> str:
        return f"{self.stem}-survey"

    @property
    def _whole(self) -> str:
        return f"{self.stem}-whole"

    @property
    def _clip(self) -> str:
        return f"{self.stem}-clip"

    @cached_property
    def _sequence(self) -> GaussianSequence:
        from beam_warp.converters import usd

        return usd.prepared(self.read())

    def __getstate__(self) -> dict[str, Any]:
        """Return what other processes need: nothing that was read."""
        return {name: value for name, value in vars(self).items() if name != "_sequence"}

    def common(self) -> str:
        """Return the code, and what every clip says of the sequence."""
        sequence = self._sequence
        return json.dumps([code_digest(), len(sequence), sequence.frames_per_second, sorted(sequence.constant)])

    def digest(self, step: Step) -> str:
        """Return nothing: frames are known by the keys of the steps that make them."""
        return ""

    def outputs(self, step: Step) -> tuple[Path, ...]:
        """Return the file of a clip; surveys are facts of receipts."""
        return (self._path(step),) if step.stage == self._clip and self._path(step).is_file() else ()

    def do(self, task: Task, progress: NotedProgress) -> Mapping[str, Any]:
        """Survey the frames of a clip, add surveys up, or write a clip."""
        from beam_warp.schema.survey import FramesSurvey, Survey
        from beam_warp.schema.writer import write_clip

        step, start = task.step, _start(task.step)
        if step.stage == self._survey:
            frames = range(len(self._sequence))[start : start + CLIP_FRAMES]
            return asdict(reduce(add, (FramesSurvey.of(self._sequence[frame]) for frame in frames)))
        if step.stage == self._whole:
            found = reduce(add, (FramesSurvey(**{**said, "counts": tuple(said["counts"])}) for said in task.facts))
            survey = asdict(Survey.of(found, self._sequence))
            return {name: sorted(value) if isinstance(value, frozenset) else value for name, value in survey.items()}
        survey = _survey_of(task.facts[0])
        self._path(step).unlink(missing_ok=True)
        if survey.varying:  # else the asset has no clips
            write_clip(self._sequence, survey, start, self._path(step))
        return {}

    def _path(self, step: Step) -> Path:
        return self.folder / FOLDER / clip_name(self.stem, _start(step))


def _start(step: Step) -> int:
    """Return the place of the first frame that a step is about."""
    return 0 if step.frame is None else int(step.name.rpartition("-")[2])


def _survey_of(facts: Mapping[str, Any]) -> Survey:
    """Return a survey that a receipt holds."""
    from beam_warp.schema.survey import Survey

    kinds = {"counts": tuple, "names": tuple, "varying": frozenset, "half": frozenset}
    return Survey(**{name: kinds.get(name, lambda it: it)(value) for name, value in facts.items()})
