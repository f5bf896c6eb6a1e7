"""Input and output of the rasteriser: options, Gaussians, images and gradients, with arrays on a device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import warp as wp

from beam_warp.checks import require_choice, require_number
from beam_warp.world.metadata import LOW_PASS_RANGE, UNSTATED_RASTER, raster_metadata, stated_raster

COEFFICIENT_COUNTS = (1, 4, 9, 16, 25)
"""Numbers of spherical harmonics of a colour: those of degree 0 to 4."""

DEPTH_MODES = ("plane", "exact")

CAMERA_PARAMETERS = (
    *("turn_right", "turn_down", "turn_forward", "shift_right", "shift_down", "shift_forward"),
    *("focal_x", "focal_y", "center_x", "center_y", "radial_1", "radial_2"),
)
"""Numbers of a camera that images are differentiated to, in this order.

A twist in the camera's axes (right, down, forward), on the left of world-to-camera: a point p in these axes comes to be
at p + turn x p + shift, turn in [rad] and shift in [m]. Focal lengths and principal point [pixel]. Radial terms of a
lens at 0, the pinhole that is drawn: the tangents u, v of a ray become u, v times 1 + k1 r^2 + k2 r^4."""

DepthMode = Literal["plane", "exact"]


@dataclass(frozen=True)
class RasterOptions:
    """Options of drawing splats.

    Attributes:
        antialiased: Keep a splat's total opacity when the low-pass widens it. For clouds trained that way, and for
            views from further away than the training views (Yu et al. 2024, Eq. 9).
        low_pass: Variance of the pixel filter that every splat is widened by [pixel^2], above 0.
        near: Depth before which a Gaussian's centre is not drawn [m], above 0: perspective explodes there.
        depth: ``"plane"``: a splat's depth is its tangent plane's, exact for flat Gaussians. ``"exact"``: that of the
            largest response on every ray, for thick ones and grazing views; costs a few operations a pixel.

    Raises:
        InvalidOptionError: An option is out of range.
    """

    antialiased: bool = UNSTATED_RASTER[0]
    low_pass: float = UNSTATED_RASTER[1]
    near: float = 0.01
    depth: DepthMode = "plane"

    def __post_init__(self) -> None:
        """Check every option once."""
        require_number("low_pass", self.low_pass, *LOW_PASS_RANGE)
        require_number("near", self.near, 1e-9, 1e9)
        require_choice("depth", self.depth, DEPTH_MODES)

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> RasterOptions:
        """Return the options that a sequence states for drawing its Gaussians; the defaults where it states none.

        Args:
            metadata: The metadata of a `beam_warp.world.gaussians.GaussianSequence`.

        Raises:
            InvalidOptionError: The sequence states something else than a filter.
        """
        antialiased, low_pass = stated_raster(metadata) or UNSTATED_RASTER
        return cls(antialiased=antialiased, low_pass=low_pass)

    def as_metadata(self) -> dict[str, str]:
        """Return the metadata that states the filter that Gaussians were fitted with; near and depth are not stated."""
        return raster_metadata(self.antialiased, self.low_pass)


class ExtraColors(Protocol):
    """Colours that splats have beside captured radiance, which whoever draws states."""

    def add(self, gaussians: GaussianArrays, views: wp.array, colors: wp.array) -> None:
        """Add to the colours of splats, ``(V * N,)`` vec3; ``views`` are of ``kernels.raster.project.RasterView``."""

    def differentiate(self, gaussians: GaussianArrays, views: wp.array, color_gradients: wp.array) -> None:
        """Take a loss's derivatives to the colours of splats: what they depend on is not the rasteriser's."""


class GaussianArrays(NamedTuple):
    """Gaussians on a device.

    Attributes:
        positions: ``(N,)`` vec3 [m].
        orientations: ``(N,)`` quat xyzw; normalised where they are used.
        scales: ``(N,)`` vec3 [m].
        opacities: ``(N,)`` float in [0, 1].
        values: ``(N, K)`` float, to be composited; None for nothing.
        radiance: ``(N, B)`` vec3 spherical harmonics of captured colour, B of `COEFFICIENT_COUNTS`, another one in
            every draw if need be; None for none.
        extra: What is added to the captured colour; None for nothing.
    """

    positions: wp.array
    orientations: wp.array
    scales: wp.array
    opacities: wp.array
    values: wp.array | None = None
    radiance: wp.array | None = None
    extra: ExtraColors | None = None


@dataclass(frozen=True, eq=False)
class RasterImages:
    """Images of all views, one view after the other and row by row, on the device; or a loss's derivatives to them.

    Attributes:
        channels: Sums of channels weighted by visibility, ``(P, K)`` float each: passes of 16 channels, the last of 4,
            8, 12 or 16, padded with zeros.
        alpha: Sum of the weights, ``(P,)`` float, at most 1 but for rounding.
        depth: Mean depth along the optical axis [m], ``(P,)``; 0 where nothing is seen.
        median_depth: Depth of the last splat in front of which more than half of the light still passes [m], ``(P,)``.
    """

    channels: tuple[wp.array, ...]
    alpha: wp.array
    depth: wp.array
    median_depth: wp.array

    def zero_(self) -> None:
        """Set everything to 0."""
        for array in (*self.channels, self.alpha, self.depth, self.median_depth):
            array.zero_()


class GaussianGradients(GaussianArrays):
    """Derivatives of a loss with respect to Gaussians, on the device, in the shapes and order of `GaussianArrays`;
    ``extra`` is None.

    ``orientations`` are to the quaternions as given, and orthogonal to them.
    """
