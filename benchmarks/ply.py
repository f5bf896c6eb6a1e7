"""How fast PLY is read and written, beside plyfile, and whether the values are the same.

Run: ``python benchmarks/ply.py [--count 150000] [--repeats 7] --out result.json``.

Both readers end with the same arrays in memory: positions, normalised quaternions, linear scales and opacities,
coefficients by band. plyfile is used as its manual shows, memory-mapped, with one copy per column. Both writers start
from those arrays and end with a closed file. They take turns, timed by process CPU time.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import record
import warp as wp
from plyfile import PlyData, PlyElement
from timing import Task, spread, take_turns

from beam_warp import converters
from beam_warp.converters.activations import dc_from_color
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

REST = [f"f_rest_{index}" for index in range(45)]


def random_cloud(count, seed=0):
    rng = np.random.default_rng(seed)
    orientations = rng.normal(size=(count, 4)).astype(np.float32)
    radiance = 0.1 * rng.normal(size=(count, 16, 3))
    radiance[:, 0] = dc_from_color(rng.uniform(size=(count, 3)))
    return GaussianCloud(
        positions=rng.normal(size=(count, 3)),
        orientations=orientations / np.linalg.norm(orientations, axis=1, keepdims=True),
        scales=np.exp(rng.uniform(-8.0, -2.0, (count, 3))),
        opacities=rng.uniform(0.01, 0.99, count),
        radiance=radiance,
        radiance_color_space=DISPLAY_SRGB,
    )


def read_with_plyfile(path):
    vertex = PlyData.read(path)["vertex"]

    def columns(*names):
        return np.stack([vertex[name] for name in names], axis=1)

    quaternions = columns("rot_1", "rot_2", "rot_3", "rot_0")
    rest = columns(*REST).reshape(-1, 3, 15).transpose(0, 2, 1)
    return {
        "positions": columns("x", "y", "z"),
        "orientations": quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        "scales": np.exp(columns("scale_0", "scale_1", "scale_2")),
        "opacities": 1.0 / (1.0 + np.exp(-vertex["opacity"])),
        "radiance": np.concatenate([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest], axis=1),
    }


def write_with_plyfile(cloud, path):
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *REST, "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    values = np.concatenate(  # one matrix seen as records: the fastest way to a structured array
        [
            cloud.positions,
            np.zeros_like(cloud.positions),
            cloud.radiance[:, 0],
            cloud.radiance[:, 1:].transpose(0, 2, 1).reshape(len(cloud), -1),
            np.log(cloud.opacities / (1.0 - cloud.opacities))[:, None],
            np.log(cloud.scales),
            cloud.orientations[:, [3, 0, 1, 2]],
        ],
        axis=1,
    )
    table = values.view([(name, "f4") for name in names])[:, 0]
    PlyData([PlyElement.describe(table, "vertex")]).write(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=150_000)
    parser.add_argument("--repeats", type=int, default=7)
    record.add_arguments(parser)
    arguments = parser.parse_args()

    cloud = random_cloud(arguments.count)
    sequence, device = GaussianSequence.from_clouds([cloud]), wp.get_device("cpu")
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs = Path(folder) / "ours.ply", Path(folder) / "theirs.ply"
        tasks = {
            "write": Task(lambda: converters.write(sequence, ours)),
            "plyfile write": Task(lambda: write_with_plyfile(cloud, theirs)),
            "read": Task(lambda: converters.read(ours)[0]),
            "plyfile read": Task(lambda: read_with_plyfile(ours)),
        }
        times = take_turns(tasks, arguments.repeats, device)
        mine, independent = converters.read(ours)[0], read_with_plyfile(ours)
        result = {
            "count": arguments.count,
            "megabytes": ours.stat().st_size / 1e6,
            "seconds": {name: spread(entry.alone) for name, entry in times.items()},
            "faster_than_plyfile": {
                name: spread(times[f"plyfile {name}"].alone / times[name].alone) for name in ("read", "write")
            },
            "largest_difference": {
                name: float(np.abs(getattr(mine, name) - values).max()) for name, values in independent.items()
            },
        }
    record.write_result(arguments, device, result)


if __name__ == "__main__":
    main()
