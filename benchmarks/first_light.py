"""The main job on a Gaussian file: seconds by stage, peak memory, rays per second, and the errors beside them.

    python benchmarks/first_light.py person.ply --environment studio.hdr [--device cuda:0] [--out result.json]

The first run warms up (kernels compile, files are cached); the second, into an empty folder, is measured. Errors:
visibility against float64 brute force, ambient occlusion at 64 rays against 4,096. The input's name is recorded, not
its content.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import record
import warp as wp

from beam_warp import Scene, ambient_occlusion, converters, visibility
from beam_warp.decomposition.job import RunOptions, run
from beam_warp.device.arrays import resolve_device
from beam_warp.materials.direct import MaterialOptions
from beam_warp.materials.normals import estimate_normals
from beam_warp.trace.rays import ray_offsets
from beam_warp.trace.reference import visibility_reference
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap


def measure_run(path: Path, light: Path, samples: int, device: str | None) -> dict:
    options = RunOptions(materials=MaterialOptions(sample_count=samples), device=device)
    process = psutil.Process()
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        run(converters.read(path), EnvironmentMap.read(light), Path(folder) / "warm", options)
        warm_up = time.perf_counter() - started
        before = process.memory_info().rss
        started = time.perf_counter()
        result = run(converters.read(path), EnvironmentMap.read(light), Path(folder) / "measured", options)
        total = time.perf_counter() - started
    memory = process.memory_info()
    peak = getattr(memory, "peak_wset", None) or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    target = resolve_device(device)
    return {
        "gaussians": result.report["input"]["gaussians"],
        "device": result.report["device"],
        "versions": result.report["versions"],
        "exposure_stops": result.report["exposure_stops"],
        "seconds": {k: round(v, 4) for k, v in result.report["seconds"].items()},
        "seconds_with_reading": round(total, 4),
        "seconds_first_run": round(warm_up, 4),
        "peak_memory_mib": round(peak / 2**20),
        "resident_before_mib": round(before / 2**20),
        "device_memory_mib": round(wp.get_mempool_used_mem_high(target) / 2**20) if target.is_cuda else None,
    }


def median_seconds(work, device, repeats: int = 5) -> float:
    work()
    wp.synchronize_device(device)
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        wp.synchronize_device(device)
        seconds.append(time.perf_counter() - started)
    return float(np.median(seconds))


def measure_rays(path: Path, samples: int, device: str | None, points: int) -> dict:
    cloud = change_axes(converters.read(path)[0], "rfu")
    scene = Scene.from_gaussians(cloud, device)
    surface = estimate_normals(cloud, scene)
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(len(cloud), min(points, len(cloud)), replace=False))
    at = wp.array(cloud.positions[rows], dtype=wp.vec3, device=scene.device)
    up = wp.array(surface.normals[rows], dtype=wp.vec3, device=scene.device)
    seconds = median_seconds(
        lambda: ambient_occlusion(scene, at, up, sample_count=samples), scene.device, 5 if scene.device.is_cuda else 1
    )
    few = rows[rng.permutation(len(rows))[:2000]]
    truth = ambient_occlusion(scene, cloud.positions[few], surface.normals[few], sample_count=4096, seed=1).visibility
    result = ambient_occlusion(scene, cloud.positions[few], surface.normals[few], sample_count=samples)
    error = result.visibility - truth

    ray_rows = few[:256]
    n = surface.normals[ray_rows]
    offsets = ray_offsets(
        scene,
        wp.array(cloud.positions[ray_rows], dtype=wp.vec3, device=scene.device),
        wp.array(n, dtype=wp.vec3, device=scene.device),
        "auto",
    ).numpy()
    origins = (cloud.positions[ray_rows] + offsets[:, None] * n).astype(np.float32)
    directions = rng.normal(size=n.shape)
    directions += n * (1e-6 + np.maximum(0.0, -2.0 * (directions * n).sum(1)))[:, None]
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    gap = np.abs(visibility(scene, origins, directions) - visibility_reference(cloud, origins, directions))
    return {
        "points": len(rows),
        "rays": len(rows) * samples,
        "rays_per_second": round(len(rows) * samples / seconds),
        "ambient_occlusion_rmse": round(float(np.sqrt((error**2).mean())), 5),
        "ambient_occlusion_psnr_db": round(float(-10.0 * np.log10((error**2).mean())), 2),
        "stated_standard_error_rms": round(float(np.sqrt((result.standard_error**2).mean())), 5),
        "visibility_largest_error": float(f"{gap.max():.2e}"),
        "visibility_p99_error": float(f"{np.quantile(gap, 0.99):.2e}"),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("input", type=Path)
    parser.add_argument("--environment", type=Path, required=True)
    parser.add_argument("--device", default=None)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--points", type=int, default=20_000, help="points for the ray rate")
    record.add_arguments(parser)
    arguments = parser.parse_args()
    result = {
        "input": arguments.input.name,
        "environment": arguments.environment.name,
        "samples": arguments.samples,
        "run": measure_run(arguments.input, arguments.environment, arguments.samples, arguments.device),
        "rays": measure_rays(arguments.input, arguments.samples, arguments.device, arguments.points),
    }
    record.write_result(arguments, resolve_device(arguments.device), result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
