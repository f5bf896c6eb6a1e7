"""Masks of cut-outs: how far they are off, by rings without light and by what all views agree on.

A mask that is too large shows a ring without light, whose width says by how much (`beam_warp.capture.cutouts`). Where
no view shows one, nothing more is done: exact masks stay as they are, to the bit, and cost no fit. Where some do, the
others may be too small, which they do not show themselves. Then:

1. The masks with rings are taken in.
2. A short fit to all views, at a reduced resolution, is a compromise between their masks. How far a view's mask reaches
   beyond what is drawn of it, less the same of the views that had rings, is most of what it is off by.
3. The masks are moved by that, and it is done again, until they move little.

With half of the masks of walker, runner and robot a pixel too large and half too small, the large ones are found to
0.03 pixel, the small ones to 0.1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_gradient_magnitude, minimum_filter, uniform_filter

from beam_warp.capture.cutouts import FADES, MOST_PIXELS, Ring, ring_of, taken_in
from beam_warp.capture.mask_corrections import MaskCorrections
from beam_warp.capture.matte_edges import SOLID
from beam_warp.capture.mattes import MaskOffset
from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.image.metrics import block_means
from beam_warp.jobs.listeners import no_progress
from beam_warp.raster.channels import RADIANCE
from beam_warp.raster.gbuffer import rasterize
from beam_warp.reconstruction.fit import OF_FEW_STEPS, FitOptions, Fitter, LearningRates
from beam_warp.reconstruction.frames.protocols import StepProgress
from beam_warp.reconstruction.initial import initial_gaussians

LEAST_RING = 0.15
"""Width from which a ring is more than the subject's own darkness [pixel]: that is 0.02 at most on clean views of
walker, runner and robot. A mask that is 0.75 pixel too large has 0.2 at least."""

FADING, SHARP = 0.33, 0.5
"""Distance from the true outline to a ring where colour fades to it and where it ends at once [pixel]; of discs and of
walker, runner and robot, within 0.05."""

RING_ERROR = 0.1
"""Standard error of an offset that is read from a ring [pixel]."""

LEAST_MOVE = 0.25
"""Masks without a ring that are off by less stay as they are [pixel]: as large is the error of the first fit."""

FEWEST_VIEWS = 6
"""Fewest views that agree on masks without rings: fewer see most of the surface once."""

SIDE = 160
"""Views are reduced by whole factors as long as their shorter side is as long [pixel]."""

MOST_GAUSSIANS, VISITS, ROUNDS = 4_000, 15, 4
"""Gaussians of a fit, how often it looks at each view, and most fits."""

GAIN = 1.25
"""Offsets over what a fit shows of them: it follows each mask a little."""

SETTLED = 0.1
"""Root mean square motion of the masks at which rounds end [pixel]."""

SAMPLES = 2
"""Side of the square of samples of a pixel where coverage is drawn."""

WINDOW = 7
"""Side of the windows whose pixels share an offset [pixel]."""

NO_FACTS: Mapping[str, float] = MappingProxyType({})


def mend_masks(
    names: Sequence[str],
    views: Sequence[CapturedView],
    options: FitOptions,
    *,
    device: str | None = None,
    progress: StepProgress = no_progress,
) -> MaskCorrections:
    """Find how far the masks of cut-outs are off.

    Args:
        names: Names of the cameras.
        views: The image of each of them at one moment.
        options: How key frames are fitted.
        device: Warp device; None takes the first CUDA device, or the CPU.
        progress: Called with (done, total, facts), in fits.

    Returns:
        Corrections of masks that are beyond doubt wrong; empty where no view has a ring without light.

    Raises:
        InvalidArrayError: The masks have no volume in common.
        DeviceError: There is no such device.
    """
    offsets = ring_offsets([ring_of(view) for view in views])
    has_ring = np.isfinite(offsets)
    if not has_ring.any():
        return MaskCorrections()
    errors = np.full(len(views), RING_ERROR)
    others = ~has_ring
    offsets[others] = 0.0
    if others.any() and len(views) >= FEWEST_VIEWS and all(view.alpha is not None for view in views):
        offsets, last = _agreed(views, offsets, has_ring, options, resolve_device(device), progress)
        errors[others] = np.hypot(RING_ERROR, last)
    kept = has_ring | (np.abs(offsets) > LEAST_MOVE)
    return MaskCorrections(
        {
            name: MaskOffset(float(pixels), float(error))
            for name, pixels, error, is_kept in zip(names, offsets, errors, kept, strict=True)
            if is_kept
        }
    )


def ring_offsets(rings: Sequence[Ring]) -> NDArray[np.float64]:
    """Return how far masks reach beyond the subject [pixel], NaN where there is no ring, ``(V,)``."""
    widths = np.array([ring.width for ring in rings])
    is_ring = widths > LEAST_RING
    dim = np.array([ring.dim for ring in rings])[is_ring]
    beyond = FADING if len(dim) and np.median(dim) > FADES else SHARP
    return np.where(is_ring, np.minimum(widths + beyond, MOST_PIXELS), np.nan)


def _agreed(
    views: Sequence[CapturedView],
    offsets: NDArray[np.float64],
    has_ring: NDArray[np.bool_],
    options: FitOptions,
    device: Any,
    progress: StepProgress,
) -> tuple[NDArray[np.float64], float]:
    """Return offsets with those of views without a ring as all views agree, and how much they moved last [pixel]."""
    moved = np.inf
    for done in range(ROUNDS):
        progress(done, ROUNDS, NO_FACTS)
        shown = _shown_offsets([taken_in(*pair) for pair in zip(views, offsets, strict=True)], options, device)
        change = np.where(has_ring, 0.0, GAIN * (shown - np.median(shown[has_ring])))
        before = offsets
        offsets = np.clip(offsets + np.nan_to_num(change), -MOST_PIXELS, MOST_PIXELS)
        moved = float(np.sqrt(np.mean(np.square(offsets - before)[~has_ring])))
        if moved < SETTLED:
            break
    progress(ROUNDS, ROUNDS, NO_FACTS)
    return offsets, moved


def _shown_offsets(views: Sequence[CapturedView], options: FitOptions, device: Any) -> NDArray[np.float64]:
    """Fit a few Gaussians to reduced views; return how far each mask reaches beyond what is drawn [pixel], ``(V,)``."""
    factors = [max(1, min(view.camera.width, view.camera.height) // SIDE) for view in views]
    reduced = [view.reduced(factor) for view, factor in zip(views, factors, strict=True)]
    count = min(options.gaussian_count, MOST_GAUSSIANS)
    start = initial_gaussians(reduced, count, device=str(device), seed=options.seed)
    fitting = replace(
        options,
        gaussian_count=count,
        target_psnr=None,
        color_iterations=VISITS * len(views),
        normal_iterations=0,
        rates=LearningRates(),  # the preset's go with its own number of steps
        samples=1,
        temporal=0.0,
        refine_every=0,
        **OF_FEW_STEPS,
    )
    fitter = Fitter(reduced, start, fitting, device)
    fitter.run()
    cameras = [view.camera.supersampled(SAMPLES) for view in reduced]
    drawn = rasterize(
        fitter.parameters.cloud(), cameras, channels=(RADIANCE,), options=options.raster, device=str(device)
    )
    return np.array(
        [
            factor * relative_offset(view.alpha, block_means(image.alpha, SAMPLES))
            for factor, view, image in zip(factors, reduced, drawn, strict=True)
            if view.alpha is not None
        ]
    )


def relative_offset(mask: NDArray[np.float32], drawn: NDArray[np.float32]) -> float:
    """Return how far a mask reaches beyond what is drawn of the view, median along the outline [pixel].

    Args:
        mask: Coverage in [0, 1], ``(H, W)``.
        drawn: Coverage as a fit to all views draws it, ``(H, W)``.

    Returns:
        The offset; NaN where the mask has no outline.
    """
    length = uniform_filter(gaussian_gradient_magnitude(mask.astype(np.float64), 1.0), WINDOW)
    edge = (mask > SOLID) & (minimum_filter(mask, 3, mode="nearest") <= SOLID) & (length > 0.5 / WINDOW)
    if not edge.any():
        return float("nan")
    return float(np.median(uniform_filter(mask.astype(np.float64) - drawn, WINDOW)[edge] / length[edge]))
