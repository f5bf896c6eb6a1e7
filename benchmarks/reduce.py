"""Reduced assets under lights and cameras that no search saw: `beam reduce` beside its rivals at the same numbers.

    python benchmarks/reduce.py [--quick] [--device cuda] [--parts sizes] [--made FOLDER] --out result.json

- ``sizes``: every rival keeps or makes the same number of Gaussians, and is measured as it is and after the refit of
  `beam reduce`: against the original under lights and cameras drawn at random, and, where a capture has true images,
  by what `beam evaluate` says of it less what it says of the original.
- ``certified``: whole calls of `beam reduce` with its defaults: seconds, and in how many of 200 fresh draws the stated
  bound holds. Its loss counts from the asset's own PSNR against the truth, where that is known.

Rivals:

- opacity x area, the Gaussians that show most by themselves;
- PUP-style, those with the largest log-determinant of the Hessian of captured images by place and size (Hanson et
  al. 2025), here estimated by random probes of the images' Jacobian (Hutchinson 1990);
- uniform random;
- splat-transform --decimate-adaptive, of npm; its Gaussians take the mean materials of the originals nearest to each.

Assets of captures in $BEAM_DATA are read from ``--made``: what `beam run CAPTURE --gaussians 140000` makes of their
first frames, as NAME.usdc. Where it is not given, they are Gaussians on the true meshes whose colours, solved from
images, stand for base colours. What splat-transform makes is kept beside the assets, for machines without Node.js.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import npm_packages
import numpy as np
import record
import warp as wp
from delivery_take import take
from numpy.typing import NDArray
from parts import measure_all, say
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from beam_warp.capture.capture import Capture
from beam_warp.converters import read, write
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import demo_environments
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import BeamError
from beam_warp.evaluate.materials import EvaluateOptions, score_materials
from beam_warp.evaluate.relit import ASSET_PSNR, RelitComparison, loss_of
from beam_warp.evaluate.trials import RelitTrials
from beam_warp.image.color import LINEAR_REC709
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.reduction.changes import changed
from beam_warp.reduction.job import ReduceOptions, Reducer, reduce_asset
from beam_warp.reduction.refit import refit
from beam_warp.study.true_surface import SHARP, surface_of_capture
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.axes import change_axes
from beam_warp.world.clusters import Clusters, shown_area
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.harmonics import SH_C0

Row = dict[str, Any]
Judge = Callable[[GaussianCloud], Row]
Keep = Callable[[Reducer, GaussianCloud, int, Path | None], GaussianCloud]

FRESH, FRESH_PAIRS = 77, 200
"""Seed and number of draws that no search and no certificate saw."""

MOST_LOSS = 1.0
"""Bound that the fewest Gaussians are asked for [dB]."""

PROBES = 2
"""Random probes of each view's Jacobian."""

CAPTURES = ("walker", "runner", "robot")


@dataclass(frozen=True)
class Bench:
    """What the parts share: assets, their size, the shares that are kept, and how much is drawn and fitted."""

    count: int
    shares: tuple[float, ...]
    tests: int
    options: ReduceOptions
    assets: tuple[str, ...]
    made: Path | None
    device: Any
    contenders: tuple[str, ...]


def asset(name: str, bench: Bench) -> GaussianSequence:
    """Return one of the assets."""
    if name == "figure":
        ((_, cloud),) = take(build_figure(), bench.count, 1)
        return GaussianSequence.from_clouds([cloud], metadata=RasterOptions(antialiased=True).as_metadata())
    if bench.made is not None and (bench.made / f"{name}.usdc").is_file():
        return read(bench.made / f"{name}.usdc")
    capture = capture_of(name)
    colored, _ = surface_of_capture(capture, 0, bench.count, options=SHARP, device=str(bench.device))
    assert colored.radiance is not None
    scene = Scene.from_gaussians(colored, str(bench.device))
    openness = ambient_occlusion(scene, colored.positions, colored.normals, sample_count=64).visibility
    cloud = colored.with_arrays(
        radiance=None,
        radiance_color_space=None,
        base_color=np.clip(0.5 + SH_C0 * colored.radiance[:, 0], 0.0, 1.0),
        roughness=np.full(len(colored), 0.5, np.float32),
        ambient_occlusion=np.clip(np.asarray(openness), 0.0, 1.0),
    )
    return GaussianSequence.from_clouds([cloud], metadata=SHARP.as_metadata())


def capture_of(name: str) -> Capture:
    """Return a capture by its name."""
    return Capture.read(Path(os.environ.get("BEAM_DATA", "../shared/data")) / "captures" / name)


def against_truth(name: str, sequence: GaussianSequence, bench: Bench) -> float | None:
    """Return the mean PSNR of relit images against a capture's true ones [dB]; None without."""
    if name not in CAPTURES or bench.made is None:
        return None
    capture = capture_of(name)
    frame = min(record.frame for record in capture.select(split="test") if record.truth_path is not None)
    options = EvaluateOptions(frames=(frame,), device=str(bench.device))
    return score_materials(sequence, capture, options).as_dict()["mean"]["relit_mean"]["deferred"]["psnr"]


def kept(score: NDArray[np.floating], cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Return the Gaussians of the highest scores."""
    return cloud.select(np.sort(np.argsort(-np.asarray(score), kind="stable")[:count]))


def ours(reducer: Reducer, cloud: GaussianCloud, count: int, place: Path | None) -> GaussianCloud:
    """Return what `beam reduce` merges, without its refit."""
    return Clusters(cloud, reducer._order.labels(count), reducer.sensitivity.visible).cloud(cloud)


def by_area(reducer: Reducer, cloud: GaussianCloud, count: int, place: Path | None) -> GaussianCloud:
    """Return the Gaussians of the largest opacity times area, ties broken at random."""
    jitter = 1.0 + 1e-6 * np.random.default_rng(1).random(len(cloud))
    return kept(cloud.opacities * shown_area(cloud.scales) * jitter, cloud, count)


def at_random(reducer: Reducer, cloud: GaussianCloud, count: int, place: Path | None) -> GaussianCloud:
    """Return Gaussians drawn evenly."""
    return kept(np.random.default_rng(0).random(len(cloud)), cloud, count)


def pup(reducer: Reducer, cloud: GaussianCloud, count: int, place: Path | None) -> GaussianCloud:
    """Return the Gaussians of the largest log-determinant of J^T J by place and size, in images of captured light."""
    assert cloud.base_color is not None
    assert cloud.ambient_occlusion is not None
    lit = cloud.base_color * cloud.ambient_occlusion[:, None]
    gaussians, rng = upload_gaussians(cloud, reducer._device, values=lit), np.random.default_rng(0)
    hessian = np.zeros((len(cloud), 6, 6))
    for view in reducer.sensitivity.views:
        drawer = Rasterizer(len(cloud), [view.camera], value_count=3, options=reducer.raster, device=reducer._device)
        drawer.draw(gaussians)
        for _ in range(PROBES):
            probe = np.zeros(drawer.adjoints().channels[0].shape, np.float32)
            probe[:, :3] = rng.choice([-1.0, 1.0], (len(probe), 3))
            drawer.adjoints().channels[0].assign(wp.array(probe, dtype=float, device=reducer._device))
            found = drawer.backward()
            slope = np.concatenate([found.positions.numpy(), found.scales.numpy()], axis=1).astype(np.float64)
            hessian += slope[:, :, None] * slope[:, None, :]
    return kept(np.linalg.slogdet(hessian + 1e-12 * np.eye(6))[1], cloud, count)


def decimated(reducer: Reducer, cloud: GaussianCloud, count: int, place: Path | None) -> GaussianCloud:
    """Return what splat-transform decimates, or what it made of the same before."""
    if place is None:
        with tempfile.TemporaryDirectory() as folder:
            return decimated(reducer, cloud, count, Path(folder) / "out.ply")
    if not place.is_file():
        assert cloud.base_color is not None
        radiance = ((cloud.base_color[:, None] - 0.5) / SH_C0).astype(np.float32)
        colored = cloud.with_arrays(radiance=radiance, radiance_color_space=LINEAR_REC709)
        source = place.with_suffix(".in.ply")
        write(GaussianSequence.from_clouds([colored]), source)
        program = [*npm_packages.splat_transform(), "-q", "-g", "cpu"]
        command = [*program, str(source), "--decimate-adaptive", str(count), str(place)]
        subprocess.run(command, check=True, capture_output=True, timeout=600)
    found = change_axes(read(place)[0], "rfu")
    near = cKDTree(found.positions).query(cloud.positions)[1]
    total = np.maximum(np.bincount(near, minlength=len(found)), 1)[:, None]
    nearest = cKDTree(cloud.positions).query(found.positions)[1]
    arrays = {}
    for name in ("base_color", "roughness", "ambient_occlusion", "normals"):
        rows = np.asarray(getattr(cloud, name), np.float64).reshape(len(cloud), -1)
        sums = np.stack([np.bincount(near, column, minlength=len(found)) for column in rows.T], axis=1)
        mean = np.where(np.bincount(near, minlength=len(found))[:, None] > 0, sums / total, rows[nearest])
        if name == "normals":
            mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
        arrays[name] = mean if mean.shape[1] == 3 else mean[:, 0]
    return found.with_arrays(radiance=None, radiance_color_space=None, **arrays)


CONTENDERS: dict[str, Keep] = {
    "beam reduce": ours,
    "opacity x area": by_area,
    "PUP-style": pup,
    "uniform random": at_random,
    "splat-transform": decimated,
}


def sizes(bench: Bench) -> Iterator[Row]:
    """Reduce every asset to every share by every contender; rivals wait until all assets have been reduced."""
    rows: list[Row] = []
    subjects = [subject(name, bench) for name in bench.assets]
    for contender in bench.contenders:
        keep = CONTENDERS[contender]
        for (known, reducer, cloud, judge), share in product(subjects, bench.shares):
            name = known["asset"]
            row: Row = {"name": f"{name} {share:g} {contender}", "share": share, "contender": contender, **known}
            place = None if bench.made is None else bench.made / f"{name}_{share:g}.ply"
            try:
                rows.append(row | contend(keep, reducer, cloud, round(share * len(cloud)), place, judge))
            except (npm_packages.MissingPackagesError, subprocess.SubprocessError, BeamError) as error:
                rows.append(row | {"absent": str(error)})
            say(f"{rows[-1]['name']}: {rows[-1].get('bare')} {rows[-1].get('refit')}")
            yield {"rows": rows, "height": bench.options.height, "tests": bench.tests}


def subject(name: str, bench: Bench) -> tuple[Row, Reducer, GaussianCloud, Judge]:
    """Return what is known of an asset, its reducer, its Gaussians, and a function that judges others beside them."""
    original = asset(name, bench)
    started = time.perf_counter()
    reducer = Reducer(original, list(demo_environments().values()), bench.options)
    measured = time.perf_counter() - started
    comparison = RelitComparison(original, reducer.trials, raster=reducer.raster, device=bench.device)
    draws = reducer.trials.draw("certificate", range(bench.tests), [0])
    truth = against_truth(name, original, bench)

    def judge(cloud: GaussianCloud) -> Row:
        one = replace(original, read_frame=lambda _: cloud)
        psnr = comparison.errors(one, draws, keep=True).psnr
        loss = loss_of(psnr) if truth is None else loss_of(psnr, truth)
        said: Row = {"psnr": psnr.mean(), "loss": loss.mean(), "loss_95": np.quantile(loss, 0.95)}
        return said if truth is None else said | {"truth_loss": truth - (against_truth(name, one, bench) or 0.0)}

    cloud = change_axes(original[0], "rfu")
    known: Row = {"asset": name, "truth": truth, "original": len(cloud), "sensitivity_seconds": measured}
    return known, reducer, cloud, judge


def contend(keep: Keep, reducer: Reducer, cloud: GaussianCloud, count: int, place: Path | None, judge: Judge) -> Row:
    """Measure one contender, as it is and refitted."""
    started = time.perf_counter()
    bare = keep(reducer, cloud, count, place)
    chosen = time.perf_counter()
    turn = Rotation.identity(len(bare))
    how = {"steps": reducer.steps, "raster": reducer.raster, "device": reducer._device}
    fitted = changed(bare, turn, refit({0: (bare, turn)}, reducer.sensitivity, **how))
    ended = time.perf_counter()
    found = {"gaussians": len(bare), "chosen_seconds": chosen - started, "refit_seconds": ended - chosen}
    return found | {"bare": judge(bare), "refit": judge(fitted)}


def certified(bench: Bench) -> Iterator[Row]:
    """Run whole reductions, and try what they state on fresh draws."""
    rows: list[Row] = []
    lights, height = list(demo_environments().values()), min(256, bench.options.height)
    for name in bench.assets:
        original = asset(name, bench)
        truth = against_truth(name, original, bench) or ASSET_PSNR
        for target in ({"gaussians": round(bench.shares[0] * len(original[0]))}, {"max_loss": MOST_LOSS}):
            changes: Row = {"gaussians": None, "asset_psnr": truth, "height": height, **target}
            options = replace(bench.options, **changes)
            rows.append({"name": f"{name} {target}", "asset": name, "target": target, "asset_psnr": truth})
            with tempfile.TemporaryDirectory() as folder:
                started = time.perf_counter()
                out = Path(folder) / "small.usdc"
                found = reduce_asset(original, lights, options, out)
                rows[-1] |= {
                    "seconds": time.perf_counter() - started,
                    "gaussians": found.count,
                    "of": found.original_count,
                }
                reduced = read(out)
                trials = RelitTrials(lights, height=height, seed=FRESH, device=bench.device)
                comparison = RelitComparison(original, trials, asset_psnr=truth, device=bench.device)
                errors = comparison.errors(reduced, trials.draw("certificate", range(FRESH_PAIRS), [0])).values("loss")
            stated = found.certificate
            within = float(np.mean(errors <= stated.bound))
            rows[-1] |= {"bound": stated.bound, "share_stated": stated.share, "within": within, "pairs": FRESH_PAIRS}
            say(str(rows[-1]))
            yield {"rows": rows}


PARTS = {"certified": certified, "sizes": sizes}


def main() -> int:
    parser = record.parser(__doc__, device=True, quick="the figure, small, a few steps", parts=PARTS)
    parser.add_argument("--made", type=Path, metavar="FOLDER", help="assets of captures, and what rivals made of them")
    parser.add_argument("--assets", nargs="+", default=["figure", *CAPTURES], metavar="NAME")
    parser.add_argument("--contenders", nargs="+", default=list(CONTENDERS), choices=CONTENDERS, metavar="NAME")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    default = ReduceOptions(gaussians=1)
    count, height, tests, views, steps = 3_000, 56, 12, 20, 80
    if device.is_cuda:
        count, height, tests, views, steps = 140_000, 512, 100, default.views, default.steps
    if arguments.quick:
        arguments.assets, count, height, tests, views, steps = ["figure"], 800, 48, 4, 4, 4
    options = ReduceOptions(gaussians=1, height=height, views=views, steps=steps, device=device)
    shares = (0.2,) if arguments.quick else (0.2, 0.1)
    bench = Bench(
        count, shares, tests, options, tuple(arguments.assets), arguments.made, device, tuple(arguments.contenders)
    )
    return measure_all(PARTS, bench, arguments, device, arguments.parts)


if __name__ == "__main__":
    sys.exit(main())
