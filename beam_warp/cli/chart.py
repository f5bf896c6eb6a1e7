"""``beam chart``: what a setting costs against how wrong it is, on the user's own data and device."""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg, subcommand

from beam_warp import converters
from beam_warp.checks import require_count, require_number, require_package
from beam_warp.cli.common.console import print_json, progress
from beam_warp.cli.common.flags import Device, Json, Quiet, SourceAxes
from beam_warp.cli.common.pages import SECOND_PAGE
from beam_warp.errors import InvalidOptionError
from beam_warp.jobs.listeners import NotedProgress
from beam_warp.jobs.store import make_folders
from beam_warp.study.page import write_page
from beam_warp.study.picture import write_image
from beam_warp.study.table import Settings, Study, Table, read_table, run_study, table_paths
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.metadata import numbers_of_frames
from beam_warp.world.shapes import still_life

REFERENCE_PART = 0.35
"""References may take this part of the budget; where they would take longer, fewer points are measured."""

LEAST_PART = 0.4
"""Measuring gets at least this part of the budget, however long normals and references took."""

FIGURE_CAMERAS, FIGURE_SIZE = 8, 96
"""Cameras of the built-in capture, and width and height of their images [pixel]."""

Names = tuple[str, ...]


def _names(choices: str) -> Any:
    """Describe an option that lists some of these names."""
    return arg(metavar="NAME ...", help=choices)


@dataclass(frozen=True)
class TracingChart:
    """Measure error against time for every way to trace visibility, and mark the best ones.

    Writes OUT/tracing.csv, OUT/tracing.png and OUT/tracing.html (one file, no network). A run that was stopped, or that
    the budget cut short, goes on when it is called again with the same options; OUT/tracing.partial.csv can be drawn as
    it is, with --from-csv. References are kept in OUT/tracing.references.npz for the next run on the same Gaussians.

    How to read it: each curve is one way to trace, with more rays to the right. Errors are against many rays from the
    same offset: noise, which falls with rays. The offset has a chart of its own: how far its truth lies from that of
    the finest offset, which no number of rays mends. Too small an offset shades itself, too large a one leaks light;
    choose the largest whose shift you can bear, then read the curves.

    Not every combination is measured: one or two factors at a time are varied around the defaults, the first of each
    list. Options that list values choose what is compared; --crossing full multiplies everything.

    Example: beam chart tracing person.ply --environment studio.hdr --out chart
    """

    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    scene: Annotated[
        Positional[Path | None],
        arg(metavar="[SCENE]", help="Gaussians: any file or folder that beam-convert reads; a built-in scene if none."),
    ] = None
    from_csv: Annotated[Path | None, arg(metavar="FILE", help="Draw this table again; measure nothing.")] = None
    environment: Annotated[
        Path | None, arg(metavar="FILE", help="Light: lat-long, .exr or .hdr; a built-in low sun by default.")
    ] = None
    source_axes: SourceAxes = None
    frame: Annotated[int, arg(metavar="N", help="Frame of a sequence, counted from 0.")] = 0
    budget_seconds: Annotated[
        float, arg(metavar="S", help="Time for references and measuring; what does not fit is skipped and counted.")
    ] = 120.0
    rays: Annotated[tuple[int, ...], arg(metavar="N ...", help="Rays per point.")] = (4, 16, 64, 256, 1024)
    acceptances: Annotated[Names, _names("product, bernoulli.")] = ("product", "bernoulli")
    samplers: Annotated[Names, _names("owen, stratified, iid.")] = ("owen", "stratified", "iid")
    densities: Annotated[Names, _names("Of irradiance: product, environment, cosine, mis.")] = (
        *("product", "environment", "cosine", "mis"),
    )
    ratios: Annotated[Names, _names("Of irradiance: ratio, plain.")] = ("ratio", "plain")
    offsets: Annotated[
        Names, arg(metavar="OFFSET ...", help="Lifts of ray origins: auto, metres (0.02), or local thicknesses (2t).")
    ] = ("auto", "2t", "8t", "0.02")
    crossing: Annotated[
        Literal["star", "full"], arg(help="Vary one or two factors around the defaults, or cross all.")
    ] = "star"
    points: Annotated[
        int | None, arg(metavar="N", help="Points at which errors are measured; 128 on a CPU, 4096 on a GPU.")
    ] = None
    reference_rays: Annotated[int, arg(metavar="N", help="Rays per point of the references."), SECOND_PAGE] = 16384
    repeats: Annotated[int, arg(metavar="N", help="Timed calls a setting; the median counts."), SECOND_PAGE] = 3
    seed: Annotated[int, arg(help="Chooses the points."), SECOND_PAGE] = 0
    device: Device = None
    quiet: Quiet = False
    json: Json = False


@dataclass(frozen=True)
class MaterialsChart:
    """Measure error against time for every way to decompose materials, and mark the best ones.

    Writes OUT/materials.csv, OUT/materials.png and OUT/materials.html (one file, no network). A run that was stopped,
    or that the budget cut short, goes on when it is called again with the same options; OUT/materials.partial.csv can
    be drawn as it is, with --from-csv.

    How to read it: each curve is one way to decompose, with more rays to the right; its error has three parts, which
    only the first of falls with rays: noise, what the method leaves out (the bounce, a lift that leaks light), and the
    Gaussians' own error. Where the capture has exact channels for its test views, errors are against them; without,
    against many rays with the default settings, so that they say nothing about the last two.

    Without files a figure is path traced, and decomposed on Gaussians of its true surface. With --capture alone, too,
    if that capture has its true surface; else give what was reconstructed from it.

    Example: beam chart materials person/asset.usda --capture person --out chart
    """

    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    asset: Annotated[
        Positional[Path | None],
        arg(metavar="[ASSET]", help="Reconstruction of the capture: any file or folder that beam-convert reads."),
    ] = None
    capture: Annotated[Path | None, arg(metavar="DIR", help="Images and cameras; a path-traced figure if none.")] = None
    from_csv: Annotated[Path | None, arg(metavar="FILE", help="Draw this table again; measure nothing.")] = None
    environment: Annotated[
        Path | None, arg(metavar="FILE", help="Light: lat-long, .exr or .hdr; the capture's own by default.")
    ] = None
    frame: Annotated[int, arg(metavar="N", help="Frame of the asset, or of the capture without one, from 0.")] = 0
    budget_seconds: Annotated[
        float, arg(metavar="S", help="Time for measuring; what does not fit is skipped and counted.")
    ] = 120.0
    rays: Annotated[tuple[int, ...], arg(metavar="N ...", help="Rays a Gaussian.")] = (8, 16, 32, 64, 128, 256)
    paths: Annotated[Names, _names("direct, images (the paper's).")] = ("direct", "images")
    samplers: Annotated[Names, _names("owen, stratified, iid.")] = ("owen", "stratified", "iid")
    offsets: Annotated[Names, arg(metavar="OFFSET ...", help="Lifts of ray origins: auto or metres.")] = (
        *("auto", "0.02", "0", "0.1"),
    )
    densities: Annotated[Names, _names("product, mis, environment, cosine.")] = (
        *("product", "mis", "environment", "cosine"),
    )
    ratios: Annotated[Names, _names("ratio, plain.")] = ("ratio", "plain")
    bounces: Annotated[Names, _names("one, none.")] = ("one", "none")
    weights: Annotated[Names, _names("albedo_scaling, fresnel_hv.")] = ("albedo_scaling", "fresnel_hv")
    fits: Annotated[Names, _names("robust, plain.")] = ("robust", "plain")
    observed: Annotated[Names, _names("difference, images."), SECOND_PAGE] = ("difference", "images")
    denoisers: Annotated[Names, _names("Of the path by images: auto, oidn, bilateral, none."), SECOND_PAGE] = (
        *("auto", "none"),
    )
    reference_rays: Annotated[
        int, arg(metavar="N", help="Rays of the reference, where there is no truth."), SECOND_PAGE
    ] = 4096
    repeats: Annotated[int, arg(metavar="N", help="Timed calls a setting; the median counts."), SECOND_PAGE] = 1
    device: Device = None
    quiet: Quiet = False
    json: Json = False


@dataclass(frozen=True)
class Chart:
    """Measure error against time on your own data and device, and mark the settings that no other beats in both."""

    study: Annotated[
        Annotated[TracingChart, subcommand("tracing", prefix_name=False)]
        | Annotated[MaterialsChart, subcommand("materials", prefix_name=False)],
        OmitArgPrefixes,
    ]


def chart(command: Chart) -> int:
    """Measure or read a table, draw it, and say what is on the frontier."""
    args = command.study
    for package in ("matplotlib", "plotly"):
        require_package(package)
    files = [args.scene] if isinstance(args, TracingChart) else [args.asset, args.capture]
    given = [str(path) for path in (*files, args.environment) if path is not None]
    if args.from_csv is not None and given:
        what = "a scene" if isinstance(args, TracingChart) else "an asset, a capture"
        raise InvalidOptionError(
            f"from-csv must be given without {what} or an environment, got {given[0]} too: it measures nothing. "
            "Drop one of them."
        )
    skipped: list[Settings] = []
    if args.from_csv is not None:
        table = read_table(args.from_csv)
        make_folders(args.out)
    else:
        with progress(args.quiet or args.json) as report:
            measure = _measure if isinstance(args, TracingChart) else _measure_materials
            table, skipped = measure(args, report)  # type: ignore[arg-type]
    name = table.subject.name
    image, page = args.out / f"{name}.png", args.out / f"{name}.html"
    write_image(table, image)
    write_page(table, page)
    if args.json:
        print_json(_summary(table, skipped, [image, page]))
    elif not args.quiet:
        _say(table, skipped, image, page)
    return 0


def _measure(args: TracingChart, report: NotedProgress) -> tuple[Table, list[Settings]]:
    """Read the inputs, prepare the study and measure it."""
    require_number("budget-seconds", args.budget_seconds, 0.0)
    from beam_warp.device.arrays import resolve_device
    from beam_warp.study.tracing import tracing_study
    from beam_warp.study.tracing_plan import TracingPlan

    plan = TracingPlan(**_options_of(args, TracingPlan))
    if args.environment is None:
        from beam_warp.demo.lights import sunset

        environment, environment_name = sunset(), "the built-in low sun"
    else:
        environment, environment_name = EnvironmentMap.read(args.environment), args.environment.name
    if args.scene is None:
        cloud, name = still_life(), "the built-in still life"
    else:
        sequence = converters.read(args.scene, source_axes=args.source_axes)
        require_count("frame", args.frame, 0, len(sequence) - 1)
        cloud, name = change_axes(sequence[args.frame], "rfu"), args.scene.name
    resolve_device(args.device)  # an unknown device is refused before a folder is made
    make_folders(args.out)
    started = time.perf_counter()
    study = tracing_study(
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
    left = max(args.budget_seconds - (time.perf_counter() - started), LEAST_PART * args.budget_seconds)
    return _run(study, args.out, left, report)


def _options_of(args: TracingChart | MaterialsChart, plan: type) -> dict[str, Any]:
    """Return the options that a plan has by the same names."""
    return {option.name: getattr(args, option.name) for option in fields(plan)}


def _run(study: Study, out: Path, seconds: float, report: NotedProgress) -> tuple[Table, list[Settings]]:
    """Measure a study; say what is kept if it is stopped."""
    try:
        return run_study(study, out, budget_seconds=seconds, progress=report)
    except KeyboardInterrupt:
        partial = table_paths(out, study.subject)[1]
        print(f"kept {partial}: call again to continue, or draw it with --from-csv", file=sys.stderr)
        raise


def _measure_materials(args: MaterialsChart, report: NotedProgress) -> tuple[Table, list[Settings]]:
    """Read or make the inputs, prepare the study and measure it."""
    require_number("budget-seconds", args.budget_seconds, 0.0)
    from beam_warp.device.arrays import resolve_device
    from beam_warp.study.materials import materials_study
    from beam_warp.study.materials_plan import MaterialsPlan

    plan = MaterialsPlan(**_options_of(args, MaterialsPlan))
    resolve_device(args.device)  # an unknown device is refused before a folder is made
    with tempfile.TemporaryDirectory() as folder:
        subject = _materials_subject(args, Path(folder), report)
        make_folders(args.out)
        study = materials_study(subject, plan, device=args.device)
        return _run(study, args.out, args.budget_seconds, report)


def _materials_subject(args: MaterialsChart, folder: Path, report: NotedProgress) -> Any:
    """Return what is decomposed; a built-in capture is written to the folder."""
    from beam_warp.capture.capture import Capture
    from beam_warp.decomposition.capture_images import CaptureImages
    from beam_warp.demo.capture import write_demo_capture
    from beam_warp.study.materials import MaterialsSubject

    if args.capture is None:
        if args.asset is not None:
            raise InvalidOptionError(
                f"capture must be given with an asset, got {args.asset} alone. Pass what it was reconstructed from."
            )
        capture = write_demo_capture(
            folder / "capture",
            frame_count=args.frame + 1,
            camera_count=FIGURE_CAMERAS,
            size=FIGURE_SIZE,
            device=args.device,
            progress=report,
        )
        name = "the built-in figure"
    else:
        capture, name = Capture.read(args.capture), args.capture.name
    light = args.environment or capture.environment_path
    if light is None:
        raise InvalidOptionError(f"environment must be given, got none and {name} has none. Pass --environment.")
    environment = EnvironmentMap.read(light)
    if args.asset is None:
        if args.frame not in capture.frames:
            raise InvalidOptionError(
                f"frame must be one of the capture's, got {args.frame}. Choose one of {capture.frames[:8]}."
            )
        return MaterialsSubject.on_true_surface(capture, environment, args.frame, name, args.device)
    sequence = converters.read(args.asset)
    require_count("frame", args.frame, 0, len(sequence) - 1)
    images = CaptureImages(capture, sequence)
    views = images.views(args.frame)
    return MaterialsSubject(
        change_axes(sequence[args.frame], "rfu"),
        views,
        environment,
        images.raster,
        capture,
        numbers_of_frames(sequence.metadata, len(sequence))[args.frame],
        args.asset.parent.name or args.asset.name,
        images.ceiling(args.frame, views),
    )


def _summary(table: Table, skipped: list[Settings], files: list[Path]) -> dict[str, Any]:
    """Return what was found, JSON-able."""
    return {
        "title": table.subject.title,
        "notes": dict(table.subject.notes),
        "measured": len(table.rows),
        "planned": table.subject.planned,
        "skipped": [dict(settings) for settings in skipped],
        "frontier": {
            metric.name: [
                {**row.settings, "cost": row.cost.value, "error": row.errors[metric.name].value}
                for row in table.frontier(metric)
            ]
            for metric in table.subject.metrics
            if not metric.by
        },
        "files": [str(path) for path in files],
    }


def _say(table: Table, skipped: list[Settings], image: Path, page: Path) -> None:
    """Print the frontier and what was left out."""
    subject = table.subject
    print(subject.title)
    for metric in subject.metrics:
        frontier = table.frontier(metric)
        if not frontier:
            continue
        print(f"\n{metric.title}: the frontier\n{'time [s]':>10} {'error':>10}  settings")
        for row in frontier:
            print(f"{row.cost.value:10.3g} {row.errors[metric.name].value:10.3g}  {subject.label(row.settings)}")
    print(f"\n{len(table.rows):,} of {subject.planned:,} planned settings measured; look at {image} and {page}")
    if "Plan" in subject.notes:
        print(f"plan: {subject.notes['Plan']}")
    if skipped:
        names = "; ".join(subject.label(settings) for settings in skipped[:3])
        more = f"; and {len(skipped) - 3:,} more" if len(skipped) > 3 else ""
        print(f"skipped for the budget: {names}{more}. Call again to go on with them.", file=sys.stderr)
