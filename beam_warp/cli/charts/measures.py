"""How each chart of ``beam chart`` is measured: its inputs are read, its study is prepared and run."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from beam_warp.checks import require_count, require_number
from beam_warp.cli.charts.flags import (
    ChartFlags,
    DeliveryChart,
    MaterialsChart,
    ReconstructChart,
    RelitChart,
    RenderChart,
    TracingChart,
)
from beam_warp.cli.charts.subjects import capture_at, light_at, materials_subject, sequence_at
from beam_warp.cli.common.flags import options_of
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.perceptual import PerceptualMetrics
from beam_warp.jobs.listeners import NotedProgress
from beam_warp.jobs.store import make_folders
from beam_warp.raster.records import RasterOptions
from beam_warp.study.delivery import delivery_study
from beam_warp.study.materials import materials_study
from beam_warp.study.materials_plan import MaterialsPlan
from beam_warp.study.reconstruction import reconstruction_study
from beam_warp.study.relighting import relighting_study
from beam_warp.study.table import Settings, Study, Table, run_study, table_paths
from beam_warp.study.tracing import tracing_study
from beam_warp.study.tracing_plan import TracingPlan
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import MAX_SIDE, Camera
from beam_warp.world.shapes import still_life
from beam_warp.world.shot import Shot

REFERENCE_PART = 0.35
"""References may take this part of the budget; where they would take longer, fewer points are measured."""

LEAST_PART = 0.4
"""Measuring gets at least this part of the budget, however long normals and references took."""


def measured(args: ChartFlags, report: NotedProgress) -> tuple[Table, list[Settings]]:
    """Measure a chart; say what is kept if it is stopped.

    Returns:
        The table, and the settings that the budget left out.
    """
    seconds = require_number("budget-seconds", args.budget_seconds, 0.0)
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        study = _STUDIES[type(args)](args, Path(folder), report)
        if isinstance(args, TracingChart):  # its references count towards the budget
            seconds = max(seconds - (time.perf_counter() - started), LEAST_PART * seconds)
        make_folders(args.out)
        try:
            return run_study(study, args.out, budget_seconds=seconds, progress=report)
        except KeyboardInterrupt:
            partial = table_paths(args.out, study.subject)[1]
            print(f"kept {partial}: call again to continue, or draw it with --from-csv", file=sys.stderr)
            raise


def _tracing(args: TracingChart, folder: Path, report: NotedProgress) -> Study:
    """Prepare the study of a scene; its references are kept with the results."""
    plan = options_of(args, TracingPlan)
    environment, environment_name = light_at(args.environment)
    if args.scene is None:
        cloud, name = still_life(), "the built-in still life"
    else:
        sequence = sequence_at(args.scene, args.frame, args.source_axes)
        cloud, name = change_axes(sequence[args.frame], "rfu"), args.scene.name
    resolve_device(args.device)  # an unknown device is refused before a folder is made
    make_folders(args.out)
    return tracing_study(
        cloud,
        environment,
        plan,
        name=name,
        environment_name=environment_name,
        device=args.device,
        references_file=args.out / "tracing.references.npz",
        reference_seconds=REFERENCE_PART * args.budget_seconds,
        progress=report,
    )


def _materials(args: MaterialsChart, folder: Path, report: NotedProgress) -> Study:
    """Prepare the study of a capture's materials."""
    plan = options_of(args, MaterialsPlan)
    resolve_device(args.device)  # before a capture is built
    return materials_study(materials_subject(args, folder, report), plan, device=args.device)


def _reconstruction(args: ReconstructChart, folder: Path, report: NotedProgress) -> Study:
    """Prepare the study of one frame of a capture."""
    resolve_device(args.device)
    capture, name = capture_at(args.capture, folder, args.frame, args.device, report)
    number = capture.frames[require_count("frame", args.frame, 0, len(capture.frames) - 1)]
    options = {option: getattr(args, option) for option in ("gaussians", "schedules", "shares")}
    return reconstruction_study(capture, number, name=name, device=args.device, **options)


def _rendering(args: RenderChart, folder: Path, report: NotedProgress) -> Study:
    """Prepare the study of one relit image of an asset."""
    sequence, light = sequence_at(args.asset, args.frame), light_at(args.environment)[0]
    cloud = change_axes(sequence[args.frame], "rfu")
    width = require_count("width", args.width, 1, MAX_SIDE)
    camera = Camera.frame_cloud(
        cloud.positions, cloud.opacities, azimuth=20.0, elevation=10.0, width=width, height=width
    )
    shot = Shot(cloud=cloud, camera=camera, environment=light)
    raster = RasterOptions.from_metadata(sequence.metadata)
    return relighting_study(shot, raster, name=_name(args), device=args.device, repeats=args.repeats)


def _delivery(args: DeliveryChart, folder: Path, report: NotedProgress) -> Study:
    """Prepare the study of an asset's size."""
    sequence, light = sequence_at(args.asset, args.frame), light_at(args.environment)[0]
    return delivery_study(
        sequence,
        light,
        name=_name(args),
        scales=args.scales,
        side=require_count("width", args.width, 1, MAX_SIDE),
        flip=PerceptualMetrics.installed().measures.get("flip"),
        device=args.device,
    )


def _name(args: RelitChart) -> str:
    return args.asset.name if args.asset is not None else ""


_STUDIES: dict[type, Callable[[Any, Path, NotedProgress], Study]] = {
    TracingChart: _tracing,
    MaterialsChart: _materials,
    ReconstructChart: _reconstruction,
    RenderChart: _rendering,
    DeliveryChart: _delivery,
}
"""What prepares the study of each chart: it takes the words, a folder for what is built in, and a listener."""
