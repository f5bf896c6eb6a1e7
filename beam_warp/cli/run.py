"""``beam run``: the main job from the command line."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from beam_warp import converters
from beam_warp.cli.console import print_json, progress
from beam_warp.environments import EnvironmentMap
from beam_warp.errors import InvalidOptionError


@dataclass(frozen=True)
class Run:
    """Decompose Gaussians with captured colour into a relightable asset.

    Writes OUT/asset.usda (+ layers), OUT/report.json and OUT/overview.png. A job that was stopped continues where it
    was when it is called again with the same input and options.

    Example: beam run person.compressed.ply --environment studio.hdr --out person
    """

    input: Annotated[Positional[Path], arg(metavar="INPUT", help="PLY or USD file, or a folder of numbered PLY files.")]
    environment: Annotated[Path, arg(metavar="ENV", help="Light of the capture: lat-long, .exr or .hdr.")]
    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    relight: Annotated[
        Path | None, arg(metavar="ENV", help="Another light for the overview; the capture's, turned, by default.")
    ] = None
    orbit: Annotated[
        tuple[float, float], arg(metavar="AZIMUTH ELEVATION", help="Where the overview looks from, in degrees.")
    ] = (0.0, 5.0)
    source_axes: Annotated[
        str | None, arg(metavar="CODE", help="Where a PLY's x, y, z point; else its word, else rdf.")
    ] = None
    rotate: Annotated[float, arg(metavar="DEG", help="Turn the light about z, counter-clockwise from above.")] = 0.0
    exposure: Annotated[
        float | Literal["auto"],
        arg(metavar="STOPS|auto", help="Brighten the light by powers of two; auto where the colour has no scale."),
    ] = "auto"
    roughness: Annotated[
        float | Path, arg(metavar="VALUE|FILE", help="Roughness of everything, or a texture (with --roughness-mesh).")
    ] = 0.5
    roughness_mesh: Annotated[
        Path | None, arg(metavar="FILE", help="Mesh whose texture coordinates the roughness texture follows.")
    ] = None
    samples: Annotated[int, arg(metavar="N", help="Rays per Gaussian for visibility, and as many for light.")] = 64
    offset: Annotated[
        float | Literal["auto"], arg(metavar="M|auto", help="Lift of ray origins off the surface, in metres.")
    ] = "auto"
    bounce: Annotated[bool, arg(help="Account for one bounce of light between surfaces.")] = True
    persistent: Annotated[bool, arg(help="Row i is the same Gaussian in every frame: fit over all frames.")] = False
    fps: Annotated[float | None, arg(metavar="RATE", help="Frames per second; else the input's word, else 30.")] = None
    seed: Annotated[int, arg(help="Same seed, same device: same result.")] = 0
    drop_invalid: Annotated[bool, arg(help="Leave out rows with NaN or zero quaternions, and say how many.")] = False
    device: Annotated[str | None, arg(help="cpu, cuda:0, …; the first GPU by default, if there is one.")] = None
    quiet: Annotated[bool, arg(help="Print nothing but errors.")] = False
    json: Annotated[bool, arg(help="Print the report as JSON.")] = False


def run(args: Run) -> int:
    """Run the job and say what came out."""
    started = time.perf_counter()
    sequence = converters.read(args.input, source_axes=args.source_axes, drop_invalid=args.drop_invalid)
    environment = EnvironmentMap.read(args.environment).rotated(args.rotate)
    if isinstance(args.roughness, Path) != (args.roughness_mesh is not None):
        raise InvalidOptionError(
            "roughness-mesh must be given with a roughness texture, and only then, got "
            f"{args.roughness_mesh} with {args.roughness}. Give both or neither."
        )

    from beam_warp.contact_sheet import Relighting
    from beam_warp.materials import MaterialOptions
    from beam_warp.pipeline import OverviewOptions, RoughnessTexture, RunOptions
    from beam_warp.pipeline import run as run_pipeline

    if args.fps is not None:
        sequence = replace(sequence, frames_per_second=args.fps)
    options = RunOptions(
        materials=MaterialOptions(sample_count=args.samples, offset=args.offset, bounce=args.bounce, seed=args.seed),
        roughness=RoughnessTexture(args.roughness, args.roughness_mesh)
        if isinstance(args.roughness, Path) and args.roughness_mesh is not None
        else float(args.roughness),  # type: ignore[arg-type]
        exposure=args.exposure,
        persistent=args.persistent,
        device=args.device,
    )
    view = OverviewOptions(
        second_light=None if args.relight is None else Relighting(args.relight.stem, EnvironmentMap.read(args.relight)),
        azimuth=args.orbit[0],
        elevation=args.orbit[1],
    )
    with progress(args.quiet or args.json) as report:
        result = run_pipeline(sequence, environment, args.out, options, overview=view, progress=report)
    if args.json:
        print_json(result.report)
    elif not args.quiet:
        for line in [f"note: {note}" for note in result.report["input"]["notes"]] + [
            f"warning: {warning}" for warning in result.report["warnings"]
        ]:
            print(line, file=sys.stderr)
        materials = result.report["materials"]
        frames = f"{len(sequence)} frame{'s' if len(sequence) > 1 else ''}"
        seconds = time.perf_counter() - started
        print(
            f"wrote {result.asset}: {frames}, {result.report['input']['gaussians']:,} Gaussians, {seconds:.1f} s on "
            f"{result.report['device']['name']}\n"
            f"exposure of the light {result.report['exposure_stops']:+.2f} stops, "
            f"mean ambient occlusion {materials['mean_ambient_occlusion']:.3f}\n"
            f"mean standard error of base colour {materials['mean_base_color_error_where_measured']:.3f}, "
            f"{materials['flags']['FILLED']:,} Gaussians filled from neighbours\n"
            f"overview: {result.overview}"
        )
    return 0
