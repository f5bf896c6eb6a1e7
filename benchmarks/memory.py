"""Memory of a long take: one process reconstructs and decomposes small frames, and says what it holds after each.

    python benchmarks/memory.py [--quick] [--tiny] [--frames N] --out result.json

The take is that of `beam_warp.demo.capture`: eight cameras, whose few frames are named over and over, to and fro. After
the materials of each frame, the memory of the process that is resident and, on CUDA, what is allocated of the device
are noted. Growth is that of a line through the means of blocks of frames, the first ones left out, for kernels are
compiled and caches filled there; its standard error is that of the scatter of the means about the line.
"""

from __future__ import annotations

import functools
import json
import resource
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import record
import warp as wp

from beam_warp.capture.capture import Capture
from beam_warp.decomposition.frames import ReconstructedFrames
from beam_warp.decomposition.job import OverviewOptions, run_capture
from beam_warp.decomposition.options import RunOptions
from beam_warp.decomposition.work import MaterialWork
from beam_warp.demo.capture import write_demo_capture
from beam_warp.demo.from_images import FromImagesOptions, demo_steps
from beam_warp.device.arrays import resolve_device
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.reconstruction.job import ReconstructionWork, ReconstructOptions
from beam_warp.world.environment import EnvironmentMap

SMALL, TINY = (64, 8, 2000), (24, 3, 100)
"""Side of the images [pixel], cameras, and Gaussians."""

SEGMENT = 25
DRAWN = 8
"""Frames that are path traced; all others show one of them again."""

WARM, BLOCK = 0.1, 20
"""Part of the frames that is left out at the start, and the number of blocks that the rest is parted into."""

FEW = FromImagesOptions(color_iterations=2, normal_iterations=2, joint_iterations=2, track_iterations=2)
"""Steps of a frame: enough to run through all code, for memory does not depend on their number."""


@dataclass
class Witness:
    """Hears of each finished frame, and notes what memory is held then [bytes]."""

    device: Any
    keep: Any
    size: tuple[int, int, int]
    resident: list[int] = field(default_factory=list)
    allocated: list[int] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)

    def __call__(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Note what is held after the materials of a frame."""
        if stage != "decompose" or done <= len(self.resident):
            return
        self.resident.append(resident_bytes())
        if self.device.is_cuda:
            wp.synchronize_device(self.device)
            self.allocated.append(wp.get_mempool_used_mem_current(self.device))
        if done % 50 == 0 or done == total:
            self.keep(self.result())

    def result(self) -> dict[str, Any]:
        """Return what was noted, and how it grows."""
        found = {"host": self.resident, "device": self.allocated}
        return {
            "take": {
                "frames": len(self.resident),
                **dict(zip(("side", "cameras", "gaussians"), self.size, strict=True)),
            },
            "seconds": time.perf_counter() - self.started,
            **{name: growth(values) for name, values in found.items() if len(values) >= 4 * BLOCK},
            "samples": {name: values[:: max(len(values) // 200, 1)] for name, values in found.items()},
        }


def resident_bytes() -> int:
    """Return the memory of this process that is resident, on Linux [bytes]."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * resource.getpagesize()


def growth(values: list[int]) -> dict[str, float]:
    """Return the line through the means of blocks: level at its start, slope a frame and its standard error [bytes]."""
    rest = np.asarray(values[int(WARM * len(values)) :], np.float64)
    blocks = [part.mean() for part in np.array_split(rest, BLOCK)]
    at = (np.arange(BLOCK) + 0.5) * len(rest) / BLOCK
    (slope, level), covariance = np.polyfit(at, blocks, 1, cov=True)
    return {
        "first_bytes": float(level),
        "last_bytes": float(level + slope * len(rest)),
        "bytes_a_frame": float(slope),
        "standard_error": float(np.sqrt(covariance[0, 0])),
        "grown_part": float(slope * len(rest) / level),
        "peak_bytes": float(rest.max()),
    }


def long_capture(folder: Path, frames: int, side: int, cameras: int, device: str | None) -> Capture:
    """Return a capture whose frames show those of a short one over and over, to and fro."""
    short = write_demo_capture(
        folder, frame_count=DRAWN, camera_count=cameras, test_camera_count=0, size=side, samples=4, device=device
    )
    by_frame = {frame: short.select(split="train", frames={frame}) for frame in range(DRAWN)}
    shown = [abs((frame + DRAWN - 1) % (2 * DRAWN - 2) - DRAWN + 1) for frame in range(frames)]
    records = [replace(one, frame=frame) for frame, drawn in enumerate(shown) for one in by_frame[drawn]]
    return Capture(**{**vars(short), "records": tuple(records)})


def main() -> None:
    """Measure, and write the result every few frames."""
    parser = record.parser(__doc__, device=True, quick="100 frames, to see whether it runs")
    parser.add_argument("--tiny", action="store_true", help="images and models as small as they can be, for a CPU")
    parser.add_argument("--frames", type=int, default=1000)
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    side, cameras, gaussians = size = TINY if arguments.tiny else SMALL
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "out"
        out.mkdir()
        count = 100 if arguments.quick else arguments.frames
        capture = long_capture(Path(name) / "capture", count, side, cameras, arguments.device)
        witness = Witness(device, functools.partial(record.write_result, arguments, device), size)
        steps = demo_steps(replace(FEW, gaussian_count=gaussians), device=arguments.device, seed=0)
        options = ReconstructOptions(segment_length=SEGMENT, cameras="keep", masks="keep", exposures="keep")
        frames = ReconstructionWork.prepare(capture, out / "reconstruction", steps, options)
        light = EnvironmentMap.read(capture.environment_path or "")
        own = RunOptions(materials=MaterialOptions(sample_count=8), device=arguments.device)
        work = MaterialWork(out, ReconstructedFrames(frames, None), light, own, witness)
        run_capture(frames, work, OverviewOptions(height=48), time.perf_counter())
        witness.keep(witness.result())
    print(json.dumps({name: witness.result().get(name) for name in ("take", "seconds", "host", "device")}, indent=1))


if __name__ == "__main__":
    main()
