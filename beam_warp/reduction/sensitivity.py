"""What relit images depend on: the error of an image as a quadratic form of its G-buffer, and of Gaussians.

A pixel shows I = f(G), with G the nine sums of its G-buffer (`COLUMNS`) and f the shading under a light, encoded for
display. To first order a change of G costs |J dG|^2, with J = df/dG. The mean of J^T J over lights, a matrix M of 9 x 9
for each pixel, holds all that these lights can tell of a change: no light is needed again. Carried back through the
rasteriser, M weighs what each Gaussian's material may change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.device.arrays import resolve_device
from beam_warp.evaluate.relit import world
from beam_warp.evaluate.trials import RelitTrials, Trial
from beam_warp.image.color import linear_to_srgb
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.render.deferred_pixels import launch_shade_gaussians
from beam_warp.light.prepared import PreparedEnvironments
from beam_warp.raster.layout import ViewLayout
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterImages, RasterOptions
from beam_warp.raster.sources import upload_gaussians
from beam_warp.render.arriving import ArrivingLight
from beam_warp.render.options import UNSHADOWED
from beam_warp.render.shadow_maps import ShadowCasters
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import MATERIAL_CHANNELS, GaussianCloud, GaussianSequence

COLUMNS = 9
"""Sums of a pixel: base colour (3), roughness, ambient occlusion, normal (3), and alpha."""

MATERIALS = COLUMNS - 1

LIGHTS = 6
"""Lights over which the matrices of a view are the mean."""

STEPS = np.array([0.02, 0.02, 0.02, 0.02, 0.02, 0.03, 0.03, 0.03, -0.02])
"""Differences by which shading is differentiated; alpha goes down, since it ends at 1."""

LEAST_ALPHA = 0.02
"""Alpha below which a pixel counts as empty."""

OTHER_BACKGROUNDS = 0.1
"""Weight of an error of alpha beyond its effect on black: the subject may be seen before any background."""

EMPTY_WEIGHT = 0.5
"""Weight of alpha where nothing should be: encoding for display is steepest in the dark."""

TRIANGLE = np.triu_indices(MATERIALS)

FloatArray = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SeenView:
    """One view of the original: what a reduced asset is to show, and how errors count.

    Attributes:
        camera: The camera.
        frame: Number of the frame.
        target: Sums of every pixel, ``(P, 9)``.
        covered: Pixels that are not empty, ``(C,)``.
        matrices: The quadratic form of their errors, ``(C, 9, 9)``.
    """

    camera: Camera
    frame: int
    target: FloatArray
    covered: NDArray[np.int64]
    matrices: FloatArray

    def error(self, sums: FloatArray) -> tuple[float, FloatArray]:
        """Return the error of what another asset shows, ``(P, 9)``, summed over pixels, and its gradient."""
        away = sums - self.target
        slope = np.zeros_like(away)
        slope[:, MATERIALS] = EMPTY_WEIGHT * away[:, MATERIALS]
        slope[self.covered] = np.einsum("pij,pj->pi", self.matrices, away[self.covered], optimize=True)
        return float(np.vdot(away, slope)), 2.0 * slope


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """What the images of all views depend on, Gaussian by Gaussian.

    Attributes:
        views: The views.
        visible: Pixels that each Gaussian is worth, over all views, ``(N,)``.
        edges: Squared slope of images there, times these pixels [1/pixel^2], ``(N,)``: what a shift costs.
        materials: Quadratic form of the error by a change of its materials, ``(N, 8, 8)``.
        pixel: Size of a pixel at the subject [m].
    """

    views: tuple[SeenView, ...]
    visible: FloatArray
    edges: FloatArray
    materials: FloatArray
    pixel: float


def measure_sensitivity(
    sequence: GaussianSequence,
    trials: RelitTrials,
    cameras: Sequence[Trial],
    lights: Sequence[Trial],
    *,
    raster: RasterOptions,
    device: Any = None,
    progress: StageProgress = no_progress,
) -> Sensitivity:
    """Measure what relit images depend on.

    Args:
        sequence: Relightable; Gaussian i is the same in every frame.
        trials: The distribution.
        cameras: Draws whose frame and camera are views.
        lights: Draws whose lights are used, `LIGHTS` for a view, in turn.
        raster: How splats are drawn.
        device: Warp device.
        progress: Called with (stage, done, total).
    """
    meter = _Meter(sequence, trials, raster, resolve_device(device))
    count = len(TRIANGLE[0])
    views, totals, pixels = [], np.zeros((len(sequence[0]), 48), np.float32), []
    for number, trial in enumerate(cameras):
        progress("measure sensitivity", number, len(cameras))
        some = [lights[(number * LIGHTS + k) % len(lights)] for k in range(LIGHTS)]
        view, carried, pixel = meter.view(trial, some)
        views.append(view)
        pixels.append(pixel)
        totals += carried
    materials = np.zeros((len(totals), MATERIALS, MATERIALS), np.float32)
    materials[:, TRIANGLE[0], TRIANGLE[1]] = materials[:, TRIANGLE[1], TRIANGLE[0]] = totals[:, :count]
    return Sensitivity(tuple(views), totals[:, count + 1], totals[:, count], materials, float(np.mean(pixels)))


class _Meter:
    """Draws views of a sequence and differentiates their shading."""

    def __init__(self, sequence: GaussianSequence, trials: RelitTrials, raster: RasterOptions, device: Any) -> None:
        self._sequence, self._trials, self._raster, self._device = sequence, trials, raster, device
        self._environments = PreparedEnvironments(device, trials.prepared)
        self._frame = -1

    def _show(self, frame: int) -> None:
        """Bring a frame to the device."""
        if frame == self._frame:
            return
        self._frame, self._cloud = frame, world(self._sequence, frame)
        self._gaussians = upload_gaussians(self._cloud, self._device, values=material_rows(self._cloud))
        self._arriving = ArrivingLight(len(self._cloud), UNSHADOWED, self._environments, self._device)
        self._casters = ShadowCasters.of(self._cloud)

    def view(self, trial: Trial, lights: Sequence[Trial]) -> tuple[SeenView, FloatArray, float]:
        """Return a view, what it carries back to Gaussians, and the size of its pixels at the subject."""
        self._show(trial.frame)
        camera = self._trials.camera(trial, self._cloud)
        rasterizer = Rasterizer(
            len(self._cloud), [camera], value_count=MATERIALS, options=self._raster, device=self._device
        )
        images = rasterizer.draw(self._gaussians)
        sums = pixel_sums(images)
        covered = np.flatnonzero(sums[:, MATERIALS] > LEAST_ALPHA)
        matrices, edges = np.zeros((len(covered), COLUMNS, COLUMNS), np.float32), np.zeros(len(sums), np.float32)
        for light in lights:
            shades = self._shades(camera, images, sums, light)
            slopes = (shades[1:, covered] - shades[0, covered]) / STEPS[:, None, None]
            matrices += np.einsum("ipc,jpc->pij", slopes, slopes, optimize=True) / len(lights)
            along = np.gradient(shades[0].reshape(camera.height, camera.width, 3), axis=(0, 1))
            edges += 0.5 * sum(np.square(each).sum(axis=-1).reshape(-1) for each in along) / len(lights)
        matrices[:, MATERIALS, MATERIALS] += OTHER_BACKGROUNDS
        seen = SeenView(camera, trial.frame, sums, covered, matrices)
        carried = np.zeros((len(sums), 48), np.float32)
        carried[covered, : len(TRIANGLE[0])] = matrices[:, TRIANGLE[0], TRIANGLE[1]]
        carried[:, len(TRIANGLE[0])], carried[:, len(TRIANGLE[0]) + 1] = edges, 1.0
        depth = float(np.linalg.norm(camera.position - self._cloud.positions.mean(axis=0)))
        return seen, self._carried_back(rasterizer, carried), depth / camera.focal_y

    def _shades(self, camera: Camera, images: RasterImages, sums: FloatArray, light: Trial) -> FloatArray:
        """Return what pixels show, encoded, as they are and with each sum changed by its step, ``(10, P, 3)``."""
        environment, lamps = self._trials.lights(light, self._cloud)
        self._arriving.set_environment(environment, light.turn, self._casters, moved=False)
        lamps = tuple(replace(lamp, casts_shadows=False) for lamp in lamps)  # maps cost more than all the rest
        self._arriving.set_lights(lamps, self._casters, moved=False)
        views = wp.array(ViewLayout.of([camera]).views, dtype=RasterView, device=self._device)
        out = wp.zeros(len(sums), dtype=wp.vec4, device=self._device)
        shades = np.zeros((COLUMNS + 1, len(sums), 3), np.float32)
        for column in range(-1, COLUMNS):
            changed = sums.copy()
            if column >= 0:
                changed[:, column] += STEPS[column]
            empty = changed[:, MATERIALS] <= 0.0
            rows = wp.array(changed[:, :MATERIALS], dtype=float, device=self._device)
            alpha = wp.array(np.where(empty, 0.0, changed[:, MATERIALS]), dtype=float, device=self._device)
            drawn = RasterImages((rows,), alpha, images.depth, images.median_depth)
            launch_shade_gaussians(views, drawn, False, self._arriving.scene_light(), out, self._device)
            shades[column + 1] = linear_to_srgb(np.clip(out.numpy()[:, :3], 0.0, 1.0))
        return shades

    def _carried_back(self, rasterizer: Rasterizer, pixels: FloatArray) -> FloatArray:
        """Return the sums over pixels, by the weight of each Gaussian there, of numbers of pixels, ``(N, 48)``."""
        parts = []
        for start in range(0, pixels.shape[1], 16):
            out = wp.empty((len(self._cloud), 16), dtype=float, device=self._device)
            part = np.ascontiguousarray(pixels[:, start : start + 16])
            rasterizer.back_project(wp.array(part, dtype=float, device=self._device), out)
            parts.append(out.numpy().copy())
        return np.concatenate(parts, axis=1)


def material_rows(cloud: GaussianCloud) -> FloatArray:
    """Return the materials of Gaussians in the order of `COLUMNS`, ``(N, 8)``."""
    return np.concatenate([getattr(cloud, name).reshape(len(cloud), -1) for name in MATERIAL_CHANNELS], axis=1)


def pixel_sums(images: RasterImages) -> FloatArray:
    """Return the sums of pixels in the order of `COLUMNS`, ``(P, 9)``."""
    return np.concatenate([images.channels[0].numpy()[:, :MATERIALS], images.alpha.numpy()[:, None]], axis=1)
