"""The main job on a Gaussian file: seconds by stage, peak memory, rays per second, and the errors beside them.

    python benchmarks/first_light.py person.ply --environment studio.hdr --device cuda:0 --out result.json

The first run warms up (kernels compile, files are cached); the others, each into an empty folder, are measured. With
``--repeats 0`` the first run counts, which tells memory and the shares of its stages. Errors: visibility against a
float64 brute force, ambient occlusion at 64 rays against 4,096. The input's name is recorded, not its content.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import record
import warp as wp
from timing import Task, spread, take_turns

from beam_warp import Scene, ambient_occlusion, converters, visibility
from beam_warp.decomposition.job import RunOptions, run
from beam_warp.device.arrays import resolve_device
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.normals import estimate_normals
from beam_warp.trace.rays import ray_offsets
from beam_warp.trace.reference import visibility_reference
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap

TRUTH_POINTS = 500
FLOAT64_RAYS = 256


def measure_run(path: Path, light: Path, samples: int, device: Any, repeats: int) -> dict[str, Any]:
    """Run the job, from files to files, and return the seconds of its stages and the peak of memory."""
    options = RunOptions(materials=MaterialOptions(sample_count=samples), device=str(device))
    totals, stages = [], []
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(1 + repeats):
            started = time.perf_counter()
            result = run(converters.read(path), EnvironmentMap.read(light), Path(folder) / str(turn), options)
            totals.append(time.perf_counter() - started)
            stages.append(result.report["seconds"])
    measured = slice(1, None) if repeats else slice(None)
    return {
        "gaussians": result.report["input"]["gaussians"],
        "seconds": {name: spread(np.array([each[name] for each in stages[measured]])) for name in stages[-1]},
        "seconds_with_reading": spread(np.array(totals[measured])),
        "seconds_first_run": totals[0],
        "peak_memory_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10),
        "device_memory_mib": round(wp.get_mempool_used_mem_high(device) / 2**20) if device.is_cuda else None,
    }


def measure_rays(path: Path, samples: int, device: Any, points: int) -> dict[str, Any]:
    """Time ambient occlusion, and compare it with many rays and single rays with float64."""
    cloud = change_axes(converters.read(path)[0], "rfu")
    scene = Scene.from_gaussians(cloud, str(device))
    surface = estimate_normals(cloud, scene)
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(len(cloud), min(points, len(cloud)), replace=False))
    at = wp.array(cloud.positions[rows], dtype=wp.vec3, device=device)
    up = wp.array(surface.normals[rows], dtype=wp.vec3, device=device)
    task = Task(lambda: ambient_occlusion(scene, at, up, sample_count=samples))
    seconds = take_turns({"": task}, 5 if device.is_cuda else 1, device)[""].alone
    few = rows[rng.permutation(len(rows))[:TRUTH_POINTS]]
    truth = ambient_occlusion(scene, cloud.positions[few], surface.normals[few], sample_count=4096, seed=1).visibility
    result = ambient_occlusion(scene, cloud.positions[few], surface.normals[few], sample_count=samples)
    error = result.visibility - truth

    ray_rows = few[:FLOAT64_RAYS]
    n = surface.normals[ray_rows]
    lifted = [wp.array(array, dtype=wp.vec3, device=device) for array in (cloud.positions[ray_rows], n)]
    offsets = ray_offsets(scene, *lifted, "auto").numpy()
    origins = (cloud.positions[ray_rows] + offsets[:, None] * n).astype(np.float32)
    directions = rng.normal(size=n.shape)
    directions += n * (1e-6 + np.maximum(0.0, -2.0 * (directions * n).sum(1)))[:, None]
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    gap = np.abs(visibility(scene, origins, directions) - visibility_reference(cloud, origins, directions))
    return {
        "points": len(rows),
        "mray_per_second": spread(len(rows) * samples / seconds / 1e6),
        "ambient_occlusion_rmse": float(np.sqrt((error**2).mean())),
        "stated_standard_error_rms": float(np.sqrt((result.standard_error**2).mean())),
        "visibility_largest_error": float(gap.max()),
        "visibility_p99_error": float(np.quantile(gap, 0.99)),
    }


def main() -> int:
    parser = record.parser(__doc__, device=True)
    parser.add_argument("input", type=Path)
    parser.add_argument("--environment", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--points", type=int, default=20_000, help="points for the ray rate")
    parser.add_argument("--repeats", type=int, default=3, help="measured runs of the job after the first")
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    result: dict[str, Any] = {"samples": arguments.samples}
    result["run"] = measure_run(arguments.input, arguments.environment, arguments.samples, device, arguments.repeats)
    record.write_result(arguments, device, result)
    result["rays"] = measure_rays(arguments.input, arguments.samples, device, arguments.points)
    record.write_result(arguments, device, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
