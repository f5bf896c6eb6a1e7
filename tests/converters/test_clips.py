"""Long assets whose clips are steps of a plan: the bytes of a sequence that is written at once."""

from dataclasses import dataclass
from pathlib import Path

import pytest
from support.radiant_cloud import radiant_cloud

from beam_warp import converters
from beam_warp.converters.clips import ClipWork
from beam_warp.jobs.listeners import no_progress
from beam_warp.outputs import replacing
from beam_warp.plan.carry import carry_out
from beam_warp.plan.steps import Plan, Step
from beam_warp.plan.workers import InProcess
from beam_warp.schema.clips import CLIP_FRAMES, MAX_FRAMES_IN_ONE_LAYER
from beam_warp.world.gaussians import GaussianSequence

COUNT = MAX_FRAMES_IN_ONE_LAYER + CLIP_FRAMES // 2


@dataclass
class Made:
    """Steps that make frames: of each, only that it was made."""

    folder: Path
    is_still: bool

    def common(self):
        return ""

    def digest(self, step):
        return ""

    def outputs(self, step):
        return (self.folder / f"{step.name}.txt",)

    def do(self, task, progress):
        with replacing(self.outputs(task.step)[0]) as temporary:
            temporary.write_text("made")
        return {}

    def frame(self, number):
        """A frame: in some, values are too small for half, or there are more Gaussians, or higher bands."""
        assert (self.folder / f"frame-{number}.txt").exists()
        if self.is_still:
            return radiant_cloud(5, degree=0)
        cloud = radiant_cloud(5 + number % 3, degree=1 + (number == 40), materials=True, seed=number, axes="rfu")
        scales = cloud.scales.copy()
        scales[0] = 1e-6 if number == 70 else 0.1
        return cloud.with_arrays(scales=scales)

    def sequence(self):
        return GaussianSequence(COUNT, self.frame, 25.0, frozenset(), "perFrame", {"normal_source": "shortestAxis"})


def written(folder, is_still):
    folder.mkdir()
    made = Made(folder, is_still)
    steps = [Step(f"frame-{number}", "frame", number) for number in range(COUNT)]
    clips = ClipWork(folder, "asset", made.sequence, [(step.name,) for step in steps], range(COUNT))
    plan = Plan(folder, tuple(steps), {"frame": made}).with_steps_of(clips.plan())
    receipts = carry_out(plan, here(plan))
    clips.write(made.sequence(), folder / "asset.usda", receipts)
    return made, receipts, plan


def layers(folder):
    return {path.name: path.read_bytes() for path in folder.glob("asset.*")}


def here(plan):
    return InProcess(plan.works, no_progress)


@pytest.mark.parametrize("is_still", [False, True])
def test_clips_of_steps_have_the_bytes_of_one_call(tmp_path, is_still):
    made, _, plan = written(tmp_path / "steps", is_still)
    converters.write(made.sequence(), tmp_path / "asset.usda")
    assert layers(tmp_path / "steps") == layers(tmp_path)
    assert len(layers(tmp_path)) == (2 if is_still else 6)
    assert all(receipt.is_kept for receipt in carry_out(plan, here(plan)).values())


def test_a_lost_clip_is_written_again_and_nothing_else(tmp_path):
    _, before, plan = written(tmp_path / "out", False)
    clip = tmp_path / "out" / "clips" / "asset.000030.usdc"
    content = clip.read_bytes()
    clip.unlink()
    again = {name for name, receipt in carry_out(plan, here(plan)).items() if not receipt.is_kept}
    assert again == {"asset-clip-000030"}
    assert clip.read_bytes() == content
    assert (tmp_path / "out" / clip.name).read_bytes() == content
    assert before.keys() > again
