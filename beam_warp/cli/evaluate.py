"""``beam evaluate``: how good the materials of an asset are, against a capture whose truth is known."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, DropInvalid, Json, Quiet, SourceAxes, notes_of, raster_options

if TYPE_CHECKING:
    from beam_warp.evaluate.asset import Evaluation
    from beam_warp.evaluate.scores import MaterialScores
    from beam_warp.evaluate.steadiness import Deviation

TITLES = {
    "ambient_occlusion": "ambient occlusion",
    "base_color": "base colour",
    "base_color_scaled": "base colour, scaled",
    "roughness": "roughness",
    "novel_view": "novel view",
}


@dataclass(frozen=True)
class Evaluate:
    """Measure ambient occlusion, base colour, roughness, normals and relighting against a capture whose truth is known.

    Scores are means over the test views whose exact channels the capture holds, in the subject's bounding box on black,
    colours encoded as sRGB and unscaled; then base colour once more with the scale that fits best. See
    docs/evaluation.md.

    Example: beam evaluate person --truth captures/walker --out person/evaluation
    """

    asset: Annotated[
        Positional[Path],
        arg(metavar="DIR", help="Folder with asset.usda; or a file of Gaussians, or a folder of numbered files."),
    ]
    truth: Annotated[Path, arg(metavar="CAPTURE", help="A capture whose test records have truth, and relit images.")]
    out: Annotated[
        Path | None, arg(metavar="DIR", help="Also write evaluation.json and the picture evaluation.png here.")
    ] = None
    renders: Annotated[
        Path | None, arg(metavar="DIR", help="Also write the images that were scored, in the layout of the truth.")
    ] = None
    relight: Annotated[
        tuple[str, ...],
        arg(metavar="NAME ...", help="How relit images are made: deferred, path; none leaves them out."),
    ] = ("deferred",)
    scaled_relighting: Annotated[bool, arg(help="Also relight with base colour times its best scale.")] = False
    samples: Annotated[
        int | None,
        arg(metavar="N", help="A pixel is the mean of N x N samples; by default as many as fits took, at least 2."),
    ] = None
    capture_frames: Annotated[
        tuple[int, ...], arg(metavar="N ...", help="The capture's number of every frame; else as the asset states.")
    ] = ()
    split: Annotated[str, arg(help="Which records of the capture.")] = "test"
    antialiased: Annotated[
        bool, arg(help="For Gaussians trained with the 2D anti-aliasing filter that don't say so.")
    ] = False
    low_pass: Annotated[
        float | None, arg(metavar="PX2", help="Variance of the pixel filter; else as the asset states, else 0.3.")
    ] = None
    source_axes: SourceAxes = None
    drop_invalid: DropInvalid = False
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def evaluate(args: Evaluate) -> int:
    """Score the asset and say what was found."""
    capture = Capture.read(args.truth)
    sequence = converters.read(args.asset, source_axes=args.source_axes, drop_invalid=args.drop_invalid)

    from beam_warp.evaluate.asset import evaluate_asset
    from beam_warp.evaluate.materials import EvaluateOptions

    options = EvaluateOptions(
        frames=args.capture_frames or None,
        split=args.split,
        raster=raster_options(sequence.metadata, "yes" if args.antialiased else None, args.low_pass),
        samples=args.samples,
        relighters=() if args.relight == ("none",) else args.relight,
        scaled_relighting=args.scaled_relighting,
        device=args.device,
    )
    with progress(args.quiet or args.json) as report:
        found = evaluate_asset(sequence, capture, options, out=args.out, renders=args.renders, progress=report)
    notes = [*notes_of(sequence), *found.scores.notes]
    if args.json:
        print_json({**found.report, "asset": str(args.asset), "asset_notes": notes})
    elif not args.quiet:
        print_notes(notes)
        _say(args, found)
    return 0


def _say(args: Evaluate, found: Evaluation) -> None:
    """Print a table for people."""
    from rich.console import Console
    from rich.table import Table

    scores = found.scores
    means = scores.mean_channels()
    rows = [(title, means[name]) for name, title in TITLES.items() if name in means]
    for scaled, suffix in ((False, ""), (True, ", scaled")):
        for relighter, by_light in scores.mean_relit(scaled=scaled).items():
            rows += [(f"{light}, {relighter}{suffix}", score) for light, score in by_light.items()]
    perceptual = list(dict.fromkeys(name for _, score in rows for name in score.perceptual))
    table = Table(title=f"{args.asset} against {args.truth}: {len(scores.views)} views")
    table.add_column("mean over views")
    for title in ("PSNR [dB]", "SSIM", "solid PSNR [dB]", *(name.upper() for name in perceptual)):
        table.add_column(title, justify="right")
    for title, score in rows:
        differences = [f"{score.perceptual[name]:.3f}" if name in score.perceptual else "–" for name in perceptual]
        table.add_row(title, f"{score.psnr:.2f}", f"{score.ssim:.3f}", f"{score.solid_psnr:.2f}", *differences)
    Console(width=None if sys.stdout.isatty() else 120).print(table)
    for line in _lines(scores):
        print(line)
    if args.out is not None:
        print(f"wrote {args.out / 'evaluation.json'} and {args.out / 'evaluation.png'}")
    if args.renders is not None:
        print(f"images: {args.renders}")


def _lines(scores: MaterialScores) -> list[str]:
    """Return what a table of images does not hold."""
    lines = []
    if scores.base_color_scale is not None:
        flicker = scores.scale_deviation
        over_time = f", its deviation over frames {_three(flicker, 4)}" if flicker is not None else ""
        lines.append(f"base colour: best scale {_three(scores.base_color_scale, 3)} (R G B){over_time}")
    median, mean = scores.mean("normals_median_degrees"), scores.mean("normals_mean_degrees")
    if median is not None and mean is not None:
        lines.append(f"normals: median {median:.2f}, mean {mean:.2f} degrees")
    depth = scores.mean("depth_median_mm")
    if depth is not None:
        lines.append(f"depth: median error {depth:.2f} mm")
    temporal = scores.temporal
    for channel, gaussians, surface in (
        ("base colour", temporal.gaussians, temporal.surface),
        ("ambient occlusion", temporal.occlusion_gaussians, temporal.occlusion_surface),
    ):
        if gaussians is not None:
            lines.append(f"{channel} over time, per Gaussian: {_deviation(gaussians)}")
        if surface is None:
            continue
        lines.append(f"{channel} over time, at points of the surface: {_deviation(surface.ours)}")
        if surface.ours_where_known is not None and surface.truth is not None:
            lines.append(
                f"  where the truth is drawn too: {_deviation(surface.ours_where_known)}; "
                f"the truth itself: {_deviation(surface.truth)}"
            )
        if surface.error is not None:
            lines.append(f"  beside an error of {surface.error:.4f} at those points")
    absent = {**scores.absent, **{f"over time, {name}": why for name, why in temporal.absent.items()}}
    return lines + [f"not measured: {name}: {why}" for name, why in absent.items()]


def _deviation(deviation: Deviation) -> str:
    return f"deviation {deviation.mean:.4f}, 95 % below {deviation.p95:.4f} ({len(deviation.frames)} frames)"


def _three(values: tuple[float, float, float], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)
