"""``beam decompose``: from Gaussians and the images they were reconstructed from to a relightable asset."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.capture.corrections import RigCorrection
from beam_warp.capture.exposures import RigExposures
from beam_warp.capture.mask_corrections import MaskCorrections
from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, Json, Quiet, Seed
from beam_warp.cli.common.pages import SECOND_PAGE
from beam_warp.cli.common.targets import TargetFlags, chosen_rays, state
from beam_warp.errors import InvalidOptionError
from beam_warp.study.targets import Rung, Target, in_words
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.metadata import capture_frames_metadata, numbers_of_frames

if TYPE_CHECKING:
    from beam_warp.decomposition.job import OverviewOptions, RunOptions, RunResult
    from beam_warp.world.gaussians import GaussianSequence

PILOT_HEIGHT = 64
"""Height of a panel of a pilot's overview, which nobody looks at [pixel]."""


@dataclass(frozen=True)
class Measuring:
    """How materials are measured and shown; the same words in every command that does."""

    environment: Annotated[
        Path | None,
        arg(metavar="ENV", help="Light of the capture: lat-long, .exr or .hdr; a capture's own by default."),
    ] = None
    relight: Annotated[
        Path | None, arg(metavar="ENV", help="Another light for the overview; the capture's, turned, by default.")
    ] = None
    orbit: Annotated[
        tuple[float, float], arg(metavar="AZIMUTH ELEVATION", help="Where the overview looks from, in degrees.")
    ] = (0.0, 5.0)
    rotate: Annotated[float, arg(metavar="DEG", help="Turn the light about z, counter-clockwise from above.")] = 0.0
    exposure: Annotated[
        float | Literal["auto"],
        arg(metavar="STOPS|auto", help="Brighten the light by powers of two; auto where the colour has no scale."),
    ] = "auto"
    turn_light: Annotated[
        bool,
        arg(help="Turn the light where the capture shows beyond doubt that it is askew by a few degrees."),
        SECOND_PAGE,
    ] = True
    roughness: Annotated[
        float | Literal["estimate"] | Path | None,
        arg(
            metavar="VALUE|estimate|FILE",
            help="Roughness of everything, found from highlights, or a texture (with --roughness-mesh). "
            "By default found where there is a capture, else 0.5.",
        ),
    ] = None
    roughness_mesh: Annotated[
        Path | None,
        arg(metavar="FILE", help="Mesh whose texture coordinates the roughness texture follows."),
        SECOND_PAGE,
    ] = None
    samples: Annotated[
        int | None,
        arg(
            metavar="N",
            help="Rays per Gaussian for visibility; light takes more or fewer, as it is noisy. 64 by default.",
        ),
    ] = None
    offset: Annotated[
        float | Literal["auto"] | None,
        arg(metavar="M|auto", help="Lift of ray origins off the surface, in metres; auto by default."),
        SECOND_PAGE,
    ] = None
    bounce: Annotated[bool, arg(help="Account for one bounce of light between surfaces."), SECOND_PAGE] = True


@dataclass(frozen=True)
class Decompose:
    """Decompose Gaussians into base colour, roughness, ambient occlusion and normals, with their standard errors.

    Light is gathered where the capture's images show the surface, and base colour explains what they show, over all
    views and frames. Writes OUT/asset.usda (+ layers), OUT/report.json and OUT/overview.png. A job that was stopped
    continues where it was. Without --capture, the Gaussians' own colour is explained.

    Example: beam decompose walker/gaussians.usda --capture captures/walker --out walker_asset

    Example: beam decompose walker/gaussians.usda --capture captures/walker --preset paper --out walker_paper

    Example: beam decompose walker/gaussians.usda --capture captures/walker --target-error 0.05 --out walker_asset
    """

    sequence: Annotated[Positional[Path], arg(metavar="SEQ", help="File of Gaussians, or a folder of numbered files.")]
    out: Annotated[Path, arg(metavar="DIR", help="Folder for the results.")]
    capture: Annotated[
        Path | None, arg(metavar="CAPTURE", help="Folder of the capture that SEQ was reconstructed from.")
    ] = None
    preset: Annotated[
        Literal["direct", "paper"],
        arg(help="Rays from every Gaussian (ours), or from every pixel as in the paper: 50 and 100 rays, 2 cm offset."),
    ] = "direct"
    measuring: OmitArgPrefixes[Measuring] = field(default_factory=Measuring)
    targets: OmitArgPrefixes[TargetFlags] = field(default_factory=TargetFlags)
    seed: Seed = 0
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def decompose(args: Decompose) -> int:
    """Run the job and say what came out; all that was asked is checked before the first frame is worked on."""
    started = time.perf_counter()
    capture = None if args.capture is None else _seen_by(Capture.read(args.capture), args.sequence)
    if args.preset == "paper" and capture is None:
        raise InvalidOptionError(
            "capture must be given for the preset paper, got none: it works on images. Name one with --capture."
        )
    target = args.targets.target
    if target is not None and args.preset == "paper":
        raise InvalidOptionError(
            f"targets must be left out with the preset paper, got {_listed(target)}. Its rays are the paper's."
        )

    def options_of(measuring: Measuring) -> RunOptions:
        return run_options(measuring, capture, preset=args.preset, seed=args.seed, device=args.device, persistent=False)

    options = options_of(args.measuring)
    environment = EnvironmentMap.read(light_of(args.measuring, capture, args.sequence)).rotated(args.measuring.rotate)
    sequence = converters.read(args.sequence)

    from beam_warp.decomposition.job import run as run_pipeline

    with progress(args.quiet or args.json) as report:
        chosen = None
        if target is not None:
            source = Piloted(lambda: sequence, capture, environment, options_of)
            chosen = rays_for(target, args.measuring, source, len(sequence), started)
            options = options_of(with_rays(args.measuring, chosen))
        result = run_pipeline(
            sequence,
            environment,
            args.out,
            options,
            capture=capture,
            overview=overview_options(args.measuring),
            progress=report,
        )
    if target is not None and chosen is not None:
        state_target(result, target, chosen, started)
    if args.json:
        print_json(result.report)
    elif not args.quiet:
        print_notes(result.report["input"]["notes"], result.report["warnings"])
        print(outcome(result, time.perf_counter() - started))
    return 0


def _listed(target: Target) -> str:
    return ", ".join(f"{name} {value:g}" for name, value in target.asked().items())


@dataclass(frozen=True)
class Piloted:
    """Inputs of a decomposition whose rays are chosen by a pilot.

    Attributes:
        read: Returns the frames.
        capture: Images that they were made from.
        environment: The light.
        options_of: Returns the job's options by its words.
    """

    read: Callable[[], GaussianSequence]
    capture: Capture | None
    environment: EnvironmentMap
    options_of: Callable[[Measuring], RunOptions]


def rays_for(target: Target, measuring: Measuring, source: Piloted, frame_count: int, started: float) -> Rung:
    """Choose the rays of a decomposition that began at a time, by `time.perf_counter` [s]; see `chosen_rays`."""
    from beam_warp.decomposition.job import OverviewOptions
    from beam_warp.decomposition.job import run as run_pipeline

    def pilot(folder: Path, rays: int, count: int) -> dict[str, Any]:
        sequence, options = source.read(), source.options_of(replace(measuring, samples=rays))
        numbers = numbers_of_frames(sequence.metadata, len(sequence))[:count]
        metadata = {**sequence.metadata, **capture_frames_metadata(numbers)}
        few = replace(sequence, frame_count=count, metadata=metadata)
        view = OverviewOptions(height=PILOT_HEIGHT)
        return run_pipeline(few, source.environment, folder, options, capture=source.capture, overview=view).report

    return chosen_rays(target, pilot, measuring.samples, frame_count, lambda: time.perf_counter() - started)


def with_rays(measuring: Measuring, chosen: Rung) -> Measuring:
    """Return the words with the rays that a target chose."""
    return replace(measuring, samples=int(chosen.settings["samples"]))


def state_target(result: RunResult, target: Target, chosen: Rung, started: float) -> None:
    """State what a target asked of a decomposition that began at a time, by `time.perf_counter` [s]; see `state`."""
    error = result.report["materials"]["mean_base_color_error_where_measured"]
    seconds = time.perf_counter() - started
    state(result.report, result.asset.parent, target, chosen, error, len(result.sequence), seconds)


def _seen_by(capture: Capture, sequence: Path) -> Capture:
    """Return a capture with the cameras, masks and colours that a reconstruction's sequence was fitted with."""
    for kind in (MaskCorrections, RigCorrection, RigExposures):
        found = kind.read(sequence.parent)
        capture = capture if found is None else found.capture(capture)
    return capture


def light_of(measuring: Measuring, capture: Capture | None, source: Path) -> Path:
    """Return the file of the light.

    Raises:
        InvalidOptionError: There is none.
    """
    light = measuring.environment or (None if capture is None else capture.environment_path)
    if light is None:
        whose = "Gaussians come" if capture is None else "this capture comes"
        raise InvalidOptionError(
            f"environment must be given, got none for {source}: {whose} without their light. "
            "Name a lat-long image with --environment."
        )
    return light


def run_options(
    measuring: Measuring,
    capture: Capture | None,
    *,
    preset: Literal["direct", "paper"],
    seed: int,
    device: str | None,
    persistent: bool,
) -> RunOptions:
    """Return the options that the words ask for.

    Raises:
        InvalidOptionError: A texture comes without its mesh, or a mesh without its texture.
    """
    from beam_warp.decomposition.job import RunOptions
    from beam_warp.materials.light_rays import MaterialOptions
    from beam_warp.materials.roughness_source import RoughnessTexture

    stated = measuring.roughness
    if isinstance(stated, Path) != (measuring.roughness_mesh is not None):
        raise InvalidOptionError(
            "roughness-mesh must be given with a roughness texture, and only then, got "
            f"{measuring.roughness_mesh} with {stated}. Give both or neither."
        )
    roughness: Any = stated
    if isinstance(stated, Path) and measuring.roughness_mesh is not None:
        roughness = RoughnessTexture(stated, measuring.roughness_mesh)
    elif stated is None:
        roughness = 0.5 if capture is None or preset == "paper" else "estimate"
    rays: dict[str, Any] = {"sample_count": measuring.samples, "offset": measuring.offset}
    rays = {name: value for name, value in rays.items() if value is not None}
    rays |= {} if measuring.bounce else {"bounce": False}
    by_images = None
    if preset == "paper":
        from beam_warp.materials.images import ImagePathOptions

        by_images = ImagePathOptions(seed=seed)
    return RunOptions(
        materials=MaterialOptions(**rays, seed=seed) if rays or preset == "direct" else None,
        images=by_images,
        roughness=roughness,
        exposure=measuring.exposure,
        turn_light=measuring.turn_light,
        persistent=persistent,
        device=device,
    )


def overview_options(measuring: Measuring) -> OverviewOptions:
    """Return what the contact sheet shows."""
    from beam_warp.decomposition.job import OverviewOptions

    light, second = measuring.relight, None
    if light is not None:
        from beam_warp.render.sheet import Relighting

        second = Relighting(light.stem, EnvironmentMap.read(light))
    return OverviewOptions(second_light=second, azimuth=measuring.orbit[0], elevation=measuring.orbit[1])


def outcome(result: RunResult, seconds: float) -> str:
    """Return what came out, in some lines."""
    materials = result.report["materials"]
    frames, fitted = len(result.sequence), result.report["exposure_is_fitted"]
    said = f"{in_words(result.report['target'])}\n" if "target" in result.report else ""
    return (
        f"wrote {result.asset}: {frames} frame{'s' if frames > 1 else ''}, "
        f"{result.report['input']['gaussians']:,} Gaussians, {seconds:.1f} s on {result.report['device']['name']}\n"
        f"exposure of the light {'fitted by ' if fitted else ''}{result.report['exposure_stops']:+.2f} stops"
        f"{', as captured colour has no scale of its own' if fitted else ''}; "
        f"mean ambient occlusion {materials['mean_ambient_occlusion']:.3f}\n"
        f"mean standard error of base colour {materials['mean_base_color_error_where_measured']:.3f}, "
        f"{materials['flags']['FILLED']:,} Gaussians filled from neighbours\n"
        f"{said}"
        f"overview: {result.overview}"
    )
