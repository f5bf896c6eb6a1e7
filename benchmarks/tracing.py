"""The tracer's speed, and its error beside it: against a loop over ``wp.Bvh`` and against Embree.

    python benchmarks/tracing.py --device cuda:0 --out benchmarks/results/tracing_h200.json [--quick]

The scene is a torus tiled with flat Gaussians, the rays are cosine-distributed from its surface. The CPU is timed by
the process CPU time of one thread, a GPU by wall-clock time around synchronised calls. Contenders take turns, and
ratios are taken within a turn, so that a busy machine disturbs them least. Errors are against a float64 brute force on
some of the same rays. Embree needs ``pip install embreex`` and gcc; without them the result says so.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import record
import warp as wp
from numpy.typing import NDArray
from parts import measure_all, once
from timing import Task, Times, spread, take_turns
from tracing_baselines import (
    BUILD_QUALITIES,
    EmbreeScene,
    EmbreeUnavailableError,
    PackedGaussians,
    PlainBvh,
    pack_gaussians,
)
from tracing_scenes import Rays, brute_force_visibility, bumpy_torus, camera_rays, cosine_rays, morton_codes

from beam_warp import GaussianCloud, Scene, visibility
from beam_warp.device.arrays import resolve_device
from beam_warp.trace.first_surface import closest_surface
from beam_warp.trace.transmittance import ACCEPTANCES, TraceOptions

SCENE_BUILDS: dict[str, dict[str, Any]] = {"wide": {}, "wide fast": {"build": "fast"}}
"""Scenes that are compared, as arguments of `Scene.from_gaussians`; the first is what users get."""

MOVES = ("refit", "fast", "quality")
"""Ways of `Scene.move` that are timed."""

EMBREE = "Embree 4"


class PlainForm(NamedTuple):
    """A form of the loop over ``wp.Bvh``.

    ``fast_math`` is Warp's option of the kernel, which ours has and which changes CUDA code only. ``sorted`` has the
    Gaussians along a Morton curve in memory, as the leaves of our trees nearly are.
    """

    constructor: str
    fast_math: bool = False
    sorted: bool = False

    @property
    def name(self) -> str:
        """Name of the contender."""
        extras = ", fast math" * self.fast_math + ", Morton order" * self.sorted
        return f"wp.Bvh {self.constructor}{extras}"


PLAIN_ON_CPU = (PlainForm("sah"), PlainForm("sah", sorted=True))
PLAIN_ON_CUDA = (
    *(PlainForm(constructor) for constructor in ("sah", "lbvh", "cubql")),
    PlainForm("sah", fast_math=True),
    PlainForm("sah", sorted=True),
    PlainForm("sah", fast_math=True, sorted=True),
    PlainForm("lbvh", fast_math=True, sorted=True),
)
STRONGEST_ON_CUDA = (PlainForm("sah", fast_math=True, sorted=True),)
"""What growth rows are compared with on CUDA, where the CPU builds every tree by surface area."""

BRUTE_FORCE_PAIRS = 5e7
"""Pairs of ray and Gaussian that the float64 truth of a growth row may cost: a second or so."""


@dataclass(frozen=True)
class Effort:
    """How much is measured.

    Attributes:
        gaussians: Of every measurement but the growth rows.
        points: Surface points of the main table's rays, 50 a point.
        repeats: Rounds of the main table.
        truth_rays: Rays compared with float64.
        seeds: Of Bernoulli acceptance, for its mean over the rays compared with float64.
        counts: Gaussians of the growth rows.
        overlaps: Of the growth rows, at ``gaussians``.
        opacities: Of the growth rows, at ``gaussians``.
        growth_rays: Rays of a growth row.
        growth_repeats: Rounds of a growth row.
        image: Width and height of the camera rays.
        parity_rays: Rays that the CPU and CUDA trace without a stop.
    """

    gaussians: int = 140_000
    points: int = 4_000
    repeats: int = 5
    truth_rays: int = 1_000
    seeds: int = 1_000
    counts: tuple[int, ...] = (10_000, 40_000, 140_000)
    overlaps: tuple[float, ...] = ()
    opacities: tuple[float, ...] = ()
    growth_rays: int = 20_000
    growth_repeats: int = 5
    image: tuple[int, int] = (160, 160)
    parity_rays: int = 200_000


ON_CPU = Effort()
ON_CUDA = Effort(
    points=100_000,
    repeats=15,
    counts=(10_000, 40_000, 140_000, 600_000, 2_000_000),
    overlaps=(0.5, 1.0, 2.0),
    opacities=(0.9, 0.5, 0.2),
    growth_rays=2_000_000,
    growth_repeats=9,
    image=(1920, 1080),
)
QUICK = Effort(
    gaussians=20_000,
    points=400,
    repeats=3,
    truth_rays=200,
    seeds=50,
    counts=(5_000, 20_000),
    overlaps=(0.5, 2.0),
    opacities=(0.9, 0.2),
    growth_rays=4_000,
    growth_repeats=3,
    image=(64, 64),
    parity_rays=20_000,
)


@dataclass
class Contender:
    """One way to trace.

    Attributes:
        task: Traces all rays and keeps the result in ``found``.
        exact: Whether V is the product; else one Bernoulli sample of it a ray.
        baseline: Whether it is a form of the loop over ``wp.Bvh``.
        found: The last result.
    """

    task: Task
    exact: bool = True
    baseline: bool = False
    found: list[Any] = field(default_factory=list)

    @classmethod
    def of(cls, trace: Callable[[], Any], **flags: bool) -> Contender:
        """Wrap a function that returns the transmittances."""
        contender = cls(Task(lambda: contender.found.__setitem__(slice(None), [trace()])), **flags)
        return contender

    def transmittances(self) -> NDArray[np.float64]:
        """Return the last result as NumPy float64."""
        (values,) = self.found
        return np.asarray(values.numpy() if isinstance(values, wp.array) else values, dtype=np.float64)


def contenders_for(
    cloud: GaussianCloud,
    rays: Rays,
    device: Any,
    closing: ExitStack,
    *,
    plain_forms: Iterable[PlainForm],
    acceptances: Iterable[str] = ACCEPTANCES,
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
    in_order = packed.sorted_by(np.argsort(morton_codes(packed.rows[:, 0, :3]), kind="stable"))
    for form in plain_forms:
        plain = PlainBvh(in_order if form.sorted else packed, device, form.constructor, fast_math=form.fast_math)
        found[form.name] = Contender.of(lambda plain=plain: plain.visibility(origins, directions), baseline=True)
    if device.is_cuda:
        return found, {EMBREE: "it runs on the CPU only"}
    try:
        embree = closing.enter_context(EmbreeScene(packed))
    except EmbreeUnavailableError as error:
        return found, {EMBREE: str(error)}
    found[EMBREE] = Contender.of(lambda: embree.visibility(*rays))
    return found, {}


def strongest_bvh(times: dict[str, Times], contenders: dict[str, Contender]) -> str:
    """Return the fastest form of the loop over ``wp.Bvh``, by its median."""
    return min((name for name in contenders if contenders[name].baseline), key=lambda n: np.median(times[n].alone))


def ratios(name: str, times: dict[str, Times], strongest: str) -> dict[str, dict[str, float]]:
    """Return how many times faster than the strongest loop over ``wp.Bvh`` and than Embree, within each turn."""
    found = {"over_wp_bvh": spread(times[strongest].alone / times[name].alone)}
    if EMBREE in times:
        found["over_embree"] = spread(times[EMBREE].alone / times[name].alone)
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
    partly = np.flatnonzero((found > 1e-3) & (found < 1.0))
    partly = partly[np.linspace(0, len(partly) - 1, min(count // 2, len(partly))).astype(np.int64)]
    rows = np.union1d(even, partly)
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
        plain = PLAIN_ON_CUDA if device.is_cuda else PLAIN_ON_CPU
        contenders, absent = contenders_for(cloud, rays, device, closing, plain_forms=plain)
        times = take_turns({name: entry.task for name, entry in contenders.items()}, effort.repeats, device)
        strongest = strongest_bvh(times, contenders)
        truth = truth_for(cloud, rays, contenders["wide product"].transmittances(), effort.truth_rays)
        table: dict[str, Any] = {}
        for name, entry in contenders.items():
            rates = spread(ray_count / times[name].alone / 1e6)
            table[name] = {"mray_per_second": rates, **ratios(name, times, strongest)}
            if entry.exact:
                table[name] |= errors(entry.transmittances(), truth)
    return {
        "gaussians": len(cloud),
        "spacing": spacing,
        "rays": ray_count,
        "truth_rays": len(truth.rows),
        "repeats": effort.repeats,
        "clock": "wall" if device.is_cuda else "process CPU time of one thread",
        "strongest_wp_bvh": strongest,
        "contenders": table,
        "absent": absent,
        "bernoulli": measure_bernoulli(effort.seeds, cloud, rays, truth, device),
    }


def measure_bernoulli(seeds: int, cloud: GaussianCloud, rays: Rays, truth: Truth, device: Any) -> dict[str, Any]:
    """Compare the mean of Bernoulli samples over rays with float64, for many seeds.

    Rays are sampled independently, each with variance V (1 - V) around the float64 V, so without bias the error of the
    mean over its standard error has mean 0 and deviation 1 over the seeds.
    """
    scene, options = Scene.from_gaussians(cloud, str(device)), TraceOptions(acceptance="bernoulli")
    some = [wp.array(array[truth.rows], dtype=wp.vec3, device=device) for array in rays]
    deviation = math.sqrt((truth.values * (1.0 - truth.values)).sum())
    drawn = [float(visibility(scene, *some, options=options, seed=seed).numpy().sum()) for seed in range(seeds)]
    z = (np.array(drawn) - truth.values.sum()) / deviation
    return {
        "rays": len(truth.rows),
        "seeds": seeds,
        "mean_z": float(z.mean()),
        "standard_error_of_mean_z": 1.0 / math.sqrt(seeds),
        "deviation_of_z": float(z.std()),
    }


def scene_tasks(cloud: GaussianCloud, device: Any) -> Iterator[tuple[str, Task]]:
    """Yield the building of each of `SCENE_BUILDS`, from arrays in host memory to a scene that can be traced."""
    for name, build in SCENE_BUILDS.items():
        yield name, Task(lambda b=build: Scene.from_gaussians(cloud, str(device), **b))


def build_tasks(cloud: GaussianCloud, packed: PackedGaussians, device: Any) -> Iterator[tuple[str, Task]]:
    """Yield every way to build or to update what rays traverse; a new one is one more entry here."""
    for name, task in scene_tasks(cloud, device):
        yield f"Scene.from_gaussians {name}", task
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
    for name in ("sah", "cubql", "lbvh") if device.is_cuda else ("sah", "cubql"):
        yield f"wp.Bvh {name}, boxes given", Task(lambda c=name: wp.Bvh(lowers, uppers, constructor=c, leaf_size=1))
    bvh = wp.Bvh(lowers, uppers, constructor="lbvh" if device.is_cuda else "sah", leaf_size=1)
    yield "wp.Bvh refit", Task(bvh.refit)
    if device.is_cuda:
        return
    for quality in BUILD_QUALITIES:
        yield f"{EMBREE} {quality}", Task(lambda q=quality: EmbreeScene(packed, q).close())


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
        "milliseconds": {name: spread(1e3 * entry.alone) for name, entry in times.items()},
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


def measure_growth(effort: Effort, device: Any) -> list[dict[str, Any]]:
    """Time the product, its build and its memory over counts, overlaps and opacities; all rows take turns."""
    settings = [(count, 1.0, 0.9) for count in effort.counts]
    settings += [(effort.gaussians, overlap, 0.9) for overlap in effort.overlaps]
    settings += [(effort.gaussians, 1.0, opacity) for opacity in effort.opacities]
    plain = STRONGEST_ON_CUDA if device.is_cuda else PLAIN_ON_CPU
    found: list[dict[str, Any]] = []
    with ExitStack() as closing:
        cases: list[tuple[GrowthCase, dict[str, Contender]]] = []
        for setting in dict.fromkeys(settings):
            case = GrowthCase.make(effort, *setting)
            contenders, _ = contenders_for(
                case.cloud, case.rays, device, closing, plain_forms=plain, acceptances=("product",)
            )
            cases.append((case, contenders))
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
            strongest = strongest_bvh(own, contenders)
            product = contenders["wide product"].transmittances()
            truth_rays = min(effort.truth_rays, max(2, int(BRUTE_FORCE_PAIRS / case.gaussians)))
            truth = truth_for(case.cloud, case.rays, product, truth_rays)
            found.append(
                {
                    "name": f"{case.gaussians} {case.overlap:g} {case.opacity:g}",
                    "gaussians": case.gaussians,
                    "overlap": case.overlap,
                    "opacity": case.opacity,
                    "rays": len(case.rays.origins),
                    "truth_rays": len(truth.rows),
                    "contenders": {
                        name: {
                            "nanoseconds_per_ray": spread(1e9 * own[name].alone / len(case.rays.origins)),
                            **ratios(name, own, strongest),
                            **errors(entry.transmittances(), truth),
                        }
                        for name, entry in contenders.items()
                    },
                    "scenes": {
                        name: {
                            "build_ms": spread(1e3 * build_times[row, name].alone),
                            "bytes_per_gaussian": held / case.gaussians,
                        }
                        for name, held in scene_bytes(case.cloud, device).items()
                    },
                }
            )
    return found


def measure_closest_surface(effort: Effort, device: Any) -> dict[str, Any]:
    """Time sorted rays from a camera through `beam_warp.trace.closest_surface`."""
    cloud, _ = bumpy_torus(effort.gaussians)
    rays = camera_rays(cloud, *effort.image)
    origins, directions = (wp.array(array, dtype=wp.vec3, device=device) for array in rays)
    scene = Scene.from_gaussians(cloud, str(device))
    times = take_turns({"": Task(lambda: closest_surface(scene, origins, directions))}, effort.growth_repeats, device)
    return {
        "rays": len(rays.origins),
        "covered": float((visibility(scene, *rays) < 0.5).mean()),
        "mray_per_second": spread(len(rays.origins) / times[""].alone / 1e6),
    }


def measure_parity(effort: Effort, device: Any) -> dict[str, Any] | None:
    """Compare a CUDA device with the CPU without the early stop; None on the CPU.

    A Gaussian whose alpha is within rounding of the cut 1/255 may count on one device only, which moves V by up to
    1/255: ``rays_beyond_1e-5`` tells such rays from a rounding that all share.
    """
    if not device.is_cuda:
        return None
    cloud, _ = bumpy_torus(effort.gaussians)
    rays = cosine_rays(cloud, max(1, effort.parity_rays // 50), seed=2)
    here, there = (
        visibility(Scene.from_gaussians(cloud, name), *rays, options=TraceOptions(stop=0.0))
        for name in ("cpu", str(device))
    )
    gap = np.abs(here.astype(np.float64) - there)
    return {
        "rays": len(rays.origins),
        "largest": float(gap.max()),
        "p99.9": float(np.quantile(gap, 0.999)),
        "rays_beyond_1e-5": int((gap > 1e-5).sum()),
    }


def sections(effort: Effort) -> dict[str, Callable[[Any], Iterator[Any]]]:
    """Return what is measured, by name; each takes a device."""
    found: dict[str, Callable[[Effort, Any], Any]] = {
        "torus": measure_torus,
        "builds": measure_builds,
        "closest_surface": measure_closest_surface,
        "parity": measure_parity,
        "growth": measure_growth,
    }
    return {name: once(partial(section, effort)) for name, section in found.items()}


def main() -> int:
    parser = record.parser(__doc__, device=True, quick="fewer rays and repeats")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    effort = QUICK if arguments.quick else ON_CUDA if device.is_cuda else ON_CPU
    return measure_all(sections(effort), device, arguments, device)


if __name__ == "__main__":
    sys.exit(main())
