"""Steps of the main job: the light, the roughness of persistent Gaussians, the materials of each frame, base colour."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.digests import CaptureDigests
from beam_warp.converters.clips import ClipWork
from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.numbering import ASSET_NAME
from beam_warp.decomposition.archive import FrameArchive
from beam_warp.decomposition.capture_images import CaptureImages
from beam_warp.decomposition.capture_light import CaptureLight, find_light
from beam_warp.decomposition.frames import Frames
from beam_warp.decomposition.measure import FrameMeasurement
from beam_warp.decomposition.options import ESTIMATE, RunOptions
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.roughness_finder import (
    are_silent,
    asked_frames,
    find_roughness,
    measured_profile,
    profiles_of,
)
from beam_warp.decomposition.seen import SeenFrame
from beam_warp.decomposition.solve import AT_A_TIME, JointColor, SolvedFrames, solve_frame, solve_jointly
from beam_warp.decomposition.source import Source
from beam_warp.decomposition.tally import counts_of
from beam_warp.device.arrays import resolve_device
from beam_warp.digests import array_digest, code_digest
from beam_warp.errors import InvalidOptionError
from beam_warp.jobs.listeners import NotedProgress, no_progress
from beam_warp.jobs.progress import JobLog
from beam_warp.jobs.store import frame_names, make_folders, read_frame, write_frame
from beam_warp.materials.direct import ColorEvidence
from beam_warp.materials.roughness import RoughnessEstimate
from beam_warp.materials.roughness_source import RoughnessTexture, stated_roughness
from beam_warp.outputs import remove_leftovers
from beam_warp.plan.steps import Plan, Rank, Step, Task
from beam_warp.raster.records import RasterOptions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import ATTRIBUTES, GaussianSequence

ASSET_STEM = Path(ASSET_NAME).stem

STAGES = ("light", "profile", "roughness", "materials", "joint", "solution")

PART = 30
"""Frames of persistent Gaussians whose solutions a step writes: they take a moment each."""


@dataclass(eq=False)
class MaterialWork:
    """Steps that find light, roughness and materials, each written to ``folder/frames``.

    Attributes:
        folder: Folder of the results.
        frames: The Gaussians, and their images.
        environment: The light as it was given.
        options: How frames are measured.
        progress: Told how far a step is, in the process that this is made in.
        written: How the asset is written.
    """

    later = ("scipy.interpolate",)  # of roughness
    folder: Path
    frames: Frames
    environment: EnvironmentMap
    options: RunOptions
    progress: NotedProgress = no_progress
    written: WriteOptions = field(default_factory=WriteOptions)

    def __getstate__(self) -> dict[str, Any]:
        """Return what other processes need: nothing that was read, and nobody who hears them."""
        return {**{own.name: vars(self)[own.name] for own in fields(self)}, "progress": no_progress}

    def prepare(self) -> list[str]:
        """Check what can be checked, make the folders and remove what a killed call has left; return notes.

        Raises:
            InvalidOptionError: The capture lacks a frame, or there is none for the image path; or keys are asked for
                where rows are not the same Gaussians in every frame.
            OutputError: A folder cannot be made.
        """
        if self.written.keyed and len(self.frames.numbers()) > 1 and not self._may_be_persistent:
            raise InvalidOptionError(
                "keyed must go with frames that have the same Gaussians, got others, whose rows must not be blended. "
                "Leave it out, or state that rows persist with --persistent."
            )
        if self.options.images is not None and not self.frames.have_images:
            raise InvalidOptionError(
                "capture must be given for the image path, got none: it works on images. Pass one, or leave images out."
            )
        if self.frames.are_made:
            _ = self.frames.sequence(), self.images  # refuses what cannot be read, and a capture that lacks a frame
        return remove_leftovers(self.folder, *make_folders(self.folder, "frames", "digests"))

    def plan(self) -> Plan:
        """Return the steps."""
        numbers = self.frames.numbers()
        made = [self.frames.step(number) for number in numbers]
        steps, shared = [Step("light", "light", None, made[0], Rank.SHARED)], ("light",)
        if self._shares_roughness:
            first: tuple[str, ...] = ()
            for index in self._asked:
                inputs = ("light", *made[index], *first)
                steps.append(Step(profile_step(numbers[index]), "profile", numbers[index], inputs, Rank.SHARED))
                first = first or (profile_step(numbers[index]),)  # whose pilot says whether the others are asked
            inputs = (*(profile_step(numbers[index]) for index in self._asked), *(it for names in made for it in names))
            steps.append(Step("roughness", "roughness", None, inputs, Rank.SHARED))
            shared = (*shared, "roughness")
        for index, number in enumerate(numbers):
            before = (material_step(numbers[index - 1]),) if index and self._follows else ()
            inputs = (*shared, *made[index], *before)
            steps.append(Step(material_step(number), "materials", number, inputs, Rank.MATERIALS))
        if self._solves_later:
            steps.append(Step("joint", "joint", None, tuple(map(material_step, numbers)), Rank.SHARED))
            for part in self._parts:
                inputs = ("joint", *map(material_step, part))
                steps.append(Step(solution_step(part[0]), "solution", part[0], inputs, Rank.PREVIEW))
        return Plan(self.folder, tuple(steps), dict.fromkeys(STAGES, self)).with_steps_of(self.clips.plan())

    @cached_property
    def clips(self) -> ClipWork:
        """Steps that write the asset."""
        numbers = self.frames.numbers()
        makers = [(material_step(number),) for number in numbers]
        if self._solves_later:
            makers = [(material_step(it), "joint", solution_step(part[0])) for part in self._parts for it in part]
        shared = self.options.shared_roughness if self._may_be_persistent else None
        return ClipWork(self.folder, ASSET_STEM, self.finished, makers, numbers, shared, self.written)

    def finished(self) -> GaussianSequence:
        """Return the frames with base colour, each to be read when it is done; without metadata."""
        sequence = self.frames.sequence()
        is_constant = self.options.persistent or sequence.topology == "constant"
        return GaussianSequence(
            frame_count=len(sequence),
            read_frame=lambda number: self.solved.cloud(number),
            frames_per_second=sequence.frames_per_second,
            constant=sequence.constant & set(ATTRIBUTES) - {"normals"},
            topology="constant" if is_constant else "perFrame",
            metadata={},
        )

    @cached_property
    def solved(self) -> SolvedFrames:
        """The frames with base colour, when all that is solved over all of them is."""
        is_varying = not self._solves_later or self._joint is None or self._joint.is_varying
        return SolvedFrames(self.archive, self.options.images is None, is_varying)

    @cached_property
    def whole(self) -> GaussianSequence:
        """The frames, when all are made."""
        return self.frames.whole()

    @property
    def are_persistent(self) -> bool:
        """Whether row i is the same Gaussian in every frame, when all are made."""
        return self.options.persistent or self.whole.topology == "constant"

    @cached_property
    def _joint(self) -> JointColor | None:
        """What was solved over all frames; None where tracking was lost, so that each was solved by itself."""
        arrays = read_frame(self.stored("joint"))
        return JointColor.from_arrays(arrays) if arrays else None

    @cached_property
    def _parts(self) -> list[tuple[int, ...]]:
        """Numbers of the frames whose solutions are written together."""
        numbers = self.frames.numbers()
        return [numbers[start : start + PART] for start in range(0, len(numbers), PART)]

    @property
    def _solves_later(self) -> bool:
        """Whether base colour is solved when all frames are measured, over all of them if they are persistent."""
        return self.options.images is None and self._may_be_persistent

    @property
    def _shares_roughness(self) -> bool:
        """Whether one roughness is estimated of Gaussians that persist."""
        return self.options.roughness == ESTIMATE and self._may_be_persistent

    @property
    def _asked(self) -> list[int]:
        """Places of the frames that the roughness of Gaussians that persist is found from."""
        return asked_frames(len(self.frames.numbers()))

    @property
    def _may_be_persistent(self) -> bool:
        return self.options.persistent or self.frames.may_be_constant

    @property
    def _follows(self) -> bool:
        """Whether colours of a frame follow those of the frame before."""
        return self.options.images is not None and self._may_be_persistent

    @property
    def solves(self) -> bool:
        """Whether each frame is solved by itself, as soon as it is measured."""
        return self.options.images is None and not self._may_be_persistent

    @cached_property
    def device(self) -> Any:
        """Warp device."""
        return resolve_device(self.options.device)

    @property
    def device_kind(self) -> str:
        """Kind of device, "cuda" or "cpu"."""
        return "cuda" if self.device.is_cuda else "cpu"

    @cached_property
    def images(self) -> CaptureImages | None:
        """Images of the capture, if there is one."""
        capture = self.frames.capture()
        return None if capture is None else CaptureImages(capture, self.frames.sequence())

    @cached_property
    def source(self) -> Source:
        """Where frames are read."""
        sequence = self.frames.sequence()
        return Source(
            sequence=sequence,
            images=self.images,
            options=self.options,
            digests=CaptureDigests(self.folder / "digests"),
            device=str(self.device),
            log=JobLog(self.progress, len(sequence), self.device),
        )

    @cached_property
    def archive(self) -> FrameArchive:
        """Where results are."""
        return FrameArchive(self.folder / "frames", self.source.first.cloud.radiance_color_space)

    def stored(self, name: str) -> Path:
        """Return the file of what is found once."""
        return self.folder / "frames" / f"{name}.h5"

    @cached_property
    def job(self) -> JobPlan:
        """What measuring needs, when the light is found."""
        light = CaptureLight.of(self.environment, read_frame(self.stored("light")), self.source)
        return JobPlan(source=self.source, light=light, archive=self.archive)

    def findings(self) -> list[dict[str, Any]]:
        """Return what was found about the light and the images."""
        return list(json.loads(read_frame(self.stored("light"), ("findings",))["findings"].tobytes()))

    def common(self) -> str:
        """Return the code and the options that results depend on."""
        return self._common

    @cached_property
    def _common(self) -> str:
        source, has_images = self.options.roughness, self.frames.have_images
        files = [source.texture, source.mesh] if isinstance(source, RoughnessTexture) else []
        content = {
            "code": code_digest(),
            "device": self.device_kind,
            "options": self.options.as_dict(),
            "raster": asdict(RasterOptions.from_metadata(self.frames.sequence().metadata)) if has_images else None,
            "evidence": ColorEvidence.ARRAYS,
            "files": [hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() for path in files],
        }
        return json.dumps(content, sort_keys=True)

    def digest(self, step: Step) -> str:
        """Return the digest of the light, or of frames that no other step makes; others are known by their keys."""
        if step.stage == "light":
            text = self._frame_digest(0) + str(self.source.is_display_referred())
            return array_digest(self.environment.radiance, text=f"{text} {self.source.has_light}")
        if step.stage in ("roughness", "joint", "solution"):
            return ""
        if step.stage == "profile":
            return self._frame_digest(self._place(step))
        return f"{self.solves} {self._frame_digest(self._place(step))}"

    def _frame_digest(self, index: int) -> str:
        number = self.frames.numbers()[index]
        return str(index) if self.frames.step(number) else self.source.digest(self._frame(index))

    def _frame(self, index: int) -> SeenFrame:
        """Return a frame; the latest ones are not read again."""
        if index == 0:
            return self.source.first
        if index not in self._latest:
            if len(self._latest) >= self._most_kept:
                self._latest.clear()
            self._latest[index] = self.source.frame(index)
        return self._latest[index]

    @cached_property
    def _latest(self) -> dict[int, SeenFrame]:
        return {}

    @cached_property
    def _most_kept(self) -> int:
        """How many frames are kept with what their views show: all, if roughness is found from all; else the latest."""
        count = len(self.frames.numbers())
        return count if self._shares_roughness and len(self._asked) == count else 1

    def _place(self, step: Step) -> int:
        assert step.frame is not None
        return self._places[step.frame]

    @cached_property
    def _places(self) -> dict[int, int]:
        return {number: index for index, number in enumerate(self.frames.numbers())}

    def outputs(self, step: Step) -> tuple[Path, ...]:
        """Return the files of a step."""
        if step.frame is None:
            is_solved = step.stage == "joint" and self._joint is not None
            return (self.stored(step.stage), *([self.archive.solution_path(0)] if is_solved else []))
        index = self._place(step)
        if step.stage == "solution":
            return tuple(map(self.archive.solution_path, self._solved_by(index)))
        if step.stage == "profile":
            return (self.archive.profile_path(index),)
        return (self.archive.frame_path(index), *([self.archive.solution_path(index)] if self.solves else []))

    def do(self, task: Task, progress: NotedProgress) -> Mapping[str, Any]:
        """Find the light, roughness or base colour of all frames, or measure one."""
        seconds = self.source.log.timer.seconds
        seconds.clear()
        if task.step.stage == "light":
            facts = self._find_light()
        elif task.step.stage == "roughness":
            facts = self._find_roughness()
        elif task.step.stage == "profile":
            facts = self._measure_profile(self._place(task.step))
        elif task.step.stage == "joint":
            facts = self._solve_jointly()
        elif task.step.stage == "solution":
            facts = self._solve(self._solved_by(self._place(task.step)))
        else:
            facts = self._measure(self._place(task.step))
        facts = {**facts, "seconds": dict(seconds)}
        seconds.clear()
        return facts

    def _find_light(self) -> dict[str, Any]:
        found = find_light(self.environment, self.source)
        write_frame(self.stored("light"), found)
        return {}

    def _find_roughness(self) -> dict[str, Any]:
        """Find what persistent Gaussians share; nothing where tracking was lost, so that they are not persistent."""
        if not self.are_persistent:
            write_frame(self.stored("roughness"), {})
            return {}
        profiles = filter(None, map(self.archive.profile, self._asked))
        estimate = find_roughness(self.source.first.cloud.positions, profiles, len(self.frames.numbers()))
        write_frame(self.stored("roughness"), _roughness_arrays(estimate))
        return {"roughness": estimate.report}

    def _measure_profile(self, index: int) -> dict[str, Any]:
        """Measure what views of a frame say of roughness; nothing where a pilot in the first one finds that none do."""
        frame, first = self._frame(index), self._asked[0]
        if index == first:
            is_silent = are_silent(self.job, frame, len(self._asked))
        else:
            is_silent = not frame_names(self.archive.profile_path(first))
        self.archive.keep_profile(index, None if is_silent else measured_profile(self.job, frame))
        return {}

    def _measure(self, index: int) -> dict[str, Any]:
        """Measure a frame and store it."""
        frame, facts = self._frame(index), dict[str, Any]()
        measurement = FrameMeasurement(self.job, self._roughness(frame, facts))
        measured = measurement.measure(frame, self.archive.read(index - 1) if index and self._follows else None)
        with self.source.log.timer("store"):
            self.archive.keep(measured)
        frame.forget()
        self._latest.pop(index, None)
        if self.solves:
            facts["counts"] = [solve_frame(self.job, measured)]
        elif not self._solves_later:
            facts["counts"] = [counts_of(measured, measured.cloud)]
        return facts | {key: getattr(measurement, key) for key in ("ray_count", "economy", "notes")}

    def _solve_jointly(self) -> dict[str, Any]:
        """Solve base colour over all frames; nothing where tracking was lost, so that they are not persistent."""
        found, facts = None, {}
        if self.are_persistent:
            others = range(1, len(self.frames.numbers()))
            found, facts = solve_jointly(self.job, self.archive.read(0), self.archive.evidence, others)
        write_frame(self.stored("joint"), {} if found is None else found.arrays())
        return facts

    def _solved_by(self, first: int) -> range:
        """Return the places of the frames that are solved after all others, in the part that begins with one."""
        places = range(first, min(first + PART, len(self.frames.numbers())))
        if self._joint is None:
            return places
        return places[first == 0 :] if self._joint.is_varying else places[:0]

    def _solve(self, places: Iterable[int]) -> dict[str, Any]:
        """Write the solutions of some frames."""
        joint = self._joint
        if joint is None:
            return {"counts": [solve_frame(self.job, self.archive.read(place)) for place in places]}

        def solve(place: int) -> None:
            self.archive.keep_solution(place, joint.of_frame(self.archive.evidence(place)))

        with self.source.log.timer("solve"), ThreadPoolExecutor(AT_A_TIME) as pool:
            deque(pool.map(solve, places), maxlen=0)
        return {"counts": []}

    def _roughness(self, frame: SeenFrame, facts: dict[str, Any]) -> Mapping[str, NDArray[np.float32]]:
        """Return the roughness of a frame: stated, what all frames share, or its own, whose report joins the facts."""
        if self.options.roughness != ESTIMATE:
            return {"roughness": stated_roughness(frame.original, self.options.roughness)}
        shared = read_frame(self.stored("roughness")) if self._may_be_persistent else {}
        if shared:
            return shared
        estimate = find_roughness(frame.cloud.positions, profiles_of(self.job, [frame], 1))
        facts["roughness"] = estimate.report
        return _roughness_arrays(estimate)


def material_step(number: int) -> str:
    """Return the name of the step that measures a frame."""
    return f"materials-{number:06d}"


def profile_step(number: int) -> str:
    """Return the name of the step that measures what views of a frame say of roughness."""
    return f"profile-{number:06d}"


def solution_step(number: int) -> str:
    """Return the name of the step that writes solutions from a frame on."""
    return f"solution-{number:06d}"


def _roughness_arrays(estimate: RoughnessEstimate) -> dict[str, NDArray[np.float32]]:
    return {"roughness": estimate.roughness, "roughness_error": estimate.standard_error}
