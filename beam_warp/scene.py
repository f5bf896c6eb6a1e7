"""Gaussians on a device, ready to be traced: packed rows, exact bounds and a bounding volume hierarchy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.assets import GaussianCloud
from beam_warp.devices import resolve_device, upload
from beam_warp.kernels.bounds import launch_pack_gaussians
from beam_warp.kernels.gaussian import Gaussians

SMALLEST_RELATIVE_SCALE = 1e-7
"""Scales are raised to this part of the scene's extent: below it float32 positions themselves are coarser."""

SMALLEST_SCALE_RATIO = 1e-4
"""Scales are raised to this part of their Gaussian's largest: the response error is about 6e-8 distance / scale."""


@dataclass(frozen=True)
class SceneReport:
    """What was done to the cloud so that it can be traced.

    Attributes:
        traced: Gaussians that take part.
        dropped: Gaussians left out because their opacity is at most 1/255: no ray can see them.
        raised_scales: Gaussians with a scale raised to the smallest that float32 can resolve.
    """

    traced: int
    dropped: int
    raised_scales: int


@dataclass(frozen=True, eq=False)
class Scene:
    """One device's copy of a cloud.

    Attributes:
        device: Warp device that holds it.
        gaussians: Packed rows, relative to ``origin``.
        bvh: Hierarchy over the exact bounds; None for a scene without Gaussians.
        origin: World position that the device's coordinates are relative to [m]: the middle of the cloud, so that
            precision does not suffer far from the world's origin.
        extent: Largest side of the centres' bounding box [m].
        rows: Row in the cloud of each traced Gaussian, ``(M,)``.
        report: What was left out or changed.
    """

    device: Any
    gaussians: Gaussians
    bvh: wp.Bvh | None
    origin: NDArray[np.float32]
    extent: float
    rows: NDArray[np.int64]
    report: SceneReport

    @classmethod
    def from_gaussians(cls, cloud: GaussianCloud, device: str | None = None) -> Scene:
        """Upload a cloud and build its hierarchy.

        Args:
            cloud: Any number of Gaussians, none included.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.

        Raises:
            DeviceError: There is no such device.
        """
        target = resolve_device(device)
        visible = cloud.opacities > 1.0 / 255.0
        rows = np.flatnonzero(visible)
        count = len(rows)
        positions = cloud.positions[rows]
        lower, upper = (positions.min(0), positions.max(0)) if count else (np.zeros(3), np.zeros(3))
        extent = float((upper - lower).max())
        origin = ((lower.astype(np.float64) + upper) / 2.0).astype(np.float32)
        scales = cloud.scales[rows]
        largest = scales.max(axis=1, initial=0.0)
        # A single Gaussian or a pile of coincident ones has no extent of its own: its largest scale stands in.
        smallest = SMALLEST_RELATIVE_SCALE * max(extent, float(largest.max(initial=0.0)), 1e-12)
        floor = np.maximum(smallest, SMALLEST_SCALE_RATIO * largest)
        report = SceneReport(count, len(cloud) - count, int((scales < floor[:, None]).any(axis=1).sum()))

        gaussians = Gaussians()
        for name in ("center_opacity", "whitening_0", "whitening_1", "whitening_2"):
            setattr(gaussians, name, wp.empty(max(count, 1), dtype=wp.vec4, device=target))
        bvh = None
        if count:
            lowers = wp.empty(count, dtype=wp.vec3, device=target)
            uppers = wp.empty(count, dtype=wp.vec3, device=target)
            launch_pack_gaussians(
                upload(positions, wp.vec3, target),
                upload(cloud.orientations[rows], wp.quat, target),
                upload(scales, wp.vec3, target),
                upload(cloud.opacities[rows], float, target),
                wp.vec3(*origin.tolist()),
                smallest,
                SMALLEST_SCALE_RATIO,
                gaussians,
                lowers,
                uppers,
                target,
            )
            # LBVH builds in under a millisecond on CUDA; on the CPU the surface-area heuristic is the better tree.
            bvh = wp.Bvh(lowers, uppers, constructor="lbvh" if target.is_cuda else "sah", leaf_size=1)
        return cls(target, gaussians, bvh, origin, extent, rows, report)

    @property
    def device_origin(self) -> wp.vec3:
        """``origin`` as kernels take it."""
        return wp.vec3(*self.origin.tolist())
