"""Decomposed reconstructions as the package makes and scores them: three ways, two renderers, and roughness."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from operator import add
from typing import Any

import numpy as np
from materials_bench import Bench
from materials_contenders import Subject, SubjectFrame
from numpy.typing import NDArray
from parts import Row, say

from beam_warp import converters
from beam_warp.capture.capture import CaptureRecord
from beam_warp.capture.matching import match_frames
from beam_warp.capture.views import CapturedView
from beam_warp.decomposition.job import run
from beam_warp.decomposition.options import ESTIMATE, OverviewOptions, RunOptions
from beam_warp.evaluate.drawn import draw_materials
from beam_warp.evaluate.materials import EvaluateOptions, score_materials
from beam_warp.evaluate.relighters import Relighter, deferred_relighter
from beam_warp.evaluate.sheet import evaluation_sheet
from beam_warp.evaluate.views import ScoredView
from beam_warp.image.files import write_png
from beam_warp.image.metrics import Score, compare
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.images import ImagePathOptions
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.normals import SurfacePoints
from beam_warp.materials.roughness import RoughnessEstimate, solve_roughness
from beam_warp.materials.roughness_profile import measure_roughness_profile
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.job import ReconstructOptions, reconstruct
from beam_warp.reconstruction.scores import truth_frames
from beam_warp.reconstruction.steps import FitAndTrack
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.study.materials import without_color
from beam_warp.trace.denoise import chosen_denoiser
from beam_warp.trace.scene import Scene
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.metadata import capture_frames_metadata

WAYS: Mapping[str, Mapping[str, Any]] = {
    "direct": {"roughness": ESTIMATE},
    "paper, bilateral": {"images": ImagePathOptions(denoiser="bilateral")},
    "paper, OIDN": {"images": ImagePathOptions(denoiser="oidn")},
}
"""What decomposes, as `beam decompose` does without options and with ``--preset paper``, whose roughness is 0.5."""

CONSTANTS = np.arange(0.3, 0.901, 0.05)
"""Roughnesses of which the best is what knowing nothing but one number would give."""

LEAST_PIXELS = 0.1
"""A Gaussian's true roughness is known where test views show at least so much of it."""


def reconstruction(bench: Bench, name: str) -> GaussianSequence:
    """Return a reconstruction that was given, or make one; a second time it is read."""
    if bench.assets is not None and (bench.assets / name / "gaussians.usda").exists():
        return converters.read(bench.assets / name / "gaussians.usda")
    effort, capture = bench.effort, bench.captures[name]
    fitting = FitOptions.of_preset("fast", gaussian_count=effort.gaussians, **(effort.fitting or {}))
    assert capture.environment_path is not None
    light = EnvironmentMap.read(capture.environment_path)
    steps = FitAndTrack(fitting=fitting, environment=light, device=str(bench.device))
    options = ReconstructOptions(frames=capture.frames[: effort.frames])
    return reconstruct(capture, bench.folder / f"{name}_gaussians", steps, options).sequence


def frames_of(sequence: GaussianSequence, numbers: Sequence[int]) -> GaussianSequence:
    """Return the frames that show some of the capture's, as a sequence of their own."""
    rows = [match_frames(sequence)[number] for number in numbers]
    metadata = {**sequence.metadata, **capture_frames_metadata(numbers)}
    return replace(sequence, frame_count=len(rows), read_frame=lambda frame: sequence[rows[frame]], metadata=metadata)


def subject_of(bench: Bench, name: str) -> Subject:
    """Return a reconstruction as the rows of the ablation take it."""
    capture, sequence = bench.captures[name], reconstruction(bench, name)
    matched = list(match_frames(sequence).items())[: bench.effort.frames]
    frames = [
        SubjectFrame(
            number,
            change_axes(sequence[index], "rfu"),
            [record.view() for record in capture.select(split="train", frames=[number])],
        )
        for number, index in matched
    ]
    kept = [frame for frame in frames if len(frame.cloud) == len(frames[0].cloud)]
    raster = RasterOptions.from_metadata(sequence.metadata)
    return Subject(name, kept, raster, bench.light_of(capture), bench.device)


def measure_evaluation(bench: Bench) -> Iterator[Row]:
    """Yield scores so far of every reconstruction, decomposed in every way."""
    result: Row = {"paths": bench.effort.paths, "captures": {}}
    for name, capture in bench.captures.items():
        sequence, known = reconstruction(bench, name), truth_frames(capture)
        matched = match_frames(sequence)
        ordered = [n for n in known if n in matched] + [n for n in matched if n not in known]
        chosen = sorted(ordered[: bench.effort.evaluated_frames])
        part: Row = {"gaussians": len(sequence[0]), "frames": chosen, "ways": {}}
        result["captures"][name] = part
        for way, options in WAYS.items():
            images = options.get("images")
            if images is not None and images.denoiser == "oidn" and chosen_denoiser("auto") != "oidn":
                part["ways"][way] = {"unavailable": "the extra denoise is not installed"}
                continue
            part["ways"][way] = row = evaluate(bench, name, frames_of(sequence, chosen), way, options)
            mean = row["mean"]
            relit = {f"{r}, {light}": f"{s['psnr']:.2f}" for r, by in mean["relit"].items() for light, s in by.items()}
            say(f"{name}, {way}: base colour {mean['base_color']['psnr']:.2f} dB, relit {relit}")
            yield result
        yield result


def evaluate(bench: Bench, name: str, sequence: GaussianSequence, way: str, options: Mapping[str, Any]) -> Row:
    """Decompose a sequence in one way and score what comes out; seconds are of both."""
    capture, device = bench.captures[name], str(bench.device)
    assert capture.environment_path is not None
    own = way == "direct"
    folder = bench.keep / name if own and bench.keep is not None else bench.folder / f"{name}_{len(way)}"
    folder.parent.mkdir(parents=True, exist_ok=True)
    made = run(
        sequence,
        EnvironmentMap.read(capture.environment_path),
        folder,
        RunOptions(**options, device=device),
        capture=capture,
        overview=OverviewOptions(height=64),
    )
    started = time.perf_counter()
    shown: list[ScoredView] = []

    def observe(view: ScoredView) -> None:
        if not shown:
            shown.append(view)

    relighters: dict[str, Relighter] = {
        "deferred": deferred_relighter,
        "path": lambda raster, samples, device: PathRenderer(PathOptions(samples=bench.effort.paths), device=device),
    }
    found = score_materials(
        made.sequence, capture, EvaluateOptions(device=device), relighters=relighters, observe=observe
    ).as_dict()
    if own and bench.pictures is not None:
        bench.pictures.mkdir(parents=True, exist_ok=True)
        write_png(bench.pictures / f"materials_{name}.png", evaluation_sheet(shown))
    facts = {key: made.report[key] for key in ("seconds", "materials", "roughness", "exposure_stops", "findings")}
    kept = ("mean", "base_color_scale", "scale_deviation", "temporal", "conditions", "absent", "notes")
    return {
        **{key: found[key] for key in kept},
        "views": len(found["views"]),
        "decompose": facts,
        "evaluate_seconds": time.perf_counter() - started,
    }


def measure_roughness(bench: Bench) -> Iterator[Row]:
    """Yield so far how good roughness and its stated errors are, of one frame and of all."""
    result: Row = {"captures": {}}
    for name, capture in bench.captures.items():
        subject = subject_of(bench, name)
        first, device = subject.frames[0], str(bench.device)
        records = [r for r in capture.select(split="test", frames=[first.number]) if r.truth_path is not None]
        truth, known = true_roughness(first.cloud, records, subject.raster, device)
        constant, score = best_constant(first.cloud, records, subject.raster, device)
        part: Row = {
            "gaussians": len(first.cloud),
            "known": float(known.mean()),
            "true_median": float(np.median(truth[known])),
            "best_constant": {"roughness": constant, "psnr": score.psnr, "ssim": score.ssim},
            "rows": [],
        }
        result["captures"][name] = part
        profiles = (profile_of(subject, frame) for frame in subject.frames)
        summed = next(profiles)
        for count in sorted({1, len(subject.frames)}):
            if count > 1:
                summed = reduce(add, profiles, summed)
            found = solve_roughness(first.cloud.positions, summed)
            cloud = first.cloud.with_arrays(roughness=found.roughness)
            score = score_of(cloud, records, subject.raster, device)
            row = {
                "frames": count,
                "psnr": score.psnr,
                "ssim": score.ssim,
                **statistics(found, truth, known),
                "informed": found.report["informed_part"],
                "median_stated_error": found.report["median_error"],
            }
            part["rows"].append(row)
            say(f"{name}, roughness of {count} frames: {score.psnr:.2f} dB, median |z| {row['median_z']:.2f}")
            yield result


def profile_of(subject: Subject, frame: SubjectFrame) -> Any:
    """Return what a frame's views say of roughness."""
    device = str(subject.device)
    scene = Scene.from_gaussians(frame.cloud, device)
    cameras = [view.camera for view in frame.views]
    seen = view_evidence(frame.cloud, cameras, frame.views, options=subject.raster, device=device)
    points = SurfacePoints.seen_by(frame.cloud, seen, scene)
    return measure_roughness_profile(
        frame.cloud, scene, points, subject.light, seen, options=MaterialOptions(), frame=frame.number
    )


def true_roughness(
    cloud: GaussianCloud, records: Sequence[CaptureRecord], raster: RasterOptions, device: str
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the truth's roughness at every Gaussian, ``(N,)``, spread back from test views, and where it is known."""
    shown = []
    for record in records:
        truth = record.truth()
        alpha = np.clip(truth.channels["A"], 0.0, 1.0).astype(np.float32)
        values = np.repeat(truth.stack("roughness") * alpha[..., None], 3, axis=-1)
        shown.append(CapturedView(name=record.name, camera=record.camera, color=values.astype(np.float32), alpha=alpha))
    cameras = [record.camera for record in records]
    colors = view_evidence(without_color(cloud), cameras, shown, options=raster, device=device).colors.numpy()
    weights = colors[..., 3].astype(np.float64)
    total = weights.sum(axis=0)
    return (colors[..., 0] * weights).sum(axis=0) / np.maximum(total, 1e-12), total >= LEAST_PIXELS


def statistics(found: RoughnessEstimate, truth: NDArray[np.float64], known: NDArray[np.bool_]) -> Row:
    """Return how errors compare with what is stated of them, where the truth is known.

    Normally distributed errors that are stated rightly have a median |z| of 0.67, 68 % within 1 and 95 % within 2.
    """
    z = np.abs(found.roughness[known] - truth[known]) / found.standard_error[known]
    errors = found.roughness[known] - truth[known]
    return {
        "median_z": float(np.median(z)),
        "within_1": float((z <= 1.0).mean()),
        "within_2": float((z <= 2.0).mean()),
        "median_error": float(np.median(np.abs(errors))),
        "mean_error": float(errors.mean()),
    }


def score_of(
    cloud: GaussianCloud,
    records: Sequence[CaptureRecord],
    raster: RasterOptions,
    device: str,
    constant: float | None = None,
) -> Score:
    """Return the mean score over views of a cloud's roughness, or of a constant one, in the subject's box."""
    scores = []
    for record in records:
        drawn = draw_materials(cloud, record.camera, channels=("roughness",), raster=raster, device=device)
        truth = record.truth()
        scores.append(
            compare(
                drawn.channels["roughness"] if constant is None else np.full_like(drawn.alpha, constant),
                truth.stack("roughness")[..., 0],
                alpha=drawn.alpha,
                truth_alpha=truth.channels["A"],
                is_color=False,
                premultiplied=False,
            )
        )
    return Score(*(float(np.mean([getattr(s, name) for s in scores])) for name in ("psnr", "ssim", "solid_psnr")))


def best_constant(
    cloud: GaussianCloud, records: Sequence[CaptureRecord], raster: RasterOptions, device: str
) -> tuple[float, Score]:
    """Return the roughness that, given to all Gaussians alike, scores best, and its score."""
    plain = cloud.with_arrays(roughness=np.full(len(cloud), 0.5, np.float32))
    scores = {float(c): score_of(plain, records, raster, device, float(c)) for c in CONSTANTS}
    best = max(scores, key=lambda value: scores[value].psnr)
    return best, scores[best]
