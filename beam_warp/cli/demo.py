"""``beam demo``: the main job on the embedded figure, with its scores."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from beam_warp.cli.console import print_json, progress

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

    Writes what `beam run` writes, and OUT/relit.png: ours above, path-traced truth below.

    Example: beam demo --out demo
    """

    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")] = Path("demo")
    frames: Annotated[int, arg(metavar="N", help="Frames of the figure's dance.")] = 3
    gaussians: Annotated[int, arg(metavar="N", help="Gaussians on the figure, about.")] = 45_000
    height: Annotated[int, arg(metavar="PX", help="Height of the images with truth.")] = 360
    seed: Annotated[int, arg(help="Same seed, same device: same result.")] = 0
    device: Annotated[str | None, arg(help="cpu, cuda:0, …; the first GPU by default, if there is one.")] = None
    quiet: Annotated[bool, arg(help="Print nothing but errors.")] = False
    json: Annotated[bool, arg(help="Print the report as JSON.")] = False


def demo(args: Demo) -> int:
    """Run the demo and print its scores."""
    from beam_warp.demo import DemoOptions, run_demo

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
        scores = result.report["scores"]
        print(f"{'against path-traced truth':32} PSNR [dB]   SSIM   solid PSNR [dB]")
        for name, title in ROWS.items():
            row = scores[name]
            print(f"{title:32} {row['psnr']:9.2f}  {row['ssim']:.3f}   {row['solid_psnr']:9.2f}")
        scale = ", ".join(f"{value:.3f}" for value in scores["base_color_scale"])
        print(f"scale of base colour (1 is calibrated): {scale}")
        print(f"normals: median error {scores['normals_median_error_degrees']:.1f} degrees")
        seconds = result.report["seconds"]
        print(
            f"{result.report['input']['gaussians']:,} Gaussians, {result.report['input']['frames']} frames, "
            f"{seconds['total']:.1f} s on {result.report['device']['name']}, of which {seconds['build demo']:.1f} s to "
            f"build and path trace the figure\n"
            f"look at {result.overview} and {args.out / 'relit.png'}"
        )
    return 0
