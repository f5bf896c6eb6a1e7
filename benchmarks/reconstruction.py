"""Quality of reconstructions, their loss over tracked frames, their time and memory, and what each choice is worth.

    python benchmarks/reconstruction.py --out FILE [--device cuda:0] [--data DIR] [--only SECTION ...] [--keep DIR]

Timed, so alone on a device: ``captures`` fits the first frame with truth of three captures by the defaults and tracks
to the last; ``large`` does so for images of 1920 x 1080, which are path traced first, and then goes back and forth
between their two frames in few steps, to say what memory a longer take needs.

Scored only, each row the walker's first frame: ``rade`` has others' choices, made ours one by one, ``rade_long`` the
last of these with as many steps as they state; ``variants`` makes 3DGS's way of drawing ours one by one; ``gaussians``
and ``cameras`` vary the number of either, the latter with opacities kept and reset.

``strides`` plays the walker at every fourth frame, every second, and every one. What each tracks is scored, beside how
far the true surface moves; where it began with what silhouettes show, also without them.

``--keep DIR`` writes the sequences of ``captures`` as ``DIR/NAME/gaussians.usda``, for benchmarks that need them.
``--small`` is what a CPU can do: few Gaussians, a sample a pixel, a draft for the key frame. ``--quick`` takes the
demo's capture and few Gaussians: does all of it run? Images are read before the clock starts;
scores and meshes are made after it stops. A section that fails says so in its place, and the program returns 1.
"""

from __future__ import annotations

import ctypes
import gc
import itertools
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import record
from device_memory import peak_memory
from parts import measure_all, say
from reconstruction_captures import write_large_capture
from reconstruction_contenders import Contender, ModelledFrame, follow, of_options, write_sequence

from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import write_demo_capture
from beam_warp.device.arrays import resolve_device
from beam_warp.mesh.distances import SAMPLE_COUNT
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import MOST_SAMPLES
from beam_warp.reconstruction.drift import tracking_drift
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.joint_tracking import JointOptions
from beam_warp.reconstruction.joints.image_motion import motion_in_pixels
from beam_warp.reconstruction.scores import read_truth_mesh, score_frame, truth_frames
from beam_warp.reconstruction.track import TrackOptions
from beam_warp.stability.capture_cases.alterations import evenly, training_cameras, with_cameras

Row = dict[str, Any]

CAPTURES = ("walker", "runner", "robot")

CLASSIC = RasterOptions()
"""How programs draw splats that state nothing."""


@dataclass(frozen=True)
class Effort:
    """Amount that is measured.

    Attributes:
        gaussians: Gaussians of every measurement that does not say otherwise.
        counts: Gaussians of the sweep over them, beside those.
        cameras: Cameras of the other sweep, beside all of them.
        few: Gaussians of the first and of the later rows of ``variants``.
        long: Steps of ``rade_long`` over ours.
        repeats: Fits of the first capture's first frame.
        large_size: Images of ``large``.
        large_views: Its training cameras.
        large_tracked: Its tracked frames.
        samples: Paths per pixel of what is path traced here.
        surface_samples: Points on each surface of a Chamfer distance.
        strides: Frames from one that is tracked to the next, of ``strides``.
        fitting: Changes of our defaults.
        tracking: How frames are tracked.
    """

    gaussians: int = 140_000
    counts: tuple[int, ...] = (20_000, 50_000)
    cameras: tuple[int, ...] = (8, 12, 16)
    few: tuple[int, int] = (20_000, 60_000)
    long: int = 4
    repeats: int = 3
    large_size: tuple[int, int] = (1920, 1080)
    large_views: int = 24
    large_tracked: int = 8
    samples: int = 32
    surface_samples: int = SAMPLE_COUNT
    strides: tuple[int, ...] = (4, 2, 1)
    fitting: Row = field(default_factory=dict)
    tracking: TrackOptions = field(default_factory=TrackOptions)


BRIEF = TrackOptions(
    joints=JointOptions(levels=(2,), iterations=(4,)),
    refinement=replace(TrackOptions().refinement, normal_iterations=4),
)
SMALL = Effort(gaussians=20_000, fitting={"samples": 1, "color_iterations": 150, "normal_iterations": 300})

QUICK = Effort(
    gaussians=2_000,
    counts=(1_000,),
    cameras=(4,),
    few=(500, 1_000),
    long=2,
    repeats=2,
    large_size=(96, 54),
    large_views=4,
    large_tracked=3,
    samples=2,
    surface_samples=2_000,
    strides=(1,),
    fitting={"color_iterations": 8, "normal_iterations": 8, "refine_every": 4},
    tracking=BRIEF,
)


@dataclass(frozen=True)
class Bench:
    """Inputs that all sections share.

    Attributes:
        captures: Captures with truth, by name; the first is the one of all sections but ``captures``.
        effort: Amount that is measured.
        make: Makes contenders.
        device: Where they run.
        keep: Folder of the sequences of ``captures``; None for none.
    """

    captures: Mapping[str, Capture]
    effort: Effort
    make: Callable[[FitOptions, TrackOptions], Contender]
    device: Any
    keep: Path | None = None

    @property
    def capture(self) -> Capture:
        """The first of the captures."""
        return next(iter(self.captures.values()))

    @property
    def fitting(self) -> FitOptions:
        """How ours fits."""
        return FitOptions(gaussian_count=self.effort.gaussians, **self.effort.fitting)

    def follow(self, contender: Contender, capture: Capture, frames: Sequence[int]) -> Iterator[ModelledFrame]:
        """Fit the first of some frames, and track the others."""
        return follow(contender, capture, frames, self.device)

    def scored(self, contender: Contender, modelled: ModelledFrame, capture: Capture) -> Row:
        """Return the scores of a frame: of test views where it has some, of its surface where that is known.

        Views are drawn with the samples of the fit; ``fine_psnr`` is with `MOST_SAMPLES`, the same for all.
        """
        seeing = [record.camera for record in capture.select(split="train", frames=[modelled.frame])]
        draw = partial(self.psnr, modelled, capture, contender.options)
        scores = score_frame(
            modelled.cloud,
            capture.select(split="test", frames=[modelled.frame]),
            contender.mesh(modelled.cloud, seeing),
            truth_mesh=read_truth_mesh(capture, modelled.frame),
            seeing=seeing,
            options=contender.options,
            samples=modelled.samples,
            sample_count=self.effort.surface_samples,
            device=self.device.alias,
        ).as_dict()
        same = modelled.samples == MOST_SAMPLES
        return {
            "gaussians": len(modelled.cloud),
            "samples": modelled.samples,
            **scores,
            "fine_psnr": scores["psnr"] if same else draw(MOST_SAMPLES),
        }

    def psnr(self, modelled: ModelledFrame, capture: Capture, options: RasterOptions | None, samples: int) -> float:
        """Return the PSNR of test views in the subject's box, drawn in some way [dB]."""
        records = capture.select(split="test", frames=[modelled.frame])
        return score_frame(modelled.cloud, records, options=options, samples=samples, device=self.device.alias).psnr

    def warm(self, capture: Capture) -> None:
        """Compile and load what is timed afterwards."""
        few = replace(
            self.fitting, gaussian_count=500, color_iterations=2, normal_iterations=2, refine_every=2, samples=2
        )
        list(follow(self.make(few, BRIEF), capture, capture.frames[:2], self.device))


def measure_captures(bench: Bench) -> Iterator[Row]:
    """Yield scores of the frames with truth of every capture, drift up to the last of them, and seconds."""
    bench.warm(bench.capture)
    rows: list[Row] = []
    for name, capture in bench.captures.items():
        contender = bench.make(bench.fitting, bench.effort.tracking)
        known = truth_frames(capture)
        last = max(known[-1], known[0] + 1)  # a capture of one frame with truth is tracked for one, too
        frames = [frame for frame in capture.frames if known[0] <= frame <= last]
        modelled = list(bench.follow(contender, capture, frames))
        meshes = [read_truth_mesh(capture, frame) for frame in frames]
        drift = tracking_drift(
            (entry.cloud for entry in modelled),
            (mesh.vertices for mesh in meshes),
            meshes[0].faces,
            cameras=[record.camera for record in capture.select(split="train", frames=frames[:1])],
            device=bench.device.alias,
        )
        views = capture.select(split="train", frames=frames[:1])
        row = {
            "name": name,
            "views": len(views),
            "size": [views[0].camera.width, views[0].camera.height],
            "frames": [
                {
                    "frame": entry.frame,
                    "seconds": entry.seconds,
                    "training_psnr": entry.report["psnr"],
                    "lost": entry.report.get("lost", ""),
                    "drift": moved.as_dict(),
                    **(bench.scored(contender, entry, capture) if entry.frame in known else {}),
                }
                for entry, moved in zip(modelled, drift, strict=True)
            ],
            "drawn": drawn(bench, modelled[0], capture, contender.options),
            "first_seconds": spread([modelled[0].seconds]),
            "tracked_seconds": spread([entry.seconds for entry in modelled[1:]]),
        }
        if bench.keep is not None:
            path = bench.keep / name / "gaussians.usda"
            write_sequence(path, capture, modelled, contender.options or CLASSIC)
        if capture is bench.capture:
            again = [next(bench.follow(contender, capture, frames[:1])) for _ in range(bench.effort.repeats - 1)]
            row["first_seconds"] = spread([entry.seconds for entry in (modelled[0], *again)])
            row["same_bits"] = all(
                np.array_equal(array, modelled[0].cloud.arrays()[key])
                for entry in again
                for key, array in entry.cloud.arrays().items()
            )
        rows.append(row)
        yield {"rows": rows}


def measure_strides(bench: Bench) -> Iterator[Row]:
    """Yield how frames follow of which more or fewer before them are left out, with and without silhouettes."""
    bench.warm(bench.capture)
    capture, effort = bench.capture, bench.effort
    known = truth_frames(capture)
    last = max(known[-1], known[0] + 1)
    key = next(bench.follow(bench.make(bench.fitting, effort.tracking), capture, known[:1]))
    rows: list[Row] = []
    for stride in effort.strides:
        for word, reach in (("with", effort.tracking.reach), ("without", math.inf)):
            row: Row = {"name": f"{stride} {word}", "stride": stride, "silhouettes": word}
            tracking = replace(effort.tracking, reach=reach)
            rows.append(row | _tracked(bench, key, tracking, range(known[0], last + 1, stride)))
            yield {"gaussians": len(key.cloud), "rows": rows}
            if all(frame["start"] != "silhouettes" for frame in rows[-1]["frames"]):
                break  # the same without them


def _tracked(bench: Bench, key: ModelledFrame, options: TrackOptions, frames: Sequence[int]) -> Row:
    """Return how far the surface moves from one of some frames to the next, and how these follow from the first."""
    capture = bench.capture
    meshes = [read_truth_mesh(capture, frame) for frame in frames]
    cameras = [record.camera for record in capture.select(split="train", frames=frames[:1])]
    pairs = itertools.pairwise(meshes)
    motion = [motion_in_pixels(before.vertices, after.vertices, cameras) for before, after in pairs]
    contender = bench.make(bench.fitting, options)
    modelled = [key, *follow(contender, capture, frames[1:], bench.device, track=key.track)]
    clouds, vertices = (entry.cloud for entry in modelled), (mesh.vertices for mesh in meshes)
    drift = tracking_drift(clouds, vertices, meshes[0].faces, cameras=cameras, device=bench.device.alias)
    seen = {record.frame for record in capture.select(split="test")}
    return {
        "pixels": dict(zip(("median", "p95", "largest"), np.quantile(motion, (0.5, 0.95, 1.0)).tolist(), strict=True)),
        "frames": [
            {
                "frame": entry.frame,
                "seconds": entry.seconds,
                "training_psnr": entry.report["psnr"],
                "start": entry.report.get("start", ""),
                "torn": entry.report.get("torn", 0.0),
                "lost": entry.report.get("lost", ""),
                "drift": moved.as_dict(),
                "psnr": bench.psnr(entry, capture, contender.options, entry.samples) if entry.frame in seen else None,
            }
            for entry, moved in zip(modelled, drift, strict=True)
        ],
    }


def drawn(bench: Bench, modelled: ModelledFrame, capture: Capture, options: RasterOptions | None) -> Row:
    """Return the PSNR of test views as fitted and as other programs draw, with one and with the fit's samples [dB]."""
    return {
        f"{name}_{word}": bench.psnr(modelled, capture, way, samples)
        for name, way in (("fitted", options), ("classic", CLASSIC))
        for word, samples in (("one_sample", 1), ("samples_of_fit", modelled.samples))
    }


def spread(values: Sequence[float]) -> Row:
    """Return median and range."""
    return {"median": float(np.median(values)), "lowest": min(values), "highest": max(values), "count": len(values)}


def measure_large(bench: Bench) -> Iterator[Row]:
    """Yield time, scores and memory of frames at full resolution.

    The first two frames take the default's steps. Then tracking goes back and forth between them in a draft's steps,
    of which only memory is of interest.
    """
    effort = bench.effort
    bench.warm(bench.capture)
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        width, height = effort.large_size
        capture = write_large_capture(
            Path(folder) / "large",
            bench.capture,
            frames=bench.capture.frames[:2],
            camera_count=effort.large_views,
            width=width,
            height=height,
            samples=effort.samples,
            subdivisions=2 if width > 960 else 0,
            device=bench.device.alias,
        )
        found: Row = {
            "views": effort.large_views,
            "width": width,
            "height": height,
            "seconds_to_path_trace": time.perf_counter() - started,
            "frames": [],
        }
        say(f"path traced in {found['seconds_to_path_trace']:.1f} s")
        draft = TrackOptions.of_preset("draft") if effort.tracking is not BRIEF else BRIEF
        contenders = [bench.make(bench.fitting, tracking) for tracking in (effort.tracking, draft)]
        track = None
        for index in range(effort.large_tracked + 1):
            frame, is_scored = capture.frames[index % 2], index < 2
            contender = contenders[0 if is_scored else 1]
            with peak_memory(bench.device) as peak:
                modelled = next(follow(contender, capture, [frame], bench.device, track=track))
            track = modelled.track
            row = {"name": str(index), "steps": "default" if is_scored else "draft", "seconds": modelled.seconds}
            row |= memory(bench.device) | peak
            if is_scored:
                records = capture.select(split="test", frames=[frame])
                scores = score_frame(
                    modelled.cloud,
                    records,
                    options=contender.options,
                    samples=modelled.samples,
                    device=bench.device.alias,
                )
                row |= {"gaussians": len(modelled.cloud), "samples": modelled.samples, **scores.as_dict()}
            found["frames"].append(row)
            yield found


def memory(device: Any) -> Row:
    """Return what this process holds of the host, as it is and after all that is free was given back [bytes].

    What is given back is what Python's collector finds, and what the allocator keeps of freed memory. On CUDA, also
    what is taken of the device, context included.
    """
    found: Row = {"host_bytes": _resident()}
    gc.collect()
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)
    found["host_bytes_after_trim"] = _resident()
    return found | ({"device_bytes": device.total_memory - device.free_memory} if device.is_cuda else {})


def _resident() -> int:
    """Return the bytes of this process that are in the host's memory; 0 where the system does not say."""
    path = Path("/proc/self/statm")
    return int(path.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if path.exists() else 0


@dataclass(frozen=True)
class Trial:
    """A first frame to fit and score.

    Attributes:
        name: In tables.
        options: How it is fitted.
        cameras: Number of training cameras; None for all.
    """

    name: str
    options: FitOptions
    cameras: int | None = None


def rade_trials(bench: Bench) -> list[Trial]:
    """Return RaDe-GS's choices with as many steps as ours, then what ours has beside them, then ours."""
    return [*_rade_trials(bench, 1), Trial("ours", bench.fitting)]


def _rade_trials(bench: Bench, longer: int) -> list[Trial]:
    ours = bench.fitting
    half = longer * (ours.color_iterations + ours.normal_iterations) // 2  # with normals in the second half
    alone = FitOptions.of_preset(
        "rade", gaussian_count=ours.gaussian_count, color_iterations=half, normal_iterations=half
    )
    fine = replace(alone, samples=ours.samples)
    masked = replace(fine, weights=replace(fine.weights, alpha=ours.weights.alpha))
    return [
        Trial("RaDe-GS's choices", alone),
        Trial("with our samples a pixel", fine),
        Trial("with our samples and loss on masks", masked),
    ]


def variant_trials(bench: Bench) -> list[Trial]:
    """Return ours drawn as 3DGS draws, and what differs added one by one: the last is ours with fewer Gaussians."""
    few, more = bench.effort.few
    plain = replace(bench.fitting, gaussian_count=few, raster=CLASSIC, samples=1, hidden_share=0.0)
    sharp = replace(plain, raster=bench.fitting.raster)
    dense = replace(sharp, gaussian_count=more)
    fine = replace(dense, samples="auto")
    return [
        Trial("drawn as 3DGS does", plain),
        Trial("antialiased", replace(plain, raster=replace(CLASSIC, antialiased=True))),
        Trial("low-pass 0.1", sharp),
        Trial("more Gaussians", dense),
        Trial("more samples", fine),
        Trial("hidden ones replaced", replace(fine, hidden_share=bench.fitting.hidden_share)),
    ]


def camera_trials(bench: Bench) -> list[Trial]:
    """Return fits to some of the cameras and to all of them, with opacities kept and reset."""
    more_than_all = len(training_cameras(bench.capture)) + 1
    ways = {"kept": replace(bench.fitting, reset_below=0), "reset": replace(bench.fitting, reset_below=more_than_all)}
    return [
        Trial(name, options, cameras=count) for count in (*bench.effort.cameras, None) for name, options in ways.items()
    ]


def trials(make: Callable[[Bench], Sequence[Trial]]) -> Callable[[Bench], Iterator[Row]]:
    """Return the section that fits and scores some trials on the first capture."""

    def measure_trials(bench: Bench) -> Iterator[Row]:
        rows: list[Row] = []
        names = training_cameras(bench.capture)
        for trial in make(bench):
            count = min(trial.cameras or len(names), len(names))
            # What counts of the surface is what these cameras see: fewer cameras are judged by less of it.
            capture = bench.capture if count == len(names) else with_cameras(bench.capture, evenly(names, count))
            contender = bench.make(trial.options, bench.effort.tracking)
            modelled = next(bench.follow(contender, capture, truth_frames(capture)[:1]))
            steps = trial.options.color_iterations + trial.options.normal_iterations
            row = {"name": trial.name, "cameras": count, "steps": steps, "seconds": modelled.seconds}
            rows.append(row | bench.scored(contender, modelled, capture))
            yield {"rows": rows}

    return measure_trials


SECTIONS: dict[str, Callable[[Bench], Iterator[Row]]] = {
    "captures": measure_captures,
    "large": measure_large,
    "strides": measure_strides,
    "rade": trials(rade_trials),
    "variants": trials(variant_trials),
    "gaussians": trials(
        lambda bench: [Trial(f"{count}", replace(bench.fitting, gaussian_count=count)) for count in bench.effort.counts]
    ),
    "cameras": trials(camera_trials),
    "rade_long": trials(lambda bench: _rade_trials(bench, bench.effort.long)[-1:]),
}


def main() -> int:
    parser = record.parser(__doc__, device=True, data=True, quick="the demo's capture, small")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="write the sequences of captures there")
    parser.add_argument(
        "--only", nargs="+", default=(), choices=SECTIONS, metavar="SECTION", help="these sections only"
    )
    parser.add_argument("--small", action="store_true", help="few Gaussians, for a CPU")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    with tempfile.TemporaryDirectory() as folder:
        if arguments.quick:
            small: Row = {"camera_count": 8, "size": 64, "samples": 4, "frame_count": 2, "device": arguments.device}
            captures = {"walker": write_demo_capture(Path(folder) / "demo", **small)}
        else:
            captures = {name: Capture.read(arguments.data / "captures" / name) for name in CAPTURES}
        bench = Bench(
            captures,
            QUICK if arguments.quick else SMALL if arguments.small else Effort(),
            lambda fitting, tracking: of_options(fitting, arguments.device, tracking),
            device,
            arguments.keep,
        )
        return measure_all(SECTIONS, bench, arguments, device, arguments.only)


if __name__ == "__main__":
    sys.exit(main())
