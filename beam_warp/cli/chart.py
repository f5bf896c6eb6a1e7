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
from beam_warp.capture.capture import Capture
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
from beam_warp.world.camera import MAX_SIDE, Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import numbers_of_frames
from beam_warp.world.shapes import still_life
from beam_warp.world.shot import Shot

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
class ChartFlags:
    """What the other charts share."""

    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    from_csv: Annotated[Path | None, arg(metavar="FILE", help="Draw this table again; measure nothing.")] = None
    frame: Annotated[int, arg(metavar="N", help="Frame that is measured, counted from 0.")] = 0
    budget_seconds: Annotated[
        float, arg(metavar="S", help="Time for measuring; what does not fit is skipped and counted.")
    ] = 120.0
    device: Device = None
    quiet: Quiet = False
    json: Json = False


@dataclass(frozen=True)
class ReconstructChart(ChartFlags):
    """Measure error against time of reconstructing a key frame: Gaussians, steps and cameras.

    Writes OUT/reconstruct.csv, .png and .html. Errors are those of test cameras, whose photographs are not used, and of
    normals where the capture has them. Without a capture a small figure is path traced.

    Example: beam chart reconstruct captures/walker --out chart
    """

    capture: Annotated[
        Positional[Path | None], arg(metavar="[CAPTURE]", help="Images and cameras; a path-traced figure if none.")
    ] = None
    gaussians: Annotated[tuple[int, ...], arg(metavar="N ...", help="Most Gaussians.")] = (500, 2000, 8000)
    schedules: Annotated[Names, _names("draft, fast, paper, rade.")] = ("draft", "fast")
    shares: Annotated[tuple[float, ...], arg(metavar="X ...", help="Parts of the cameras, all first.")] = (1.0, 0.5)


@dataclass(frozen=True)
class RenderChart(ChartFlags):
    """Measure error against time of relit images: both renderers, samples, shadows, maps and bounces.

    Writes OUT/render.csv, .png and .html. The truth is path traced at pixels chosen at random.

    Example: beam chart render person/asset.usda --environment studio.hdr --out chart
    """

    asset: Annotated[Positional[Path | None], arg(metavar="ASSET", help="A relightable asset.")] = None
    environment: Annotated[
        Path | None, arg(metavar="FILE", help="Light: lat-long, .exr or .hdr; a built-in low sun by default.")
    ] = None
    width: Annotated[int, arg(metavar="PX", help="Width and height of the image.")] = 256
    repeats: Annotated[int, arg(metavar="N", help="Timed frames a setting; the median counts."), SECOND_PAGE] = 3


@dataclass(frozen=True)
class DeliveryChart(ChartFlags):
    """Measure error against size of delivery (.b4d) by the factor of its bounds: relit images and, if installed, FLIP.

    Writes OUT/delivery.csv, .png and .html. The truth is the asset itself, under a light and that light turned.

    Example: beam chart delivery person/asset.usda --environment studio.hdr --out chart
    """

    asset: Annotated[Positional[Path | None], arg(metavar="ASSET", help="A relightable asset.")] = None
    environment: Annotated[
        Path | None, arg(metavar="FILE", help="Light: lat-long, .exr or .hdr; a built-in low sun by default.")
    ] = None
    scales: Annotated[tuple[float, ...], arg(metavar="X ...", help="Factors of the bounds.")] = (
        *(0.25, 0.5, 1.0, 2.0, 4.0, 8.0),
    )
    width: Annotated[int, arg(metavar="PX", help="Width and height of the images.")] = 256


@dataclass(frozen=True)
class AllCharts(ChartFlags):
    """Measure every chart that an asset, a capture or both allow, and put all of them on one page.

    Of an asset: tracing, render, delivery. Of a capture: reconstruct; of one with an asset or its true surface:
    materials. Writes OUT/chart.html, and what each chart writes. Every chart has the whole budget.

    Example: beam chart all person/asset.usda --capture person --out chart
    """

    asset: Annotated[Positional[Path | None], arg(metavar="[ASSET]", help="A relightable asset.")] = None
    capture: Annotated[Path | None, arg(metavar="DIR", help="The capture that it was reconstructed from.")] = None
    environment: Annotated[
        Path | None, arg(metavar="FILE", help="Light: lat-long, .exr or .hdr; the capture's, or a built-in low sun.")
    ] = None


Charted = TracingChart | MaterialsChart | ReconstructChart | RenderChart | DeliveryChart


@dataclass(frozen=True)
class Chart:
    """Measure error against cost on your own data and device, and mark the settings that no other beats in both."""

    study: Annotated[
        Annotated[TracingChart, subcommand("tracing", prefix_name=False)]
        | Annotated[MaterialsChart, subcommand("materials", prefix_name=False)]
        | Annotated[ReconstructChart, subcommand("reconstruct", prefix_name=False)]
        | Annotated[RenderChart, subcommand("render", prefix_name=False)]
        | Annotated[DeliveryChart, subcommand("delivery", prefix_name=False)]
        | Annotated[AllCharts, subcommand("all", prefix_name=False)],
        OmitArgPrefixes,
    ]


def chart(command: Chart) -> int:
    """Measure or read tables, draw them, and say what is on the frontiers."""
    args = command.study
    for package in ("matplotlib", "plotly"):
        require_package(package)
    charts = _charts(args) if isinstance(args, AllCharts) else [args]
    tables = [_draw(each) for each in charts]
    page = args.out / "chart.html"
    if isinstance(args, AllCharts):
        write_page([table for table, _ in tables], page)
    if args.json:
        said = [_summary(table, skipped, args.out) for table, skipped in tables]
        print_json({"charts": said, "page": str(page)} if isinstance(args, AllCharts) else said[0])
    elif not args.quiet:
        for table, skipped in tables:
            _say(table, skipped, args.out)
    return 0


def _charts(args: AllCharts) -> list[Charted]:
    """Return the charts that an asset and a capture allow.

    Raises:
        InvalidOptionError: There is neither, or a table is to be drawn again.
    """
    if args.from_csv is not None:
        raise InvalidOptionError(f"from-csv must be left out for all charts, got {args.from_csv}. Draw that one alone.")
    if args.asset is None and args.capture is None:
        raise InvalidOptionError("asset or capture must be given for all charts, got neither. Name what is measured.")
    shared: dict[str, Any] = {field.name: getattr(args, field.name) for field in fields(ChartFlags)}
    lit, found = {**shared, "environment": args.environment}, list[Charted]()
    if args.asset is not None:
        found += [kind(**lit, asset=args.asset) for kind in (RenderChart, DeliveryChart)]
        found.append(TracingChart(**lit, scene=args.asset))
    if args.capture is not None:
        found.append(ReconstructChart(**shared, capture=args.capture))
        if args.asset is not None or (args.capture / "truth").is_dir():
            found.append(MaterialsChart(**lit, asset=args.asset, capture=args.capture))
    return found


def _draw(args: Charted) -> tuple[Table, list[Settings]]:
    """Measure or read a table, and draw it."""
    names = ("scene", "asset", "capture", "environment")
    given = [str(path) for name in names if (path := getattr(args, name, None)) is not None]
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
        require_number("budget-seconds", args.budget_seconds, 0.0)
        with progress(args.quiet or args.json) as report:
            table, skipped = _MEASURES[type(args)](args, report)
    image, page = _files(table, args.out)
    write_image(table, image)
    write_page([table], page)
    return table, skipped


def _files(table: Table, out: Path) -> tuple[Path, Path]:
    name = table.subject.name
    return out / f"{name}.png", out / f"{name}.html"


def _measure_reconstruction(args: ReconstructChart, report: NotedProgress) -> tuple[Table, list[Settings]]:
    """Read or make the capture, prepare the study and measure it."""
    from beam_warp.device.arrays import resolve_device
    from beam_warp.study.reconstruction import reconstruction_study

    resolve_device(args.device)
    with tempfile.TemporaryDirectory() as folder:
        capture, name = _capture(args.capture, Path(folder), args.frame, args.device, report)
        number = capture.frames[require_count("frame", args.frame, 0, len(capture.frames) - 1)]
        options = {name: getattr(args, name) for name in ("gaussians", "schedules", "shares")}
        study = reconstruction_study(capture, number, name=name, device=args.device, **options)
        make_folders(args.out)
        return _run(study, args.out, args.budget_seconds, report)


def _light(path: Path | None) -> EnvironmentMap:
    from beam_warp.demo.lights import sunset

    return sunset() if path is None else EnvironmentMap.read(path)


def _asset(args: RenderChart | DeliveryChart) -> GaussianSequence:
    if args.asset is None:
        raise InvalidOptionError("asset must be given, got none. Name a relightable asset.")
    sequence = converters.read(args.asset)
    require_count("frame", args.frame, 0, len(sequence) - 1)
    return sequence


def _measure_rendering(args: RenderChart, report: NotedProgress) -> tuple[Table, list[Settings]]:
    """Read the asset, prepare the study and measure it."""
    from beam_warp.raster.records import RasterOptions
    from beam_warp.study.relighting import relighting_study

    sequence, light = _asset(args), _light(args.environment)
    cloud = change_axes(sequence[args.frame], "rfu")
    width = require_count("width", args.width, 1, MAX_SIDE)
    camera = Camera.frame_cloud(
        cloud.positions, cloud.opacities, azimuth=20.0, elevation=10.0, width=width, height=width
    )
    shot = Shot(cloud=cloud, camera=camera, environment=light)
    raster = RasterOptions.from_metadata(sequence.metadata)
    name = args.asset.name if args.asset is not None else ""
    study = relighting_study(shot, raster, name=name, device=args.device, repeats=args.repeats)
    make_folders(args.out)
    return _run(study, args.out, args.budget_seconds, report)


def _measure_delivery(args: DeliveryChart, report: NotedProgress) -> tuple[Table, list[Settings]]:
    """Read the asset, prepare the study and measure it."""
    from beam_warp.evaluate.perceptual import PerceptualMetrics
    from beam_warp.study.delivery import delivery_study

    sequence, light = _asset(args), _light(args.environment)
    study = delivery_study(
        sequence,
        light,
        name=args.asset.name if args.asset is not None else "",
        scales=args.scales,
        side=require_count("width", args.width, 1, MAX_SIDE),
        flip=PerceptualMetrics.installed().measures.get("flip"),
        device=args.device,
    )
    make_folders(args.out)
    return _run(study, args.out, args.budget_seconds, report)


def _measure(args: TracingChart, report: NotedProgress) -> tuple[Table, list[Settings]]:
    """Read the inputs, prepare the study and measure it."""
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


def _capture(
    path: Path | None, folder: Path, frame: int, device: str | None, report: NotedProgress
) -> tuple[Capture, str]:
    """Return a capture and what to call it; without one, the built-in figure, written to the folder."""
    from beam_warp.demo.capture import write_demo_capture

    if path is not None:
        return Capture.read(path), path.name
    made = write_demo_capture(
        folder / "capture",
        frame_count=frame + 1,
        camera_count=FIGURE_CAMERAS,
        size=FIGURE_SIZE,
        device=device,
        progress=report,
    )
    return made, "the built-in figure"


def _materials_subject(args: MaterialsChart, folder: Path, report: NotedProgress) -> Any:
    """Return what is decomposed; a built-in capture is written to the folder."""
    from beam_warp.decomposition.capture_images import CaptureImages
    from beam_warp.study.materials import MaterialsSubject

    if args.capture is None and args.asset is not None:
        raise InvalidOptionError(
            f"capture must be given with an asset, got {args.asset} alone. Pass what it was reconstructed from."
        )
    capture, name = _capture(args.capture, folder, args.frame, args.device, report)
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


_MEASURES: dict[type, Any] = {
    TracingChart: _measure,
    MaterialsChart: _measure_materials,
    ReconstructChart: _measure_reconstruction,
    RenderChart: _measure_rendering,
    DeliveryChart: _measure_delivery,
}
"""What measures each chart: it takes the words and a listener, and returns the table and what was left out."""


def _summary(table: Table, skipped: list[Settings], out: Path) -> dict[str, Any]:
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
        "files": [str(path) for path in _files(table, out)],
    }


def _say(table: Table, skipped: list[Settings], out: Path) -> None:
    """Print the frontier and what was left out."""
    subject, (image, page) = table.subject, _files(table, out)
    cost = f"{'time' if subject.cost_unit == 's' else 'size'} [{subject.cost_unit}]"
    print(subject.title)
    for metric in subject.metrics:
        frontier = table.frontier(metric)
        if not frontier:
            continue
        print(f"\n{metric.title}: the frontier\n{cost:>10} {'error':>10}  settings")
        for row in frontier:
            print(f"{row.cost.value:10.3g} {row.errors[metric.name].value:10.3g}  {subject.label(row.settings)}")
    print(f"\n{len(table.rows):,} of {subject.planned:,} planned settings measured; look at {image} and {page}")
    if "Plan" in subject.notes:
        print(f"plan: {subject.notes['Plan']}")
    if skipped:
        names = "; ".join(subject.label(settings) for settings in skipped[:3])
        more = f"; and {len(skipped) - 3:,} more" if len(skipped) > 3 else ""
        print(f"skipped for the budget: {names}{more}. Call again to go on with them.", file=sys.stderr)
