"""``beam run``: the main job from the command line, from Gaussians or all the way from a capture."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp import converters
from beam_warp.assets import GaussianSequence
from beam_warp.captures import Capture
from beam_warp.checks import require_number
from beam_warp.cli.console import ProgressCallback, print_json, progress
from beam_warp.cli.reconstruct import Modelling, options_of, steps_of, summary
from beam_warp.environments import EnvironmentMap
from beam_warp.errors import InvalidOptionError, MissingFileError

if TYPE_CHECKING:
    from beam_warp.reconstruction import Reconstruction


@dataclass(frozen=True)
class Run:
    """Decompose Gaussians with captured colour into a relightable asset; of a capture, reconstruct them first.

    Writes OUT/asset.usda (+ layers), OUT/report.json and OUT/overview.png; of a capture, also OUT/reconstruction with
    what `beam reconstruct` writes. A job that was stopped continues where it was when it is called again with the same
    input and options.

    Example: beam run person.compressed.ply --environment studio.hdr --out person

    Example: beam run captures/walker --gaussians 20000 --out walker
    """

    input: Annotated[
        Positional[Path],
        arg(metavar="INPUT", help="PLY or USD file, a folder of numbered PLY files, or the folder of a capture."),
    ]
    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    environment: Annotated[
        Path | None,
        arg(metavar="ENV", help="Light of the capture: lat-long, .exr or .hdr; a capture's own by default."),
    ] = None
    modelling: OmitArgPrefixes[Modelling] = field(default_factory=Modelling)
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
    """Run the job and say what came out; all that was asked is checked before the first frame is worked on."""
    started = time.perf_counter()
    capture = capture_at(args.input)
    environment = EnvironmentMap.read(_light(args, capture)).rotated(args.rotate)
    if isinstance(args.roughness, Path) != (args.roughness_mesh is not None):
        raise InvalidOptionError(
            "roughness-mesh must be given with a roughness texture, and only then, got "
            f"{args.roughness_mesh} with {args.roughness}. Give both or neither."
        )
    if args.fps is not None:
        require_number("frames_per_second", args.fps, 1e-3, 1e6)

    from beam_warp.contact_sheet import Relighting
    from beam_warp.materials import MaterialOptions
    from beam_warp.pipeline import OverviewOptions, RoughnessTexture, RunOptions
    from beam_warp.pipeline import run as run_pipeline

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
        found = None if capture is None else _reconstruct(args, capture, report)
        sequence = _read(args) if found is None else found.sequence
        if args.fps is not None:
            sequence = replace(sequence, frames_per_second=args.fps)
        result = run_pipeline(sequence, environment, args.out, options, overview=view, progress=report)
    reconstruction = None if found is None else found.report
    if args.json:
        print_json(result.report if reconstruction is None else {**result.report, "reconstruction": reconstruction})
    elif not args.quiet:
        warnings = [] if reconstruction is None else reconstruction["warnings"]
        for line in [f"note: {note}" for note in result.report["input"]["notes"]] + [
            f"warning: {warning}" for warning in [*warnings, *result.report["warnings"]]
        ]:
            print(line, file=sys.stderr)
        if reconstruction is not None:
            print(f"reconstructed {args.input}: {summary(reconstruction)}")
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


def capture_at(path: Path) -> Capture | None:
    """Return the capture at a path; None if there is none, but perhaps Gaussians."""
    if not (path.is_dir() or path.suffix == ".json"):
        return None
    try:
        return Capture.read(path)
    except MissingFileError:
        if any(path.glob("*.ply")) and not (path / "transforms.json").exists():
            return None
        raise


def _light(args: Run, capture: Capture | None) -> Path:
    """Return the file of the light; refuse words that do not go with the input."""
    if capture is None and args.modelling != Modelling():
        raise InvalidOptionError(
            "gaussians, target-psnr, preset, segment-length and frames must be left out unless the input is a "
            f"capture, got {args.input}. Drop them."
        )
    if capture is not None and (args.source_axes is not None or args.drop_invalid or args.persistent):
        raise InvalidOptionError(
            "source-axes, drop-invalid and persistent must be left out for a capture, whose Gaussians are made here, "
            f"got {args.input}. Drop them."
        )
    light = args.environment or (None if capture is None else capture.environment_path)
    if light is None:
        whose = "Gaussians come" if capture is None else "this capture comes"
        raise InvalidOptionError(
            f"environment must be given, got none for {args.input}: {whose} without their light. "
            "Name a lat-long image with --environment."
        )
    return light


def _read(args: Run) -> GaussianSequence:
    return converters.read(args.input, source_axes=args.source_axes, drop_invalid=args.drop_invalid)


def _reconstruct(args: Run, capture: Capture, report: ProgressCallback) -> Reconstruction:
    from beam_warp.frame_store import make_folders
    from beam_warp.reconstruction import reconstruct

    steps = steps_of(args.modelling, capture, args.seed, args.device)
    folder = args.out / "reconstruction"
    options = options_of(args.modelling, capture)
    make_folders(args.out)
    return reconstruct(capture, folder, steps, options, progress=report)
