"""What do the flaws of real captures cost, and are they told? The product's own job on flawed copies of clean captures.

    python benchmarks/flaws.py --out JSON [--device cuda:0] [--captures NAME ...] [--flaws NAME ...] [--sizes S ...]
        [--seeds N ...] [--preset draft] [--gaussians 8000] [--frames 1] [--seconds 540] [--naming all]
        [--reduction 2]

A case is a capture with a flaw (`beam_warp.stability.flaws`), of a size over the nominal one, drawn by a seed, which is
the job's seed too. ``clean`` is without any, ``flawed`` with all that a good studio gets a little wrong, and ``a+b``
with several. `beam run` makes an asset of the first frames whose truth is known, and `beam evaluate` scores it against
the clean capture: its test images, poses and materials. Results are written after each case; cases that the file holds
already are not run again, if the code is the same. With ``--seconds``, no case is begun that would not end by then.

With ``--naming``, a case ends with what is said of it: of images, of the rig too, or of all but the materials;
nothing is scored. Flaws are measured in pixels, so that captures may be reduced by ``--reduction``, as a CPU must.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import record
from numpy.typing import NDArray
from parts import Row

from beam_warp import converters
from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.corrections import RigCorrection, move_between
from beam_warp.capture.findings import Finding
from beam_warp.capture.inspect import require_reconstructable
from beam_warp.capture.views import CapturedView
from beam_warp.cli.decompose import Measuring, run_options
from beam_warp.cli.reconstruct import Modelling, options_of, steps_of
from beam_warp.cli.run import Run
from beam_warp.cli.run import run as run_job
from beam_warp.decomposition.capture_light import find_light
from beam_warp.decomposition.frames import GivenFrames
from beam_warp.decomposition.work import MaterialWork
from beam_warp.demo.capture import write_demo_capture
from beam_warp.demo.lights import sunset
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import BeamError
from beam_warp.evaluate.materials import EvaluateOptions, score_materials
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.image.metrics import root_mean_square
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.job import reconstruct
from beam_warp.reconstruction.rig import in_gauge, pixels_of
from beam_warp.reconstruction.scores import truth_frames
from beam_warp.reconstruction.steps import FitAndTrack
from beam_warp.stability.capture_cases.case import Detection, detections_of, in_words
from beam_warp.stability.flaws.write import FLAWS, STUDIO, FlawedCapture, write_flawed
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.harmonics import SH_C0

CLEAN, TOGETHER = "clean", "flawed"
SIZELESS = (CLEAN, "plate")
"""Cases that have one size only."""

MATERIALS = {"base_color": ("base_color.R", "base_color.G", "base_color.B"), "roughness": ("roughness",)}
SOLID = 0.99
"""Channels whose stated errors are compared with the truth's layers, and coverage by which a pixel shows the subject
alone."""

NAMED: Mapping[str, Collection[str]] = {
    "exposure": ("camera-exposure", "camera-white-balance"),
    "vignetting": ("vignetting",),
    "noise": ("noisy-images",),
    "masks": ("mask-offset", "mask-softness"),
    "hard-masks": ("mask-softness",),
    "cutouts": ("mask-offset",),
    "blots": ("mask-blots",),
    "light": ("environment-turned", "environment-exposure"),
    "clipping": ("clipped-images",),
    "defocus": ("soft-images",),
    "motion-blur": ("motion-blur",),
    "jpeg": ("jpeg-loss",),
    "poses": ("camera-poses",),
    "distortion": ("lens-distortion", "camera-poses"),
    "wrong-camera": ("sees-nothing", "camera-contradicts"),
    "missing-image": ("missing-image",),
}
"""Codes of findings that name a flaw."""


def cases(arguments: argparse.Namespace) -> Iterator[tuple[str, str, float, int]]:
    """Yield the cases that are asked for: capture, name of the flaw, size and seed."""
    for capture, seed, size, name in product(arguments.captures, arguments.seeds, arguments.sizes, arguments.flaws):
        if name not in SIZELESS or size == arguments.sizes[0]:
            yield capture, name, 1.0 if name in SIZELESS else size, seed


def flaws_of(name: str) -> tuple[str, ...]:
    """Return the flaws that a case's name stands for."""
    return () if name == CLEAN else STUDIO if name == TOGETHER else tuple(name.split("+"))


def measure(clean: Capture, name: str, size: float, seed: int, arguments: argparse.Namespace, folder: Path) -> Row:
    """Return what comes of a case: scores, what was found, what was recovered, and seconds of each step."""
    frames = truth_frames(clean)[: arguments.frames]
    started = time.perf_counter()
    copy = write_flawed(clean, folder / "capture", flaws_of(name), size=size, seed=seed, frames=frames)
    written = time.perf_counter()
    out = folder / "out"
    modelling = Modelling(gaussians=arguments.gaussians, preset=arguments.preset)
    how = {"seed": seed, "device": arguments.device, "workers": "1", "quiet": True}
    asked = Run(input=copy.capture.folder, out=out, modelling=modelling, **how)
    row: Row = {"injected": copy.injected, "seconds": {"write": written - started}}
    findings: list[Finding] = []
    try:
        if arguments.naming:
            findings = findings_of(asked, arguments.naming)
        else:
            run_job(asked)
    except BeamError as error:
        said = str(error).replace(f"{folder}{os.sep}", "")
        row["seconds"]["run"] = time.perf_counter() - written
        return {**row, "refused": said, **told(copy, name, [Finding("error", "refused", said)])}
    row["seconds"]["run"] = time.perf_counter() - written
    if arguments.naming:
        return row | told(copy, name, findings)
    reconstruction, decomposition = (
        json.loads((place / "report.json").read_text()) for place in (out / "reconstruction", out)
    )
    said = [*reconstruction["findings"], *decomposition["findings"]]
    said += [finding for frame in reconstruction["frames"] for finding in frame["findings"]]
    row |= told(copy, name, [Finding(**finding) for finding in said])
    rig = RigCorrection.read(out / "reconstruction")
    surface = converters.read(out / "asset.usda")[0]
    row["recovered"] = recovered(copy, reconstruction, decomposition)
    row["recovered"] |= recovered_poses(clean, copy.capture, rig, change_axes(surface, "rfu").positions)
    row["gaussians"] = decomposition["input"]["gaussians"]
    evaluated = time.perf_counter()
    sequence = in_units_of(converters.read(out / "asset.usda"), copy.white)
    options = EvaluateOptions(scaled_relighting=True, device=arguments.device)
    row["scores"] = scores(score_materials(sequence, clean, options, metrics=PerceptualMetrics()).as_dict())
    row["errors"] = stated_errors(sequence, clean, frames[0], arguments.device)
    row["seconds"]["evaluate"] = time.perf_counter() - evaluated
    return row


def findings_of(asked: Run, what: str) -> list[Finding]:
    """Return what the job says of a capture: of its images, of its rig too, or of Gaussians and light too."""
    capture = Capture.read(asked.input)
    if what == "images":
        return list(require_reconstructable(capture).fallbacks)
    assert capture.environment_path is not None
    light = EnvironmentMap.read(capture.environment_path)
    steps = steps_of(asked.modelling, capture, asked.seed, asked.device, light)
    assert isinstance(steps, FitAndTrack)
    if what == "rig":
        steps = replace(steps, fitting=replace(steps.fitting, color_iterations=1, normal_iterations=0))
    found = reconstruct(capture, asked.out, steps, options_of(asked.modelling, capture))
    said = found.report["findings"] + [finding for frame in found.report["frames"] for finding in frame["findings"]]
    if what == "all":
        options = run_options(
            Measuring(), capture, preset="direct", seed=asked.seed, device=asked.device, persistent=False
        )
        work = MaterialWork(asked.out, GivenFrames(lambda: found.sequence, found.capture), light, options)
        said += json.loads(find_light(light, work.source)["findings"].tobytes())
    return [Finding(**finding) for finding in said]


@dataclass(frozen=True, eq=False, kw_only=True)
class ReducedRecord(CaptureRecord):
    """A record at a lower resolution than its file's."""

    whole: CaptureRecord
    reduction: int

    def view(self) -> CapturedView:
        """Read the view and reduce it."""
        return self.whole.view().reduced(self.reduction)


def reduced(capture: Capture, reduction: int) -> Capture:
    """Return a capture at a lower resolution."""
    records = (
        ReducedRecord(**{**vars(record), "camera": record.camera.reduced(reduction)}, whole=record, reduction=reduction)
        for record in capture.records
    )
    return replace(capture, records=tuple(records))


def told(copy: FlawedCapture, name: str, findings: Collection[Finding]) -> Row:
    """Return what was found, in words, which flaws that names, and what it names beside them.

    A flaw of one camera is named where that camera is.
    """
    cameras = tuple(dict.fromkeys(entry.camera_name for entry in copy.capture.records))
    warnings = detections_of([finding for finding in findings if finding.severity != "note"], cameras)
    faulty = {camera for camera, flaws in copy.injected["cameras"].items() if "turn_degrees" in flaws}

    def names(found: Detection, flaw: str) -> bool:
        return found.code in NAMED.get(flaw, ()) and (flaw != "wrong-camera" or found.camera in faulty)

    flaws = flaws_of(name)
    beside = [found for found in warnings if not any(names(found, flaw) for flaw in flaws)]
    return {
        "said": in_words(warnings),
        "named": {flaw: any(names(found, flaw) for found in warnings) for flaw in flaws},
        "beside": in_words(beside),
    }


def recovered(copy: FlawedCapture, reconstruction: Row, decomposition: Row) -> Row:
    """Return parameters that the product reports, beside those that were injected.

    ``light_stops``: how much brighter the light was made; it should be minus what was injected.
    ``exposure_spread``: largest exposure of a camera over the mean [stop]; 0 where none is known. ``falloff``: power
    of the cosine by which vignetting was undone.
    """
    stops = [flaws.get("exposure_stops", 0.0) for flaws in copy.injected["cameras"].values()]
    exposures = reconstruction["exposures"]
    spreads = [] if exposures is None else [abs(camera["stops"]) for camera in exposures["cameras"]]
    return {
        "light_stops": decomposition["exposure_stops"],
        "light_stops_injected": float(np.log2(copy.injected["light"].get("gain", 1.0))),
        "exposure_spread": max(spreads, default=0.0),
        "exposure_spread_injected": max(map(abs, stops), default=0.0),
        "falloff_injected": copy.injected["falloff"],
        **({} if exposures is None else vignetting_of(exposures)),
        **({} if exposures is None else gain_errors(copy.injected["cameras"], exposures["cameras"])),
    }


def vignetting_of(exposures: Row) -> dict[str, float]:
    """Return the power of vignetting that was found, its error, and what was undone."""
    undone = exposures["falloff"] * exposures["falloff_undone"]
    return {"falloff_found": exposures["falloff"], "falloff_error": exposures["falloff_error"], "falloff": undone}


def recovered_poses(
    clean: Capture, copy: Capture, rig: RigCorrection | None, surface: NDArray[np.floating]
) -> dict[str, float]:
    """Return how far cameras are from the true ones as the copy states them, and as they were found.

    A motion and a scale of the world, which no photograph tells, are taken out first: those of least squares in pixels.

    Args:
        clean: The capture with the true cameras.
        copy: The flawed copy.
        rig: What was found; None for nothing.
        surface: Points of the subject [m], ``(N, 3)``.

    Returns:
        Root mean squares over the cameras that are left: ``pose_pixels`` of what moves in the image, and ``pose_mm`` of
        the camera's place, both with ``_injected``, too; how far the world was moved by that, ``gauge_mm``.
    """
    true = {entry.camera_name: entry.camera for entry in clean.select(split="train")}
    records = copy.select(split="train")
    found = {entry.camera_name: entry.camera for entry in (records if rig is None else rig.corrected(records))}
    given = {entry.camera_name: entry.camera for entry in records if entry.camera_name in found}
    result = {}
    for ending, cameras in (("_injected", given), ("", found)):
        pixels, metres, world = apart([true[name] for name in cameras], list(cameras.values()), surface)
        result |= {f"pose_pixels{ending}": pixels, f"pose_mm{ending}": 1e3 * metres}
        result[f"gauge_mm{ending}"] = 1e3 * float(np.linalg.norm(world[3:6]))
    return result


def apart(
    true: Sequence[Camera], found: Sequence[Camera], surface: NDArray[np.floating]
) -> tuple[float, float, NDArray[np.float64]]:
    """Return how far cameras are from true ones, in the image [pixel] and in place [m], and the world's motion."""
    points = surface[:: max(1, len(surface) // 500)].astype(np.float64)
    moves = np.array([[*move_between(*pair), 0.0, 0.0] for pair in zip(true, found, strict=True)])
    moves, world = in_gauge(true, moves, points, ("turn", "shift"))
    pixels = [pixels_of(*pair, points) for pair in zip(true, moves, strict=True)]
    return float(np.sqrt(np.mean(np.square(pixels)))), float(np.sqrt(np.square(moves[:, 3:6]).sum(1).mean())), world


def gain_errors(injected: Row, cameras: Sequence[Row]) -> dict[str, float]:
    """Return root mean square errors of the cameras' gains over those of the rig, natural logarithms.

    ``exposure`` is the mean of red, green and blue, ``white_balance`` what these differ from it. ``found`` is before
    anything is judged, ``error`` what is left where it was undone.

    Args:
        injected: Flaws of each camera that has some, by name.
        cameras: What was found of each.
    """
    true, found, undone = [], [], []
    for camera in cameras:
        flaws = injected.get(camera["camera"], {})
        red, blue = flaws.get("white_balance", (0.0, 0.0))
        true.append(np.log(2.0) * flaws.get("exposure_stops", 0.0) + np.log1p([red, 0.0, blue]))
        found.append(np.log(2.0) * camera["stops"] + np.array(camera["balance"]))
        undone.append(np.log(camera["gains"]))
    errors = {}
    for word, logs in (("found", found), ("error", undone)):
        off = np.stack(logs) - np.stack(true)
        off -= off.mean(axis=0)
        exposure = off.mean(axis=1, keepdims=True)
        errors[f"exposure_{word}"] = float(np.sqrt(np.mean(np.square(exposure))))
        errors[f"white_balance_{word}"] = float(np.sqrt(np.mean(np.square(off - exposure))))
    return errors


def in_units_of(sequence: GaussianSequence, white: float) -> GaussianSequence:
    """Return a sequence whose captured colour, in units of white, is in those of the clean capture."""

    def brightened(cloud: GaussianCloud) -> GaussianCloud:
        assert cloud.radiance is not None
        radiance = cloud.radiance * np.float32(white)
        radiance[:, 0] += np.float32(0.5 * (white - 1.0) / SH_C0)  # colour is 0.5 more than the harmonics say
        return cloud.with_arrays(radiance=radiance)

    return replace(sequence, read_frame=lambda frame: brightened(sequence[frame])) if white != 1.0 else sequence


def scores(found: Row) -> Row:
    """Return the scores that a table of flaws has, means over views: PSNR and SSIM of images, errors of geometry."""
    mean = found["mean"]
    images = ("ambient_occlusion", "base_color", "base_color_scaled", "roughness", "novel_view")
    relit = {name: mean[name].get("deferred", {}) for name in ("relit", "relit_scaled")}
    picked = {name: mean[name] for name in images if name in mean}
    picked |= {
        name: {key: float(np.mean([light[key] for light in lights.values()])) for key in ("psnr", "ssim")}
        for name, lights in relit.items()
        if lights
    }
    kept = {name: {key: score[key] for key in ("psnr", "ssim")} for name, score in picked.items()}
    geometry = ("normals_median_degrees", "normals_mean_degrees", "depth_median_mm", "overlap")
    return {**kept, "base_color_scale": found["base_color_scale"], **{name: mean[name] for name in geometry}}


def stated_errors(sequence: GaussianSequence, clean: Capture, frame: int, device: str) -> Row:
    """Return how errors of the first frame's materials compare with the standard errors that the asset states.

    Both are drawn, and compared in the pixels of test views that show the subject alone: a Gaussian's own value is seen
    by nobody, and neighbours in a fit err against each other in what their sum shows rightly. Normally distributed
    errors that are stated rightly have a median |z| of 0.67, 68 % within 1 and 95 % within 2. A light that is stated
    too bright makes all base colours too dark by one factor. Its error is stated apart, and joined with that of each
    colour; ``base_color_alone`` is without it, and ``base_color_scaled`` without the factor.
    """
    cloud = change_axes(sequence[0], "rfu")
    records = [entry for entry in clean.select(split="test", frames=[frame]) if entry.truth_path is not None]
    drawn = rasterize(
        cloud,
        [entry.camera for entry in records],
        channels=[f"{name}{of}" for name in MATERIALS for of in ("", "_error")],
        options=RasterOptions.from_metadata(sequence.metadata),
        device=device,
    )
    truths = [entry.truth() for entry in records]
    shown = [(truth.channels["A"] > SOLID) & (image.alpha > SOLID) for truth, image in zip(truths, drawn, strict=True)]
    found = {}
    for name, layers in MATERIALS.items():
        true, value, error = (
            np.concatenate([image[at].reshape(at.sum(), -1) for image, at in zip(images, shown, strict=True)])
            for images in (
                [truth.stack(*layers) for truth in truths],
                [image.channels[name] for image in drawn],
                [image.channels[f"{name}_error"] for image in drawn],
            )
        )
        found[name] = shares(value - true, error)
        if name == "base_color":
            common = [float(word) for word in sequence.metadata["base_color_scale_errors"].split()]
            found["base_color_alone"] = found[name]
            found[name] = shares(value - true, np.hypot(error, value * common))
            scale = (value * true).sum(axis=0) / (value**2).sum(axis=0)
            found["base_color_scaled"] = shares(scale * value - true, scale * error)
    return found


def shares(errors: NDArray[Any], stated: NDArray[Any]) -> Row:
    """Return how many errors lie within one and two stated ones, the median of their ratio, and both in the mean."""
    z = np.abs(errors) / np.maximum(stated, 1e-6)
    return {
        "median_z": float(np.median(z)),
        "within_1": float((z <= 1.0).mean()),
        "within_2": float((z <= 2.0).mean()),
        "root_mean_square": root_mean_square(errors),
        "stated": root_mean_square(stated),
    }


def capture_of(name: str, data: Path, folder: Path, device: str) -> Capture:
    """Return a clean capture of the data folder, or the demo's, path traced."""
    if name != "demo":
        return Capture.read(data / "captures" / name)
    options: dict[str, Any] = {"frame_count": 1, "camera_count": 24, "size": 320, "samples": 64, "device": device}
    return write_demo_capture(folder / "demo", relit={"sunset": sunset()}, **options)


def known_rows(arguments: argparse.Namespace) -> list[Row]:
    """Return the rows that the result holds already.

    Raises:
        SystemExit: They were measured by other code.
    """
    if not arguments.out.is_file():
        return []
    known = json.loads(arguments.out.read_text(encoding="utf-8"))
    if changed := record.changed_since(known["measured"]):
        raise SystemExit(f"{arguments.out} was measured by other code: {', '.join(changed)}. Move it away.")
    return known["rows"]


def main() -> int:
    parser = record.parser(__doc__, device=True, data=True)
    parser.add_argument("--captures", nargs="+", default=["walker", "runner", "robot"], metavar="NAME", help="or demo")
    parser.add_argument("--flaws", nargs="+", default=[CLEAN, TOGETHER, *FLAWS], metavar="NAME")
    parser.add_argument("--sizes", nargs="+", type=float, default=[1.0], metavar="S", help="over the nominal size")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="N")
    parser.add_argument("--preset", choices=("fast", "draft"), default="fast")
    parser.add_argument("--gaussians", type=int, metavar="N", help="by default the preset's")
    parser.add_argument("--frames", type=int, default=1, metavar="N", help="with truth, from the first on")
    parser.add_argument("--seconds", type=float, help="begin no case that would end later")
    parser.add_argument("--naming", choices=("images", "rig", "all"), help="stop at what is said of these")
    parser.add_argument("--reduction", type=int, default=1, metavar="K", help="of images, with --naming")
    arguments = parser.parse_args()
    for name in arguments.flaws:
        if unknown := set(flaws_of(name)) - set(FLAWS):
            parser.error(f"flaws must be {CLEAN}, {TOGETHER} or of {', '.join(FLAWS)}, got {', '.join(unknown)}")
    started, longest = time.perf_counter(), 0.0
    rows = known_rows(arguments)
    done = {tuple(row["case"].values()) for row in rows}
    with tempfile.TemporaryDirectory() as place:
        captures: dict[str, Capture] = {}
        for case in cases(arguments):
            begun = time.perf_counter()
            if case in done or (arguments.seconds and begun + longest - started > arguments.seconds):
                continue
            capture, name, size, seed = case
            if capture not in captures:
                whole = capture_of(capture, arguments.data, Path(place), arguments.device)
                captures[capture] = reduced(whole, arguments.reduction)
            with tempfile.TemporaryDirectory(dir=place) as folder:
                row = measure(captures[capture], name, size, seed, arguments, Path(folder))
            title = f"{capture} {name}" + ("" if name in SIZELESS else f" x{size:g}") + f" seed {seed}"
            rows.append(
                {"name": title, "case": dict(zip(("capture", "flaw", "size", "seed"), case, strict=True)), **row}
            )
            record.write_result(arguments, resolve_device(arguments.device), {"rows": rows})
            longest = max(longest, time.perf_counter() - begun)
            print(f"{title}: {in_a_line(row)} ({time.perf_counter() - begun:.0f} s)", file=sys.stderr, flush=True)
    return 0


def in_a_line(row: Row) -> str:
    """Return a row for people who wait."""
    if "refused" in row:
        return f"refused: {row['refused']}"
    said = f"said {', '.join(row['said']) or 'nothing'}"
    if "scores" not in row:
        return said
    found = row["scores"]
    keys = ("ambient_occlusion", "base_color_scaled", "relit_scaled", "novel_view")
    psnr = ", ".join(f"{key} {found[key]['psnr']:.1f}" for key in keys if key in found)
    return f"{psnr}, normals {found['normals_median_degrees']:.1f}°; {said}"


if __name__ == "__main__":
    sys.exit(main())
