"""CPU against CUDA on one relightable asset: largest and 99.9 % differences of what each stage gives.

python benchmarks/parity.py demo/asset.usda --environment demo/lights/sunset.exr [--out parity.json]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import record
import warp as wp

from beam_warp import Camera, EnvironmentMap, Scene, ambient_occlusion, rasterize, read, visibility
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED
from beam_warp.world.axes import change_axes
from beam_warp.world.shot import Shot

DEVICES = ("cpu", "cuda:0")


def main() -> int:
    parser = record.parser(__doc__)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--environment", type=Path, required=True)
    arguments = parser.parse_args()
    cloud = change_axes(read(arguments.asset)[0], "rfu")
    environment = EnvironmentMap.read(arguments.environment)
    rng = np.random.default_rng(0)
    rows = rng.permutation(len(cloud))[:20_000]
    normals = cloud.normals[rows]
    origins = cloud.positions[rows] + 0.05 * normals
    directions = rng.normal(size=origins.shape) + 2.0 * normals
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    camera = Camera.frame_cloud(cloud.positions, cloud.opacities, azimuth=25.0, elevation=8.0, width=512, height=512)
    shot = Shot(cloud=cloud, camera=camera, environment=environment)
    found = {}
    for device in DEVICES:
        scene = Scene.from_gaussians(cloud, device)
        buffer = rasterize(cloud, camera, device=device)
        found[device] = {
            "visibility": visibility(scene, origins, directions),
            "ambient_occlusion": ambient_occlusion(scene, cloud.positions, cloud.normals).visibility,
            "alpha": buffer.alpha,
            "depth": buffer.depth,
            "base_color": buffer.channels["base_color"],
            "relit": DeferredRenderer(UNSHADOWED, device=device).draw(shot).rgb,
        }
    result = {"gaussians": len(cloud)}
    for name, values in found[DEVICES[0]].items():
        gap = np.abs(values - found[DEVICES[1]][name])
        result[name] = {"largest": float(gap.max()), "p99.9": float(np.quantile(gap, 0.999))}
    record.write_result(arguments, wp.get_device(DEVICES[1]), result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
