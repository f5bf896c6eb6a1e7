"""Refit of merged Gaussians: every number that relit images depend on is moved until they look as the original's do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.raster.adam import Adam, Parameters
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianGradients, RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.reduction.moments import Changes, changed
from beam_warp.reduction.sensitivity import COLUMNS, MATERIALS, Sensitivity, material_rows, pixel_sums
from beam_warp.world.gaussians import GaussianCloud

RATES = {"shift": 0.05, "turn": 0.01, "stretch": 0.02, "logit": 0.05, "materials": 0.005}
"""Learning rates at first, of shifts in median scales; they fall to nothing along a quarter of a cosine."""

WIDTHS = {"shift": 3, "turn": 4, "stretch": 3, "logit": 1, "materials": MATERIALS}

FloatArray = NDArray[np.float64]


def refit(
    frames: Mapping[int, tuple[GaussianCloud, Rotation]],
    found: Sensitivity,
    *,
    steps: int,
    raster: RasterOptions,
    device: Any,
    progress: StageProgress = no_progress,
) -> Changes:
    """Find the changes of merged Gaussians that bring them closest to the original, by the forms of its views.

    Args:
        frames: Merged Gaussians of the frames that views are of, and how they are turned since the reference.
        found: What images of the original depend on.
        steps: Steps of Adam, one view each, in turn.
        raster: How splats are drawn.
        device: Warp device.
        progress: Called with (stage, done, total).
    """
    count = len(next(iter(frames.values()))[0])
    values = {name: wp.zeros((count, width), dtype=float, device=device) for name, width in WIDTHS.items()}
    values["turn"].assign(np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (count, 1)))
    slopes = {name: wp.zeros_like(array) for name, array in values.items()}
    some, _ = next(iter(frames.values()))
    rates = RATES | {"shift": RATES["shift"] * float(np.median(np.sort(some.scales, axis=1)[:, 1]))}
    adam = Adam({name: Parameters(values[name], slopes[name], rates[name]) for name in WIDTHS})
    cameras = [view.camera for view in found.views]
    drawer = Rasterizer(count, cameras[:1], value_count=MATERIALS, options=raster, device=device)
    prepared = [drawer.prepare_cameras([camera]) for camera in cameras]
    for step in range(steps):
        progress("refit", step, steps)
        for name, rate in rates.items():
            adam.set_learning_rate(name, rate * np.cos(0.5 * np.pi * step / steps))
        view = found.views[step % len(cameras)]
        drawer.set_cameras(prepared[step % len(cameras)])
        cloud, turn = frames[view.frame]
        now = changed(cloud, turn, _changes(values))
        images = drawer.draw(upload_gaussians(now, device, values=material_rows(now)))
        _set_adjoints(drawer, view.error(pixel_sums(images))[1])
        for name, rows in _slopes(now, turn, drawer.backward()).items():
            slopes[name].assign(rows.astype(np.float32).reshape(count, -1))
        adam.step()
    return _changes(values)


def _changes(values: Mapping[str, wp.array]) -> Changes:
    """Return the parameters as changes."""
    rows = {name: array.numpy().astype(np.float64) for name, array in values.items()}
    return Changes(**(rows | {"logit": rows["logit"][:, 0]}))


def _set_adjoints(drawer: Rasterizer, slope: NDArray[np.float32]) -> None:
    """Write an error's derivatives to the sums of pixels where `Rasterizer.backward` reads them."""
    target = drawer.adjoints()
    assert slope.shape[1] == COLUMNS
    target.channels[0].assign(np.ascontiguousarray(slope[:, :MATERIALS]))
    target.alpha.assign(np.ascontiguousarray(slope[:, MATERIALS]))


def _slopes(now: GaussianCloud, turn: Rotation, found: GaussianGradients) -> dict[str, FloatArray]:
    """Return the derivatives to the changes, from those to the Gaussians as they are drawn."""
    gradients = {name: getattr(found, name).numpy().astype(np.float64) for name in found._fields if name != "radiance"}
    back, materials = turn.inv(), gradients["values"][:, :MATERIALS].copy()
    normals = materials[:, 5:]
    assert now.normals is not None
    normals -= (normals * now.normals).sum(axis=1, keepdims=True) * now.normals
    materials[:, 5:] = back.apply(normals)
    opacities = now.opacities.astype(np.float64)
    return {
        "shift": back.apply(gradients["positions"]),
        "turn": _hamilton(now.orientations * [-1.0, -1.0, -1.0, 1.0], gradients["orientations"]),
        "stretch": gradients["scales"] * now.scales,
        "logit": gradients["opacities"] * opacities * (1.0 - opacities),
        "materials": materials,
    }


def _hamilton(left: NDArray[np.floating], right: FloatArray) -> FloatArray:
    """Return the products of quaternions xyzw, ``(N, 4)``."""
    (a, s), (b, t) = ((rows[:, :3], rows[:, 3:]) for rows in (left, right))
    return np.concatenate([s * b + t * a + np.cross(a, b), s * t - (a * b).sum(axis=1, keepdims=True)], axis=1)
