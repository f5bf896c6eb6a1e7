"""Long USD assets, whose value clips are steps of a plan: workers write them, and only small layers are left to do.

A clip must be written in the precision that is safe for the whole sequence, and hold what varies in it. So the frames
of each clip are surveyed first, as soon as they are made; the surveys are added up; and then the clips are written, in
any order. Where all frames may have the same Gaussians, a survey also says which quaternions change their sign from the
first frame of a clip to that of the next one, since signs are kept along the sequence. The result has the same bytes as
`beam_warp.converters.write` of the whole sequence.

OpenUSD is loaded with this module, before a job begins any thread. Its libraries give Python up and take it back while
the system loads them; a thread that has Python by then and needs the system's loader waits for them, and they for it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, reduce
from operator import add
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.converters import usd
from beam_warp.converters.common.options import WriteOptions
from beam_warp.digests import code_digest
from beam_warp.jobs.listeners import NotedProgress
from beam_warp.outputs import replacing
from beam_warp.plan.steps import Plan, Rank, Step, Task
from beam_warp.schema.authoring import turned_signs
from beam_warp.schema.clips import CLIP_FRAMES, MAX_FRAMES_IN_ONE_LAYER, clip_name
from beam_warp.schema.survey import FramesSurvey, Survey
from beam_warp.schema.writer import WrittenClips, write_clip
from beam_warp.world.gaussians import GaussianSequence

FOLDER = "clips"
"""Folder of the clips, in that of the asset; the asset's own are second names of the same files."""


@dataclass(eq=False)
class ClipWork:
    """Steps that survey a sequence part by part, add the surveys up, and write the clips to ``folder/clips``.

    Attributes:
        folder: Folder of the asset.
        stem: Name of the asset without its suffix; names of steps and stages begin with it.
        read: Returns the sequence, to be read when its frames are made. Picklable.
        makers: Names of the steps that make each frame; the results of a frame follow from their keys alone.
        numbers: What the frames are called.
        shared: Arrays that are the same in all frames if the topology is constant: because the sequence states it, or
            the frames turn out to have the same identities. None where it cannot be.
        options: How the asset is written. One with keys has no steps: what varies is told beside its first frame.
    """

    later = ("beam_warp.converters.usd",)
    folder: Path
    stem: str
    read: Callable[[], GaussianSequence]
    makers: Sequence[tuple[str, ...]]
    numbers: Sequence[int]
    shared: frozenset[str] | None = None
    options: WriteOptions = field(default_factory=WriteOptions)

    def plan(self) -> Plan:
        """Return the steps; none for a sequence that is written without clips, or with keys."""
        if len(self.makers) <= MAX_FRAMES_IN_ONE_LAYER or self.options.keyed:
            return Plan(self.folder, (), {})
        (self.folder / FOLDER).mkdir(parents=True, exist_ok=True)
        parts, clips = list[Step](), list[Step]()
        for start in range(0, len(self.makers), CLIP_FRAMES):
            made, surveyed = (
                _joined(self.makers[start : start + CLIP_FRAMES + more]) for more in (0, self._may_be_constant)
            )
            first, label = self.numbers[start], f"{start:06d}"
            parts.append(Step(f"{self._survey}-{label}", self._survey, first, surveyed, Rank.PREVIEW))
            clips.append(Step(f"{self._clip}-{label}", self._clip, first, (self._whole, *made), Rank.PREVIEW))
        whole = Step(self._whole, self._whole, None, tuple(part.name for part in parts), Rank.SHARED)
        steps = (*parts, whole, *clips)
        return Plan(self.folder, steps, dict.fromkeys((step.stage for step in steps), self))

    def write(self, sequence: GaussianSequence, path: Path, said: Mapping[str, Mapping[str, Any]]) -> list[Path]:
        """Write an asset, or what is left of it to write when all steps are done; return its files, the root last.

        Args:
            sequence: What is written.
            path: Root layer.
            said: Facts of the steps, by name; those of other steps do not matter.
        """
        known = said.get(self._whole)
        clips = None if known is None else WrittenClips(_survey_of(known["survey"]), self.folder / FOLDER)
        return usd.write(sequence, path, self.options, clips)

    def files(self) -> tuple[Path, ...]:
        """Return the files of the asset that was written, but for the clips, which are outputs of their own steps."""
        clips = {path.name for path in (self.folder / FOLDER).glob(f"{self.stem}.*")}
        return tuple(path for path in sorted(self.folder.glob(f"{self.stem}.*")) if path.name not in clips)

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
    def _given(self) -> GaussianSequence:
        return self.read()

    @cached_property
    def _sequence(self) -> GaussianSequence:
        return usd.prepared(self._given)

    def __getstate__(self) -> dict[str, Any]:
        """Return what other processes need: nothing that was read."""
        return {name: value for name, value in vars(self).items() if name not in ("_given", "_sequence")}

    def common(self) -> str:
        """Return the code, and what every clip says of the sequence."""
        given, shared = self._given, None if self.shared is None else sorted(self.shared)
        said = [len(given), given.frames_per_second, given.topology, sorted(given.constant), shared]
        return json.dumps([code_digest(), *said])

    def digest(self, step: Step) -> str:
        """Return nothing: frames are known by the keys of the steps that make them."""
        return ""

    def outputs(self, step: Step) -> tuple[Path, ...]:
        """Return the file of a clip, or of signs that turn, if there is one; surveys are facts of receipts."""
        return (self._path(step),) if self._path(step).is_file() else ()

    def do(self, task: Task, progress: NotedProgress) -> Mapping[str, Any]:
        """Survey the frames of a clip, add surveys up, or write a clip."""
        self._path(task.step).unlink(missing_ok=True)
        if task.step.stage == self._survey:
            return self._look_at(task.step)
        return self._add_up(task) if task.step.stage == self._whole else self._write(task)

    def _look_at(self, step: Step) -> Mapping[str, Any]:
        """Survey the frames of a clip; write which signs turn until the next one, while rows are the same Gaussians."""
        start, found, before, turned = _start(step), list[FramesSurvey](), None, None
        are_same = self._may_be_constant
        for frame in range(len(self._given))[start : start + CLIP_FRAMES + are_same]:
            cloud = self._sequence[frame]
            if len(found) < CLIP_FRAMES:
                found.append(FramesSurvey.of(cloud))
            are_same = are_same and (before is None or len(before) == len(cloud))
            if are_same:
                turned, before = turned_signs(before, cloud.orientations, turned), cloud.orientations
        if are_same and turned is not None:
            self._save(step, turned)
        return asdict(reduce(add, found))

    def _add_up(self, task: Task) -> Mapping[str, Any]:
        """Add surveys up; if the topology is constant, write which signs are turned where each clip begins."""
        found = reduce(add, (FramesSurvey(**{**said, "counts": tuple(said["counts"])}) for said in task.facts))
        sequence = self._of_topology(self._may_be_constant and found.digests.get("ids", "") != "")
        survey = asdict(Survey.of(found, sequence))
        if sequence.topology == "constant":
            parts = [self.folder / FOLDER / f"{name}.npy" for name in task.step.inputs]
            turned = np.stack([np.zeros(found.counts[0], bool), *map(_loaded, parts[:-1])])
            self._save(task.step, np.logical_xor.accumulate(turned))
        plain = {name: sorted(value) if isinstance(value, frozenset) else value for name, value in survey.items()}
        return {"survey": plain, "is_constant": sequence.topology == "constant"}

    def _write(self, task: Task) -> Mapping[str, Any]:
        survey, start, turned = _survey_of(task.facts[0]["survey"]), _start(task.step), None
        if task.facts[0]["is_constant"]:
            turned = _loaded(self.folder / FOLDER / f"{self._whole}.npy", start // CLIP_FRAMES)
        if survey.varying:  # else the asset has no clips
            sequence = self._of_topology(task.facts[0]["is_constant"])
            write_clip(sequence, survey, start, self._path(task.step), turned)
        return {}

    @property
    def _may_be_constant(self) -> bool:
        return self.shared is not None

    def _of_topology(self, is_constant: bool) -> GaussianSequence:
        """Return the sequence, whose frames may have turned out to have the same Gaussians."""
        if not is_constant and self._given.topology != "constant":
            return self._sequence
        constant = self._given.constant | (self.shared or frozenset())
        return replace(self._sequence, topology="constant", constant=constant)

    def _save(self, step: Step, turned: NDArray[np.bool_]) -> None:
        with replacing(self._path(step)) as temporary, temporary.open("wb") as file:
            np.save(file, turned)

    def _path(self, step: Step) -> Path:
        name = clip_name(self.stem, _start(step)) if step.stage == self._clip else f"{step.name}.npy"
        return self.folder / FOLDER / name


def _joined(names: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """Return all names, each once, in their order."""
    return tuple(dict.fromkeys(name for some in names for name in some))


def _loaded(path: Path, row: Any = ...) -> NDArray[np.bool_]:
    """Return which signs turn, all or a row of them."""
    return np.array(np.load(path, mmap_mode="r")[row])


def _start(step: Step) -> int:
    """Return the place of the first frame that a step is about."""
    return 0 if step.frame is None else int(step.name.rpartition("-")[2])


def _survey_of(facts: Mapping[str, Any]) -> Survey:
    """Return a survey that a receipt holds."""
    kinds = {"counts": tuple, "names": tuple, "varying": frozenset, "half": frozenset}
    return Survey(**{name: kinds.get(name, lambda it: it)(value) for name, value in facts.items()})
