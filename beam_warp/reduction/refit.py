"""Refit of merged Gaussians: every number that relit images depend on is moved until they look as the original's do."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from beam_warp.device.arrays import resolve_device, upload
from beam_warp.device.graphs import StepGraphs
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.kernels.reduction.changes import launch_change, launch_change_adjoint
from beam_warp.raster.adam import Adam, Parameters
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.reduction.changes import Changes, logit_of
from beam_warp.reduction.sensitivity import MATERIALS, Sensitivity, material_rows
from beam_warp.world.gaussians import GaussianCloud

RATES = {"shift": 0.025, "turn": 0.005, "stretch": 0.01, "logit": 0.025, "materials": 0.0025}
"""Learning rates at first, of shifts in median scales. Twice as much costs 1 dB and more: shapes never settle."""

LAST = 0.05
"""Share of the rates that is left at last; they fall by the same factor in every step."""

FORGETTING = 0.99
"""Decay of Adam's mean squared gradients: what it is usually, 0.999, remembers the large ones of the first steps."""

RATED_EVERY = 10
"""Steps between changes of the rates."""

MOVED = ("shift", "turn", "stretch", "logit", "materials")


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
    some, _ = next(iter(frames.values()))
    work = _Refit(frames, found, raster, device)
    rates = RATES | {"shift": RATES["shift"] * float(np.median(np.sort(some.scales, axis=1)[:, 1]))}
    pairs = zip(MOVED, work.changes, work.slopes, strict=True)
    groups = {name: Parameters(values, slopes, rates[name]) for name, values, slopes in pairs}
    adam = Adam(groups, beta2=FORGETTING)
    graphs = StepGraphs(resolve_device(device))

    def take(view: int) -> None:
        work.differentiate(view)
        adam.step()

    for step in range(steps):
        if step % RATED_EVERY == 0:
            progress("refit", step, steps)
            for name, rate in rates.items():
                adam.set_learning_rate(name, rate * LAST ** (step / steps))
            if work.lacks_room():
                work.make_room()
                graphs.clear()
        view = step % len(found.views)
        if work.is_whole:
            graphs.run(view, partial(take, view))
        else:
            take(view)
    return work.found()


class _Refit:
    """The numbers that a refit moves, and their derivatives, on the device.

    Attributes:
        changes: As in `Changes`, in the order of `MOVED`.
        slopes: Derivatives of the error of one view to them.
        is_whole: Whether every view is drawn in one go, so that a step may be recorded.
    """

    def __init__(
        self,
        frames: Mapping[int, tuple[GaussianCloud, Rotation]],
        found: Sensitivity,
        raster: RasterOptions,
        device: Any,
    ) -> None:
        """Bring the frames to the device, unchanged as yet."""
        self._views, self._device = found.views, device
        self._merged = {frame: _uploaded(cloud, turn, device) for frame, (cloud, turn) in frames.items()}
        some = next(iter(self._merged.values()))
        count = len(some[0])
        kinds = zip(MOVED, (wp.vec3, wp.quat, wp.vec3, float, float), strict=True)
        shapes = {name: (count, MATERIALS) if name == "materials" else (count,) for name in MOVED}
        self.changes = tuple(wp.zeros(shapes[name], dtype=kind, device=device) for name, kind in kinds)
        self.changes[1].fill_(wp.quat(0.0, 0.0, 0.0, 1.0))
        self.slopes = tuple(wp.zeros_like(array) for array in self.changes)
        self._gaussians = GaussianArrays(*(wp.empty_like(array) for array in some[:-1]))
        cameras = [view.camera for view in found.views]
        how: dict[str, Any] = {"options": raster, "device": device, "checkpoints": True}
        self._drawer = Rasterizer(count, cameras[:1], value_count=MATERIALS, **how)
        self._cameras = [self._drawer.prepare_cameras([camera]) for camera in cameras]

        self.is_whole, self._has_room = True, False

    def lacks_room(self) -> bool:
        """Return whether the last view did not fit, or none was drawn yet."""
        return not self._has_room or self._drawer.pair_count() > self._drawer.pair_capacity

    def make_room(self) -> None:
        """Draw every view as it is now, with as much room as it takes, some of it to spare."""
        self.is_whole = self._has_room = True
        for number in range(len(self._views)):
            self._show(number)
            self._drawer.draw(self._gaussians)
            self.is_whole &= self._drawer.is_whole
        self._drawer.backward()  # allocates what the way back needs, which a recording must not

    def _show(self, number: int) -> tuple[wp.array, ...]:
        """Take a view's camera, and change the Gaussians of its frame; return these as they were."""
        self._drawer.set_cameras(self._cameras[number])
        merged = self._merged[self._views[number].frame]
        launch_change(merged, self.changes, self._gaussians[:5], self._device)
        return merged

    def differentiate(self, number: int) -> None:
        """Find the slopes of the error of a view; nothing waits for the device, if all views have room."""
        drawer, merged = self._drawer, self._show(number)
        self._views[number].slopes(drawer.redraw(), drawer.adjoints())
        gradients = drawer.backward()[:5]
        launch_change_adjoint(merged, self.changes, self._gaussians[:5], gradients, self.slopes, self._device)

    def found(self) -> Changes:
        """Return the changes on the host."""
        return Changes(**{n: a.numpy().astype(np.float64) for n, a in zip(MOVED, self.changes, strict=True)})


def _uploaded(cloud: GaussianCloud, turn: Rotation, device: Any) -> tuple[wp.array, ...]:
    """Return positions, orientations, scales, logits of opacities, materials, and turns since the reference."""
    shape = upload_gaussians(cloud, device, values=material_rows(cloud))
    logits = logit_of(cloud.opacities.astype(np.float64)).astype(np.float32)
    turns = turn.as_quat().astype(np.float32)
    return (*shape[:3], upload(logits, float, device), shape.values, upload(turns, wp.quat, device))
