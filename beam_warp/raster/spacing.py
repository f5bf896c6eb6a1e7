"""How far apart the Gaussians of a surface lie, and how many samples of a pixel that asks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

DISC_WIDTH = 0.7
"""Deviation of the discs that cover a surface, in spacings: neighbours overlap, so that light does not pass between
them."""

MOST_SAMPLES = 4
"""Largest side of the square of samples of a pixel."""

SAMPLES_PER_SPACING = 2.0
"""Samples that fall on the distance of neighbouring Gaussians, unless `MOST_SAMPLES` are fewer."""


def disc_spacing(cloud: GaussianCloud) -> float:
    """Return the distance of neighbouring discs [m], from the median of their second largest deviations."""
    return float(np.median(np.sort(cloud.scales, axis=1)[:, 1])) / DISC_WIDTH


def sample_side(cameras: Sequence[Camera], center: NDArray[np.floating], spacing: float) -> int:
    """Return how many samples a pixel's side needs, so that two fall on the distance of neighbouring Gaussians.

    At silhouettes many layers lie behind each other, so that their blurred edges are opaque further out than half of
    the blur, and what is fitted shrinks to make up for it, by half a pixel. Samples finer than the Gaussians keep that
    below their own size.

    Args:
        cameras: Of what is fitted.
        center: Middle of the subject [m], ``(3,)``.
        spacing: Distance of neighbouring Gaussians [m].
    """
    footprints = [float((center - camera.position) @ camera.forward) / camera.focal_x for camera in cameras]
    footprint = float(np.median(footprints))
    if not footprint > 0.0:
        return 1
    needed = SAMPLES_PER_SPACING * footprint
    return int(np.ceil(needed / spacing)) if MOST_SAMPLES * spacing > needed else MOST_SAMPLES


def samples_of_fit(cloud: GaussianCloud, cameras: Sequence[Camera], options: RasterOptions) -> int:
    """Return with how many samples a pixel's side Gaussians look as they did when they were fitted.

    Antialiased ones look the same at any resolution, so that samples may be as fine as they are; others were fitted to
    one sample a pixel, and their opacity is that of splats as wide as that.
    """
    if not options.antialiased or not len(cloud) or not cameras:
        return 1
    return sample_side(cameras, np.median(cloud.positions, axis=0), disc_spacing(cloud))
