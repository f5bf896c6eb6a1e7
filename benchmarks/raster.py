"""The rasteriser's speed, and its error beside it: against gsplat, stage by stage, and how both grow.

    python benchmarks/raster.py [--device cuda:0] --out JSON [--only peer stages] [--quick]

Scenes are those of ``raster_scenes.py``. On CUDA a frame is timed as `Rasterizer.redraw` launches it and as one CUDA
graph, by the host's clock from idle to idle and between events on the device; events of what the host launches count
the device's waits for it. On the CPU one thread is timed by process CPU time, one and two by wall-clock time.
Contenders take turns, and ratios are medians of ratios within a turn, so that a busy machine disturbs them least.
Errors are against float64 brute force at some pixels, gsplat, the readable composite, and the other device.

gsplat is drawn where it and torch for CUDA are importable; else the JSON says that it is absent. A section that fails
says so in its place, and the program returns 1. Writes the JSON after each section.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import record
from gsplat_peer import GsplatPeer, GsplatUnavailableError, kernel_seconds
from gsplat_peer import Images as PeerImages
from numpy.typing import NDArray
from parts import measure_all, once, say
from raster_contenders import Clocked, Drawing, Measured, Seen, captured, digits, measure_in_turn, random_adjoints
from raster_scenes import RasterScene, cube, figure, growth
from raster_stages import measure_stages
from raster_truth import Truth, brute_force
from timing import launch_threads

from beam_warp.device.arrays import resolve_device
from beam_warp.raster.records import RasterOptions

Row = dict[str, Any]

CASES = {"RGB and depth": 3, "11 channels and depth": 11}
"""Channels of the comparison with gsplat; 3 are the captured colour."""

SIZES, MOST_TIMES = (1_000, 10_000, 140_000, 1_000_000, 5_000_000), 40
"""Gaussians of frames that are timed by themselves, and how many times those of other frames they may be."""

PARTS = ("forward", "backward", "training")
"""Timed parts of a training step: drawing, the way back, and both one after the other."""

FLIP = 1e-4
"""A larger difference is a decision that fell the other way: a splat at the cut of alpha, the stop, the order of two,
the pick of the median. Rounding stays below."""

ROUNDING = 2e-6
"""Largest difference between CPU and CUDA in a channel where nothing was decided otherwise."""

OPAQUE = 0.5
"""Depths are compared where alpha is above: elsewhere they are means over little."""

BEFORE_STOP = 0.999
"""Below this alpha no pixel is near the stop, where gsplat leaves a splat out that we draw."""

PEER_NOTES = (
    "gsplat's depth is that of splats' centres, ours that of their tangent planes: they differ by splats' sizes.",
    "gsplat draws neither median depth nor the last Gaussian; ours include both.",
    "gsplat reads a count back, which waits for the device: it cannot be captured; its wall times include the wait.",
)


@dataclass(frozen=True)
class Effort:
    """Extent of a measurement.

    Attributes:
        gaussians: Of every measurement but growth.
        size: Image of every measurement but growth.
        repeats: Rounds, but of growth.
        slow_repeats: Rounds where the readable composite takes part.
        stage_repeats: Frames of the stages.
        truth_pixels: Pixels compared with float64.
        counts: Gaussians of the growth over them, at ``size``.
        sizes: Images of the growth over pixels, at ``gaussians``.
        growth_repeats: Rounds of a growth row.
    """

    gaussians: int
    size: tuple[int, int]
    repeats: int
    slow_repeats: int
    stage_repeats: int
    truth_pixels: int
    counts: tuple[int, ...]
    sizes: tuple[tuple[int, int], ...]
    growth_repeats: int


ON_CPU = Effort(
    gaussians=100_000,
    size=(512, 512),
    repeats=3,
    slow_repeats=2,
    stage_repeats=3,
    truth_pixels=200,
    counts=(1_000, 3_000, 10_000, 30_000, 100_000, 200_000),
    sizes=((128, 128), (256, 256), (512, 512), (1920, 1080), (3840, 2160)),
    growth_repeats=2,
)
ON_CUDA = Effort(
    gaussians=140_000,
    size=(1920, 1080),
    repeats=50,
    slow_repeats=20,
    stage_repeats=30,
    truth_pixels=400,
    counts=(1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000),
    sizes=((128, 128), (256, 256), (512, 512), (1024, 1024), (1920, 1080), (3840, 2160)),
    growth_repeats=15,
)
QUICK = Effort(
    gaussians=5_000,
    size=(160, 90),
    repeats=2,
    slow_repeats=1,
    stage_repeats=2,
    truth_pixels=30,
    counts=(1_000, 4_000),
    sizes=((64, 64), (160, 90)),
    growth_repeats=1,
)


def peer_for(scene: RasterScene, values: NDArray[np.float32], device: Any) -> tuple[GsplatPeer | None, str | None]:
    """Return gsplat with a scene that it has drawn once, or why there is none."""
    if not device.is_cuda:
        return None, "it runs on CUDA only"
    try:
        peer = GsplatPeer(scene.cloud, scene.camera, values, device=device.alias)
        peer.forward()
    except (GsplatUnavailableError, ImportError, OSError, RuntimeError) as error:  # also: its kernels do not compile
        return None, f"{type(error).__name__}: {str(error)[:300]}"
    return peer, None


def peer_adjoints(scene: RasterScene, adjoints: Seen) -> PeerImages:
    """Return derivatives to images as gsplat takes them."""
    shape = (scene.camera.height, scene.camera.width)
    return PeerImages(
        adjoints.channels.reshape(*shape, -1), adjoints.depth.reshape(shape), adjoints.alpha.reshape(shape)
    )


def contenders_for(
    scene: RasterScene, values: NDArray[np.float32], device: Any, parts: Sequence[str] = PARTS
) -> tuple[dict[str, Clocked], Row]:
    """Return everything that draws a scene here, of some `PARTS` of a step, and facts about the scene."""
    drawing = Drawing(scene, device, values=values)
    works: dict[str, Callable[[], Any]] = {part: getattr(drawing, part) for part in parts}
    found = {f"ours redraw, {name}": Clocked.on(device, work) for name, work in works.items()}
    facts: Row = {"pairs": drawing.rasterizer.pair_count(), "covered": digits((drawing.seen().alpha > OPAQUE).mean())}
    if device.is_cuda:
        found |= {f"ours graph, {name}": Clocked.on(device, captured(work, device)) for name, work in works.items()}
    peer, absent = peer_for(scene, values, device)
    if peer is None:
        facts["gsplat"] = f"absent: {absent}"
        return found, facts
    facts["gsplat"], facts["gsplat_pairs"] = peer.version, peer.pair_count()
    adjoints = random_adjoints(scene.camera.width * scene.camera.height, values.shape[1])
    theirs = {"forward": peer.forward, "training": peer.training(peer_adjoints(scene, adjoints))}
    inference = peer.inference() if values.shape[1] == 3 else None
    if inference is not None:
        theirs["inference, RGB alone"] = inference
    for name, work in theirs.items():
        work()
        found[f"gsplat, {name}"] = Clocked(work, peer.event, peer.seconds_between)
    return found, facts


def ratios_to_gsplat(measured: Mapping[str, Measured]) -> Row:
    """Return how many times faster than gsplat each way of ours is, by the host's clock."""
    found = {}
    for name, entry in measured.items():
        way, _, part = name.partition(", ")
        other = measured.get(f"gsplat, {part}")
        if other is not None and way != "gsplat":
            found[name] = digits(entry.times.faster_than(other.times))
    return found


def measure_peer(effort: Effort, device: Any) -> Row:
    """Time frames of 3 and of 11 channels beside gsplat, and compare images and gradients."""
    scene = figure(effort.gaussians, *effort.size)
    values = scene.values()
    found: Row = {"scene": describe(scene), "repeats": effort.repeats, "notes": PEER_NOTES, "cases": {}}
    for case, count in CASES.items():
        contenders, facts = contenders_for(scene, np.ascontiguousarray(values[:, :count]), device)
        measured = measure_in_turn(contenders, effort.repeats, device)
        rows = {name: entry.summary() for name, entry in measured.items()}
        if not facts["gsplat"].startswith("absent"):
            for name, entry in contenders.items():
                rows[name]["kernel_ms"] = digits(1e3 * kernel_seconds(entry.work, device.alias))
        found["cases"][case] = {**facts, "ms": rows, "faster_than_gsplat": ratios_to_gsplat(measured)}
    faint = replace(scene.cloud, opacities=0.1 * scene.cloud.opacities)
    found["agreement"] = compare_with_peer(scene, device)
    found["agreement_of_faint_splats"] = compare_with_peer(scene._replace(cloud=faint), device)
    return found


def compare_with_peer(scene: RasterScene, device: Any) -> Row | str:
    """Compare images and gradients of RGB and alpha with gsplat's."""
    values = np.ascontiguousarray(scene.values()[:, :3])
    peer, absent = peer_for(scene, values, device)
    if peer is None:
        return f"absent: {absent}"
    theirs = peer.draw()
    drawing = Drawing(scene, device, values=values)
    ours = drawing.seen()
    pixel_count = len(ours.alpha)
    colors, alpha, depth = theirs.values.reshape(-1, 3), theirs.alpha.reshape(-1), theirs.depth.reshape(-1)
    gap = np.abs(ours.channels[:, :3] - colors).max(axis=1)
    alpha_gap = np.abs(ours.alpha - alpha)
    opaque = (ours.alpha > OPAQUE) & (alpha > OPAQUE)
    found: Row = {
        "rgb_psnr_db": psnr(ours.channels[:, :3], colors),
        "rgb": gaps(gap),
        "alpha": gaps(alpha_gap),
        "depth_where_opaque_m": gaps((ours.depth - depth)[opaque]),
        "median_depth_against_their_mean_m": gaps((ours.median_depth - depth)[opaque]),
    }
    random = random_adjoints(pixel_count, 3)
    nowhere = np.zeros(pixel_count, np.float32)
    agreeing = (gap < FLIP) & (alpha_gap < FLIP) & (ours.alpha < BEFORE_STOP)
    for name, chosen in (("all_pixels", np.ones(pixel_count, bool)), ("agreeing_pixels_before_the_stop", agreeing)):
        adjoints = Seen(random.channels * chosen[:, None], random.alpha * chosen, nowhere, nowhere)
        drawing.set_adjoints(adjoints)
        own, other = drawing.gradients(), peer.gradients(peer_adjoints(scene, adjoints))
        expected = {
            "positions": other["means"],
            "orientations": other["quats"][:, [1, 2, 3, 0]],
            "scales": other["scales"],
            "opacities": other["opacities"],
            "values": other["colors"],
        }
        found[f"gradients_relative_l2_{name}"] = {
            "pixels": int(chosen.sum()),
            **{part: relative_l2(own[part], array) for part, array in expected.items()},
        }
    return found


def all_channels(scene: RasterScene) -> Row:
    """Return what makes a `Drawing` composite all that an asset has: captured colour of degree 3, normals of geometry,
    and base colour, roughness, ambient occlusion and normals, 14 channels.
    """
    rng = np.random.default_rng(7)
    radiance = 0.05 * rng.standard_normal((len(scene.cloud), 16, 3), dtype=np.float32)
    radiance[:, :1] = scene.cloud.radiance
    return {"values": np.ascontiguousarray(scene.values()[:, 3:]), "radiance": radiance, "normals": True}


def measure_frames(effort: Effort, device: Any) -> Row:
    """Time a frame of all channels forwards and backwards, with both depths."""
    scene = figure(effort.gaussians, *effort.size)
    contenders = {}
    for depth in ("plane", "exact"):
        drawing = Drawing(scene, device, **all_channels(scene), options=RasterOptions(depth=depth))
        for name, work in (("forward", drawing.forward), ("backward", drawing.backward)):
            contenders[f"{depth}, {name}"] = Clocked.on(device, captured(work, device) if device.is_cuda else work)
    measured = measure_in_turn(contenders, effort.repeats, device, two_threads=True)
    return {
        "scene": describe(scene),
        "channels": drawing.channel_count,
        "repeats": effort.repeats,
        "ms": {name: entry.summary() for name, entry in measured.items()},
    }


def measure_all_stages(effort: Effort, device: Any) -> Row:
    """Time the stages of a frame: on CUDA of few channels and of many; on the CPU of many, by one thread and two."""
    scene, dense = figure(effort.gaussians, *effort.size), cube(effort.gaussians, *effort.size)
    few = {
        case: lambda count=count: Drawing(scene, device, values=np.ascontiguousarray(scene.values()[:, :count]))
        for case, count in CASES.items()
    }
    makers: dict[str, Callable[[], Drawing]] = {
        **(few if device.is_cuda else {}),
        "14 channels and depth": lambda: Drawing(scene, device, **all_channels(scene)),
        "cube, 11 channels and depth": lambda: Drawing(dense, device),
    }
    found: Row = {"scene": describe(scene), "repeats": effort.stage_repeats}
    for case, make in makers.items():
        if device.is_cuda:
            found[case] = measure_stages(make, effort.stage_repeats, device)
            continue
        for threads in (1, 2):
            with launch_threads(threads):
                found[f"{case}, {threads} threads"] = measure_stages(make, effort.stage_repeats, device)
    return found


VARIANTS: dict[str, Row] = {
    "plane": {},
    "exact": {"options": RasterOptions(depth="exact")},
    "antialiased": {"options": RasterOptions(antialiased=True)},
    "readable": {"readable": True},
    "readable exact": {"readable": True, "options": RasterOptions(depth="exact")},
}
"""Ways to draw 11 channels; the first is the usual one."""

TWINS = (("plane", "readable"), ("exact", "readable exact"))


def measure_variants(effort: Effort, device: Any) -> Row:
    """Time variants of a frame, and compare each with float64 at some pixels, on thin splats and on thick ones."""
    found: Row = {"repeats": effort.slow_repeats}
    for make in (figure, cube):
        scene = make(effort.gaussians, *effort.size)
        drawings = {name: Drawing(scene, device, **arguments) for name, arguments in VARIANTS.items()}
        tasks = {name: Clocked.on(device, drawing.forward) for name, drawing in drawings.items()}
        measured = measure_in_turn(tasks, effort.slow_repeats, device)
        seen = {name: drawing.seen() for name, drawing in drawings.items()}
        pixels = sampled_pixels(seen["plane"], effort.truth_pixels)
        truths = {
            antialiased: brute_force(scene.cloud, scene.camera, scene.values(), pixels, antialiased)
            for antialiased in (False, True)
        }
        usual = measured["plane"].times
        rows: Row = {}
        for name, entry in measured.items():
            options = VARIANTS[name].get("options", RasterOptions())
            rows[name] = {
                **entry.summary(),
                "times_as_long_as_plane": digits(usual.faster_than(entry.times)),
                "errors": errors(seen[name], pixels, truths[options.antialiased], options.depth),
            }
        for fast, readable in TWINS:
            rows[readable]["bit_equal_to_fast"] = {
                name: bool(np.array_equal(*(getattr(seen[which], name) for which in (fast, readable))))
                for name in Seen._fields
            }
            rows[readable]["largest_difference_to_fast"] = differences(seen[fast], seen[readable])
            rows[readable]["fast_is_faster"] = digits(measured[fast].times.faster_than(measured[readable].times))
        found[scene.name] = {"scene": describe(scene), "truth_pixels": len(pixels), "variants": rows}
    return found


def measure_sizes(effort: Effort, device: Any) -> Row:
    """Time frames of RGB and depth over the number of Gaussians, forwards and backwards, each as one CUDA graph."""
    rows: list[Row] = []
    for count in (n for n in SIZES if n <= MOST_TIMES * effort.gaussians):
        scene = figure(count, *effort.size)
        say(f"sizes: {count:,} Gaussians")
        drawing = Drawing(scene, device, values=scene.values()[:, :3])
        works = {"forward": drawing.forward, "backward": drawing.backward}
        tasks = {name: Clocked.on(device, captured(work, device)) for name, work in works.items()}
        measured = measure_in_turn(tasks, effort.repeats, device)
        times = {name: entry.summary() for name, entry in measured.items()}
        rows.append({"scene": describe(scene), "pairs": drawing.rasterizer.pair_count(), **times})
    return {"repeats": effort.repeats, "rows": rows}


def measure_checkpoints(effort: Effort, device: Any) -> Row:
    """Time the way back with and without checkpoints, from small images to large ones, and compare the gradients."""
    rows: list[Row] = []
    for side in effort.sizes[:-1]:
        for make in (figure, cube):
            scene = make(effort.gaussians, *side)
            values = np.ascontiguousarray(scene.values()[:, :6])
            drawings = {kept: Drawing(scene, device, values=values, checkpoints=kept) for kept in (False, True)}
            found = {kept: drawing.gradients() for kept, drawing in drawings.items()}
            parts = {
                f"{name} {kept}": Clocked.on(device, captured(getattr(drawing, name), device))
                for kept, drawing in drawings.items()
                for name in ("forward", "backward")
            }
            measured = measure_in_turn(parts, effort.repeats, device)
            entry: Row = {"scene": describe(scene), "pairs": drawings[True].rasterizer.pair_count()}
            for name in ("forward", "backward"):
                ways = {"whole": measured[f"{name} False"], "shared": measured[f"{name} True"]}
                entry[name] = {way: timed.summary() for way, timed in ways.items()}
            entry["gradients"] = {
                name: relative_l2(np.asarray(found[True][name]), np.asarray(found[False][name])) for name in found[True]
            }
            rows.append(entry)
    return {"channels": values.shape[1], "rows": rows}


def sampled_pixels(seen: Seen, count: int) -> NDArray[np.int64]:
    """Return some pixels that see something, half of them where the coverage is partial, as at silhouettes."""
    even = np.flatnonzero(seen.alpha > 1e-3)
    partly = np.flatnonzero((seen.alpha > 1e-3) & (seen.alpha < 0.99))
    pick = lambda rows: rows[np.linspace(0, len(rows) - 1, min(count // 2, len(rows))).astype(np.int64)]  # noqa: E731
    return np.union1d(pick(even), pick(partly))


def errors(seen: Seen, pixels: NDArray[np.int64], truth: Truth, depth: str) -> Row:
    """Return differences to float64: rounding, and for depth also the model's to the largest response on the ray."""
    opaque = truth.alpha > OPAQUE
    found: Row = {
        "channels": gaps(np.abs(seen.channels[pixels] - truth.values).max(axis=1)),
        "alpha": gaps(seen.alpha[pixels] - truth.alpha),
    }
    kinds = {"own_model": depth, "largest_response": "exact"}
    for against, kind in kinds.items():
        for name in ("depth", "median_depth"):
            gap = getattr(seen, name)[pixels] - getattr(truth, name)[kind]
            found[f"{name}_to_{against}_m"] = gaps(gap[opaque])
    return found


def measure_growth(effort: Effort, device: Any) -> Row:
    """Time 11 channels and depth over the number of Gaussians, and over that of pixels."""
    found: Row = {"gaussians": [], "pixels": [], "repeats": effort.growth_repeats}
    for series, scene in growth(effort.counts, effort.sizes, count=effort.gaussians, size=effort.size):
        say(f"growth: {len(scene.cloud):,} Gaussians, {scene.camera.width} x {scene.camera.height}")
        contenders, facts = contenders_for(scene, scene.values(), device, ("forward", "training"))
        measured = measure_in_turn(contenders, effort.growth_repeats, device, two_threads=True)
        found[series].append(
            {
                **describe(scene),
                **facts,
                "ms": {name: entry.summary() for name, entry in measured.items()},
                "faster_than_gsplat": ratios_to_gsplat(measured),
            }
        )
    return found


def measure_accuracy(effort: Effort, device: Any) -> Row:
    """Compare runs with each other, one CPU thread with two, and CPU with CUDA."""
    found: Row = {}
    for make in (figure, cube):
        scene = make(effort.gaussians, *effort.size)
        first, again = (Drawing(scene, device) for _ in range(2))
        one, two = first.seen(), again.seen()
        here = first.gradients()
        row: Row = {
            "scene": describe(scene),
            "two_runs_bit_equal": {
                "images": all(map(np.array_equal, one, two)),
                "gradients": all(map(np.array_equal, here.values(), again.gradients().values())),
            },
        }
        if device.is_cpu:
            row["one_and_two_threads_bit_equal"] = threads_agree(scene, device)
        row["cpu_against_cuda"] = compare_devices(scene, one, first) if device.is_cuda else "absent: no CUDA device"
        found[scene.name] = row
    return found


def threads_agree(scene: RasterScene, device: Any) -> Row:
    """Return whether one CPU thread and two give the same bits."""
    images, gradients = [], []
    for threads in (1, 2):
        with launch_threads(threads):
            drawing = Drawing(scene, device)
            images.append(drawing.seen())
            gradients.append(drawing.gradients().values())
    return {"images": all(map(np.array_equal, *images)), "gradients": all(map(np.array_equal, *gradients))}


def compare_devices(scene: RasterScene, there: Seen, drawing: Drawing) -> Row:
    """Compare the CPU with a drawing on CUDA: images, and gradients of all pixels and of those without a flip."""
    other = Drawing(scene, resolve_device("cpu"))
    here = other.seen()
    flipped = np.zeros(len(here.alpha), bool)
    found: Row = {}
    for name in Seen._fields:
        gap = np.abs(getattr(here, name).astype(np.float64) - getattr(there, name))
        if name == "channels":
            gap = gap.max(axis=1)
        rows = gap > FLIP
        found[name] = {**gaps(gap), "largest_without_flips": digits(gap[~rows].max(initial=0.0))}
        flipped |= rows
    found["flipped_pixels"] = int(flipped.sum())
    found["pixels"] = len(flipped)
    found["last_gaussian_differs"] = int(
        (other.rasterizer.gaussian_ids.numpy() != drawing.rasterizer.gaussian_ids.numpy()).sum()
    )
    random = random_adjoints(len(flipped), drawing.channel_count)
    kept = ~flipped
    for name, chosen in (("all_pixels", np.ones(len(kept), bool)), ("pixels_without_flips", kept)):
        adjoints = Seen(*(array * (chosen[:, None] if array.ndim == 2 else chosen) for array in random))
        for each in (other, drawing):
            each.set_adjoints(adjoints)
        ours, theirs = drawing.gradients(), other.gradients()
        found[f"gradients_relative_l2_{name}"] = {part: relative_l2(ours[part], theirs[part]) for part in ours}
    return found


def gaps(gap: NDArray[Any]) -> Row:
    """Return median, 99 % and largest of absolute differences, and how many are beyond rounding."""
    gap = np.abs(np.asarray(gap, np.float64))
    if not len(gap):
        return {"compared": 0}
    return {
        "median": digits(np.median(gap)),
        "p99": digits(np.quantile(gap, 0.99)),
        "largest": digits(gap.max()),
        "beyond_2e-6": int((gap > ROUNDING).sum()),
        "beyond_1e-4": int((gap > FLIP).sum()),
        "compared": len(gap),
    }


def differences(first: Seen, second: Seen) -> Row:
    """Return the largest absolute difference of each image."""
    return {
        name: digits(np.abs(a.astype(np.float64) - b).max())
        for name, a, b in zip(Seen._fields, first, second, strict=True)
    }


def psnr(first: NDArray[Any], second: NDArray[Any]) -> float:
    """Return the peak signal-to-noise ratio of colours in [0, 1] [dB]."""
    return digits(-10.0 * np.log10(max(float(((first.astype(np.float64) - second) ** 2).mean()), 1e-30)))


def relative_l2(found: NDArray[Any], expected: NDArray[Any]) -> float:
    """Return the length of the difference over the expected length."""
    expected = expected.astype(np.float64)
    return digits(np.linalg.norm(found - expected) / max(float(np.linalg.norm(expected)), 1e-300))


def describe(scene: RasterScene) -> Row:
    """Return a scene's name and sizes."""
    camera = scene.camera
    return {"name": scene.name, "splats": len(scene.cloud), "width": camera.width, "height": camera.height}


def sections(effort: Effort, device: Any) -> dict[str, Callable[[Any], Iterator[Row]]]:
    """Return what is measured on a device, by name."""
    found: dict[str, Callable[[Effort, Any], Row]] = {
        "frames": measure_frames,
        "stages": measure_all_stages,
        "variants": measure_variants,
        "accuracy": measure_accuracy,
        "growth": measure_growth,
    }
    if device.is_cuda:
        found = {"peer": measure_peer, **found, "sizes": measure_sizes, "checkpoints": measure_checkpoints}
    return {name: once(partial(section, effort)) for name, section in found.items()}


def main() -> int:
    parser = record.parser(__doc__, device=True, quick="small scenes and few repeats: does all of it run?")
    parser.add_argument("--only", nargs="+", default=(), metavar="SECTION", help="measure these sections only")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    effort = QUICK if arguments.quick else ON_CUDA if device.is_cuda else ON_CPU
    known = sections(effort, device)
    if unknown := set(arguments.only) - set(known):
        parser.error(f"--only must name sections of {', '.join(known)}, got {unknown}")
    return measure_all(known, device, arguments, device, arguments.only)


if __name__ == "__main__":
    sys.exit(main())
