"""What relit images depend on: the error of an image as a quadratic form of its G-buffer, and of Gaussians.

A pixel shows I = f(G), with G the nine sums of its G-buffer (`COLUMNS`) and f the shading under a light, encoded for
display. To first order a change of G costs |J dG|^2, with J = df/dG. The mean of J^T J over lights, a matrix M of 9 x 9
for each pixel, holds all that these lights can tell of a change: no light is needed again. What few lights do not tell
of a pixel, the mean M of all pixels does: it is shrunk towards that (Ledoit and Wolf 2004). Carried back through the
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
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.kernels.raster.project import RasterView
from beam_warp.kernels.reduction.image_forms import (
    launch_add_columns,
    launch_add_edges,
    launch_add_forms,
    launch_blend_forms,
    launch_carry,
    launch_form_slopes,
    launch_nudge,
)
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

LIGHTS = 2
"""Lights over which the matrices of a view are the mean: more cost time, and refits gain nothing by them."""

MEAN_LIGHTS, MEAN_VIEWS = 1.0, 16
"""Lights that the mean matrix counts as in the matrix of every pixel, and views that it is measured in. Two lights have
six colour values: alone, they let a pixel's nine sums change freely in three ways, and long refits go these ways."""

STEPS = np.array([0.02, 0.02, 0.02, 0.02, 0.02, 0.03, 0.03, 0.03, -0.02])
"""Differences by which shading is differentiated; alpha goes down, since it ends at 1."""

LEAST_ALPHA = 0.02
"""Alpha below which a pixel counts as empty."""

OTHER_BACKGROUNDS = 0.1
"""Weight of an error of alpha beyond its effect on black: the subject may be seen before any background."""

EMPTY_WEIGHT = 0.5
"""Weight of alpha where nothing should be: encoding for display is steepest in the dark."""

FORM, PASSES = COLUMNS * (COLUMNS + 1) // 2, (16, 16, 8)
"""Numbers of a form as it is stored; those of a pixel that are carried back, so many at a time."""

TRIANGLE = np.tril_indices(MATERIALS)

FloatArray = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SeenView:
    """One view of the original: what a reduced asset is to show, and how errors count; arrays are on the device.

    Attributes:
        camera: The camera.
        frame: Number of the frame.
        target: Sums of the materials of every pixel, ``(P, 8)``.
        alpha: Alpha of every pixel, ``(P,)``.
        places: Each pixel's row in ``forms``, -1 where it is empty, ``(P,)``.
        forms: The quadratic forms of errors of pixels that are not empty, as in ``kernels/reduction/image_forms.py``.
    """

    camera: Camera
    frame: int
    target: wp.array
    alpha: wp.array
    places: wp.array
    forms: wp.array

    def slopes(self, images: RasterImages, out: RasterImages) -> None:
        """Write the derivatives of the error of what another asset shows to ``out``."""
        known = (self.places, self.forms, self.target, self.alpha, EMPTY_WEIGHT)
        found = (images.channels[0], images.alpha, out.channels[0], out.alpha)
        launch_form_slopes(len(self.alpha), *known, *found, self.alpha.device)


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
    views, pixels = [], []
    for number, trial in enumerate(cameras):
        progress("measure sensitivity", number, len(cameras))
        some = [lights[(number * LIGHTS + k) % len(lights)] for k in range(LIGHTS)]
        view, pixel = meter.view(trial, some)
        views.append(view)
        pixels.append(pixel)
    _blend_mean(views)
    totals = meter.carried.numpy()
    materials = np.zeros((len(totals), MATERIALS, MATERIALS), np.float32)
    materials[:, TRIANGLE[0], TRIANGLE[1]] = materials[:, TRIANGLE[1], TRIANGLE[0]] = totals[:, :count]
    return Sensitivity(tuple(views), totals[:, count + 1], totals[:, count], materials, float(np.mean(pixels)))


def _blend_mean(views: Sequence[SeenView]) -> None:
    """Take the mean form of all pixels into the form of each, as further lights that it is known under."""
    some = [view.forms.numpy() for view in views[:: max(1, len(views) // MEAN_VIEWS)]]
    forms = np.concatenate(some, dtype=np.float64)
    if not len(forms):
        return
    share = MEAN_LIGHTS / (LIGHTS + MEAN_LIGHTS)
    mean = forms.mean(axis=0).astype(np.float32)
    for view in views:
        device = view.forms.device
        launch_blend_forms(len(view.forms), wp.array(mean, dtype=float, device=device), share, view.forms, device)


class _Meter:
    """Draws views of a sequence and differentiates their shading.

    Attributes:
        carried: Sums over pixels, by the weight of each Gaussian there, of forms, slopes and 1, ``(N, 40)``.
    """

    def __init__(self, sequence: GaussianSequence, trials: RelitTrials, raster: RasterOptions, device: Any) -> None:
        self._sequence, self._trials, self._device = sequence, trials, device
        self._environments = PreparedEnvironments(device, trials.prepared)
        self._frame, count = -1, len(sequence[0])
        self.carried = wp.zeros((count, sum(PASSES)), dtype=float, device=device)
        some = trials.camera(trials.draw("search", range(1), [0])[0], world(sequence, 0))
        self._rasterizer = Rasterizer(count, [some], value_count=MATERIALS, options=raster, device=device)

    def _show(self, frame: int) -> None:
        """Bring a frame to the device."""
        if frame == self._frame:
            return
        self._frame, self._cloud = frame, world(self._sequence, frame)
        self._gaussians = upload_gaussians(self._cloud, self._device, values=material_rows(self._cloud))
        self._arriving = ArrivingLight(len(self._cloud), UNSHADOWED, self._environments, self._device)
        self._casters = ShadowCasters.of(self._cloud)

    def view(self, trial: Trial, lights: Sequence[Trial]) -> tuple[SeenView, float]:
        """Return a view, and the size of its pixels at the subject; what it carries back is added to the rest."""
        self._show(trial.frame)
        camera = self._trials.camera(trial, self._cloud)
        self._rasterizer.set_cameras(self._rasterizer.prepare_cameras([camera]))
        images = self._rasterizer.draw(self._gaussians)
        covered = np.flatnonzero(images.alpha.numpy() > LEAST_ALPHA)
        forms, edges = self._forms(camera, images, covered, lights)
        places = np.full(len(images.alpha), -1, np.int32)
        places[covered] = np.arange(len(covered))
        rows = wp.array(places, dtype=int, device=self._device)
        seen = SeenView(camera, trial.frame, wp.clone(images.channels[0]), wp.clone(images.alpha), rows, forms)
        depth = float(np.linalg.norm(camera.position - self._cloud.positions.mean(axis=0)))
        self._carry_back(seen, edges)
        return seen, depth / camera.focal_y

    def _forms(
        self, camera: Camera, images: RasterImages, covered: NDArray[np.int64], lights: Sequence[Trial]
    ) -> tuple[wp.array, wp.array]:
        """Return the forms of covered pixels, ``(C, 45)``, and the squared slope of the image at every pixel."""
        count, device = len(images.alpha), self._device
        pixels = wp.array(covered.astype(np.int32), dtype=int, device=device)
        steps = wp.array(STEPS.astype(np.float32), dtype=float, device=device)
        views = wp.array(ViewLayout.of([camera]).views, dtype=RasterView, device=device)
        forms, edges = wp.zeros((len(covered), FORM), dtype=float, device=device), wp.zeros(count, float, device=device)
        forms[:, FORM - 1].fill_(OTHER_BACKGROUNDS)
        shades = wp.zeros((COLUMNS + 1, count), dtype=wp.vec4, device=device)
        nudged = []
        for column, step in ((COLUMNS, 0.0), *enumerate(STEPS)):
            rows, alpha = wp.empty_like(images.channels[0]), wp.empty_like(images.alpha)
            launch_nudge(count, images.channels[0], images.alpha, column, float(step), rows, alpha, device)
            nudged.append(RasterImages((rows,), alpha, images.depth, images.median_depth))
        share = 1.0 / len(lights)
        for light in lights:
            self._light(light)
            arriving = self._arriving.scene_light()
            for row, drawn in enumerate(nudged):
                launch_shade_gaussians(views, drawn, False, arriving, shades[row], device)
            launch_add_forms(len(covered), pixels, shades, steps, share, forms, device)
            launch_add_edges(count, camera.width, camera.height, shades, share, edges, device)
        return forms, edges

    def _light(self, light: Trial) -> None:
        """Take the lights of a draw, without shadows: their maps cost more than all the rest."""
        environment, lamps = self._trials.lights(light, self._cloud)
        lamps = tuple(replace(lamp, casts_shadows=False) for lamp in lamps)
        self._arriving.set(environment, light.turn, lamps, self._casters, moved=False)

    def _carry_back(self, seen: SeenView, edges: wp.array) -> None:
        """Add the sums of a view."""
        start, count = 0, len(self._cloud)
        for width in PASSES:
            pixels = wp.empty((len(edges), width), dtype=float, device=self._device)
            rows = wp.empty((count, width), dtype=float, device=self._device)
            launch_carry(len(edges), start, seen.places, seen.forms, edges, pixels, self._device)
            self._rasterizer.back_project(pixels, rows)
            launch_add_columns(count, rows, start, self.carried, self._device)
            start += width


def material_rows(cloud: GaussianCloud) -> FloatArray:
    """Return the materials of Gaussians in the order of `COLUMNS`, ``(N, 8)``."""
    return np.concatenate([getattr(cloud, name).reshape(len(cloud), -1) for name in MATERIAL_CHANNELS], axis=1)
