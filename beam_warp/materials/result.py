"""Last step of the main job: the relightable sequence, the contact sheet, and the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from beam_warp._version import __version__
from beam_warp.image.files import write_png
from beam_warp.jobs.report import device_facts, versions
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.capture_light import CaptureLight
from beam_warp.materials.measure import FrameMeasurement
from beam_warp.materials.options import ESTIMATE, OverviewOptions, RunOptions
from beam_warp.materials.solve import SolvedFrames
from beam_warp.materials.source import Source
from beam_warp.materials.tally import warnings_about
from beam_warp.raster.records import RasterOptions
from beam_warp.render.sheet import Relighting, contact_sheet
from beam_warp.world.camera import Camera
from beam_warp.world.framing import bulk
from beam_warp.world.gaussians import ATTRIBUTES, GaussianSequence


def relightable_sequence(
    source: Source, solved: SolvedFrames, options: RunOptions, stops: float, *, persistent: bool
) -> GaussianSequence:
    """Return the frames that were solved as a sequence, read lazily, in the world's axes.

    Args:
        source: What was decomposed.
        solved: Its relightable frames.
        options: How roughness was found.
        stops: Exposure of the light.
        persistent: Whether row i is the same Gaussian in every frame.
    """
    sequence = source.sequence
    shared = sequence.constant & set(ATTRIBUTES) - {"normals"}
    if not solved.is_varying:
        shared |= {"base_color", "base_color_error", "observability"}
    if persistent:
        shared |= {"roughness", "roughness_error"} if options.roughness == ESTIMATE else {"roughness"}
    return GaussianSequence(
        frame_count=len(sequence),
        read_frame=solved.cloud,
        frames_per_second=sequence.frames_per_second,
        constant=frozenset(shared),
        topology="constant" if persistent else "perFrame",
        metadata={
            **sequence.metadata,
            "generator": f"beam-warp {__version__}",
            "normal_source": "shortestAxis" if solved.statistics["normals_from_shape"] > 0.5 else "authored",
            "roughness_source": options.roughness_source,
            "radiance_meaning": "captured",
            "source_axes": source.first.original.axes,
            "exposure_stops": f"{stops:.4f}",
        },
    )


def draw_overview(path: Path, sequence: GaussianSequence, light: PreparedEnvironment, options: OverviewOptions) -> None:
    """Draw the middle frame as captured and under two lights; panels are as wide as the subject needs."""
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
        Relighting("relit by the light of the capture", light),
        options.second_light or Relighting("relit by that light turned by 180°", light, degrees=180.0),
    ]
    raster = RasterOptions.from_metadata(sequence.metadata)
    write_png(path, contact_sheet(cloud, camera, lights, options=raster, device=str(light.device)))


def run_report(
    source: Source,
    light: CaptureLight,
    measurement: FrameMeasurement,
    solved: SolvedFrames,
    options: RunOptions,
    *,
    persistent: bool,
    findings: list[dict[str, Any]],
    roughness: dict[str, Any],
    seconds: dict[str, float],
) -> dict[str, Any]:
    """Return what was done, found and spent, JSON-able.

    Args:
        source: What was decomposed.
        light: The light of the capture.
        measurement: What measured its frames.
        solved: Its relightable frames.
        options: How they were measured.
        persistent: Whether row i is the same Gaussian in every frame.
        findings: What was wrong with the light and the images.
        roughness: How an estimate of roughness came about.
        seconds: By stage.
    """
    sequence, count = source.sequence, len(source.first.cloud)
    measured = len(sequence) - measurement.resumed
    traced = seconds.get("materials", 0.0)
    rays = measured * count * options.materials.sample_count * 2
    notes = [*sequence.metadata.get("notes", "").splitlines(), *measurement.notes, *_lines(findings, "note")]
    return {
        "input": {"frames": len(sequence), "gaussians": count, "notes": notes},
        "device": device_facts(light.prepared.device),
        "versions": versions(),
        "options": options.as_dict(),
        "exposure_stops": light.stops,
        "resumed_frames": measurement.resumed,
        "persistent": persistent,
        "materials": solved.statistics,
        "roughness": roughness,
        "seconds": dict(seconds),
        "light_and_occlusion_rays_per_second": rays / traced if traced > 0.0 and measured else None,
        "findings": findings,
        "warnings": [*_lines(findings, "warning"), *warnings_about(solved.statistics)],
    }


def _lines(findings: list[dict[str, Any]], severity: str) -> list[str]:
    """Return the findings of a severity as lines for people."""
    lines = []
    for finding in findings:
        place = f" ({finding['where']})" if finding["where"] else ""
        if finding["severity"] == severity:
            lines.append(f"{finding['what']}{place}. {finding['remedy']}".strip())
    return lines
