"""From captured radiance and known light to base colour and ambient occlusion: measure each frame, then solve.

The direct path: rays are traced once per Gaussian; every view's diffuse and specular residue comes from the same rays;
base colour is the weighted least-squares fit of the captured radiance over views, and over frames where Gaussians
persist. Nothing is divided by a small number: what was hardly lit or never seen is flagged and filled from neighbours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from beam_warp.assets import DISPLAY_SRGB, GaussianCloud, Observability
from beam_warp.checks import require_count
from beam_warp.devices import upload
from beam_warp.environment_sampling import SampledEnvironment
from beam_warp.errors import InvalidArrayError
from beam_warp.ggx import specular_albedo_table
from beam_warp.images import srgb_to_linear
from beam_warp.kernels.incident_light import launch_sum_unshadowed
from beam_warp.kernels.product_sampling import launch_accumulate_block_weights
from beam_warp.kernels.residues import (
    CapturedSurface,
    ColorFit,
    LightRays,
    launch_draw_light,
    launch_fit_color,
    launch_trace_bounce,
)
from beam_warp.kernels.sampling import SampleSet
from beam_warp.kernels.surface_rays import RayBatch
from beam_warp.lighting import Progress, ambient_occlusion
from beam_warp.sampling import sample_set
from beam_warp.scene import Scene
from beam_warp.spherical_harmonics import SH_C0
from beam_warp.surface_rays import points_for_weights, ray_batches, room_for_rays
from beam_warp.surfaces import SurfaceNormals
from beam_warp.tracing import EXACT, trace_rays

BOUNCE_PART = 4
"""The bounce is a tenth of the light or less, so a quarter of the rays leaves its noise below that of the sky."""

VIEW_COUNT = 8
SMALLEST_VIEW_COSINE = 0.2
"""Views below this n.v count for nothing: there the shading normal and the lobe's edge dominate the residue."""

UNLIT_PART = 0.01
"""A Gaussian is unlit below this part of the environment's mean unshadowed irradiance."""

BURIED_VISIBILITY = 0.02
"""Below this visibility no view shows the Gaussian: its captured colour was never constrained."""

SATURATION = 0.995
"""Captured display colour above which the sensor's or the training's ceiling may have cut it."""

UNCERTAIN_NORMAL = 0.2
"""Confidence below which a normal counts as uncertain: fog has a median of 0.1, closed surfaces are above 0.5."""

FILL_NEIGHBORS = 8


@dataclass(frozen=True, kw_only=True)
class MaterialOptions:
    """How materials are measured.

    Attributes:
        sample_count: Rays per Gaussian and frame for visibility, and as many for light; a power of two is best.
        offset: Lift of ray origins [m] or ``"auto"``; see `beam_warp.ambient_occlusion`.
        bounce: Add one bounce from the captured radiance of what rays hit (the paper leaves it out).
        seed: Same seed, same device, same bits.
    """

    sample_count: int = 64
    offset: float | Literal["auto"] = "auto"
    bounce: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_count("sample_count", self.sample_count, 2, 4096)
        require_count("seed", self.seed, 0, 2**32 - 1)


@dataclass(frozen=True, eq=False, kw_only=True)
class ColorEvidence:
    """What frames say about base colour; evidence on the same Gaussians adds up.

    Attributes:
        numerator: Sum of w L_D (L_o - L_S), ``(N, 3)``.
        denominator: Sum of w L_D^2, ``(N, 3)``.
        observed: Sum of w (L_o - L_S)^2, ``(N, 3)``.
        irradiance: Sum over frames of the environment's shadowed irradiance, ``(N, 3)``.
        openness: Sum over frames of the hemispherical visibility, ``(N,)``.
        noise: Sum over frames of the squared relative standard error of the irradiance, ``(N,)``.
        frames: Number of frames.
    """

    numerator: NDArray[Any]
    denominator: NDArray[Any]
    observed: NDArray[Any]
    irradiance: NDArray[Any]
    openness: NDArray[Any]
    noise: NDArray[Any]
    frames: int = 1

    ARRAYS: ClassVar[tuple[str, ...]] = (
        "numerator",
        "denominator",
        "observed",
        "irradiance",
        "openness",
        "noise",
    )

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


@dataclass(frozen=True, eq=False)
class MaterialMeasurement:
    """One frame's ambient occlusion with its standard error, ``(N,)`` each, and its evidence on base colour."""

    ambient_occlusion: NDArray[np.float32]
    ambient_occlusion_error: NDArray[np.float32]
    evidence: ColorEvidence


def view_set() -> NDArray[np.float32]:
    """Return unit directions towards viewers, evenly over the visible side of +z, ``(VIEW_COUNT, 3)``."""
    index = np.arange(VIEW_COUNT) + 0.5
    z = 1.0 - (1.0 - SMALLEST_VIEW_COSINE) * index / VIEW_COUNT
    phi = np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1).astype(np.float32)


def measure_materials(
    cloud: GaussianCloud,
    scene: Scene,
    surface: SurfaceNormals,
    roughness: NDArray[np.float32],
    light: SampledEnvironment,
    *,
    options: MaterialOptions,
    frame: int = 0,
    rows: NDArray[np.integer[Any]] | None = None,
    progress: Progress | None = None,
) -> MaterialMeasurement:
    """Trace one frame and accumulate its evidence on base colour.

    Args:
        cloud: Gaussians with captured radiance, axes "rfu".
        scene: The same Gaussians, uploaded.
        surface: Their normals.
        roughness: Their perceptual roughness, ``(N,)``.
        light: The light of the capture, prepared on the scene's device.
        options: Rays, offset, bounce, seed.
        frame: Number of the frame. Light rays differ from frame to frame, so that fits over frames average their
            noise; occlusion rays do not, so that ambient occlusion does not flicker.
        rows: Gaussians to measure; all of them if None.
        progress: Called now and then with (Gaussians done, Gaussians in all).

    Raises:
        InvalidArrayError: The cloud has no captured radiance.

    Source: BEAM Eqs. 3 to 6; the ratio estimator, Heitz et al. 2018.
    """
    if cloud.radiance is None:
        raise InvalidArrayError(
            "radiance must be given to decompose materials, got None. Import Gaussians with captured colour."
        )
    device = scene.device
    chosen = np.arange(len(cloud)) if rows is None else np.asarray(rows)
    count = len(chosen)
    occlusion = ambient_occlusion(
        scene,
        cloud.positions[chosen],
        surface.normals[chosen],
        sample_count=options.sample_count,
        offset=options.offset,
        seed=options.seed,
        # Occlusion and light are about as much work, so each is half of the way.
        progress=None if progress is None else lambda done, total: progress(done // 2, total),
    )
    table = upload(specular_albedo_table(), wp.vec2, device)
    views = upload(view_set(), wp.vec3, device)
    is_display = cloud.radiance_color_space == DISPLAY_SRGB
    # Hits are taken as diffuse: the band of degree 0 is their mean colour over views.
    mean_color = 0.5 + SH_C0 * cloud.radiance[:, 0]
    if is_display:
        mean_color = srgb_to_linear(np.clip(mean_color, 0.0, 1.0))
    hit_radiance = upload(np.maximum(mean_color, 0.0).astype(np.float32), wp.vec3, device)
    samples = sample_set("owen", options.sample_count)
    stream = (options.seed, frame)
    # What is buried is filled from neighbours anyway: its light is not traced.
    seen = np.flatnonzero(occlusion.visibility > BURIED_VISIBILITY)
    points = upload(cloud.positions[chosen[seen]], wp.vec3, device)
    normals = upload(surface.normals[chosen[seen]], wp.vec3, device)
    captured = CapturedSurface()
    captured.radiance = upload(cloud.radiance, wp.vec3, device)
    captured.gaussians = upload(chosen[seen].astype(np.int32), int, device)
    captured.display_srgb = int(is_display)
    captured.roughness = upload(roughness[chosen[seen]].astype(np.float32), float, device)
    unshadowed, bounce, irradiance = (wp.zeros(len(seen), dtype=wp.vec3, device=device) for _ in range(3))
    launch_sum_unshadowed(light.moments, normals, unshadowed, device)
    fit = ColorFit()
    for name in ("numerator", "denominator", "observed"):
        setattr(fit, name, wp.empty(len(seen), dtype=wp.vec3, device=device))
    fit.relative_error = wp.empty(len(seen), dtype=float, device=device)
    done = count - len(seen)
    for batch in ray_batches(
        scene,
        points,
        normals,
        options.offset,
        samples.count,
        stratified=samples.columns > 0,
        points_at_once=points_for_weights(device),
    ):
        light_rays = _trace_light(scene, light, batch, samples, stream)
        if options.bounce:
            bounce_samples = max(samples.count // BOUNCE_PART, 2)
            launch_trace_bounce(scene, EXACT.settings(scene), batch, hit_radiance, stream, bounce_samples, bounce)
        launch_fit_color(batch, light_rays, unshadowed, bounce, table, views, captured, irradiance, fit, device)
        done += len(batch.rows)
        if progress is not None:
            progress(count - (count - done) // 2, count)

    def by_row(array: wp.array) -> NDArray[np.float32]:
        """Zeros for what is buried."""
        result = np.zeros((count, *array.numpy().shape[1:]), np.float32)
        result[seen] = array.numpy()
        return result

    evidence = ColorEvidence(
        numerator=by_row(fit.numerator),
        denominator=by_row(fit.denominator),
        observed=by_row(fit.observed),
        irradiance=by_row(irradiance),
        openness=occlusion.visibility,
        noise=by_row(fit.relative_error) ** 2,
    )
    return MaterialMeasurement(occlusion.visibility, occlusion.standard_error, evidence)


def _trace_light(
    scene: Scene, light: SampledEnvironment, batch: RayBatch, samples: SampleSet, stream: tuple[int, int]
) -> LightRays:
    """Draw a batch's rays towards the environment and trace them."""
    device = scene.device
    cumulative = wp.empty((len(batch.rows), 512), dtype=float, device=device)
    launch_accumulate_block_weights(light.blocks, batch.normals, cumulative, device)
    rays = room_for_rays(batch, device, bernoulli=False, reaches=True)
    result = LightRays()
    result.directions = rays.directions
    result.radiance_over_pdf = wp.empty(len(rays.origins), dtype=wp.vec3, device=device)
    result.visibility = wp.empty(len(rays.origins), dtype=float, device=device)
    launch_draw_light(light.blocks, cumulative, batch, samples, stream, rays, result.radiance_over_pdf, device)
    trace_rays(scene, EXACT, rays, result.visibility)
    return result


@dataclass(frozen=True, eq=False)
class BaseColor:
    """Solved base colour.

    Attributes:
        base_color: In [0, 1], scene-linear Rec.709, ``(N, 3)`` float32.
        standard_error: ``(N, 3)`` float32.
        observability: `Observability` flags, ``(N,)`` uint8.
        clipped_part: Part of the observed opacity with a channel cut at 1: a sign of light stated too dim.
    """

    base_color: NDArray[np.float32]
    standard_error: NDArray[np.float32]
    observability: NDArray[np.uint8]
    clipped_part: float


def solve_base_color(
    cloud: GaussianCloud,
    evidence: ColorEvidence,
    mean_irradiance: float,
) -> BaseColor:
    """Solve the least-squares problem that the frames add up to.

    rho = sum w L_D (L_o - L_S) / sum w L_D^2, cut to [0, 1]. The standard error joins two independent parts: how
    badly one rho explains all views and frames, and the noise of the irradiance, averaged over frames.

    Args:
        cloud: The Gaussians, of any one of the frames, with the confidence of their normals.
        evidence: Of one frame, or the sum over frames of the same Gaussians.
        mean_irradiance: The environment's mean unshadowed irradiance [W/m^2].

    Source: weighted linear least squares; BEAM Eq. 4 solved for the base colour.
    """
    assert cloud.radiance is not None
    assert cloud.normal_confidence is not None
    numerator, denominator, observed = (
        np.asarray(array, dtype=np.float64) for array in (evidence.numerator, evidence.denominator, evidence.observed)
    )
    irradiance = evidence.irradiance.mean(axis=1) / evidence.frames
    openness = evidence.openness / evidence.frames

    flags = np.zeros(len(cloud), np.uint8)
    flags[~(irradiance > UNLIT_PART * mean_irradiance) | ~(denominator > 0.0).all(axis=1)] |= np.uint8(
        Observability.UNLIT
    )
    flags[~(openness > BURIED_VISIBILITY)] |= np.uint8(Observability.UNSEEN)
    flags[(0.5 + SH_C0 * cloud.radiance[:, 0] >= SATURATION).any(axis=1)] |= np.uint8(Observability.SATURATED)
    flags[~(cloud.normal_confidence > UNCERTAIN_NORMAL)] |= np.uint8(Observability.UNCERTAIN_NORMAL)
    missing = (flags & np.uint8(Observability.UNLIT | Observability.UNSEEN)) != 0

    safe = np.where(denominator > 0.0, denominator, 1.0)
    raw = np.where(denominator > 0.0, numerator / safe, 0.0)
    base_color = np.clip(raw, 0.0, 1.0)
    residual = np.maximum(observed - 2.0 * base_color * numerator + base_color**2 * denominator, 0.0)
    degrees = max(VIEW_COUNT * evidence.frames - 1, 1)
    noise = np.sqrt(evidence.noise) / evidence.frames
    error = np.sqrt(residual / safe / degrees + (base_color * noise[:, None]) ** 2)
    weight = np.where(missing, 0.0, cloud.opacities)
    clipped = float((weight * (raw > 1.0).any(axis=1)).sum() / max(weight.sum(), 1e-12))
    base_color, error = _fill_from_neighbors(cloud.positions, base_color, error, missing)
    flags[missing] |= np.uint8(Observability.FILLED)
    return BaseColor(base_color.astype(np.float32), error.astype(np.float32), flags, clipped)


def _fill_from_neighbors(
    positions: NDArray[np.float32],
    values: NDArray[np.float64],
    errors: NDArray[np.float64],
    missing: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Give what was not observed the mean of its nearest observed neighbours; its error is their spread."""
    known = np.flatnonzero(~missing)
    if not missing.any() or len(known) == 0:
        return values, errors
    k = min(FILL_NEIGHBORS, len(known))
    distance, index = cKDTree(positions[known]).query(positions[missing], k=k, workers=-1)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    weight = 1.0 / np.maximum(distance, 1e-9)
    weight /= weight.sum(axis=1, keepdims=True)
    near = values[known[index]]
    mean = np.einsum("nk,nkc->nc", weight, near)
    filled, spread = values.copy(), errors.copy()
    filled[missing] = mean
    spread[missing] = np.sqrt(np.einsum("nk,nkc->nc", weight, (near - mean[:, None]) ** 2)) + errors[known].mean(axis=0)
    return filled, spread
