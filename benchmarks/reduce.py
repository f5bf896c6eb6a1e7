"""Reduced assets under lights and cameras that no search saw: `beam reduce` beside its rivals at the same numbers.

    python benchmarks/reduce.py [--quick] [--device cuda] [--parts sizes] --out result.json

Every rival keeps or makes the same number of Gaussians, and is measured as it is and after the refit of `beam reduce`:

- opacity x area, the Gaussians that show most by themselves;
- PUP-style, those with the largest log-determinant of the Hessian of captured images by place and size (Hanson et
  al. 2025), here estimated by random probes of the images' Jacobian (Hutchinson 1990);
- uniform random;
- splat-transform --decimate-adaptive, of npm; its Gaussians take the mean materials of the originals nearest to each.

Assets are the demo's figure, and Gaussians on the true meshes of captures in $BEAM_DATA whose colours, solved from
their images, stand for base colours. Defaults were chosen on the figure alone.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import npm_packages
import numpy as np
import record
import warp as wp
from delivery_take import take
from numpy.typing import NDArray
from parts import measure, say
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from beam_warp.capture.capture import Capture
from beam_warp.converters import read, write
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import demo_environments
from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.relit import RelitComparison, loss_of
from beam_warp.image.color import LINEAR_REC709
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.reduction.job import ReduceOptions, Reducer
from beam_warp.reduction.moments import Clusters, changed, shown_area
from beam_warp.reduction.refit import refit
from beam_warp.study.true_surface import SHARP, surface_of_capture
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.harmonics import SH_C0

Row = dict[str, Any]
Keep = Callable[[Reducer, GaussianCloud, int], GaussianCloud]

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
    device: Any


def asset(name: str, bench: Bench) -> GaussianSequence:
    """Return one of the assets."""
    if name == "figure":
        ((_, cloud),) = take(build_figure(), bench.count, 1)
        return GaussianSequence.from_clouds([cloud], metadata=RasterOptions(antialiased=True).as_metadata())
    capture = Capture.read(Path(os.environ.get("BEAM_DATA", "../shared/data")) / "captures" / name)
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


def kept(score: NDArray[np.floating], cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Return the Gaussians of the highest scores."""
    return cloud.select(np.sort(np.argsort(-np.asarray(score), kind="stable")[:count]))


def ours(reducer: Reducer, cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Return what `beam reduce` merges, without its refit."""
    return Clusters(cloud, reducer._order.labels(count), reducer.sensitivity.visible).cloud(cloud)


def by_area(reducer: Reducer, cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Return the Gaussians of the largest opacity times area, ties broken at random."""
    jitter = 1.0 + 1e-6 * np.random.default_rng(1).random(len(cloud))
    return kept(cloud.opacities * shown_area(cloud.scales) * jitter, cloud, count)


def at_random(reducer: Reducer, cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Return Gaussians drawn evenly."""
    return kept(np.random.default_rng(0).random(len(cloud)), cloud, count)


def pup(reducer: Reducer, cloud: GaussianCloud, count: int) -> GaussianCloud:
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


def decimated(reducer: Reducer, cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Return what splat-transform decimates."""
    assert cloud.base_color is not None
    colored = cloud.with_arrays(
        radiance=((cloud.base_color[:, None] - 0.5) / SH_C0).astype(np.float32), radiance_color_space=LINEAR_REC709
    )
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.ply", Path(folder) / "out.ply"
        write(GaussianSequence.from_clouds([colored]), source)
        program = [*npm_packages.splat_transform(), "-q", "-g", "cpu"]
        command = [*program, str(source), "--decimate-adaptive", str(count), str(target)]
        subprocess.run(command, check=True, capture_output=True, timeout=600)
        found = change_axes(read(target)[0], "rfu")
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
    """Reduce every asset to every share by every contender."""
    rows: list[Row] = []
    for name in bench.assets:
        original = asset(name, bench)
        started = time.perf_counter()
        reducer = Reducer(original, list(demo_environments().values()), bench.options)
        measured = time.perf_counter() - started
        comparison = RelitComparison(original, reducer.trials, raster=reducer.raster, device=bench.device)
        draws = reducer.trials.draw("certificate", range(bench.tests), [0])
        cloud = change_axes(original[0], "rfu")
        for share in bench.shares:
            for contender, keep in CONTENDERS.items():
                row: Row = {"name": f"{name} {share:g} {contender}", "asset": name, "share": share}
                row |= {"contender": contender, "original": len(cloud), "sensitivity_seconds": measured}
                try:
                    rows.append(row | contend(keep, reducer, cloud, round(share * len(cloud)), comparison, draws))
                except (npm_packages.MissingPackagesError, subprocess.SubprocessError) as error:
                    rows.append(row | {"absent": str(error)})
                say(f"{rows[-1]['name']}: {rows[-1].get('refit', {}).get('psnr')}")
                yield {"rows": rows, "height": bench.options.height, "tests": bench.tests}


def contend(
    keep: Keep, reducer: Reducer, cloud: GaussianCloud, count: int, comparison: RelitComparison, draws: Any
) -> Row:
    """Measure one contender, as it is and refitted."""
    started = time.perf_counter()
    bare = keep(reducer, cloud, count)
    chosen = time.perf_counter()
    turn = Rotation.identity(len(bare))
    how = {"steps": reducer.options.steps, "raster": reducer.raster, "device": reducer._device}
    fitted = changed(bare, turn, refit({0: (bare, turn)}, reducer.sensitivity, **how))
    ended = time.perf_counter()
    found = {"gaussians": len(bare), "chosen_seconds": chosen - started, "refit_seconds": ended - chosen}
    for name, each in (("bare", bare), ("refit", fitted)):
        psnr = comparison.errors(GaussianSequence.from_clouds([each]), draws, keep=True).psnr
        loss = loss_of(psnr)
        found[name] = {"psnr": psnr.mean(), "loss": loss.mean(), "loss_95": np.quantile(loss, 0.95)}
    return found


PARTS = {"sizes": sizes}


def main() -> int:
    parser = record.parser(__doc__, device="cpu", quick="the figure, small, a few steps", parts=PARTS)
    parser.add_argument("--assets", nargs="+", default=["figure", *CAPTURES], metavar="NAME")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    count, height, tests, views, steps = (140_000, 320, 64, 96, 600) if device.is_cuda else (3_000, 56, 12, 20, 80)
    if arguments.quick:
        arguments.assets, count, height, tests, views, steps = ["figure"], 800, 48, 4, 4, 4
    options = ReduceOptions(gaussians=1, height=height, views=views, steps=steps, device=device)
    shares = (0.2,) if arguments.quick else (0.2, 0.1)
    bench = Bench(count, shares, tests, options, tuple(arguments.assets), device)
    keep = functools.partial(record.write_result, arguments, device)
    result = measure(PARTS, bench, only=arguments.parts, keep=keep)
    keep(result)
    return 1 if result["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
