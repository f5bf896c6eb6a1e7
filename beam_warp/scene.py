"""Gaussians on a device, ready to be traced: packed rows, exact bounds and a bounding volume hierarchy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.assets import GaussianCloud
from beam_warp.checks import require_choice
from beam_warp.devices import resolve_device, upload
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.bounds import INVISIBLE, NOT_FINITE, RAISED, TRACED, launch_pack_gaussians
from beam_warp.kernels.gaussian import Gaussians
from beam_warp.kernels.occluders import WarpTreeOccluders

SMALLEST_RELATIVE_SCALE = 1e-7
"""Scales are raised to this part of the scene's extent: below it float32 positions themselves are coarser."""

SMALLEST_SCALE_RATIO = 1e-4
"""Scales are raised to this part of their Gaussian's largest: the response error is about 6e-8 distance / scale."""

NOTHING = GaussianCloud(
    positions=np.zeros((1, 3)), orientations=[[0.0, 0.0, 0.0, 1.0]], scales=np.ones((1, 3)), opacities=[0.0]
)

BACKENDS = ("wide", "warp")


@dataclass(frozen=True)
class SceneReport:
    """What was done to the cloud so that it can be traced.

    Attributes:
        traced: Gaussians that take part.
        dropped: Gaussians left out because their opacity is at most 1/255: no ray can see them.
        raised_scales: Gaussians traced with a scale raised to the smallest that float32 can resolve.
        not_finite: Gaussians left out because of NaN, infinity, a negative scale or a zero quaternion.
    """

    traced: int
    dropped: int
    raised_scales: int
    not_finite: int = 0


@dataclass(frozen=True, eq=False)
class Scene:
    """One device's copy of a cloud.

    Attributes:
        device: Warp device that holds it.
        backend: Hierarchy that rays traverse.
        occluders: What kernels trace, relative to ``origin``.
        origin: World position that the device's coordinates are relative to [m]: the middle of the cloud, so that
            precision does not suffer far from the world's origin.
        extent: Largest side of the centres' bounding box [m].
        report: What was left out or changed.
        orientations: Quaternions of the cloud as given, one row for each of its Gaussians, on the device; gradients
            refer to them.
        scales: Scales of the cloud as given, likewise.
        smallest_scale: Scales below it were raised to it [m].
    """

    device: Any
    backend: str
    occluders: Any
    origin: NDArray[np.float32]
    extent: float
    report: SceneReport
    orientations: Any
    scales: Any
    smallest_scale: float
    _keep: Any = None

    @classmethod
    def from_gaussians(
        cls,
        cloud: GaussianCloud,
        device: str | None = None,
        *,
        backend: Literal["wide", "warp"] = "warp",
        response_degree: Literal[2, 4] = 2,
    ) -> Scene:
        """Upload a cloud and build its hierarchy.

        Args:
            cloud: Any number of Gaussians, none included.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.
            backend: ``"wide"``, the own hierarchy of four children a node, or ``"warp"``, ``wp.Bvh``.
            response_degree: 2 for Gaussians, 4 for the faster falloff exp(-x^4 / 18) of 3DGRT, if trained with it.

        Raises:
            DeviceError: There is no such device.
            InvalidOptionError: An option is none of its choices.
        """
        target = resolve_device(device)
        require_choice("backend", backend, BACKENDS)
        if response_degree not in (2, 4):
            raise InvalidOptionError(f"response_degree must be 2 or 4, got {response_degree!r}. Choose one of them.")
        seen = cloud.opacities > 1.0 / 255.0
        positions = cloud.positions[seen]
        lower, upper = (positions.min(0), positions.max(0)) if len(positions) else (np.zeros(3), np.zeros(3))
        extent = float((upper - lower).max())
        origin = ((lower.astype(np.float64) + upper) / 2.0).astype(np.float32)
        # A single Gaussian or a pile of coincident ones has no extent of its own: its largest scale stands in.
        smallest = SMALLEST_RELATIVE_SCALE * max(extent, float(cloud.scales[seen].max(initial=0.0)), 1e-12)
        traceable, count = len(cloud), max(len(cloud), 1)
        gaussians = Gaussians()
        for name in ("center_opacity", "whitening_0", "whitening_1", "whitening_2"):
            setattr(gaussians, name, wp.empty(count, dtype=wp.vec4, device=target))
        gaussians.degree = response_degree
        if cloud.normals is not None:
            gaussians.normals = upload(cloud.normals, wp.vec3, target)
        lowers = wp.empty(count, dtype=wp.vec3, device=target)
        uppers = wp.empty(count, dtype=wp.vec3, device=target)
        fates = wp.empty(count, dtype=int, device=target)
        orientations = upload(cloud.orientations, wp.quat, target)
        scales = upload(cloud.scales, wp.vec3, target)
        if not len(cloud):  # one Gaussian that nothing sees: kernels need no case for an empty scene
            cloud = NOTHING
        launch_pack_gaussians(
            upload(cloud.positions, wp.vec3, target),
            orientations if traceable else upload(cloud.orientations, wp.quat, target),
            scales if traceable else upload(cloud.scales, wp.vec3, target),
            upload(cloud.opacities, float, target),
            wp.vec3(*origin.tolist()),
            smallest,
            SMALLEST_SCALE_RATIO,
            gaussians,
            lowers,
            uppers,
            fates,
            target,
        )
        occluders = WarpTreeOccluders()
        occluders.gaussians = gaussians
        occluders.origin = wp.vec3(*origin.tolist())
        # LBVH builds in under a millisecond on CUDA; on the CPU the surface-area heuristic is the better tree.
        bvh = wp.Bvh(lowers, uppers, constructor="lbvh" if target.is_cuda else "sah", leaf_size=1)
        occluders.tree.bvh = bvh.id
        number = np.bincount(fates.numpy()[:traceable], minlength=4)
        report = SceneReport(
            traced=int(number[TRACED] + number[RAISED]),
            dropped=int(number[INVISIBLE]),
            raised_scales=int(number[RAISED]),
            not_finite=int(number[NOT_FINITE]),
        )
        return cls(target, backend, occluders, origin, extent, report, orientations, scales, smallest, bvh)

    @property
    def has_normals(self) -> bool:
        """Whether the cloud came with normals."""
        normals = self.occluders.gaussians.normals
        return normals is not None and len(normals) > 0
