"""Last step of the main job: the relightable sequence, the contact sheet, and the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from beam_warp._version import __version__
from beam_warp.capture.findings import Finding
from beam_warp.decomposition.measure import FrameMeasurement
from beam_warp.decomposition.options import ESTIMATE, OverviewOptions
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.solve import SolvedFrames
from beam_warp.decomposition.tally import warnings_about
from beam_warp.image.files import write_png
from beam_warp.jobs.report import device_facts, versions
from beam_warp.raster.records import RasterOptions
from beam_warp.render.sheet import Relighting, contact_sheet
from beam_warp.world.camera import Camera
from beam_warp.world.framing import bulk
from beam_warp.world.gaussians import ATTRIBUTES, GaussianSequence


def relightable_sequence(plan: JobPlan, solved: SolvedFrames) -> GaussianSequence:
    """Return the frames that were solved as a sequence, read lazily, in the world's axes."""
    sequence, options = plan.source.sequence, plan.source.options
    shared = sequence.constant & set(ATTRIBUTES) - {"normals"}
    if not solved.is_varying:
        shared |= {"base_color", "base_color_error", "observability"}
    if plan.persistent:
        shared |= {"roughness", "roughness_error"} if options.roughness == ESTIMATE else {"roughness"}
    return GaussianSequence(
        frame_count=len(sequence),
        read_frame=solved.cloud,
        frames_per_second=sequence.frames_per_second,
        constant=frozenset(shared),
        topology="constant" if plan.persistent else "perFrame",
        metadata={
            **sequence.metadata,
            "generator": f"beam-warp {__version__}",
            "normal_source": "shortestAxis" if solved.statistics["normals_from_shape"] > 0.5 else "authored",
            "roughness_source": options.roughness_source,
            "radiance_meaning": "captured",
            "source_axes": plan.source.first.original.axes,
            "exposure_stops": f"{plan.light.stops:.4f}",
            "light_turn_degrees": f"{plan.light.turned_by:.4f}",
        },
    )


def draw_overview(path: Path, sequence: GaussianSequence, plan: JobPlan, options: OverviewOptions) -> None:
    """Draw the middle frame as captured and under two lights; panels are as wide as the subject needs."""
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
    plan: JobPlan,
    measurement: FrameMeasurement,
    solved: SolvedFrames,
    *,
    findings: list[dict[str, Any]],
    roughness: dict[str, Any],
    seconds: float,
) -> dict[str, Any]:
    """Return what was done, found and spent, JSON-able.

    Args:
        plan: The job.
        measurement: How its frames were measured.
        solved: Its relightable frames.
        findings: Findings about the light and the images.
        roughness: How an estimate of roughness came about.
        seconds: Duration of the whole job.
    """
    sequence, count, stages = plan.source.sequence, len(plan.source.first.cloud), plan.source.log.timer.seconds
    traced = stages.get("materials", 0.0)
    notes = [*sequence.metadata.get("notes", "").splitlines(), *measurement.notes, *_lines(findings, "note")]
    return {
        "input": {"frames": len(sequence), "gaussians": count, "notes": notes},
        "device": device_facts(plan.light.prepared.device),
        "versions": versions(),
        "options": plan.source.options.as_dict(),
        "light": _light_in_words(plan),
        "exposure_stops": plan.light.stops,
        "exposure_is_fitted": plan.light.is_fitted,
        **plan.light.as_record(),
        "resumed_frames": measurement.resumed,
        "persistent": plan.persistent,
        "materials": solved.statistics,
        "roughness": roughness,
        "seconds": {**stages, "total": seconds},
        "light_and_occlusion_rays_per_second": measurement.ray_count / traced if traced > 0.0 else None,
        "findings": findings,
        "warnings": [*_lines(findings, "warning"), *warnings_about(solved.statistics)],
    }


def _lines(findings: list[dict[str, Any]], severity: str) -> list[str]:
    """Return the findings of a severity as lines for people."""
    some = [Finding(**finding) for finding in findings if finding["severity"] == severity]
    return [str(finding).removeprefix(f"{severity}: ") for finding in some]
