"""The tracer's speed, and its error beside it: against a plain wp.Bvh loop and against Embree.

    python benchmarks/tracing.py [--device cuda:0] [--out DIR] [--quick]

The scene is a torus tiled with flat Gaussians, the rays are cosine-distributed from its surface. On the CPU one thread
is timed by process CPU time and two by wall-clock time; a GPU by wall-clock time around synchronised calls. Contenders
take turns, and ratios are medians of ratios within a turn, so that a busy machine disturbs them least. Errors are
against a float64 brute force on some of the same rays. Embree needs ``pip install embreex`` and gcc; without them the
report says so. Writes ``tracing_<device>.json`` and ``.png`` into DIR, and the tables to the terminal.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import record
import warp as wp
from numpy.typing import NDArray
from timing import Task, Times, machine, rates, take_turns
from tracing_baselines import (
    BUILD_QUALITIES,
    EmbreeScene,
    EmbreeUnavailableError,
    PackedGaussians,
    PlainBvh,
    pack_gaussians,
)
from tracing_scenes import Rays, brute_force_visibility, bumpy_torus, camera_rays, cosine_rays

from beam_warp import GaussianCloud, Scene, visibility
from beam_warp.device.arrays import resolve_device
from beam_warp.trace.first_surface import closest_surface
from beam_warp.trace.transmittance import ACCEPTANCES, TraceOptions

SCENE_BUILDS: dict[str, dict[str, Any]] = {"wide": {}, "wide fast": {"build": "fast"}}
"""Scenes that are compared, as arguments of `Scene.from_gaussians`; the first is what users get."""

MOVES = ("refit", "fast", "quality")
"""Ways of `Scene.move` that are timed."""

FROM_HOST = "Scene.from_gaussians "
PLAIN = "plain wp.Bvh"
EMBREE = "Embree 4"

BRUTE_FORCE_PAIRS = 2e8
"""Pairs of ray and Gaussian that the float64 truth of a growth row may cost: a few seconds."""


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        gaussians: Of every measurement but the growth rows.
        points: Surface points of the main table's rays, 50 a point.
        repeats: Rounds of the main table.
        truth_rays: Rays compared with float64.
        counts: Gaussians of the growth rows.
        overlaps: Of the growth rows, at ``sweep_count`` Gaussians.
        opacities: Of the growth rows, at ``sweep_count`` Gaussians.
        sweep_count: See above.
        growth_rays: Rays of a growth row.
        growth_repeats: Rounds of a growth row.
        image: Width and height of the camera rays.
        parity_rays: Rays that the CPU and CUDA trace without a stop.
    """

    gaussians: int = 140_000
    points: int = 4_000
    repeats: int = 7
    truth_rays: int = 1_000
    counts: tuple[int, ...] = (10_000, 40_000, 140_000, 600_000)
    overlaps: tuple[float, ...] = (0.5, 1.0, 2.0)
    opacities: tuple[float, ...] = (0.9, 0.5, 0.2)
    sweep_count: int = 140_000
    growth_rays: int = 20_000
    growth_repeats: int = 7
    image: tuple[int, int] = (256, 256)
    parity_rays: int = 200_000


ON_CPU = Effort()
ON_CUDA = Effort(
    points=140_000,
    repeats=20,
    counts=(10_000, 40_000, 140_000, 600_000, 2_000_000, 4_000_000),
    growth_rays=4_000_000,
    growth_repeats=9,
    image=(1920, 1080),
)
QUICK = Effort(
    points=800,
    repeats=5,
    truth_rays=300,
    counts=(10_000, 40_000, 140_000),
    sweep_count=40_000,
    growth_rays=8_000,
    growth_repeats=3,
    image=(96, 96),
    parity_rays=50_000,
)


@dataclass
class Contender:
    """One way to trace.

    Attributes:
        task: Traces all rays and keeps the result in ``found``.
        exact: Whether V is the product; else one Bernoulli sample of it a ray.
        baseline: Whether it is a form of the plain ``wp.Bvh`` loop.
        found: The last result.
    """

    task: Task
    exact: bool = True
    baseline: bool = False
    found: list[Any] = field(default_factory=list)

    @classmethod
    def of(cls, trace: Callable[[], Any], *, threaded: bool = True, **flags: bool) -> Contender:
        """Wrap a function that returns the transmittances."""
        contender = cls(Task(lambda: contender.found.__setitem__(slice(None), [trace()]), threaded), **flags)
        return contender

    def transmittances(self) -> NDArray[np.float64]:
        """Return the last result as NumPy float64."""
        (values,) = self.found
        return np.asarray(values.numpy() if isinstance(values, wp.array) else values, dtype=np.float64)


def contenders_for(
    cloud: GaussianCloud, rays: Rays, device: Any, closing: ExitStack, *, acceptances: Iterable[str] = ACCEPTANCES
) -> tuple[dict[str, Contender], dict[str, str]]:
    """Return everything that can trace the cloud here, by name, and why others cannot."""
    origins, directions = (wp.array(array, dtype=wp.vec3, device=device) for array in rays)
    found: dict[str, Contender] = {}
    for name, build in SCENE_BUILDS.items():
        scene = Scene.from_gaussians(cloud, str(device), **build)
        for acceptance in acceptances:
            options = TraceOptions(acceptance=acceptance)
            found[f"{name} {acceptance}"] = Contender.of(
                lambda scene=scene, options=options: visibility(scene, origins, directions, options=options),
                exact=acceptance == "product",
            )
    packed = pack_gaussians(cloud)
    for constructor in ("sah", "lbvh") if device.is_cuda else ("sah",):
        plain = PlainBvh(packed, device, constructor)
        found[f"{PLAIN} {constructor}"] = Contender.of(
            lambda plain=plain: plain.visibility(origins, directions), baseline=True
        )
    if device.is_cuda:
        return found, {EMBREE: "it runs on the CPU only"}
    try:
        embree = closing.enter_context(EmbreeScene(packed))
    except EmbreeUnavailableError as error:
        return found, {EMBREE: str(error)}
    found[EMBREE] = Contender.of(lambda: embree.visibility(*rays), threaded=False)
    return found, {}


def ratios(name: str, times: dict[str, Times], contenders: dict[str, Contender]) -> dict[str, float]:
    """Return how many times faster than the fastest form of ``wp.Bvh`` and than Embree."""
    over_bvh = [times[name].faster_than(times[other]) for other, entry in contenders.items() if entry.baseline]
    found = {"over_wp_bvh": min(over_bvh)}
    if EMBREE in times:
        found["over_embree"] = times[name].faster_than(times[EMBREE])
    return found


class Truth(NamedTuple):
    """Float64 transmittances of some rays: the rows ``(M,)`` and their values ``(M,)``."""

    rows: NDArray[np.int64]
    values: NDArray[np.float64]


def truth_for(cloud: GaussianCloud, rays: Rays, found: NDArray[np.float64], count: int) -> Truth:
    """Compute the truth for up to ``count`` rays: half evenly spread, half of those that are partly occluded.

    Of cosine rays on closed surfaces 99.5 % are open or blocked, where errors are 0 or that of the stop; ``found``,
    transmittances of all rays, tells the others.
    """
    even = np.linspace(0, len(found) - 1, -(-count // 2)).astype(np.int64)
    partial = np.flatnonzero((found > 1e-3) & (found < 1.0))
    partial = partial[np.linspace(0, len(partial) - 1, min(count // 2, len(partial))).astype(np.int64)]
    rows = np.union1d(even, partial)
    return Truth(rows, brute_force_visibility(cloud, Rays(rays.origins[rows], rays.directions[rows])))


def errors(values: NDArray[np.float64], truth: Truth) -> dict[str, float]:
    """Return the largest and the 99 % absolute difference, and the largest where the stop has no part in it."""
    gap = np.abs(values[truth.rows] - truth.values)
    return {
        "largest_error": float(gap.max()),
        "p99_error": float(np.quantile(gap, 0.99)),
        "largest_error_above_1e-3": float(gap[truth.values > 1e-3].max(initial=0.0)),
    }


def measure_torus(effort: Effort, device: Any) -> dict[str, Any]:
    """Time every contender on one scene, and compare each with float64."""
    cloud, spacing = bumpy_torus(effort.gaussians)
    rays = cosine_rays(cloud, effort.points)
    ray_count = len(rays.origins)
    with ExitStack() as closing:
        contenders, absent = contenders_for(cloud, rays, device, closing)
        tasks = {name: entry.task for name, entry in contenders.items()}
        times = take_turns(tasks, effort.repeats, device, two_threads=True)
        product = contenders["wide product"].transmittances()
        truth = truth_for(cloud, rays, product, effort.truth_rays)
        table: dict[str, Any] = {}
        for name, entry in contenders.items():
            values, seconds = entry.transmittances(), times[name]
            row: dict[str, Any] = {"mray_per_second": rates(seconds.alone, ray_count)}
            if seconds.two_threads is not None:
                row["mray_per_second_two_threads"] = rates(seconds.two_threads, ray_count)
                row["thread_gain"] = seconds.thread_gain()
            row |= ratios(name, times, contenders)
            row["mean_visibility"] = float(values.mean())
            if entry.exact:
                row |= errors(values, truth)
            else:
                # Rays are sampled independently, each with variance V (1 - V) around the product.
                spread = math.sqrt(float((product * (1.0 - product)).sum())) / ray_count
                row["standard_errors_from_product"] = float((values.mean() - product.mean()) / spread)
            table[name] = row
    return {
        "gaussians": len(cloud),
        "spacing": spacing,
        "rays": ray_count,
        "truth_rays": len(truth.rows),
        "repeats": effort.repeats,
        "clock": "wall" if device.is_cuda else "process CPU time of one thread",
        "contenders": table,
        "absent": absent,
    }


def scene_tasks(cloud: GaussianCloud, device: Any) -> Iterator[tuple[str, Task]]:
    """Yield the building of each of `SCENE_BUILDS`, from arrays in host memory to a scene that can be traced."""
    for name, build in SCENE_BUILDS.items():
        yield name, Task(lambda b=build: Scene.from_gaussians(cloud, str(device), **b))


def build_tasks(cloud: GaussianCloud, packed: PackedGaussians, device: Any) -> Iterator[tuple[str, Task]]:
    """Yield every way to build or to update what rays traverse; a new one is one more entry here."""
    for name, task in scene_tasks(cloud, device):
        yield FROM_HOST + name, task
    placed = [
        wp.array(array, dtype=dtype, device=device)
        for array, dtype in ((cloud.positions, wp.vec3), (cloud.orientations, wp.quat), (cloud.scales, wp.vec3))
    ]
    for way in MOVES:
        scene = Scene.from_gaussians(cloud, str(device))
        yield f"Scene.move wide {way}", Task(lambda s=scene, w=way: s.move(*placed, tree=w))
    lowers, uppers = (
        wp.array(np.ascontiguousarray(part), dtype=wp.vec3, device=device)
        for part in (packed.boxes[:, :3], packed.boxes[:, 3:])
    )
    constructors = ("sah", "median", "cubql", "lbvh") if device.is_cuda else ("sah", "median", "cubql")
    for name in constructors:
        yield f"wp.Bvh {name}, boxes given", Task(lambda c=name: wp.Bvh(lowers, uppers, constructor=c, leaf_size=1))
    bvh = wp.Bvh(lowers, uppers, constructor="lbvh" if device.is_cuda else "sah", leaf_size=1)
    yield "wp.Bvh refit", Task(bvh.refit)
    if device.is_cuda:
        return
    for quality in BUILD_QUALITIES:
        yield f"{EMBREE} {quality}", Task(lambda q=quality: EmbreeScene(packed, q).close(), threaded=False)


def measure_builds(effort: Effort, device: Any) -> dict[str, Any]:
    """Time builds and refits, and count what scenes hold."""
    cloud, _ = bumpy_torus(effort.gaussians)
    packed = pack_gaussians(cloud)
    tasks = dict(build_tasks(cloud, packed, device))
    absent = {}
    for name in [name for name in tasks if name.startswith(EMBREE)]:
        try:
            tasks[name].run()
        except EmbreeUnavailableError as error:
            absent[name] = str(error)
            del tasks[name]
    times = take_turns(tasks, effort.growth_repeats, device)
    held = scene_bytes(cloud, device)
    return {
        "gaussians": len(cloud),
        "milliseconds": {
            name: {
                "median": 1e3 * float(np.median(entry.alone)),
                "lowest": 1e3 * float(entry.alone.min()),
                "highest": 1e3 * float(entry.alone.max()),
            }
            for name, entry in times.items()
        },
        "bytes_per_gaussian": {name: value / len(cloud) for name, value in held.items()},
        "absent": absent,
    }


def scene_bytes(cloud: GaussianCloud, device: Any) -> dict[str, int]:
    """Return what each of `SCENE_BUILDS` keeps on the device."""
    return {
        name: allocated_bytes(Scene.from_gaussians(cloud, str(device), **build)) for name, build in SCENE_BUILDS.items()
    }


def allocated_bytes(*roots: Any) -> int:
    """Return the bytes of every array that objects hold at any depth, each once."""
    total, pending, seen = 0, list(roots), set()
    while pending:
        value = pending.pop()
        key = (wp.array, value.ptr) if isinstance(value, wp.array) else id(value)
        if key in seen:
            continue
        seen.add(key)
        if isinstance(value, wp.array):
            total += value.capacity
        elif isinstance(value, (list, tuple)):
            pending += value
        elif isinstance(value, dict):
            pending += value.values()
        elif type(value).__module__.startswith(("beam_warp", "warp._src.codegen")) and hasattr(value, "__dict__"):
            pending += [part for name, part in vars(value).items() if name != "_ctype"]
    return total


@dataclass(frozen=True)
class GrowthCase:
    """One row of the growth table: what is traced."""

    gaussians: int
    overlap: float
    opacity: float
    cloud: GaussianCloud
    rays: Rays

    @classmethod
    def make(cls, effort: Effort, gaussians: int, overlap: float, opacity: float) -> GrowthCase:
        """Make the scene and as many rays as for every other."""
        cloud, _ = bumpy_torus(gaussians, overlap=overlap, opacity=opacity)
        points = min(gaussians, max(1, effort.growth_rays // 50))
        rays = cosine_rays(cloud, points, max(1, effort.growth_rays // points))
        return cls(gaussians, overlap, opacity, cloud, rays)


def measure_growth(effort: Effort, device: Any, say: Callable[[str], None]) -> list[dict[str, Any]]:
    """Time the product, its build and its memory over counts, overlaps and opacities.

    All rows take turns with each other. Times are the least of the repeats: the one that was disturbed least.
    """
    settings = [(count, 1.0, 0.9) for count in effort.counts]
    settings += [(effort.sweep_count, overlap, 0.9) for overlap in effort.overlaps]
    settings += [(effort.sweep_count, 1.0, opacity) for opacity in effort.opacities]
    found: list[dict[str, Any]] = []
    with ExitStack() as closing:
        cases: list[tuple[GrowthCase, dict[str, Contender]]] = []
        for setting in dict.fromkeys(settings):
            say("growth: {:,} Gaussians, overlap {:g}, opacity {:g}".format(*setting))
            case = GrowthCase.make(effort, *setting)
            contenders, _ = contenders_for(case.cloud, case.rays, device, closing, acceptances=("product",))
            cases.append((case, contenders))
        say("growth: timing")
        times = take_turns(
            {(row, name): entry.task for row, (_, entries) in enumerate(cases) for name, entry in entries.items()},
            effort.growth_repeats,
            device,
        )
        build_times = take_turns(
            {
                (row, name): task
                for row, (case, _) in enumerate(cases)
                for name, task in scene_tasks(case.cloud, device)
            },
            max(1, effort.growth_repeats // 3),
            device,
        )
        for row, (case, contenders) in enumerate(cases):
            own = {name: times[row, name] for name in contenders}
            product = contenders["wide product"].transmittances()
            truth_rays = min(effort.truth_rays, max(2, int(BRUTE_FORCE_PAIRS / case.gaussians)))
            truth = truth_for(case.cloud, case.rays, product, truth_rays)
            traced = {
                name: {
                    "nanoseconds_per_ray": 1e9 * float(own[name].alone.min()) / len(case.rays.origins),
                    **ratios(name, own, contenders),
                    **errors(entry.transmittances(), truth),
                }
                for name, entry in contenders.items()
            }
            scenes = {
                name: {
                    "build_seconds": float(build_times[row, name].alone.min()),
                    "bytes_per_gaussian": held / case.gaussians,
                }
                for name, held in scene_bytes(case.cloud, device).items()
            }
            found.append(
                {
                    "gaussians": case.gaussians,
                    "overlap": case.overlap,
                    "opacity": case.opacity,
                    "rays": len(case.rays.origins),
                    "truth_rays": len(truth.rows),
                    "mean_visibility": float(product.mean()),
                    "contenders": traced,
                    "scenes": scenes,
                }
            )
    return found


def measure_closest_surface(effort: Effort, device: Any) -> dict[str, Any]:
    """Time sorted rays from a camera through `beam_warp.trace.closest_surface`."""
    cloud, _ = bumpy_torus(effort.gaussians)
    rays = camera_rays(cloud, *effort.image)
    origins, directions = (wp.array(array, dtype=wp.vec3, device=device) for array in rays)
    scenes = {name: Scene.from_gaussians(cloud, str(device), **build) for name, build in SCENE_BUILDS.items()}
    tasks = {
        name: Task(lambda scene=scene: closest_surface(scene, origins, directions)) for name, scene in scenes.items()
    }
    times = take_turns(tasks, effort.growth_repeats, device)
    return {
        "rays": len(rays.origins),
        "covered": float((visibility(scenes["wide"], *rays) < 0.5).mean()),
        "mray_per_second": {name: rates(entry.alone, len(rays.origins)) for name, entry in times.items()},
    }


def measure_parity(effort: Effort) -> dict[str, Any] | None:
    """Compare CPU and CUDA without the early stop; None where there is no CUDA device.

    A Gaussian whose alpha is within rounding of the cut 1/255 may count on one device only, which moves V by up to
    1/255: ``rays_beyond_1e-5`` tells such rays from a rounding that all share.
    """
    if not wp.is_cuda_available():
        return None
    cloud, _ = bumpy_torus(effort.gaussians)
    rays = cosine_rays(cloud, max(1, effort.parity_rays // 50), seed=2)
    found: dict[str, Any] = {"rays": len(rays.origins)}
    for name, build in SCENE_BUILDS.items():
        here, there = (
            visibility(Scene.from_gaussians(cloud, device, **build), *rays, options=TraceOptions(stop=0.0))
            for device in ("cpu", "cuda:0")
        )
        gap = np.abs(here.astype(np.float64) - there)
        found[name] = {
            "largest": float(gap.max()),
            "p99.9": float(np.quantile(gap, 0.999)),
            "rays_beyond_1e-5": int((gap > 1e-5).sum()),
        }
    return found


def goals(result: dict[str, Any], device: Any) -> list[dict[str, Any]]:
    """Return what was to be reached beside what was."""
    table = result["torus"]["contenders"]
    exact, sampled = table["wide product"], table["wide bernoulli"]
    rows: list[tuple[str, float | None, str, float]] = [
        ("exact over wp.Bvh", exact["over_wp_bvh"], ">=", 2.0),
        ("largest error of V against float64, stop 1e-4", exact["largest_error"], "<=", 2e-4),
    ]
    if device.is_cuda:
        rebuild = result["builds"]["milliseconds"]["Scene.move wide fast"]["median"]
        rows.append(("Bernoulli over wp.Bvh", sampled["over_wp_bvh"], ">=", 3.0))
        rows.append(("fast rebuild of arrays on the device [ms]", rebuild, "<=", 2.0))
    else:
        rows.append(("exact over Embree", exact.get("over_embree"), ">=", 0.8))
        rows.append(("two threads over one", exact["thread_gain"], ">=", 1.6))
    if result["parity"] is not None:
        rows.append(
            ("largest difference of V between CPU and CUDA, no stop", result["parity"]["wide"]["largest"], "<=", 1e-5)
        )
    if device.is_cuda:
        rate = result["closest_surface"]["mray_per_second"]["wide"]["median"]
        rows.append(("sorted Mray/s", rate, ">=", 40.0))
    return [
        {
            "goal": name,
            "measured": value,
            "wanted": f"{sign} {wanted:g}",
            "reached": None if value is None else (value >= wanted if sign == ">=" else value <= wanted),
        }
        for name, value, sign, wanted in rows
    ]


def markdown(result: dict[str, Any]) -> str:
    """Return the tables that a person reads first."""
    torus = result["torus"]
    lines = [
        f"{result['machine']['device']} ({result['machine']['processor']}), commit {result['commit']}: "
        f"{torus['gaussians']:,} Gaussians, {torus['rays']:,} rays, {torus['clock']}, median of {torus['repeats']}",
        "",
        "| | Mray/s (range) | × wp.Bvh | × Embree | 2 threads | mean V | largest error | where V > 1e-3 |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, row in torus["contenders"].items():
        rate = row["mray_per_second"]
        z = row.get("standard_errors_from_product")
        lines.append(
            f"| {name} | {rate['median']:.3g} ({rate['lowest']:.3g}–{rate['highest']:.3g}) | {row['over_wp_bvh']:.2f} "
            f"| {_cell(row.get('over_embree'), '.2f')} | {_cell(row.get('thread_gain'), '.2f', '× ')} "
            f"| {row['mean_visibility']:.5f} | {_cell(row.get('largest_error'), '.1e')}"
            f"{'' if z is None else f'{z:+.1f} s.e.'} | {_cell(row.get('largest_error_above_1e-3'), '.1e')} |"
        )
    lines += [f"\n{name} is absent: {why}." for name, why in torus["absent"].items()]
    builds = result["builds"]
    lines += ["", f"| build of {builds['gaussians']:,} | ms (range) | bytes a Gaussian |", "|---|---|---|"]
    for name, value in builds["milliseconds"].items():
        held = builds["bytes_per_gaussian"].get(name.removeprefix(FROM_HOST))
        lines.append(
            f"| {name} | {value['median']:.3g} ({value['lowest']:.3g}–{value['highest']:.3g}) | {_cell(held, '.0f')} |"
        )
    growth = result["growth"]
    names = list(growth[0]["contenders"])
    lines += ["", "| Gaussians, overlap, opacity | " + " | ".join(f"{name} [ns/ray]" for name in names) + " | mean V |"]
    lines.append("|---" * (len(names) + 2) + "|")
    for row in growth:
        cells = " | ".join(f"{row['contenders'][name]['nanoseconds_per_ray']:.3g}" for name in names)
        label = f"{row['gaussians']:,}, {row['overlap']:g}, {row['opacity']:g}"
        lines.append(f"| {label} | {cells} | {row['mean_visibility']:.4f} |")
    lines += ["", "| goal | wanted | measured | |", "|---|---|---|---|"]
    marks = {True: "reached", False: "missed", None: "not measured"}
    lines += [
        f"| {row['goal']} | {row['wanted']} | {_cell(row['measured'], '.3g')} | {marks[row['reached']]} |"
        for row in result["goals"]
    ]
    return "\n".join(lines) + "\n"


def _cell(value: float | None, form: str, before: str = "") -> str:
    """Return a number for a table, nothing for None."""
    return "" if value is None else f"{before}{value:{form}}"


def measure(effort: Effort, device: Any, say: Callable[[str], None]) -> dict[str, Any]:
    """Return everything that is measured, ready for JSON; ``say`` hears what is being done."""
    result: dict[str, Any] = {"machine": machine(device)}
    say("torus")
    result["torus"] = measure_torus(effort, device)
    say("builds")
    result["builds"] = measure_builds(effort, device)
    result["growth_sweep_gaussians"] = effort.sweep_count
    result["growth"] = measure_growth(effort, device, say)
    say("closest surface, CPU against CUDA")
    result["closest_surface"] = measure_closest_surface(effort, device)
    result["parity"] = measure_parity(effort)
    result["load_average_after"] = machine(device)["load_average"]
    result["goals"] = goals(result, device)
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    record.add_arguments(parser)
    parser.add_argument("--quick", action="store_true", help="fewer rays and repeats: a minute on two cores")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    effort = QUICK if arguments.quick else ON_CUDA if device.is_cuda else ON_CPU
    result = measure(effort, device, lambda text: print(text, file=sys.stderr, flush=True))
    record.write_result(arguments, device, result)
    print(markdown(result), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
