"""The rasteriser's gradients against float64, entry by entry, with every decision held still.

    python benchmarks/raster_gradients.py [--device cuda:0] --out JSON

For random scenes and every hazard of ``tests/support/raster_hazards.py``: relative L2 errors of the gradients to each
array, of a loss with random derivatives to every image, against complex steps of the float64 rasteriser of
``tests/reference``; beside them what one rounding of the inputs to single precision changes, which no program that
reads single precision can be better than. Writes JSON.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import record
import warp as wp

from beam_warp.device.arrays import resolve_device, upload
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from reference.raster_differences import gradients, random_upstream
from reference.rasterizing import decide
from reference.single_precision import rounded
from support.raster_hazards import HAZARDS, in_view, make

ARRAYS = {"positions": wp.vec3, "orientations": wp.quat, "scales": wp.vec3, "opacities": float, "values": float}
MODES = ("plane", "exact")
ROUNDINGS = 5
"""Roundings of the inputs, of which the largest effect counts."""


def scenes() -> Iterator[tuple[str, Any]]:
    """Yield what is differentiated, by name."""
    for count in (60, 300):
        rng = np.random.default_rng(count)
        scales = np.exp(rng.normal(-2.7, 0.6, (count, 3)))
        yield f"{count} random splats", make(rng, in_view(rng, count), scales, rng.uniform(0.05, 0.95, count))
    for name, hazard in HAZARDS.items():
        yield name.replace("_", " "), hazard(np.random.default_rng(1))


def found_gradients(scene: Any, upstream: Any, device: Any) -> dict[str, np.ndarray]:
    """Return the rasteriser's gradients of a scene."""
    options = RasterOptions(scene.antialiased, scene.low_pass, scene.near, scene.depth_mode)
    values = scene.values.shape[1]
    drawer = Rasterizer(
        len(scene.positions), [scene.camera], value_count=values, normals=True, options=options, device=device
    )
    arrays = (upload(scene.arrays()[name].astype(np.float32), kind, device) for name, kind in ARRAYS.items())
    drawer.draw(GaussianArrays(*arrays))
    adjoints = drawer.adjoints()
    for name in ("alpha", "depth", "median_depth"):
        getattr(adjoints, name).assign(getattr(upstream, name).astype(np.float32).ravel())
    columns = np.zeros((scene.camera.width * scene.camera.height, adjoints.channels[0].shape[1]), np.float32)
    columns[:, list(drawer.normal_channels)] = upstream.normals.reshape(len(columns), -1)
    columns[:, list(drawer.value_channels)] = upstream.channels.reshape(len(columns), -1)
    adjoints.channels[0].assign(columns)
    found = drawer.backward()
    return {name: getattr(found, name).numpy() for name in ARRAYS}


def relative(error: np.ndarray, size: np.ndarray) -> float:
    """Return the L2 norm of an error over that of what it is an error of; 0 of nothing."""
    norm = float(np.linalg.norm(size))
    return float(f"{np.linalg.norm(error) / norm:.2e}") if norm else 0.0


def report(device: Any) -> list[dict[str, Any]]:
    """Return a row for every scene and mode of depth."""
    rows = []
    for name, scene in scenes():
        for mode in MODES:
            rng = np.random.default_rng(2)
            moded = replace(scene, depth_mode=mode)
            decisions = decide(moded)
            upstream = random_upstream(rng, moded, decisions)
            wanted = gradients(moded, upstream, decisions)
            found = found_gradients(moded, upstream, device)
            others = [gradients(rounded(rng, moded), upstream, decisions) for _ in range(ROUNDINGS)]
            rows.append(
                {
                    "scene": name,
                    "depth": mode,
                    "error": {key: relative(found[key] - wanted[key], wanted[key]) for key in ARRAYS},
                    "one_rounding": {
                        key: max(relative(other[key] - wanted[key], wanted[key]) for other in others) for key in ARRAYS
                    },
                }
            )
    return rows


def main() -> None:
    """Measure and write."""
    parser = record.parser(__doc__, device=True)
    arguments = parser.parse_args()
    device = resolve_device(arguments.device)
    rows = report(device)
    record.write_result(arguments, device, {"rows": rows})


if __name__ == "__main__":
    main()
