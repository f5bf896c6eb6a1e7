"""How far the relit images of an asset are from those of another one: the error of a reduction."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.errors import MissingPackageError
from beam_warp.evaluate.perceptual import Measure, PerceptualMetrics
from beam_warp.evaluate.trials import RelitTrials, Trial
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.metrics import bounding_box, psnr
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import DeferredOptions
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.shot import RenderedImage

ASSET_PSNR = 35.0
"""PSNR of an asset's relit images against the truth where nobody measured it: that of a good one [dB]."""


MEASURES = ("loss", "flip", "error")
"""Errors of relit images by name: `loss_of` [dB], mean FLIP, and the root mean square of display values, 0 to 1."""


def compared_options(height: int) -> DeferredOptions:
    """Return how trials of a height [pixel] are drawn: the split sum with ambient occlusion, shadow maps of lamps."""
    size = int(np.clip(2 * height, 64, 1024))
    return DeferredOptions(environment_shadows=0, bounces=0, light_map_size=size, layers=())


def loss_of(psnr: ArrayLike, asset_psnr: float = ASSET_PSNR) -> NDArray[np.float64]:
    """Return what an asset's relit images lose against the truth by errors that are independent of its own [dB].

    Args:
        psnr: Of its images against those before the errors [dB].
        asset_psnr: Of its images before the errors against the truth [dB].
    """
    return 10.0 * np.log10(1.0 + 10.0 ** ((asset_psnr - np.asarray(psnr)) / 10.0))


@dataclass(frozen=True, eq=False)
class RelitErrors:
    """Errors of trials, in their order.

    Attributes:
        psnr: PSNR of the images against those of the original, in the subject's box on black, as sRGB [dB], ``(T,)``.
        flip: Mean FLIP there, ``(T,)``; None unless it was asked for.
        asset_psnr: See `loss_of`.
    """

    psnr: NDArray[np.float64]
    flip: NDArray[np.float64] | None
    asset_psnr: float = ASSET_PSNR

    def values(self, measure: str) -> NDArray[np.float64]:
        """Return errors by the name of their measure, one of `MEASURES`."""
        if measure == "loss":
            return loss_of(self.psnr, self.asset_psnr)
        if measure == "error":
            return 10.0 ** (-self.psnr / 20.0)
        assert self.flip is not None
        return self.flip


class RelitComparison:
    """Compares assets with an original; images of the original are kept for as long as trials repeat."""

    def __init__(
        self,
        original: GaussianSequence,
        trials: RelitTrials,
        *,
        raster: RasterOptions | None = None,
        measure: str = "loss",
        asset_psnr: float = ASSET_PSNR,
        device: Any = None,
    ) -> None:
        """Choose the original, and how images are drawn and compared.

        Args:
            original: Relightable, any axes.
            trials: The distribution.
            raster: How splats are drawn; as the original states without.
            measure: ``flip`` if that is to be measured besides the loss.
            asset_psnr: See `loss_of`.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.

        Raises:
            MissingPackageError: FLIP cannot be measured here.
        """
        self.original, self.trials, self.asset_psnr = original, trials, asset_psnr
        self._flip = require_flip() if measure == "flip" else None
        options = raster or RasterOptions.from_metadata(original.metadata)
        shading = compared_options(trials.height)
        self._renderers = [
            DeferredRenderer(shading, raster=options, device=device, prepared=trials.prepared) for _ in range(2)
        ]
        self._kept: dict[Trial, RenderedImage] = {}

    def errors(self, other: GaussianSequence, trials: Sequence[Trial], *, keep: bool = False) -> RelitErrors:
        """Return the errors of an asset.

        Args:
            other: As many frames as the original.
            trials: Draws of the distribution.
            keep: Whether the original's images of these trials will be wanted again.
        """
        found, flip = np.zeros(len(trials)), np.full(len(trials), np.nan)
        for frame in sorted({trial.frame for trial in trials}):
            pair = world(self.original, frame), world(other, frame)
            for place, trial in enumerate(trials):
                if trial.frame == frame:
                    found[place], flip[place] = self._compared(trial, *pair, keep)
        return RelitErrors(found, None if self._flip is None else flip, self.asset_psnr)

    def seconds(self, asset: GaussianSequence, trials: Sequence[Trial]) -> float:
        """Return how long an image of an asset takes to draw [s], the median over trials of its first frame."""
        cloud, times = world(asset, 0), []
        shots = [self.trials.shot(trial, cloud, cloud) for trial in trials]
        for shot in (*shots, *shots):  # the first round makes room for each kind of light
            started = time.perf_counter()
            self._renderers[1].draw(shot)
            times.append(time.perf_counter() - started)
        return float(np.median(times[len(shots) :]))

    def _compared(self, trial: Trial, original: GaussianCloud, cloud: GaussianCloud, keep: bool) -> tuple[float, float]:
        truth, shot = self._kept.get(trial), self.trials.shot(trial, cloud, original)
        if truth is None:
            truth = self._renderers[0].draw(replace(shot, cloud=original))
            if keep:
                self._kept[trial] = truth
        found = self._renderers[1].draw(shot)
        box = bounding_box(truth.alpha)
        images = [linear_to_srgb(np.clip(each.rgb[box], 0.0, 1.0)).astype(np.float32) for each in (found, truth)]
        shown, wanted = images
        return psnr(shown, wanted), np.nan if self._flip is None else self._flip(shown, wanted)


def require_flip() -> Measure:
    """Return how FLIP is measured.

    Raises:
        MissingPackageError: It cannot be measured here.
    """
    metrics = PerceptualMetrics.installed()
    if "flip" not in metrics.measures:
        raise MissingPackageError(f"max-flip must have a program to measure FLIP, got none: {metrics.absent['flip']}.")
    return metrics.measures["flip"]


def world(sequence: GaussianSequence, frame: int) -> GaussianCloud:
    """Return a frame in the world's axes."""
    return change_axes(sequence[frame], WORLD_AXES)
