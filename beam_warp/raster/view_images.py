"""Each view's images: in a rasteriser's memory, for every library that reads DLPack, or copied to the host.

`view_images` copies nothing and waits for nothing: a Warp array hands its memory over by ``__dlpack__``, and what reads
it on a GPU is ordered behind Warp's stream. This converts only: libraries that read the images differentiate nothing
through them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.device.array_checks import pixel_channels
from beam_warp.errors import InvalidOptionError
from beam_warp.raster.rasterizer import Rasterizer


@dataclass(frozen=True, eq=False)
class ViewImages:
    """The images of one camera in a rasteriser's memory: the next draw overwrites them.

    Attributes:
        channels: ``(H, W, K)`` float each, a pass of channels, K 4, 8, 12 or 16, the last padded with zeros. Compact,
            as JAX wants them.
        alpha: ``(H, W)`` float.
        depth: ``(H, W)`` float [m]; this and the others as in `beam_warp.raster.records.RasterImages`.
        median_depth: ``(H, W)`` float [m].
        gaussian_ids: ``(H, W)`` int.
    """

    channels: tuple[wp.array, ...]
    alpha: wp.array
    depth: wp.array
    median_depth: wp.array
    gaussian_ids: wp.array

    def select(self, channels: range) -> wp.array:
        """Return some channels that follow one another as a view ``(H, W, len(channels))``, strided.

        NumPy, torch and CuPy read it as it is; JAX reads compact arrays only, and so wants `channels`.

        Args:
            channels: Such as ``rasterizer.value_channels``.

        Raises:
            InvalidOptionError: They are not all in one pass, so that no view holds them.
        """
        first = 0
        for image in self.channels:
            end = first + image.shape[2]
            if first <= channels.start and channels.stop <= end and channels.step == 1:
                return image[:, :, channels.start - first : channels.stop - first]
            first = end
        lengths = [image.shape[2] for image in self.channels]
        raise InvalidOptionError(
            f"channels must lie in one pass of the lengths {lengths}, got {channels}. Select from each pass and join."
        )


def view_images(rasterizer: Rasterizer) -> list[ViewImages]:
    """Return the images of every camera of a rasteriser, without copying.

    Args:
        rasterizer: The rasteriser; the images stay where they are, whatever it draws next.

    Returns:
        One for each of its cameras, in their order. ``numpy.from_dlpack(view.alpha)``, ``torch.from_dlpack`` and
        ``jax.numpy.from_dlpack`` read each array.
    """
    images = rasterizer.images
    views = []
    starts = rasterizer.first_pixels
    for camera, first, end in zip(rasterizer.cameras, starts[:-1], starts[1:], strict=True):
        shape = (camera.height, camera.width)
        flat = (images.alpha, images.depth, images.median_depth, rasterizer.gaussian_ids)
        passes = tuple(pixel_channels(rows[first:end], *shape, 0, rows.shape[1]) for rows in images.channels)
        views.append(ViewImages(passes, *(image[first:end].reshape(shape) for image in flat)))
    return views


class ValueImages(NamedTuple):
    """Images of one camera on the host: sums over what every pixel sees, weighted by visibility.

    Attributes:
        alpha: Sum of the weights, ``(H, W)`` float32; at most 1 but for rounding.
        depth: Mean depth [m], ``(H, W)`` float32; 0 where nothing is seen.
        median_depth: See `beam_warp.raster.gbuffer.GBuffer`.
        gaussian_ids: See `beam_warp.raster.gbuffer.GBuffer`.
        values: Sums of values, ``(H, W, K)`` float32.
    """

    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]
    gaussian_ids: NDArray[np.int32]
    values: NDArray[np.float32]


def host_images(view: ViewImages, channel_count: int) -> ValueImages:
    """Bring one view's images to the host; of its channels the first ones, without padding."""
    passes = [image.numpy() for image in view.channels]
    values = passes[0] if len(passes) == 1 else np.concatenate(passes, axis=-1)
    flat = (view.alpha, view.depth, view.median_depth, view.gaussian_ids)
    return ValueImages(*(image.numpy() for image in flat), values=values[..., :channel_count])
