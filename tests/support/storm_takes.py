"""Takes of 20 frames that a storm of kills goes over: of steps that nap, or of small real ones. Who begins says so."""

import os
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import psutil
from support.toy_work import toy_plan

from beam_warp.jobs.listeners import no_progress
from beam_warp.plan.carry import carry_out
from beam_warp.plan.crew import crew_of
from beam_warp.plan.steps import Work

FRAMES, SEGMENT, NAP = 20, 5, 0.1


@dataclass
class Noted:
    """Work that notes in a file, to which processes append, every step that is begun, and by whom."""

    work: Work
    begun: Path

    def do(self, task, progress):
        with self.begun.open("a") as begun:
            begun.write(f"{task.step.stage} {os.getpid()}\n")
        return self.work.do(task, progress)

    @property
    def folder(self):
        return self.work.folder

    @property
    def later(self):
        return self.work.later

    def common(self):
        return self.work.common()

    def digest(self, step):
        return self.work.digest(step)

    def outputs(self, step):
        return self.work.outputs(step)


def processes_of(driver, known=()):
    """Return the processes that work for a driver: the server that workers are forked from, and these.

    ``known`` are numbers of workers, of which some may have outlived their server.
    """
    found = {}
    for number in (*(it.pid for it in psutil.Process(driver).children(recursive=True)), *known):
        with suppress(psutil.NoSuchProcess):  # it has ended, and may wait for its parent to notice
            process = psutil.Process(number)
            if any(word in str(process.cmdline()) for word in ("forkserver", "spawn_main")):
                found[number] = process
    return list(found.values())


def begun_file(out):
    """Return where steps of a take are noted: beside its folder, which holds nothing but the take."""
    return out.with_name(f"{out.name}.begun")


def noting(words, out):
    """Return a crew that notes what it begins."""

    def crew(plan, kind, progress):
        works = {stage: Noted(work, begun_file(out)) for stage, work in plan.works.items()}
        return crew_of(words, None)(replace(plan, works=works), kind, progress)

    return crew


def toy(out, crew, device):
    """Steps that nap, and write digests of what they read."""
    plan = toy_plan(out, FRAMES, SEGMENT, seconds=NAP)
    carry_out(plan, crew(plan, "", no_progress))


def real(out, crew, device, segment):
    """All that ``beam run`` does with the capture beside the take's folder, in segments of a length."""
    from beam_warp.capture.capture import Capture
    from beam_warp.decomposition.frames import ReconstructedFrames
    from beam_warp.decomposition.job import OverviewOptions, RunOptions, run_capture
    from beam_warp.decomposition.work import MaterialWork
    from beam_warp.demo.from_images import FromImagesOptions, demo_steps
    from beam_warp.materials.light_rays import MaterialOptions
    from beam_warp.reconstruction.job import ReconstructionWork, ReconstructOptions
    from beam_warp.world.environment import EnvironmentMap

    few = FromImagesOptions(
        gaussian_count=300, color_iterations=2, normal_iterations=2, joint_iterations=2, track_iterations=2
    )
    capture, steps = Capture.read(out.with_name("capture")), demo_steps(few, device=device, seed=0)
    options = RunOptions(materials=MaterialOptions(sample_count=8), roughness="estimate", device=device)
    frames = ReconstructionWork.prepare(
        capture, out / "reconstruction", steps, ReconstructOptions(segment_length=segment)
    )
    light = EnvironmentMap.read(capture.environment_path)
    work = MaterialWork(out, ReconstructedFrames(frames, None), light, options)
    run_capture(frames, work, OverviewOptions(height=48), time.perf_counter(), crew)


def draw_capture(folder, device):
    """Path trace what `real` works on."""
    from beam_warp.demo.capture import write_demo_capture

    write_demo_capture(folder, frame_count=FRAMES, camera_count=6, test_camera_count=0, size=48, device=device)


TAKES = {"toy": (toy,), "real": (partial(real, segment=SEGMENT), partial(real, segment=0))}
"""Takes that follow one another, by kind: of real steps, one in segments, and one of a single segment."""


def drive(kind, number, out, words, device):
    """Carry out a take of a kind, all given as words of a command line."""
    TAKES[kind][int(number)](Path(out), noting(words, Path(out)), device)
