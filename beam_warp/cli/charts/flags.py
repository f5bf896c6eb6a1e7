"""Options of ``beam chart``, one record a chart."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from beam_warp.cli.common.flags import Device, Json, Quiet, SourceAxes
from beam_warp.cli.common.pages import SECOND_PAGE

Names = tuple[str, ...]


def _names(choices: str) -> Any:
    """Describe an option that lists some of these names."""
    return arg(metavar="NAME ...", help=choices)


Samplers = Annotated[Names, _names("owen, stratified, iid.")]
Sun = Annotated[Path | None, arg(metavar="FILE", help="Light: lat-long, .exr or .hdr; a built-in low sun by default.")]


@dataclass(frozen=True)
class ChartFlags:
    """What all charts share."""

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
class TracingChart(ChartFlags):
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

    scene: Annotated[
        Positional[Path | None],
        arg(metavar="[SCENE]", help="Gaussians: any file or folder that beam-convert reads; a built-in scene if none."),
    ] = None
    environment: Sun = None
    source_axes: SourceAxes = None
    rays: Annotated[tuple[int, ...], arg(metavar="N ...", help="Rays per point.")] = (4, 16, 64, 256, 1024)
    acceptances: Annotated[Names, _names("product, bernoulli.")] = ("product", "bernoulli")
    samplers: Samplers = ("owen", "stratified", "iid")
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


@dataclass(frozen=True)
class MaterialsChart(ChartFlags):
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

    asset: Annotated[
        Positional[Path | None],
        arg(metavar="[ASSET]", help="Reconstruction of the capture: any file or folder that beam-convert reads."),
    ] = None
    capture: Annotated[Path | None, arg(metavar="DIR", help="Images and cameras; a path-traced figure if none.")] = None
    environment: Annotated[
        Path | None, arg(metavar="FILE", help="Light: lat-long, .exr or .hdr; the capture's own by default.")
    ] = None
    rays: Annotated[tuple[int, ...], arg(metavar="N ...", help="Rays a Gaussian.")] = (8, 16, 32, 64, 128, 256)
    paths: Annotated[Names, _names("direct, images (the paper's).")] = ("direct", "images")
    samplers: Samplers = ("owen", "stratified", "iid")
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
class RelitChart(ChartFlags):
    """What charts of relit images share."""

    asset: Annotated[Positional[Path | None], arg(metavar="ASSET", help="A relightable asset.")] = None
    environment: Sun = None
    width: Annotated[int, arg(metavar="PX", help="Width and height of the images.")] = 256


@dataclass(frozen=True)
class RenderChart(RelitChart):
    """Measure error against time of relit images: both renderers, samples, shadows, maps and bounces.

    Writes OUT/render.csv, .png and .html. The truth is path traced at pixels chosen at random.

    Example: beam chart render person/asset.usda --environment studio.hdr --out chart
    """

    repeats: Annotated[int, arg(metavar="N", help="Timed frames a setting; the median counts."), SECOND_PAGE] = 3


@dataclass(frozen=True)
class DeliveryChart(RelitChart):
    """Measure error against size of delivery (.b4d) by the factor of its bounds: relit images and, if installed, FLIP.

    Writes OUT/delivery.csv, .png and .html. The truth is the asset itself, under a light and that light turned.

    Example: beam chart delivery person/asset.usda --environment studio.hdr --out chart
    """

    scales: Annotated[tuple[float, ...], arg(metavar="X ...", help="Factors of the bounds.")] = (
        *(0.25, 0.5, 1.0, 2.0, 4.0, 8.0),
    )


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
