"""Light of Gaussians in one frame: rays from each towards the light, and what they leave in every view.

Rays are traced once per Gaussian; every view's diffuse and specular residue comes from the same rays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_choice, require_count, require_number
from beam_warp.device.arrays import upload, zero_struct
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import DISPLAY_SRGB, srgb_to_linear
from beam_warp.jobs.listeners import CountProgress
from beam_warp.kernels.common.sampling import SampleSet
from beam_warp.kernels.light.lights import Lights
from beam_warp.kernels.light.product_sampling import launch_accumulate_block_weights
from beam_warp.kernels.materials.residues import (
    ALBEDO_SCALING,
    FRESNEL_HV,
    GatheredLight,
    LightRays,
    Observations,
    ReflectedLight,
    ShadedPoints,
    launch_gather_light,
    launch_sample_radiance,
    launch_trace_bounce,
    launch_view_residues,
)
from beam_warp.kernels.trace.incident_light import (
    PRODUCT,
    launch_draw_light,
    launch_recall_visibility,
    launch_sum_unshadowed,
)
from beam_warp.kernels.trace.surface_rays import RayBatch
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.light.uploaded import upload_lights
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.normals import SurfacePoints
from beam_warp.materials.pilot import rays_needed
from beam_warp.trace.incident import DENSITIES, Density, techniques
from beam_warp.trace.rays import points_for_weights, ray_batches, room_for_rays
from beam_warp.trace.sampling import SAMPLERS, Sampler, sample_set
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import TraceOptions, trace_rays
from beam_warp.world.directions import even_directions
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0

BOUNCE_PART = 4
"""The bounce is a tenth of the light or less, so a quarter of the rays leaves its noise below that of the sky."""

FEWEST_FIRST_RAYS = 4
"""First rays of a Gaussian, of which an error can be stated."""

VIEW_COUNT = 8
SMALLEST_VIEW_COSINE = 0.2
"""Least n.v of a view, where there are no images: below, the normal and the lobe's edge dominate."""

DiffuseWeight = Literal["albedo_scaling", "fresnel_hv"]

DIFFUSE_WEIGHTS: dict[str, int] = {"albedo_scaling": int(ALBEDO_SCALING), "fresnel_hv": int(FRESNEL_HV)}
"""Ways to weigh the light that is left for diffusion, and the kernels' numbers for them: ``"albedo_scaling"``, what the
specular lobe as a whole does not reflect, which conserves energy; ``"fresnel_hv"``, 1 - F(h.v) for every ray (the
paper's 1 - F, with Schlick's F)."""


@dataclass(frozen=True, kw_only=True)
class MaterialOptions:
    """Options of the direct path.

    Attributes:
        sample_count: Rays per Gaussian and frame for visibility; a power of two is best.
        light_error: Relative standard error, as it is stated, with which a Gaussian gets ``sample_count`` rays towards
            the light. Others get from a quarter to four times as many, those with larger errors more, as the first rays
            of their neighbours tell (`beam_warp.materials.pilot`). With 0, and for sets that do not go on
            (``"stratified"``, ``"mis"``), each gets ``sample_count``. The bounce is treated in the same way.
        offset: Lift of ray origins [m] or ``"auto"``; see `beam_warp.materials.normals.SurfacePoints`.
        bounce: Add one bounce from the captured radiance of what rays hit (the paper leaves it out).
        diffuse_weight: What the specular lobe leaves for diffusion, one of `DIFFUSE_WEIGHTS`.
        sampler: Sample sets; see `beam_warp.irradiance`.
        density: What light rays are drawn by; see there.
        ratio: Whether rays only say which share of the unshadowed light arrives; see there.
        robust: Count views little that disagree with the others.
        blended: Solve for base colour by what pixels say of all Gaussians together, and of neighbours; else each by
            itself. See `beam_warp.materials.blended_color`. Only where there are images, and all are measured.
        seed: Same seed, same device, same bits.

    Raises:
        InvalidOptionError: An option is out of range.
    """

    sample_count: int = 64
    light_error: float = 0.05
    offset: float | Literal["auto"] = "auto"
    bounce: bool = True
    diffuse_weight: DiffuseWeight = "albedo_scaling"
    sampler: Sampler = "owen"
    density: Density = "product"
    ratio: bool = True
    robust: bool = True
    blended: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every option once."""
        require_count("sample_count", self.sample_count, 4, 4096)
        require_number("light_error", self.light_error, 0.0, 1.0)
        require_choice("diffuse_weight", self.diffuse_weight, tuple(DIFFUSE_WEIGHTS))
        require_choice("sampler", self.sampler, SAMPLERS)
        require_choice("density", self.density, DENSITIES)
        require_count("seed", self.seed, 0, 2**32 - 1)
        if self.offset != "auto":
            require_number("offset", self.offset)

    @property
    def light_rays(self) -> tuple[int, int]:
        """Fewest and most rays towards the light of a Gaussian."""
        return self._around(self.sample_count)

    @property
    def usual_bounce_rays(self) -> int:
        """Rays of the bounce of a Gaussian where none gets more than another."""
        return max(self.sample_count // BOUNCE_PART, 2)

    @property
    def bounce_rays(self) -> tuple[int, int]:
        """Fewest and most rays of the bounce of a Gaussian."""
        return self._around(self.usual_bounce_rays)

    def _around(self, count: int) -> tuple[int, int]:
        if self.light_error == 0.0 or self.sampler == "stratified" or self.density == "mis":
            return count, count
        fewest = max(count // 4, FEWEST_FIRST_RAYS)
        return fewest, max(4 * count, fewest)


@dataclass(frozen=True, eq=False)
class LitPoints:
    """Points whose light is known; all arrays are on the device and by row.

    Attributes:
        light: The light at each point; filled batch by batch by `light_batches`.
        surface: Their normals and roughness.
        views: What views show of them.
        rows: Which Gaussians they are, ``(M,)``.
        rays: How many rays go towards the light, ``(M,)``; filled when `light_batches` begins.
        bounce_rays: The same of the bounce; 0 where there is none.
    """

    light: GatheredLight
    surface: ShadedPoints
    views: Observations
    rows: NDArray[np.int64]
    rays: NDArray[np.int32]
    bounce_rays: NDArray[np.int32]

    def bounce_noise(self) -> NDArray[np.float32]:
        """Return the standard error of the bounce over all the light that arrives, ``(M,)``."""
        return _over_light(self.light)

    def bounce_share(self) -> NDArray[np.float32]:
        """Return which part of the light that arrives is the bounce's, ``(M,)``."""
        bounce = self.light.bounce.numpy().sum(axis=1)
        return bounce / np.maximum(self.light.arriving.numpy().sum(axis=1) + bounce, 1e-12)


def _over_light(light: GatheredLight) -> NDArray[np.float32]:
    """Return the standard error of the bounce over all light."""
    total = light.arriving.numpy().sum(axis=1) + light.bounce.numpy().sum(axis=1)
    return light.bounce_error.numpy() / np.maximum(total, 1e-12)


def view_set() -> NDArray[np.float32]:
    """Return unit directions towards viewers, evenly over the visible side of +z, ``(VIEW_COUNT, 3)``."""
    return even_directions(VIEW_COUNT, last=SMALLEST_VIEW_COSINE).astype(np.float32)


def lit_points(
    cloud: GaussianCloud,
    points: SurfacePoints,
    roughness: NDArray[np.float32],
    light: PreparedEnvironment,
    rows: NDArray[np.integer[Any]],
    views: ViewEvidence | None,
) -> LitPoints:
    """Make room for the light of some Gaussians, and collect what views show of them.

    Raises:
        InvalidArrayError: The cloud has no captured radiance.
    """
    radiance = require_radiance(cloud)
    device, count = light.device, len(rows)
    at = upload(np.asarray(rows, np.int32), int, device)
    observed = Observations()
    if views is None:
        observed.colors = wp.empty((VIEW_COUNT, count), dtype=wp.vec4, device=device)
        observed.directions = wp.empty((VIEW_COUNT, count), dtype=wp.vec3, device=device)
        launch_sample_radiance(
            len(at),
            upload(radiance, wp.vec3, device),
            at,
            int(cloud.radiance_color_space == DISPLAY_SRGB),
            points.normals[at].contiguous(),
            upload(view_set(), wp.vec3, device),
            observed.colors,
            observed.directions,
            device,
        )
    else:
        observed.colors = views.colors[:, at].contiguous()
        observed.directions = views.directions[:, at].contiguous()
    surface = ShadedPoints()
    surface.normals = points.normals[at].contiguous()
    surface.roughness = upload(roughness[rows].astype(np.float32), float, device)
    observed.specular = wp.zeros(observed.directions.shape, dtype=wp.vec3, device=device)
    observed.diffuse_share = wp.zeros(observed.directions.shape, dtype=float, device=device)
    arriving = zero_struct(GatheredLight, len(rows), device)
    launch_sum_unshadowed(len(surface.normals), light.moments, surface.normals, arriving.unshadowed, device)
    rays, bounce_rays = np.zeros((2, len(rows)), np.int32)
    return LitPoints(arriving, surface, observed, np.asarray(rows, np.int64), rays, bounce_rays)


def reflected_light(light: PreparedEnvironment) -> ReflectedLight:
    """Return what specular lobes see of a light: small bright sources as such, and the rest blurred."""
    rest, sources = light.split
    reflected = ReflectedLight()
    reflected.sources, reflected.rest = upload_lights(sources, light.device), rest.blurred
    return reflected


def light_batches(
    scene: Scene,
    points: SurfacePoints,
    light: PreparedEnvironment,
    measured: LitPoints,
    options: MaterialOptions,
    hit_radiance: NDArray[np.float32] | None,
    frame: int,
    progress: CountProgress,
) -> Iterator[tuple[RayBatch, LightRays]]:
    """Trace the light of some points, batch by batch, and fill in what it leaves in every view.

    Each batch comes with its rays, which are gone when the next one is asked for.

    Args:
        scene: Occluders.
        points: Of all Gaussians.
        light: The light.
        measured: Which points; its arrays are filled.
        options: Rays and what they are drawn by.
        hit_radiance: What rays that hit a Gaussian see of it, scene-linear, ``(N, 3)``: one bounce; None keeps the
            bounce that ``measured`` holds.
        frame: Number of the frame.
        progress: Called with (points done, points in all).
    """
    device = scene.device
    if not len(measured.rows):
        return
    reflected = reflected_light(light)
    ways = LightPaths.of(scene, points, light, measured, options, frame)
    measured.rays[:], pilot = ways.counted(reflected.sources, measured.light)
    if hit_radiance is not None:
        measured.bounce_rays[:] = ways.bounced(upload(hit_radiance, wp.vec3, device), measured.light)
    done = 0
    for count in np.unique(measured.rays):
        for batch in ways.batches(int(count), np.flatnonzero(measured.rays == count)):
            found = ways.traced(batch, pilot)
            launch_gather_light(
                len(batch.rows), batch, found, int(options.ratio), reflected.sources, measured.light, device
            )
            launch_view_residues(
                batch,
                found,
                measured.light,
                reflected,
                measured.surface,
                DIFFUSE_WEIGHTS[options.diffuse_weight],
                measured.views,
                device,
            )
            yield batch, found
            done += len(batch.rows)
            progress(done, len(measured.rows))


class Pilot(NamedTuple):
    """What the first rays of every point met: the set they are, where each row is, and visibility by place and slot."""

    samples: SampleSet
    places: wp.array
    visibility: wp.array


@dataclass(frozen=True, eq=False)
class LightPaths:
    """Rays from points towards the light; arrays are on the device and by row."""

    scene: Scene
    light: PreparedEnvironment
    positions: wp.array
    normals: wp.array
    offsets: wp.array
    tracing: TraceOptions
    options: MaterialOptions
    frame: int

    @classmethod
    def of(
        cls,
        scene: Scene,
        points: SurfacePoints,
        light: PreparedEnvironment,
        measured: LitPoints,
        options: MaterialOptions,
        frame: int,
    ) -> LightPaths:
        """Collect what rays of the measured points need."""
        at = upload(measured.rows.astype(np.int32), int, scene.device)
        positions, offsets = points.positions[at].contiguous(), points.offsets[at].contiguous()
        return cls(scene, light, positions, measured.surface.normals, offsets, points.tracing, options, frame)

    def batches(self, count: int, rows: NDArray[np.integer[Any]]) -> list[RayBatch]:
        """Return batches of so many rays from some of the points."""
        is_product, device = self.options.density == "product", self.scene.device
        return ray_batches(
            self.scene,
            self.positions,
            self.normals,
            self.offsets,
            count,
            stream=(self.options.seed, self.frame),
            points_at_once=points_for_weights(device) if is_product else None,
            chosen=None if len(rows) == len(self.positions) else upload(rows.astype(np.int32), int, device),
        )

    def traced(self, batch: RayBatch, pilot: Pilot | None = None) -> LightRays:
        """Draw and trace the rays of a batch; those that the pilot has traced are taken from there."""
        device, count = self.scene.device, len(batch.rows)
        parts = techniques(self.options.density, self.options.sampler, batch.sample_count)
        is_product = parts[0].density == int(PRODUCT)
        cumulative = wp.empty((count, 512) if is_product else (0, 0), dtype=float, device=device)
        if is_product:
            launch_accumulate_block_weights(count, self.light.blocks, batch.normals, cumulative, device)
        rays = room_for_rays(batch, device, bernoulli=False, reaches=True)
        found = LightRays()
        found.directions = rays.directions
        found.weights = wp.empty(len(rays.origins), dtype=wp.vec3, device=device)
        found.visibility = wp.empty(len(rays.origins), dtype=float, device=device)
        found.paired = int(all(part.samples.columns > 0 for part in parts))
        for part in parts:
            part.known = 0 if pilot is None else pilot.samples.count
            launch_draw_light(part, self.light, cumulative, batch, rays, found.weights, device)
        trace_rays(self.scene, self.tracing, rays, found.visibility)
        if pilot is not None:
            items = count * pilot.samples.count
            launch_recall_visibility(items, parts[0], pilot.samples, batch, *pilot[1:], found.visibility, device)
        return found

    def counted(self, sources: Lights, out_light: GatheredLight) -> tuple[NDArray[np.int32], Pilot | None]:
        """Return how many rays each point needs, and what its first ones met; ``out_light`` is used for their error."""
        (first, most), device, count = self.options.light_rays, self.scene.device, len(self.positions)
        if first == most:
            return np.full(count, most, np.int32), None
        rows, seen = [], []
        for batch in self.batches(first, np.arange(count)):
            found = self.traced(batch)
            launch_gather_light(len(batch.rows), batch, found, int(self.options.ratio), sources, out_light, device)
            rows.append(batch.rows.numpy())
            seen.append(found.visibility)
        order = np.concatenate(rows)
        needed, places = np.empty(count, np.int32), np.empty(count, np.int32)
        needed[order] = rays_needed(
            out_light.noise.numpy()[order],
            first,
            most,
            count=self.options.sample_count,
            target=self.options.light_error,
        )
        places[order] = np.arange(count)
        known = wp.empty(count * first, dtype=float, device=device)
        for start, part in zip(np.cumsum([0, *map(len, seen)]), seen, strict=False):
            wp.copy(known, part, dest_offset=int(start))
        return needed, Pilot(sample_set(self.options.sampler, first), upload(places, int, device), known)

    def bounced(self, radiance: wp.array, out_light: GatheredLight) -> NDArray[np.int32]:
        """Gather one bounce, with as many rays as each point needs, and return how many those are.

        Args:
            radiance: What rays that hit a Gaussian see of it, scene-linear, ``(N,)`` of vec3.
            out_light: Holds the light that the first rays found, if points differ; its bounce is filled.
        """
        (first, most), count, device = self.options.bounce_rays, len(self.positions), self.scene.device
        needed, rows = np.full(count, first, np.int32), np.arange(count)

        def trace(batches: list[RayBatch]) -> None:
            counts, stream = upload(needed, int, device), (self.options.seed, self.frame)
            settings = self.tracing.settings(self.scene)
            for batch in batches:
                launch_trace_bounce(self.scene, settings, batch, radiance, stream, counts, out_light)

        batches = self.batches(first, rows)
        trace(batches)
        if first < most:
            usual, target = self.options.usual_bounce_rays, self.options.light_error
            order = np.concatenate([batch.rows.numpy() for batch in batches])
            needed[order] = rays_needed(_over_light(out_light)[order], first, most, count=usual, target=target)
            more = np.flatnonzero(needed > first)
            if len(more):
                trace(self.batches(first, more))
        return needed


def require_radiance(cloud: GaussianCloud) -> NDArray[np.float32]:
    """Return the captured radiance of Gaussians, ``(N, K, 3)``.

    Raises:
        InvalidArrayError: There is none.
    """
    if cloud.radiance is None:
        raise InvalidArrayError(
            "radiance must be given to decompose materials, got None. Import Gaussians with captured colour."
        )
    return cloud.radiance


def mean_radiance(cloud: GaussianCloud, views: ViewEvidence | None) -> NDArray[np.float32]:
    """Return what a ray that hits a Gaussian sees, ``(N, 3)``: hits are taken as diffuse, so its mean colour.

    Over the views that show it; the band of degree 0 is the mean over all directions, seen or not.
    """
    assert cloud.radiance is not None
    mean = 0.5 + SH_C0 * cloud.radiance[:, 0]
    if cloud.radiance_color_space == DISPLAY_SRGB:
        mean = srgb_to_linear(np.clip(mean, 0.0, 1.0))
    if views is not None and views.colors.shape[0]:
        colors = views.colors.numpy()
        weight = colors[..., 3].sum(axis=0)
        shown = np.einsum("vn,vnc->nc", colors[..., 3], colors[..., :3])
        mean = np.where((weight > 0.0)[:, None], shown / np.maximum(weight, 1e-12)[:, None], mean)
    return np.asarray(np.maximum(mean, 0.0), np.float32)
