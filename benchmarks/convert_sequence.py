"""Write a relightable sequence once, and read its frames at random: prints seconds and memory as JSON.

    python benchmarks/convert_sequence.py asset.usda FRAMES GAUSSIANS

Every channel that the main job writes is there. What moves or depends on the frame's light differs from frame to
frame; scales, opacities and ids do not.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd

from beam_warp.converters import read, write
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

READS = 100


def made_sequence(frames: int, count: int) -> GaussianSequence:
    """Return Gaussians that turn and shimmer; all frames are in memory."""
    rng = np.random.default_rng(3)

    def floats(*shape: int) -> Any:
        return rng.random(shape, np.float32)

    def unit(*shape: int) -> Any:
        values = rng.standard_normal(shape, np.float32)
        return values / np.linalg.norm(values, axis=1, keepdims=True)

    constant = {"scales": 0.01 * floats(count, 3), "opacities": floats(count), "ids": np.arange(count)}
    clouds = [
        GaussianCloud(
            positions=floats(count, 3),
            orientations=unit(count, 4),
            base_color=floats(count, 3),
            roughness=floats(count),
            ambient_occlusion=floats(count),
            normals=unit(count, 3),
            normal_confidence=floats(count),
            ambient_occlusion_error=floats(count),
            base_color_error=floats(count, 3),
            roughness_error=floats(count),
            observability=rng.integers(0, 64, count).astype(np.uint8),
            axes="rub",
            **constant,
        )
        for _ in range(frames)
    ]
    return GaussianSequence.from_clouds(clouds)


def frame_seconds(path: Path, numbers: Any) -> tuple[list[float], list[float]]:
    """Return how long frames take through OpenUSD, all arrays of the Gaussians at one time; and through `read`."""
    stage = Usd.Stage.Open(str(path))
    prim = next(prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField3DGaussianSplat")
    arrays = [found for found in prim.GetAttributes() if found.HasValue() and found.GetTypeName().isArray]
    start = stage.GetStartTimeCode()
    through_usd, through_us = [], []
    for number in numbers:
        started = time.perf_counter()
        for found in arrays:
            np.asarray(found.Get(start + float(number)))
        through_usd.append(time.perf_counter() - started)
    sequence = read(path)
    for number in numbers:
        started = time.perf_counter()
        sequence[int(number)]
        through_us.append(time.perf_counter() - started)
    return through_usd, through_us


def peak_mib() -> float:
    """Return the peak of this process's resident memory so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> int:
    path, frames, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    sequence = made_sequence(frames, count)
    before, started = peak_mib(), time.perf_counter()
    files = write(sequence, path)
    written, grown = time.perf_counter() - started, peak_mib() - before
    through_usd, through_us = frame_seconds(path, np.random.default_rng(0).integers(0, frames, READS))
    print(
        json.dumps(
            {
                "write_seconds": written,
                "write_mib": grown,
                "megabytes": sum(file.stat().st_size for file in files) / 1e6,
                "usd_frame_ms": 1e3 * float(np.median(through_usd)),
                "beam_frame_ms": 1e3 * float(np.median(through_us)),
            }
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
