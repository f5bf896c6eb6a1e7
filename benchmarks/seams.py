"""Flicker at the seams of segments: renders of a take that was reconstructed in segments, and of the same in one.

    python benchmarks/seams.py [--small | --quick] --out result.json

Segments are cut, or faded into each other as by default.

The take is that of `beam_warp.demo.capture`, photographed without noise that matters. Two frames that follow each other
differ because the figure moves, which the truth says; what else differs is flicker. Its size is the root mean square,
over the pixels of the subject in views that were not trained on, of the change of (render - truth), in steps of 1/255
of display-encoded colour. It is given for pairs of frames with a seam between them, for all other pairs of the same
reconstruction, and for the first ones where there is no seam; and each time over the error itself, which does not
flicker.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import record
from numpy.typing import NDArray
from parts import measure, say

from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import write_demo_capture
from beam_warp.demo.from_images import FromImagesOptions, demo_steps
from beam_warp.device.arrays import resolve_device
from beam_warp.image.color import linear_to_srgb
from beam_warp.raster.channels import RADIANCE
from beam_warp.raster.gbuffer import rasterize
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.job import ReconstructOptions, reconstruct
from beam_warp.reconstruction.scores import seen_radiance
from beam_warp.reconstruction.steps import FitAndTrack
from beam_warp.world.gaussians import GaussianSequence

Row = dict[str, Any]

SUBJECT = 0.5
"""Coverage of a pixel of the subject."""


@dataclass
class Bench:
    """The take.

    Attributes:
        frames: Of the take.
        segment: Frames of a segment.
        size: Of an image [pixel].
        cameras: Around the figure.
        samples: Paths of a pixel.
        steps: How it is reconstructed.
        device: Where.
    """

    frames: int
    segment: int
    size: int
    cameras: int
    samples: int
    steps: FitAndTrack
    device: str | None


def errors(capture: Capture, sequence: GaussianSequence, steps: FitAndTrack) -> list[list[NDArray[np.float64]]]:
    """Return render - truth of each frame and test view, NaN beyond the subject [1/255 of display colour]."""
    found = []
    for index, frame in enumerate(capture.frames):
        cloud, views = sequence[index], []
        for shot in capture.select(split="test", frames={frame}):
            truth = shot.image().linear_rgba()
            buffer = rasterize(cloud, shot.camera, channels=(RADIANCE,), options=steps.raster, device=steps.device)
            drawn, wanted = (
                linear_to_srgb(np.clip(image, 0.0, 1.0)) for image in (seen_radiance(buffer, cloud), truth[..., :3])
            )
            views.append(np.where(truth[..., 3:] > SUBJECT, 255.0 * (drawn - wanted), np.nan))
        found.append(views)
    return found


def rms(values: NDArray[np.float64]) -> float:
    """Return the root mean square of what is not NaN."""
    return float(np.sqrt(np.nanmean(np.square(values))))


def flicker(bench: Bench) -> Iterator[Row]:
    """Reconstruct in segments and in one, and compare pairs of frames."""
    with tempfile.TemporaryDirectory() as name:
        capture = write_demo_capture(
            Path(name) / "capture",
            frame_count=bench.frames,
            camera_count=bench.cameras,
            size=bench.size,
            samples=bench.samples,
            device=bench.device,
        )
        result: Row = {"frames": bench.frames, "segment": bench.segment, "size": bench.size, "cameras": bench.cameras}
        mended = ReconstructOptions(cameras="keep", masks="keep", exposures="keep")
        for label, changes in (
            ("segments", {"segment_length": bench.segment, "seam_frames": 0}),
            ("faded", {"segment_length": bench.segment}),
            ("one", {}),
        ):
            # One folder: what they have in common is made once.
            made = reconstruct(capture, Path(name) / "made", bench.steps, replace(mended, **changes))
            off = errors(capture, made.sequence, bench.steps)
            steps = [rms(np.stack([b - a for a, b in zip(*pair, strict=True)])) for pair in pairwise(off)]
            at = range(bench.segment - 1, bench.frames - 1, bench.segment)
            result[label] = {
                "pairs": steps,
                "error": [rms(np.stack(views)) for views in off],
                "at_seams": float(np.mean([steps[number] for number in at])),
                "elsewhere": float(np.mean([step for number, step in enumerate(steps) if number not in at])),
                "worst": float(max(steps)),
                "psnr": made.report["mean_psnr"],
                "segments": made.report["segments"],
                "seam_frames": made.report["options"]["seam_frames"],
            }
            say(str(result[label]))
            yield result


def main() -> None:
    """Measure, and write the result."""
    parser = record.parser(__doc__, device=True, quick="small and few steps, to see whether it runs")
    parser.add_argument("--small", action="store_true", help="as much as a CPU does in some minutes")
    arguments = parser.parse_args()
    device = arguments.device
    if arguments.quick:
        few = demo_steps(FromImagesOptions(gaussian_count=3000), device=device, seed=0)
        bench = Bench(4, 2, 96, 10, 8, few, device)
    elif arguments.small:
        size = FromImagesOptions(
            gaussian_count=5000, color_iterations=80, normal_iterations=160, joint_iterations=60, track_iterations=60
        )
        bench = Bench(9, 3, 112, 12, 32, demo_steps(size, device=device, seed=0), device)
    else:
        bench = Bench(8, 2, 256, 16, 64, FitAndTrack(fitting=FitOptions(gaussian_count=20_000), device=device), device)
    keep = functools.partial(record.write_result, arguments, resolve_device(device))
    measure({"flicker": flicker}, bench, keep=keep)


if __name__ == "__main__":
    main()
