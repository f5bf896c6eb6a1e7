"""References of the materials study: exact channels of views to which nothing was fitted, or many rays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.records import CaptureRecord
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import linear_to_srgb
from beam_warp.image.metrics import SOLID_ALPHA, block_means
from beam_warp.raster.gbuffer import rasterize_values
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

BLOCK = 8
"""Side of the blocks of pixels that an interval resamples [pixel]: errors of neighbours depend on each other."""

OCCLUSION, COLOR = "occlusion_error", "color_error"


class Reference(Protocol):
    """A reference that materials are compared with."""

    @property
    def note(self) -> str:
        """The reference in words."""
        ...

    def squares(
        self, base_color: NDArray[np.float32], openness: NDArray[np.float32]
    ) -> Mapping[str, NDArray[np.float64]]:
        """Return sums of squared errors and their number, over clusters that are independent of each other, ``(K, 2)``.

        Args:
            base_color: Base colour of every Gaussian, ``(N, 3)``.
            openness: Ambient occlusion of every Gaussian, ``(N,)``.
        """
        ...


@dataclass(frozen=True, eq=False)
class _TrueView:
    """The exact channels of one view, and where they mean something."""

    camera: Camera
    base_color: NDArray[np.float64]
    openness: NDArray[np.float64]
    solid: NDArray[np.bool_]


class TrueViews:
    """Exact channels of test views."""

    def __init__(
        self,
        cloud: GaussianCloud,
        records: Sequence[CaptureRecord],
        raster: RasterOptions,
        *,
        samples: int = 2,
        device: str | None = None,
    ) -> None:
        """Read the truth.

        Args:
            cloud: What carries the materials.
            records: Records with truth, at least one.
            raster: How splats are drawn.
            samples: Side of the square of samples of a pixel.
            device: Warp device.

        Raises:
            InvalidArrayError: No pixel of the truth is solid.
        """
        self._cloud, self._raster, self._samples, self._device = cloud, raster, samples, device
        self._views = []
        for record in records:
            truth = record.truth()
            self._views.append(
                _TrueView(
                    record.camera,
                    _encoded(truth.stack("base_color.R", "base_color.G", "base_color.B")),
                    truth.stack("ambient_occlusion")[..., 0].astype(np.float64),
                    truth.channels["A"] > SOLID_ALPHA,
                )
            )
        if not any(view.solid.any() for view in self._views):
            raise InvalidArrayError("truth must show a solid subject, got none. Choose a capture whose test views do.")

    @property
    def note(self) -> str:
        """The reference in words."""
        return f"exact channels of {len(self._views)} test views, where their alpha is above {SOLID_ALPHA}"

    def squares(
        self, base_color: NDArray[np.float32], openness: NDArray[np.float32]
    ) -> Mapping[str, NDArray[np.float64]]:
        """Return squared errors of solid pixels, summed over blocks; base colour encoded as sRGB."""
        columns = np.concatenate([base_color, openness[:, None]], axis=1, dtype=np.float32)
        found: dict[str, list[NDArray[np.float64]]] = {OCCLUSION: [], COLOR: []}
        for view in self._views:
            camera = view.camera.supersampled(self._samples)
            drawn = rasterize_values(self._cloud, camera, columns, options=self._raster, device=self._device)
            alpha = np.maximum(block_means(drawn.alpha, self._samples), 1e-6)
            means = block_means(drawn.values, self._samples) / alpha[..., None]
            color = np.square(_encoded(means[..., :3]) - view.base_color).mean(axis=-1)
            found[COLOR].append(_block_sums(color, view.solid))
            found[OCCLUSION].append(_block_sums(np.square(means[..., 3] - view.openness), view.solid))
        return {name: np.concatenate(parts) for name, parts in found.items()}


class ManyRays:
    """Materials by many rays, per Gaussian: noise is judged, not what the method leaves out."""

    def __init__(
        self, base_color: NDArray[np.float32], openness: NDArray[np.float32], seen: NDArray[np.bool_], rays: int
    ) -> None:
        """Keep materials; only the Gaussians that views show count."""
        self._color, self._openness = _encoded(base_color[seen]), openness[seen].astype(np.float64)
        self._seen, self._rays = seen, rays

    @property
    def note(self) -> str:
        """The reference in words."""
        return f"{self._rays:,} rays a Gaussian with the defaults, at the Gaussians that views show: no truth was given"

    def squares(
        self, base_color: NDArray[np.float32], openness: NDArray[np.float32]
    ) -> Mapping[str, NDArray[np.float64]]:
        """Return squared errors, one a Gaussian; base colour encoded as sRGB."""
        color = np.square(_encoded(base_color[self._seen]) - self._color).mean(axis=-1)
        occlusion = np.square(openness[self._seen] - self._openness)
        one = np.ones(len(color))
        return {OCCLUSION: np.column_stack([occlusion, one]), COLOR: np.column_stack([color, one])}


def _encoded(color: NDArray[np.floating]) -> NDArray[np.float64]:
    return linear_to_srgb(np.clip(np.asarray(color, np.float64), 0.0, 1.0))


def _block_sums(squares: NDArray[np.float64], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return sum and number of masked pixels of every block, ``(K, 2)``."""
    height, width = mask.shape
    padded = ((0, -height % BLOCK), (0, -width % BLOCK))
    parts = [np.pad(np.where(mask, values, 0.0), padded) for values in (squares, np.ones_like(squares))]
    rows, columns = (side // BLOCK for side in parts[0].shape)
    return np.stack([p.reshape(rows, BLOCK, columns, BLOCK).sum(axis=(1, 3)).reshape(-1) for p in parts], axis=-1)
