"""Long assets whose clips are steps of a plan: the bytes of a sequence that is written at once."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from support.radiant_cloud import radiant_cloud

from beam_warp import converters
from beam_warp.converters import usd
from beam_warp.converters.clips import ClipWork
from beam_warp.jobs.listeners import no_progress
from beam_warp.outputs import replacing
from beam_warp.plan.carry import carry_out
from beam_warp.plan.steps import Plan, Step, version_of
from beam_warp.plan.workers import InProcess
from beam_warp.schema.clips import CLIP_FRAMES, MAX_FRAMES_IN_ONE_LAYER
from beam_warp.world.gaussians import GaussianSequence

PLAIN = converters.WriteOptions()
COUNT = MAX_FRAMES_IN_ONE_LAYER + CLIP_FRAMES // 2


@dataclass
class Made:
    """Steps that make frames: of each, only that it was made."""

    later = ()
    folder: Path
    kind: str

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
        """A frame: in some, values are too small for half, or there are more Gaussians, or higher bands.

        Of the same Gaussians, quaternions leap at random, and roughness is said to be that of the first frame.
        """
        assert (self.folder / f"frame-{number}.txt").exists()
        if self.kind == "still":
            return radiant_cloud(5, degree=0)
        if self.kind in ("same", "found"):
            return radiant_cloud(40, degree=0, materials=True, seed=number, axes="rfu", ids=np.arange(40))
        cloud = radiant_cloud(5 + number % 3, degree=1 + (number == 40), materials=True, seed=number, axes="rfu")
        scales = cloud.scales.copy()
        scales[0] = 1e-6 if number == 70 else 0.1
        return cloud.with_arrays(scales=scales)

    def sequence(self):
        """The frames as steps see them: of some, that they are the same Gaussians is found out."""
        stated = {"constant": frozenset({"ids"}), "topology": "constant"} if self.kind == "same" else {}
        return GaussianSequence(COUNT, self.frame, 25.0, **stated, metadata={"normal_source": "shortestAxis"})

    def whole(self):
        """The frames when all are made."""
        if self.kind not in ("same", "found"):
            return self.sequence()
        return replace(self.sequence(), constant=frozenset({"ids", "roughness"}), topology="constant")


def work(folder, kind, options=PLAIN):
    folder.mkdir()
    made, names = Made(folder, kind), [(f"frame-{number}",) for number in range(COUNT)]
    shared = {"same": {"roughness"}, "found": {"roughness"}, "lost": {"roughness"}}.get(kind)
    return made, ClipWork(folder, "asset", made.sequence, names, range(COUNT), shared and frozenset(shared), options)


def written(folder, kind, options=PLAIN):
    made, clips = work(folder, kind, options)
    steps = [Step(f"frame-{number}", "frame", number) for number in range(COUNT)]
    plan = Plan(folder, tuple(steps), {"frame": made}).with_steps_of(clips.plan())
    receipts = carry_out(plan, here(plan))
    clips.write(made.whole(), folder / "asset.usda", {name: receipt.facts for name, receipt in receipts.items()})
    return made, receipts, plan


def layers(folder):
    return {path.name: path.read_bytes() for path in folder.glob("asset.*")}


def here(plan):
    return InProcess(plan.works, no_progress)


@pytest.mark.parametrize("kind", ["varying", "still", "same", "found", "lost"])
def test_clips_of_steps_have_the_bytes_of_one_call(tmp_path, kind):
    made, _, plan = written(tmp_path / "steps", kind)
    converters.write(made.whole(), tmp_path / "asset.usda")
    assert layers(tmp_path / "steps") == layers(tmp_path)
    assert len(layers(tmp_path)) == (2 if kind == "still" else 6)
    assert all(receipt.is_kept for receipt in carry_out(plan, here(plan)).values())


def test_keys_are_written_when_all_frames_are_made(tmp_path):
    """Clips with keys are no steps: their survey compares all frames with the first one."""
    options = converters.WriteOptions(keyed=True, error_scale=2.0)
    made, receipts, _ = written(tmp_path / "steps", "same", options)
    converters.write(made.whole(), tmp_path / "asset.usda", options)
    assert layers(tmp_path / "steps") == layers(tmp_path)
    assert all(name.startswith("frame") for name in receipts)


def test_a_lost_clip_is_written_again_and_nothing_else(tmp_path):
    _, before, plan = written(tmp_path / "out", "same")
    clip = tmp_path / "out" / "clips" / "asset.000030.usdc"
    content = clip.read_bytes()
    clip.unlink()
    again = {name for name, receipt in carry_out(plan, here(plan)).items() if not receipt.is_kept}
    assert again == {"asset-clip-000030"}
    assert clip.read_bytes() == content
    assert (tmp_path / "out" / clip.name).read_bytes() == content
    assert before.keys() > again


def test_who_hands_steps_out_loads_no_usd(tmp_path, monkeypatch):
    monkeypatch.setattr(usd, "prepared", None)
    _, clips = work(tmp_path / "out", "varying")
    assert version_of(clips.plan().works["asset-clip"])
