"""``beam reduce``: the fewest Gaussians whose relit images stay within a bound, with a certificate."""

from __future__ import annotations

import math
import re
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp.cli.common.console import print_json, print_notes, progress
from beam_warp.cli.common.flags import Device, Json, Quiet, ReadingFlags, Seed, notes_of
from beam_warp.cli.common.pages import SECOND_PAGE
from beam_warp.errors import InvalidOptionError
from beam_warp.study.targets import Rung, Target, in_words, outcome

if TYPE_CHECKING:
    from beam_warp.reduction.job import Reduction

UNITS = {"": 1, "B": 1, "KB": 1000, "MB": 1000**2, "GB": 1000**3}
"""Bytes of the units of sizes."""


@dataclass(frozen=True)
class Reduce:
    """Merge Gaussians until a target is met: a bound on the error of relit images, a size, or a number.

    Errors are measured over random lights, cameras and frames: environments turned, suns, lamps. The certificate is
    made on draws that the search did not see, and is written into the asset; beam-validate --physical repeats it.
    See docs/reducing.md.

    Example: beam reduce person/asset.usda --out small.usda --max-loss 0.5
    """

    asset: Annotated[
        Positional[Path], arg(metavar="ASSET", help="A relightable asset: its folder, or a file of Gaussians.")
    ]
    out: Annotated[Path, arg(metavar="FILE", help="Asset to write: .usda, .usdc, or .b4d for players.")]
    max_loss: Annotated[
        float | None, arg(metavar="DB", help="Most loss of PSNR against the truth, in 19 of 20 draws.")
    ] = None
    max_flip: Annotated[float | None, arg(metavar="X", help="Most FLIP against the original, in 19 of 20 draws.")] = (
        None
    )
    target_error: Annotated[
        float | None, arg(metavar="E", help="Most RMS error of display values against the original, in 19 of 20 draws.")
    ] = None
    size: Annotated[str | None, arg(metavar="BYTES", help="Most bytes of the file, such as 20MB.")] = None
    gaussians: Annotated[int | None, arg(metavar="N", help="Number of Gaussians.")] = None
    target_fps: Annotated[
        float | None, arg(metavar="F", help="As many Gaussians as this device draws so often a second.")
    ] = None
    target_seconds: Annotated[
        float | None, arg(metavar="S", help="With --gaussians: refit for as long as this whole call may take.")
    ] = None
    asset_psnr: Annotated[
        float, arg(metavar="DB", help="What the asset's relit images have against the truth, as beam evaluate says.")
    ] = 35.0
    environment: Annotated[
        tuple[Path, ...], arg(metavar="FILE ...", help="One to four lights to measure under; else the demo's three.")
    ] = ()
    height: Annotated[int, arg(metavar="PX", help="Side of compared images: how large it will be seen.")] = 256
    pairs: Annotated[
        int, arg(metavar="N", help="Draws of light, camera and frame for the certificate."), SECOND_PAGE
    ] = 200
    confidence: Annotated[float, arg(metavar="P", help="Confidence of the certificate."), SECOND_PAGE] = 0.95
    views: Annotated[Annotated[int | None, arg(metavar="N", help="Views that the search looks at.")], SECOND_PAGE] = (
        None
    )
    steps: Annotated[
        int | None, arg(metavar="N", help="Steps of a refit; by default 8640 on a GPU, 600 elsewhere."), SECOND_PAGE
    ] = None
    reading: OmitArgPrefixes[ReadingFlags] = field(default_factory=ReadingFlags)
    seed: Seed = 0
    device: Device = None
    quiet: Quiet = False
    json: Json = False


def reduce(args: Reduce) -> int:
    """Reduce the asset and say what was found."""
    started = time.perf_counter()
    from beam_warp.demo.lights import demo_environments
    from beam_warp.reduction.job import ReduceOptions, reduce_asset
    from beam_warp.world.environment import EnvironmentMap

    sequence = args.reading.read(args.asset)
    environments = [EnvironmentMap.read(path) for path in args.environment] or [*demo_environments().values()]
    options = ReduceOptions(
        max_loss=args.max_loss,
        max_flip=args.max_flip,
        target_error=args.target_error,
        size=None if args.size is None else bytes_of(args.size),
        gaussians=args.gaussians,
        target_fps=args.target_fps,
        asset_psnr=args.asset_psnr,
        height=args.height,
        pairs=args.pairs,
        confidence=args.confidence,
        views=args.views,
        steps=args.steps,
        target_seconds=args.target_seconds,
        spent=time.perf_counter() - started,
        seed=args.seed,
        raster=args.reading.raster(sequence),
        device=args.device,
    )
    with progress(args.quiet or args.json) as report:
        found = reduce_asset(sequence, environments, options, args.out, progress=report)
    seconds = time.perf_counter() - started
    target = _target(args, found, seconds)
    if args.json:
        said = {"target": target} if target else {}
        print_json({**_facts(found), "seconds": round(seconds, 3), "notes": notes_of(sequence), **said})
    elif not args.quiet:
        print_notes(notes_of(sequence))
        print(f"{found.count:,} of {found.original_count:,} Gaussians in {args.out}, {seconds:.1f} s")
        print(f"certified: {found.certificate}")
        if target:
            print(in_words(target))
    return 0


def _target(args: Reduce, found: Reduction, seconds: float) -> dict[str, Any]:
    """Return what is said of a target; empty if none was asked. An error is what the certificate bounds."""
    asked = Target(error=args.target_error, seconds=args.target_seconds, fps=args.target_fps)
    if not asked.asked():
        return {}
    chosen = Rung(settings={"gaussians": found.count, "steps": found.steps}, seconds=math.nan, frame_seconds=math.nan)
    reached = {"error": found.certificate.bound, "seconds": seconds, "fps": found.fps}
    return outcome(asked, chosen, reached if args.target_error is not None else {**reached, "error": None})


def bytes_of(text: str) -> int:
    """Return the bytes of a size such as ``20MB``.

    Raises:
        InvalidOptionError: It is none.
    """
    match = re.fullmatch(r"\s*(\d{1,15}(?:\.\d{1,9})?)\s*([KMG]?B?)\s*", text.upper())
    if match is None or match[2] not in UNITS:
        raise InvalidOptionError(f"size must be a number of bytes, got {text[:40]!r}. Write it like 20MB.")
    return int(float(match[1]) * UNITS[match[2]])


def _facts(found: Reduction) -> dict[str, object]:
    """Return what a program wants to know."""
    return {
        "gaussians": found.count,
        "original": found.original_count,
        "bytes": sum(path.stat().st_size for path in found.paths),
        "error_scale": found.error_scale,
        "fps": found.fps,
        "candidates": [{"gaussians": count, "error": error} for count, error in found.candidates],
        "certificate": asdict(found.certificate),
    }
