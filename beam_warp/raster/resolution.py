"""How finely Gaussians are to be sampled: by samples of a pixel where they are finer, by fewer pixels where coarser.

Photographs and truth are means over a pixel, so a pixel is the mean of samples that are finer than the Gaussians.
Images are reduced by a whole factor to where a pixel is half as wide as the splats' deviation, if they are finer than
that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.metadata import LOW_PASS_RANGE

DISC_WIDTH = 0.7
"""Deviation of the discs that cover a surface, in spacings: neighbours overlap, so that light does not pass between
them."""

MOST_SAMPLES = 4
"""Largest side of the square of samples of a pixel."""

LEAST_SAMPLES = 2
"""Side of the square of samples of a pixel of a still image, at least: one sample in the middle of a pixel costs up to
7 dB of base colour against means over it (docs/evaluation.md)."""

MOST_IMAGE_SAMPLES = 7680 * 4320
"""Samples of a whole image, at most, unless `LEAST_SAMPLES` take more: 2 x 2 of an image of 3840 x 2160, 4 x 4 of
1920 x 1080. Memory and time go with them."""

SAMPLES_PER_SPACING = 2.0
"""Samples that fall on the distance of neighbouring Gaussians, unless `MOST_SAMPLES` are fewer."""

WIDEST_PIXEL = 0.5
"""Width of a reduced pixel in deviations of splats, at most.

A reduced bake draws splats at the centres of blocks and compares them with means over what counts of these; both differ
by what the picture bends within a block, and at rims. Measured on a ball of splats, in views apart: at a width of 0.5
the images drawn of the result have an error of 56 dB from that, at 0.8 of 47 dB; on a reconstructed figure, 44 dB at
1.3.
"""

SMALL_SPLATS = 25.0
"""Percentile of the deviations that counts."""

MEASURED_SPLATS = 4096
"""Least number of splats that the percentile is taken of; larger clouds are thinned evenly."""


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


def samples_of_images(cloud: GaussianCloud, cameras: Sequence[Camera], options: RasterOptions) -> int:
    """Return how many samples a side a pixel of still images has, where nothing else is asked for.

    As many as fits take (`samples_of_fit`), so that images are what the photographs were: at least `LEAST_SAMPLES`, and
    no more than `MOST_IMAGE_SAMPLES` allow.
    """
    largest = max((camera.width * camera.height for camera in cameras), default=1)
    allowed = int(np.sqrt(MOST_IMAGE_SAMPLES / largest))
    return max(min(samples_of_fit(cloud, cameras, options), allowed), LEAST_SAMPLES)


def reduction_factor(cloud: GaussianCloud, cameras: Sequence[Camera], *, near: float) -> int:
    """Return by how much images may be reduced, the same for all: 1 unless pixels are far finer than splats.

    A splat's deviation is the second largest scale of its Gaussian, seen from the front.

    Args:
        cloud: Gaussians.
        cameras: Their views; the one that sees them smallest decides.
        near: Depth before which nothing is drawn [m].
    """
    some = slice(None, None, max(1, len(cloud) // MEASURED_SPLATS))
    positions = cloud.positions[some].astype(np.float64)
    deviations = np.sort(cloud.scales[some], axis=1)[:, 1].astype(np.float64)
    least = np.inf
    for camera in cameras:
        rotation, shift = camera.world_to_camera[2, :3], camera.world_to_camera[2, 3]
        depth = positions @ rotation + shift
        seen = depth >= near
        if seen.any():
            focal = min(camera.focal_x, camera.focal_y)
            least = min(least, float(np.percentile(focal * deviations[seen] / depth[seen], SMALL_SPLATS)))
    largest = max(max(camera.width, camera.height) for camera in cameras)
    return int(np.clip(WIDEST_PIXEL * least, 1, largest)) if np.isfinite(least) else 1


def reduced_camera(camera: Camera, factor: int) -> Camera:
    """Return a camera with one pixel for each block of them, those beyond the last whole ones too."""
    width, height = -(-camera.width // factor), -(-camera.height // factor)
    return camera.cropped(0, 0, width * factor, height * factor).reduced(factor)


def reduced_options(options: RasterOptions, factor: int) -> RasterOptions:
    """Return how reduced views are drawn: splats of the same shape in the scene, sampled at fewer places."""
    return replace(options, low_pass=max(options.low_pass / factor**2, LOW_PASS_RANGE[0]))
