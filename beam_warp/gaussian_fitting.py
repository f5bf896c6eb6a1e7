"""The first frame: Gaussians that look like the photographs of a moment, with the geometry that these imply."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.adam import Adam
from beam_warp.assets import GaussianCloud
from beam_warp.captured_views import CapturedView
from beam_warp.densification import choose_strained, prune, split
from beam_warp.devices import resolve_device
from beam_warp.gaussian_parameters import GaussianParameters
from beam_warp.kernels.stress import launch_add_stress
from beam_warp.raster_records import RasterOptions
from beam_warp.view_targets import LossWeights, ViewTargets, crop_views

FitProgress = Callable[[int, int], None]
"""Called with (iterations done, iterations in all)."""


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How Gaussians are fitted to the photographs of one moment."""

    gaussian_count: int = 60_000
    color_iterations: int = 1_000
    normal_iterations: int = 2_000
    sh_degree: int = 2
    normal_weight: float = 0.03
    alpha_weight: float = 0.5
    attraction: float = 0.1
    samples: int = 1
    ssim_weight: float = 0.2
    refine_every: int = 250
    refine_until: float = 0.6
    split_fraction: float = 0.1
    dead_opacity: float = 0.02
    position_rate: float = 1.6e-4
    final_position_rate: float = 1.6e-6
    orientation_rate: float = 2e-3
    scale_rate: float = 5e-3
    opacity_rate: float = 3e-2
    color_rate: float = 5e-3
    band_rate: float = 2.5e-4
    raster: RasterOptions = field(default_factory=lambda: RasterOptions(antialiased=True))
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Fit:
    """What came out."""

    cloud: GaussianCloud
    report: dict[str, Any] = field(default_factory=dict)


def fit_gaussians(
    views: Sequence[CapturedView],
    start: GaussianCloud,
    options: FitOptions | None = None,
    *,
    device: str | None = None,
    progress: FitProgress | None = None,
) -> Fit:
    """Fit."""
    fitter = Fitter(views, start, options or FitOptions(), resolve_device(device))
    fitter.run(progress)
    return Fit(fitter.parameters.cloud(), fitter.report())


class Fitter:
    """Steps of the fit of one moment."""

    def __init__(self, views: Sequence[CapturedView], start: GaussianCloud, options: FitOptions, device: Any) -> None:
        self.options = options
        self.device = device
        self.parameters = GaussianParameters(
            start, device, row_count=max(options.gaussian_count, len(start)), sh_degree=options.sh_degree
        )
        cropped = crop_views(views)
        by_size: dict[tuple[int, int], list[CapturedView]] = {}
        for view in cropped:
            by_size.setdefault((view.camera.width, view.camera.height), []).append(view)
        self.groups = [
            ViewTargets(group, len(self.parameters), options.raster, options.samples, device)
            for group in by_size.values()
        ]
        self.views = [(group, index) for group in self.groups for index in range(len(group))]
        center = np.median(start.positions, axis=0)
        self.extent = float(np.mean([np.linalg.norm(view.camera.position - center) for view in views]))
        chosen = options
        self.adam: Adam = self.parameters.optimizer(
            {
                "positions": chosen.position_rate * self.extent,
                "orientations": chosen.orientation_rate,
                "log_scales": chosen.scale_rate,
                "logits": chosen.opacity_rate,
                "color": chosen.color_rate,
                "bands": chosen.band_rate,
            }
        )
        self.weights = LossWeights(
            l1=1.0 - chosen.ssim_weight, ssim=chosen.ssim_weight, alpha=chosen.alpha_weight, normal=0.0
        )
        count = len(self.parameters)
        self.stress = wp.zeros(count, dtype=float, device=device)
        self.seen = wp.zeros(count, dtype=float, device=device)
        self._graphs: dict[int, Any] = {}
        self._capacities: list[int] = []
        self.seconds = 0.0

    def run(self, progress: FitProgress | None = None) -> None:
        """Take all steps."""
        began = time.perf_counter()
        chosen = self.options
        total = chosen.color_iterations + chosen.normal_iterations
        order = self._order(total)
        self.make_room()
        for iteration in range(total):
            if iteration == chosen.color_iterations:
                self.weights = replace(self.weights, normal=chosen.normal_weight)
                self._graphs.clear()
            if iteration % 50 == 0:
                part = iteration / max(total - 1, 1)
                rate = chosen.position_rate * (chosen.final_position_rate / chosen.position_rate) ** part
                self.adam.set_learning_rate("positions", rate * self.extent)
                if progress is not None:
                    progress(iteration, total)
            self.step(int(order[iteration]))
            done = iteration + 1
            if done % chosen.refine_every == 0 and done <= chosen.refine_until * total:
                self.refine()
                self.make_room()
        wp.synchronize_device(self.device)
        self.seconds = time.perf_counter() - began

    def _order(self, total: int) -> NDArray[np.int64]:
        """Return which view each step looks at: all of them, shuffled, again and again."""
        rng = np.random.default_rng(self.options.seed)
        rounds = -(-total // len(self.views))
        return np.concatenate([rng.permutation(len(self.views)) for _ in range(rounds)])

    def make_room(self) -> None:
        """Draw every view once, with as much room as it takes."""
        self.parameters.activate()
        for group, index in self.views:
            group.select(index)
            group.rasterizer.draw(self.parameters.drawn)
        capacities = [group.rasterizer.pair_capacity for group in self.groups]
        if capacities != self._capacities:
            self._graphs.clear()
            self._capacities = capacities

    def step(self, view: int) -> None:
        """Take one step, as a graph where the device has them."""
        if not self.device.is_cuda:
            self._launch_step(view)
            return
        if view not in self._graphs:
            with wp.ScopedCapture(self.device) as capture:
                self._launch_step(view)
            self._graphs[view] = capture.graph
        wp.capture_launch(self._graphs[view])

    def _launch_step(self, view: int) -> None:
        group, index = self.views[view]
        parameters = self.parameters
        parameters.activate()
        group.select(index)
        group.rasterizer.redraw()
        group.add_losses(index, self.weights)
        drawn = group.rasterizer.backward()
        launch_add_stress(drawn.positions, self.stress, self.seen, self.device)
        parameters.zero_gradients()
        parameters.add_gradients(drawn)
        if self.options.attraction > 0.0:
            group.attract(index, parameters.drawn, self.options.attraction, parameters.gradient("positions"))
        self.adam.step()

    def refine(self) -> None:
        """Drop Gaussians that are not seen, and split strained ones into their rows."""
        chosen = self.options
        rows = self.parameters.rows()
        stress, seen = self.stress.numpy(), self.seen.numpy()
        alive = self.parameters.alive()
        opacity = 1.0 / (1.0 + np.exp(-rows["logits"].astype(np.float64)))
        dead = alive & ((opacity < chosen.dead_opacity) | (seen == 0))
        prune(rows, dead)
        alive &= ~dead
        free = np.flatnonzero(~alive)
        strained = choose_strained(
            stress / np.maximum(seen, 1.0), alive, min(len(free), int(chosen.split_fraction * alive.sum()))
        )
        split(rows, strained, free[: len(strained)])
        self.parameters.set_rows(rows)
        changed = dead.copy()
        changed[strained] = True
        changed[free[: len(strained)]] = True
        self.adam.restart(changed)
        self.stress.zero_()
        self.seen.zero_()

    def psnr(self) -> float:
        """Return the mean PSNR over the views of crops, encoded and clipped [dB]."""
        self.parameters.activate()
        values = []
        for group, index in self.views:
            group.select(index)
            group.rasterizer.draw(self.parameters.drawn)
            values.append(-10.0 * np.log10(max(group.square_error(index), 1e-12)))
        return float(np.mean(values))

    def report(self) -> dict[str, Any]:
        """Return what was done, JSON-able."""
        return {
            "psnr": self.psnr(),
            "gaussians": int(self.parameters.alive().sum()),
            "seconds": self.seconds,
        }
