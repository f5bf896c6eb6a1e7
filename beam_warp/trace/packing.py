"""Gaussians as kernels read them, with their exact bounds, on a device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.device.arrays import upload
from beam_warp.kernels.trace.bounds import CloudArrays, GaussianBounds, launch_count_fates, launch_pack_gaussians
from beam_warp.kernels.trace.gaussian import Gaussians
from beam_warp.world.gaussians import GaussianCloud

SMALLEST_RELATIVE_SCALE = 1e-7
"""Scales are raised to this part of the scene's extent: below it float32 positions themselves are coarser."""

SMALLEST_SCALE_RATIO = 1e-4
"""Scales are raised to this part of their Gaussian's largest: the response error is about 6e-8 distance / scale."""


@dataclass(frozen=True, eq=False)
class PackedGaussians:
    """Packed rows of a cloud and what trees are built from.

    Attributes:
        device: Where everything is.
        gaussians: What kernels read, relative to ``origin``.
        positions, orientations, scales: As given, to which gradients refer, ``(N,)`` vec3, quat and vec3.
        opacities: ``(N,)``.
        lowers, uppers: Bounds relative to ``origin``, ``(N,)`` vec3; a point where nothing can be seen.
        fates: What becomes of each Gaussian (see `beam_warp.kernels.trace.bounds`), ``(N,)`` int32.
        takes_part: 1 for what is traced, ``(N,)`` int32.
        origin: World position of the device's coordinates [m]: the middle of what can be seen.
        extent: Largest side of the bounding box of those centres [m].
        smallest_scale: Smaller scales are raised to this [m].
    """

    device: Any
    gaussians: Gaussians
    positions: wp.array
    orientations: wp.array
    scales: wp.array
    opacities: wp.array
    lowers: wp.array
    uppers: wp.array
    fates: wp.array
    takes_part: wp.array
    origin: NDArray[np.float32]
    extent: float
    smallest_scale: float

    @classmethod
    def from_cloud(cls, cloud: GaussianCloud, response_degree: int, device: Any) -> PackedGaussians:
        """Upload and pack a cloud of at least one Gaussian."""
        seen = cloud.opacities > 1.0 / 255.0
        positions = cloud.positions[seen]
        lower, upper = (positions.min(0), positions.max(0)) if len(positions) else (np.zeros(3), np.zeros(3))
        extent = float((upper - lower).max())
        # A single Gaussian or a pile of coincident ones has no extent of its own: its largest scale stands in.
        reach = max(extent, float(cloud.scales[seen].max(initial=0.0)), 1e-12)
        count = len(cloud)
        gaussians = Gaussians()
        for name in ("center_opacity", "whitening_0", "whitening_1", "whitening_2"):
            setattr(gaussians, name, wp.empty(count, dtype=wp.vec4, device=device))
        gaussians.degree = response_degree
        if cloud.normals is not None:
            gaussians.normals = upload(cloud.normals, wp.vec3, device)
        packed = cls(
            device,
            gaussians,
            wp.empty(count, dtype=wp.vec3, device=device),
            wp.empty(count, dtype=wp.quat, device=device),
            wp.empty(count, dtype=wp.vec3, device=device),
            upload(cloud.opacities, float, device),
            *(wp.empty(count, dtype=wp.vec3, device=device) for _ in range(2)),
            *(wp.empty(count, dtype=int, device=device) for _ in range(2)),
            origin=((lower.astype(np.float64) + upper) / 2.0).astype(np.float32),
            extent=extent,
            smallest_scale=SMALLEST_RELATIVE_SCALE * reach,
        )
        packed.place(
            upload(cloud.positions, wp.vec3, device),
            upload(cloud.orientations, wp.quat, device),
            upload(cloud.scales, wp.vec3, device),
        )
        return packed

    def __len__(self) -> int:
        """Return the number of Gaussians, those that are not traced included."""
        return len(self.opacities)

    def place(self, positions: wp.array, orientations: wp.array, scales: wp.array) -> None:
        """Write rows and bounds of Gaussians at these world positions; device arrays of vec3, quat and vec3."""
        wp.copy(self.positions, positions)
        wp.copy(self.orientations, orientations)
        wp.copy(self.scales, scales)
        cloud, bounds = CloudArrays(), GaussianBounds()
        cloud.positions, cloud.orientations, cloud.scales = positions, orientations, scales
        cloud.opacities = self.opacities
        bounds.lower, bounds.upper = self.lowers, self.uppers
        bounds.fate, bounds.takes_part = self.fates, self.takes_part
        launch_pack_gaussians(
            len(cloud.positions),
            cloud,
            wp.vec3(*self.origin.tolist()),
            self.smallest_scale,
            SMALLEST_SCALE_RATIO,
            self.gaussians,
            bounds,
            self.device,
        )

    def fate_counts(self) -> list[int]:
        """Return how many Gaussians met each fate of `beam_warp.kernels.trace.bounds`."""
        counts = wp.zeros(4, dtype=int, device=self.device)
        launch_count_fates(self.fates, counts, self.device)
        return counts.numpy().tolist()
