"""``beam demo``: the main job on the embedded figure, with its scores."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from beam_warp.cli.common.console import print_json, progress
from beam_warp.cli.common.flags import Device, Json, Quiet, Seed

ROWS = {
    "ambient_occlusion": "ambient occlusion",
    "base_color": "base colour",
    "relit_studio": "relit, light of the capture",
    "relit_sunset": "relit, sunset",
    "relit_stage": "relit, stage",
}


@dataclass(frozen=True)
class Demo:
    """Build, capture, decompose, relight and score a small animated figure whose truth is known.

    First a stand-in for a trained capture, on which decomposition can be judged by itself: writes what `beam run`
    writes, and OUT/relit.png: ours above, path-traced truth below. Then from images: writes OUT/capture, photographs of
    the figure as any capture has them; OUT/reconstruction, Gaussians fitted to them and tracked; OUT/from_images, what
    `beam run` makes of those; and OUT/reconstruction.png.

    Example: beam demo --out demo
    """

    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")] = Path("demo")
    frames: Annotated[int, arg(metavar="N", help="Frames of the stand-in.")] = 1
    gaussians: Annotated[int, arg(metavar="N", help="Gaussians of the stand-in, about.")] = 45_000
    height: Annotated[int, arg(metavar="PX", help="Height of the stand-in's images with truth.")] = 300
    seed: Seed = 0
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def demo(args: Demo) -> int:
    """Run the demo and print its scores."""
    from beam_warp.demo.job import DemoOptions, run_demo

    options = DemoOptions(
        frame_count=args.frames,
        gaussian_count=args.gaussians,
        image_height=args.height,
        device=args.device,
        seed=args.seed,
    )
    with progress(args.quiet or args.json) as report:
        result = run_demo(args.out, options, report)
    if args.json:
        print_json(result.report)
    elif not args.quiet:
        _print(result.report)
        print(f"look at {result.overview}, {args.out / 'relit.png'} and {args.out / 'reconstruction.png'}")
    return 0


def _print(report: dict[str, Any]) -> None:
    """Print the scores of both halves."""
    scores, images = report["scores"], report["from_images"]
    size, key, last = images["options"]["size"], images["frames"][0], images["frames"][-1]
    print(f"{'stand-in, against path-traced truth':42} PSNR [dB]   SSIM   solid PSNR [dB]")
    _print_rows(scores)
    print(
        f"{report['input']['gaussians']:,} Gaussians, {report['input']['frames']} frame(s); normals: median error "
        f"{scores['normals_median_error_degrees']:.1f} degrees\n"
    )
    title = f"from images of {size} x {size}, unseen views"
    print(f"{title:42} PSNR [dB]   SSIM   solid PSNR [dB]")
    _print_row("photographs, first frame", key)
    _print_row("photographs, last frame", last)
    _print_rows(images["relightable"])
    drift = images["drift"][-1]["vertices"]["mean_mm"]
    print(
        f"{images['gaussians'][-1]:,} Gaussians, {len(images['frames'])} frames, "
        f"{images['options']['camera_count']} cameras; normals: median error {last['normals_median_degrees']:.1f} "
        f"degrees; surface: {last['surface']['chamfer_mm']:.1f} mm off; drift after the last frame: {drift:.1f} mm"
    )
    for warning in images["warnings"]:
        print(f"warning: {warning}")
    seconds = report["seconds"]
    print(
        f"{seconds['total']:.1f} s on {report['device']['name']}, of which {seconds['build demo']:.1f} s to build and "
        f"path trace the stand-in, {images['seconds']['capture']:.1f} s the photographs, and "
        f"{images['seconds']['reconstruct']:.1f} s to reconstruct"
    )


def _print_rows(scores: dict[str, Any]) -> None:
    for name, title in ROWS.items():
        _print_row(title, scores[name])


def _print_row(title: str, score: dict[str, float]) -> None:
    print(f"{title:42} {score['psnr']:9.2f}  {score['ssim']:.3f}   {score['solid_psnr']:9.2f}")
