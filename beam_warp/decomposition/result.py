"""Last step of the main job: the relightable sequence, the contact sheet, and the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beam_warp._version import __version__
from beam_warp.capture.findings import Finding
from beam_warp.decomposition.options import OverviewOptions
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.solve import SolvedFrames
from beam_warp.decomposition.tally import summary as tally
from beam_warp.decomposition.tally import warnings_about
from beam_warp.decomposition.work import material_step, profile_step, solution_step
from beam_warp.image.files import write_png
from beam_warp.jobs.report import device_facts, versions
from beam_warp.materials.pilot import summary
from beam_warp.plan.steps import Receipt
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.framing import bulk
from beam_warp.world.gaussians import ATTRIBUTES, GaussianSequence


@dataclass(frozen=True)
class Measurements:
    """What the steps of a job said in their receipts.

    Attributes:
        resumed: Frames that were found finished.
        ray_count: Rays of light and occlusion that were traced for the others.
        economy: What fewer rays for some Gaussians have left out, over all frames.
        notes: What a reader of the result should know.
        statistics: Over all frames; see `beam_warp.decomposition.tally.summary`.
        roughness: How the last estimate of roughness came about; empty if none was made.
        seconds: By stage, spent by all workers on steps of this call.
        workers: Machines and processes that did the steps.
    """

    resumed: int
    ray_count: int
    economy: dict[str, Any]
    notes: list[str]
    statistics: dict[str, Any]
    roughness: dict[str, Any]
    seconds: dict[str, float]
    workers: list[str]

    @classmethod
    def of(cls, receipts: Mapping[str, Receipt], numbers: Sequence[int]) -> Measurements:
        """Add up the receipts of all steps, given what the frames are called."""
        names = ("light", *map(profile_step, numbers), "roughness", "joint", *map(solution_step, numbers))
        shared = [receipts[name] for name in names if name in receipts]
        frames = [receipts[material_step(number)] for number in numbers]
        steps = [(step, dict(step.facts)) for step in (*shared, *frames)]  # which reads them, once
        said = [facts for _, facts in steps[len(shared) :]]
        counts = [frame for _, facts in steps for frame in facts.get("counts", ())]
        changes = next((facts["changes"] for _, facts in steps if "changes" in facts), {})
        estimates = [facts["roughness"] for _, facts in steps if "roughness" in facts]
        seconds: dict[str, float] = {}
        for step, facts in steps:
            for stage, spent in facts["seconds"].items() if not step.is_kept else ():
                seconds[stage] = seconds.get(stage, 0.0) + spent
        return cls(
            resumed=sum(frame.is_kept for frame in frames),
            ray_count=sum(facts["ray_count"] for frame, facts in zip(frames, said, strict=True) if not frame.is_kept),
            economy=summary([facts["economy"] for facts in said]),
            notes=list(dict.fromkeys(note for facts in said for note in facts["notes"])),
            statistics=tally(counts, changes),
            roughness=estimates[-1] if estimates else {},
            seconds=seconds,
            workers=sorted({step.worker for step, _ in steps}),
        )


def relightable_sequence(
    plan: JobPlan, solved: SolvedFrames, statistics: Mapping[str, Any], *, persistent: bool
) -> GaussianSequence:
    """Return the frames that were solved as a sequence, read lazily, in the world's axes.

    Args:
        plan: The job.
        solved: Its frames.
        statistics: Over all frames.
        persistent: Whether row i is the same Gaussian in every frame.
    """
    sequence, options = plan.source.sequence, plan.source.options
    shared = sequence.constant & set(ATTRIBUTES) - {"normals"}
    if not solved.is_varying:
        shared |= {"base_color", "base_color_error", "observability"}
    if persistent:
        shared |= options.shared_roughness
    return GaussianSequence(
        frame_count=len(sequence),
        read_frame=solved.cloud,
        frames_per_second=sequence.frames_per_second,
        constant=frozenset(shared),
        topology="constant" if persistent else "perFrame",
        metadata={
            **sequence.metadata,
            "generator": f"beam-warp {__version__}",
            "normal_source": "shortestAxis" if statistics["normals_from_shape"] > 0.5 else "authored",
            "roughness_source": options.roughness_source,
            "radiance_meaning": "captured",
            "source_axes": plan.source.first.original.axes,
            "exposure_stops": f"{plan.light.stops:.4f}",
            "light_turn_degrees": f"{plan.light.turned_by:.4f}",
            "base_color_scale_errors": " ".join(f"{error:.4f}" for error in plan.light.scale_errors),
        },
    )


def draw_overview(path: Path, sequence: GaussianSequence, plan: JobPlan, options: OverviewOptions) -> None:
    """Draw the middle frame as captured and under two lights; panels are as wide as the subject needs."""
    from beam_warp.render.sheet import Relighting, contact_sheet  # with renderers, which no step needs

    light = plan.light.prepared
    cloud = sequence[len(sequence) // 2]
    extent = np.ptp(bulk(cloud.positions, cloud.opacities), axis=0)
    aspect = float(np.clip(np.hypot(extent[0], extent[1]) / max(extent[2], 1e-9), 0.5, 1.8))
    camera = Camera.frame_cloud(
        cloud.positions,
        cloud.opacities,
        azimuth=options.azimuth,
        elevation=options.elevation,
        width=round(options.height * aspect),
        height=options.height,
    )
    lights = [
        Relighting(f"relit by {_light_in_words(plan)}", light),
        options.second_light or Relighting("relit by that light turned by 180°", light, degrees=180.0),
    ]
    raster = RasterOptions.from_metadata(sequence.metadata)
    write_png(path, contact_sheet(cloud, camera, lights, options=raster, device=str(light.device)))


def _light_in_words(plan: JobPlan) -> str:
    """Return what is known of the light: only images with a scale of their own can be compared with a relighting."""
    stops, is_fitted = plan.light.stops, plan.light.is_fitted
    name = "the given light" if plan.source.images is None or is_fitted else "the light of the capture"
    name += f", turned by {plan.light.turned_by:+.1f} degrees" if plan.light.turned_by else ""
    if is_fitted:
        return f"{name}, exposure fitted by {stops:+.1f} stops"
    return f"{name}, exposed by {stops:+.1f} stops" if stops else name


def run_report(
    plan: JobPlan, made: Measurements, *, findings: list[dict[str, Any]], persistent: bool, seconds: float
) -> dict[str, Any]:
    """Return what was done, found and spent, JSON-able.

    Args:
        plan: The job.
        made: What its steps said.
        findings: Findings about the light and the images.
        persistent: Whether row i is the same Gaussian in every frame.
        seconds: Duration of the whole job.
    """
    sequence, count, own = plan.source.sequence, len(plan.source.first.cloud), plan.source.log.timer.seconds
    stages = {stage: made.seconds.get(stage, 0.0) + own.get(stage, 0.0) for stage in made.seconds | own}
    traced = stages.get("materials", 0.0)
    notes = [*sequence.metadata.get("notes", "").splitlines(), *made.notes, *_lines(findings, "note")]
    return {
        "input": {"frames": len(sequence), "gaussians": count, "notes": notes},
        "device": device_facts(plan.light.prepared.device),
        "workers": made.workers,
        "versions": versions(),
        "options": plan.source.options.as_dict(),
        "light": _light_in_words(plan),
        "exposure_stops": plan.light.stops,
        "exposure_is_fitted": plan.light.is_fitted,
        **plan.light.as_record(),
        "resumed_frames": made.resumed,
        "persistent": persistent,
        "materials": made.statistics,
        "roughness": made.roughness,
        "economy": made.economy,
        "seconds": {**stages, "total": seconds},
        "light_and_occlusion_rays_per_second": made.ray_count / traced if traced > 0.0 else None,
        "findings": findings,
        "warnings": [*_lines(findings, "warning"), *warnings_about(made.statistics)],
    }


def _lines(findings: list[dict[str, Any]], severity: str) -> list[str]:
    """Return the findings of a severity as lines for people."""
    some = [Finding(**finding) for finding in findings if finding["severity"] == severity]
    return [str(finding).removeprefix(f"{severity}: ") for finding in some]
