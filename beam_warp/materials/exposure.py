"""Exposure of a light under which display-referred captured colour is physically possible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.base_color import least_squares, misfit_error
from beam_warp.materials.direct import measure_materials
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.normals import SurfacePoints
from beam_warp.trace.scene import Scene
from beam_warp.world.gaussians import GaussianCloud

BRIGHTEST = (0.95, 0.8)
"""Quantile of the largest channel, and the base colour it is given where the bounds leave a choice: white cloth."""

MISFIT_SLACK = 1e-2
"""Exposures whose misfit is within this part of the captured radiance of the least one count as equally good."""

DOUBT = 2.0
"""Standard errors by which a base colour must be beyond its bounds before it counts as impossible."""

WELL_LIT_PART = 0.5
"""Gaussians that get at least this part of the mean irradiance have a say in the exposure."""

ASKED = 4096
"""Most Gaussians to look at, spread evenly over the cloud."""

EXPOSURE_FACTORS = np.exp2(np.arange(-10.0, 10.0 + 1e-9, 1.0 / 16.0))
"""Candidates of `estimate_exposure`, a sixteenth of a stop apart."""


def estimate_exposure(
    cloud: GaussianCloud,
    scene: Scene,
    points: SurfacePoints,
    roughness: NDArray[np.float32],
    light: PreparedEnvironment,
    *,
    options: MaterialOptions,
    views: ViewEvidence | None = None,
    is_measured: bool = False,
) -> float:
    """Find the factor on an environment that makes display-referred captured colour physically plausible.

    Display-referred colour has no absolute scale, so base colour has none either; but it lies in [0, 1]. Too little
    light asks for more than 1, too much lets the specular lobe alone exceed what was captured. The factor is the one
    whose bounds cut least of the captured radiance (in absolute values: outliers must not decide); among those that are
    equally good, the one that gives the brightest surfaces `BRIGHTEST`, or of a light that was measured, the one that
    changes it least: a subject without white is no evidence against it.

    Nor is chance. Noise of the images, of the rays and of normals puts base colours of white surfaces above 1 as often
    as below, and only a brighter light brings the former back. So what is cut counts from `DOUBT` standard errors of
    each base colour on, as `beam_warp.materials.base_color` states them.

    For light s times the environment, sum w L_D (L_o - L_S) / s = A - s B: two measurements with the same rays give
    A and B, and with them the base colour under every s. Its standard error is one of captured radiance over light, and
    goes with 1 / s.

    Args:
        cloud: Gaussians with captured radiance.
        scene: The same, uploaded.
        points: Where their light is gathered.
        roughness: Their roughness.
        light: The light of the capture up to a factor.
        options: Rays, offset, seed; the bounce, which does not scale with the light, is left out.
        views: What views with images show; None takes the captured radiance around each normal.
        is_measured: Whether the light is in the units of the capture as far as anybody knows.

    Returns:
        A positive factor; 1 where nothing was observed.
    """
    rows = np.unique(np.linspace(0, max(len(cloud) - 1, 0), min(ASKED, len(cloud))).astype(np.int64))
    # Weights that depend on the light would make the sums more than linear in it.
    direct = replace(options, bounce=False, robust=False)
    full, half = (
        measure_materials(
            cloud, scene, points, roughness, light.scaled(factor), options=direct, views=views, rows=rows
        ).evidence
        for factor in (1.0, 0.5)
    )
    # Where the assumed light hardly reaches the quotient is arbitrary; such Gaussians have no say.
    lit = full.irradiance.mean(axis=1)
    good = (full.denominator > 0.0).all(axis=1) & (lit > WELL_LIT_PART * lit.mean())
    if not good.any():
        return 1.0
    specular = 2.0 * (2.0 * half.numerator - full.numerator)[good].astype(np.float64)
    captured = full.numerator[good] + specular
    denominator = full.denominator[good].astype(np.float64)
    weight = cloud.opacities[rows][good].astype(np.float64)
    amplitude = weight[:, None] * full.irradiance[good]  # turns base colour into what is reflected
    doubt = DOUBT * np.hypot(least_squares(full, bounds=(-np.inf, np.inf))[1], misfit_error(full))[good]

    misfit, brightest = [], []
    for factor in EXPOSURE_FACTORS:
        base_color = (captured - factor * specular) / (factor * denominator)
        beyond = factor * np.abs(base_color - np.clip(base_color, 0.0, 1.0))
        misfit.append(float((amplitude * np.maximum(beyond - doubt, 0.0)).sum()))
        largest = base_color.max(axis=1)
        order = np.argsort(largest)
        middle = np.searchsorted(np.cumsum(weight[order]), BRIGHTEST[0] * weight.sum())
        brightest.append(max(float(largest[order][min(middle, len(order) - 1)]), 1e-9))
    energy = float((amplitude * captured / denominator).sum())
    equally_good = np.array(misfit) <= min(misfit) + MISFIT_SLACK * energy
    off = EXPOSURE_FACTORS if is_measured else np.array(brightest) / BRIGHTEST[1]
    distance = np.where(equally_good, np.abs(np.log(off)), np.inf)
    return float(EXPOSURE_FACTORS[int(np.argmin(distance))])
