"""Steps that cost nothing: a capture's graph whose outputs are digests of their inputs, with faults on request."""

import hashlib
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from beam_warp.device.compilation import tell_of_compilation
from beam_warp.errors import AssetFormatError
from beam_warp.outputs import replacing
from beam_warp.plan.steps import Plan, Step


@dataclass
class ToyWork:
    """Writes one file a step; what it read and did is told by `calls`, a file that processes append to."""

    later = ()
    folder: Path
    seconds: float = 0.0
    options: str = ""
    said: int = 0
    faults: dict = field(default_factory=dict)

    def common(self):
        return self.options

    def digest(self, step):
        return f"image {step.frame}"

    def outputs(self, step):
        return (self.folder / "out" / f"{step.name}.bin",)

    def do(self, task, progress):
        step = task.step
        progress("toy", 1, 1, step.name)
        with (self.folder / "calls.txt").open("a") as calls:
            calls.write(f"{step.name}\n")
        self.fault(step)
        digest = hashlib.blake2b(f"{self.options} {step.name}".encode())
        for name in step.inputs:
            content = (self.folder / "out" / f"{name}.bin").read_bytes()
            if len(content) != 6400 or content != content[:64] * 100:
                raise AssetFormatError(f"output must be whole, got a damaged one of {name}. Make it again.")
            digest.update(content)
        for path in self.outputs(step):
            with replacing(path) as temporary:
                temporary.write_bytes(digest.digest())
                time.sleep(self.seconds)  # whoever is killed leaves half an output
                temporary.write_bytes(digest.digest() * 100)
        return {"frame": step.frame, "said": "." * self.said}

    def fault(self, step):
        """Fail in the way that is asked for; with ``once``, at the first call only."""
        kind, _, when = self.faults.get(step.name, "").partition(" ")
        if kind and not (when == "once" and self.calls().count(step.name) > 1):
            if kind == "compile":
                tell_of_compilation(2, 1.5, is_running=False)
            if kind == "exit":
                os._exit(3)
            if kind == "kill":
                os.kill(os.getpid(), 9)
            if kind == "hang":
                time.sleep(600)
            if kind == "raise":
                raise ValueError("a poisoned frame")
            if kind == "full":
                with replacing(Path("/dev/full")):
                    raise OSError(28, "No space left on device")

    def calls(self):
        return (self.folder / "calls.txt").read_text().split()


def toy_plan(folder, frame_count=20, segment_length=5, **options):
    """A rig, key frames and tracked ones, the light of the first frame, materials and a preview of each."""
    (folder / "out").mkdir(parents=True, exist_ok=True)
    steps = [Step("cameras", "cameras", rank=9)]
    for frame in range(frame_count):
        tracked = frame % segment_length > 0
        steps.append(
            Step(f"frame-{frame}", "frame", frame, ("cameras", f"frame-{frame - 1}")[: 1 + tracked], int(tracked))
        )
        steps.append(Step(f"materials-{frame}", "materials", frame, ("light", f"frame-{frame}"), 2))
    steps.append(Step("light", "light", None, ("frame-0",), 9))
    work = ToyWork(folder, **options)
    return Plan(folder, tuple(steps), dict.fromkeys({step.stage for step in steps}, work))
