"""Direct path: ambient occlusion of each Gaussian in one frame, and evidence on its base colour.

What views show comes from their images (`beam_warp.materials.evidence`), or, of Gaussians without images, from their
own captured radiance around the normal; what arrives there, from `beam_warp.materials.light_rays`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from beam_warp.device.arrays import upload, zero_struct
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.jobs.listeners import CountProgress
from beam_warp.kernels.materials.residues import ColorFit, launch_fit_color
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.blended_color import solve_blended
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.light_rays import (
    LitPoints,
    MaterialOptions,
    light_batches,
    lit_points,
    mean_radiance,
    require_radiance,
)
from beam_warp.materials.normals import SurfacePoints
from beam_warp.materials.pilot import economy
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0

BURIED_VISIBILITY = 0.02
"""Visibility below which no view shows the Gaussian: its captured colour was never constrained."""

SATURATION = 0.995
"""Captured display colour above which the sensor's or the training's ceiling may have cut it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ColorEvidence:
    """Evidence of frames on base colour; evidence on the same Gaussians adds up.

    Attributes:
        numerator: Sum of w L_D (L_o - L_S), ``(N, 3)``.
        denominator: Sum of w L_D^2, ``(N, 3)``.
        observed: Sum of w (L_o - L_S)^2, ``(N, 3)``.
        irradiance: Sum over frames of the irradiance that arrives from the environment, ``(N, 3)``.
        openness: Sum over frames of the hemispherical visibility, ``(N,)``.
        noise: Sum over frames of the squared relative standard error of the arriving light, ``(N,)``.
        misfit: Sum over frames of the mean square of what images differ by from what the Gaussians show, over the
            square of the arriving light: in units of base colour, ``(N, 3)``.
        views: How many equally good views the weights are worth, ``(N,)``.
        facing: Sum over frames of the part of what was seen that was not seen grazing, ``(N,)``.
        saturated: Sum over frames of the part of what was seen that was cut at a ceiling, ``(N,)``.
        unseen: Sum over frames of 1 where no view shows the Gaussian, ``(N,)``.
        frames: Number of frames.
    """

    numerator: NDArray[Any]
    denominator: NDArray[Any]
    observed: NDArray[Any]
    irradiance: NDArray[Any]
    openness: NDArray[Any]
    noise: NDArray[Any]
    misfit: NDArray[Any]
    views: NDArray[Any]
    facing: NDArray[Any]
    saturated: NDArray[Any]
    unseen: NDArray[Any]
    frames: int = 1

    ARRAYS: ClassVar[tuple[str, ...]]
    """Names of the arrays."""

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], frames: int = 1) -> ColorEvidence:
        """Collect arrays by name."""
        return cls(**{name: arrays[name] for name in cls.ARRAYS}, frames=frames)  # type: ignore[arg-type]

    def __add__(self, other: ColorEvidence) -> ColorEvidence:
        """Join evidence, in float64."""
        sums = {
            name: np.add(getattr(self, name), getattr(other, name), dtype=np.float64) for name in ColorEvidence.ARRAYS
        }
        return ColorEvidence.from_arrays(sums, self.frames + other.frames)


ColorEvidence.ARRAYS = tuple(field.name for field in fields(ColorEvidence) if field.name != "frames")


@dataclass(frozen=True, eq=False)
class MaterialMeasurement:
    """One frame's ambient occlusion with its standard error, ``(N,)`` each, and its evidence on base colour.

    ``ray_count`` is how many rays were traced for both, those of the bounce left out; ``economy`` is what fewer rays
    for some have left out (`beam_warp.materials.pilot.economy`), of the light and of the bounce.
    """

    ambient_occlusion: NDArray[np.float32]
    ambient_occlusion_error: NDArray[np.float32]
    evidence: ColorEvidence
    ray_count: int
    economy: dict[str, Any]


def measure_materials(
    cloud: GaussianCloud,
    scene: Scene,
    points: SurfacePoints,
    roughness: NDArray[np.float32],
    light: PreparedEnvironment,
    *,
    options: MaterialOptions,
    views: ViewEvidence | None = None,
    frame: int = 0,
    rows: NDArray[np.integer[Any]] | None = None,
    progress: CountProgress | None = None,
) -> MaterialMeasurement:
    """Trace one frame and accumulate its evidence on base colour.

    Args:
        cloud: Gaussians with captured radiance, axes "rfu".
        scene: The same Gaussians, uploaded.
        points: Where their light is gathered.
        roughness: Their perceptual roughness, ``(N,)``.
        light: The light of the capture, prepared on the scene's device.
        options: Rays, offset, bounce, seed.
        views: What views with images show; None takes the captured radiance around each normal.
        frame: Number of the frame. Light rays differ from frame to frame, so that fits over frames average their
            noise; occlusion rays do not, so that ambient occlusion does not flicker.
        rows: Gaussians to measure; all of them if None.
        progress: Called now and then with (Gaussians done, Gaussians in all).

    Raises:
        InvalidArrayError: The cloud has no captured radiance.

    Source: BEAM Eqs. 3 to 6; the ratio estimator, Heitz et al. 2018.
    """
    require_radiance(cloud)
    device = scene.device
    chosen = np.arange(len(cloud)) if rows is None else np.asarray(rows)
    count = len(chosen)
    blends = views is not None and bool(views.cameras) and options.blended and rows is None

    def part(number: int) -> CountProgress:
        """Tell of occlusion, light and blends, which are about as much work each."""
        parts = 3 if blends else 2

        def report(done: int, total: int) -> None:
            if progress is not None:
                progress(count * (number * total + done) // max(parts * total, 1), count)

        return report

    shown = chosen[points.seen[chosen]]
    at = upload(shown.astype(np.int32), int, device)
    occlusion = ambient_occlusion(
        scene,
        points.positions[at].contiguous(),
        points.normals[at].contiguous(),
        sample_count=options.sample_count,
        offset=points.offsets[at].contiguous(),
        options=points.tracing,
        sampler=options.sampler,
        seed=options.seed,
        progress=part(0),
    )
    visibility = occlusion.visibility.numpy()
    # What is buried is filled from neighbours anyway: its light is not traced.
    lit = shown[visibility > BURIED_VISIBILITY]
    measured = lit_points(cloud, points, roughness, light, lit, views)
    bounced = mean_radiance(cloud, views) if options.bounce else None
    for _ in light_batches(scene, points, light, measured, options, bounced, frame, part(1)):
        pass
    fit = zero_struct(ColorFit, len(lit), device)
    launch_fit_color(measured.views, measured.light, measured.surface, options.robust, fit, device)
    numerator, denominator, observed = (fit.numerator.numpy(), fit.denominator.numpy(), fit.observed.numpy())
    if views is not None and blends:
        sums = numerator, denominator, observed
        numerator, observed = _blended_sums(cloud, views, measured, *sums, progress=part(2))

    def by_row(values: NDArray[Any], at_rows: NDArray[np.integer[Any]], otherwise: float = 0.0) -> NDArray[np.float32]:
        """Spread what was measured over all rows that were asked for."""
        whole = np.full((len(cloud), *values.shape[1:]), otherwise, np.float32)
        whole[at_rows] = values
        return whole[chosen]

    # The normal is a mean over views, whose errors have little in common.
    tilt = measured.light.tilt.numpy() * points.normal_error[lit] / np.sqrt(np.maximum(fit.views.numpy(), 1.0))
    arriving = measured.light.arriving.numpy() + measured.light.bounce.numpy()
    misfit = np.zeros_like(arriving)
    if views is not None:
        np.divide(views.misfit[lit], arriving**2, out=misfit, where=arriving > 0.0)
    evidence = ColorEvidence(
        numerator=by_row(numerator, lit),
        denominator=by_row(denominator, lit),
        observed=by_row(observed, lit),
        irradiance=by_row(np.pi * measured.light.arriving.numpy(), lit),
        openness=by_row(visibility, shown),
        noise=by_row(measured.light.noise.numpy() ** 2 + tilt**2, lit),
        misfit=by_row(misfit, lit),
        views=by_row(fit.views.numpy(), lit),
        facing=by_row(fit.facing.numpy(), lit),
        saturated=(_cut_radiance(cloud) if views is None else views.saturated)[chosen],
        unseen=by_row(np.zeros(len(lit)), lit, 1.0),
    )
    return MaterialMeasurement(
        by_row(visibility, shown, 1.0),
        by_row(occlusion.standard_error.numpy(), shown, 1.0),
        evidence,
        options.sample_count * len(shown) + int(measured.rays.sum()),
        {
            "light": economy(measured.light.noise.numpy(), measured.rays, options.light_rays[1]),
            "bounce": economy(
                measured.bounce_noise(), measured.bounce_rays, options.bounce_rays[1], share=measured.bounce_share()
            ),
        },
    )


def _blended_sums(
    cloud: GaussianCloud,
    views: ViewEvidence,
    measured: LitPoints,
    numerator: NDArray[np.float32],
    denominator: NDArray[np.float32],
    observed: NDArray[np.float32],
    *,
    progress: CountProgress,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sums whose least-squares solution is that of all pixels together; what views leave of it stays as it was.

    Args:
        cloud: The Gaussians.
        views: What views with images show of them.
        measured: Those whose light is known.
        numerator: Of `ColorEvidence`, of these; so are the others.
        denominator: Likewise.
        observed: Likewise.
        progress: See `solve_blended`.

    Returns:
        The numerator, and what was observed.
    """
    weight = denominator.astype(np.float64)
    told = (weight > 0.0).all(axis=1, keepdims=True)
    separate = np.divide(numerator, weight, out=np.full_like(weight, np.nan), where=told & np.ones(3, bool))
    joint = np.where(told, solve_blended(cloud, views, measured, separate, progress=progress), 0.0)
    moved = weight * (joint**2 - np.where(told, separate, 0.0) ** 2)
    return np.where(told, weight * joint, numerator), observed + moved


def _cut_radiance(cloud: GaussianCloud) -> NDArray[np.float32]:
    """Return 1 where captured display colour is at the top of its range."""
    assert cloud.radiance is not None
    if cloud.radiance_color_space != DISPLAY_SRGB:
        return np.zeros(len(cloud), np.float32)  # scene-linear colour has no top
    return np.asarray((0.5 + SH_C0 * cloud.radiance[:, 0] >= SATURATION).any(axis=1), np.float32)
