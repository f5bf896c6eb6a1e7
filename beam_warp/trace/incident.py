"""How much light of an environment falls on surface points through what is in the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import warp as wp

from beam_warp.checks import require_choice, require_count
from beam_warp.device.arrays import download_like
from beam_warp.errors import InvalidOptionError
from beam_warp.kernels.light.product_sampling import launch_accumulate_block_weights
from beam_warp.kernels.trace.incident_light import (
    COSINE,
    ENVIRONMENT,
    PRODUCT,
    Technique,
    launch_draw_light,
    launch_reduce_light,
    launch_sum_unshadowed,
)
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.trace.rays import checked_points, points_for_weights, ray_batches, room_for_rays
from beam_warp.trace.sampling import Sampler, sample_set
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import EXACT, TraceOptions, trace_rays
from beam_warp.world.environment import EnvironmentMap

Density = Literal["cosine", "environment", "product", "mis"]

DENSITIES = ("cosine", "environment", "product", "mis")


@dataclass(frozen=True)
class Irradiance:
    """Light that falls on each point.

    Attributes:
        value: Irradiance over pi, the radiance that a white diffuser there sends out [W/(m^2 sr)], scene-linear
            Rec.709, ``(N, 3)`` float32.
        standard_error: Standard error of ``value``, ``(N, 3)`` float32. It cannot know of light that no ray found.
    """

    value: Any
    standard_error: Any


def techniques(density: Density, sampler: Sampler, sample_count: int) -> list[Technique]:
    """Return who draws which part of each point's samples: one density, or cosine and environment by halves."""
    half = sample_count // 2
    parts = {
        "cosine": [(COSINE, sample_count)],
        "environment": [(ENVIRONMENT, sample_count)],
        "product": [(PRODUCT, sample_count)],
        "mis": [(COSINE, half), (ENVIRONMENT, sample_count - half)],
    }[density]
    shares = {int(kind): count / sample_count for kind, count in parts}
    result = []
    for place, (kind, count) in enumerate(parts):
        technique = Technique()
        technique.density = int(kind)
        technique.samples = sample_set(sampler, count)
        technique.begin = parts[0][1] * place
        technique.sample_count = sample_count
        technique.cosine_share = shares.get(int(COSINE), 0.0)
        technique.environment_share = shares.get(int(ENVIRONMENT), 0.0)
        result.append(technique)
    return result


def irradiance(
    scene: Scene,
    points: Any,
    normals: Any,
    environment: EnvironmentMap | PreparedEnvironment,
    *,
    sample_count: int = 64,
    sampler: Sampler = "owen",
    density: Density = "product",
    ratio: bool = True,
    offset: float | Literal["auto"] = "auto",
    options: TraceOptions = EXACT,
    seed: int = 0,
    frame: int = 0,
) -> Irradiance:
    """Estimate the light that an environment sheds on each surface point.

    E(x) / pi = 1/pi * integral over the hemisphere of V(x, w) L(w) (n.w) dw, by channel. Every density draws w from a
    sample set of its own for each point; docs/sampling.md measures them:

    - ``"cosine"``: by n.w. Right for even light; misses suns.
    - ``"environment"``: by the luminance of L times solid angle. Finds suns; half of its rays or more go below the
      horizon of the point, and those near it weigh little.
    - ``"product"``: by the product of both, up to a bound of the cosine over blocks of 1/16 x 1/32 of the map.
    - ``"mis"``: half of the samples by cosine, half by environment, joined by the balance heuristic: each is divided
      by the density of both together, so that neither alone can make a sample weigh much.

    With ``ratio``, E = E_free * sum V f / sum f, where f = L (n.w) / pdf and E_free, the unshadowed irradiance, is a
    sum over the whole map in closed form: noise remains only where visibility varies. It is consistent, with a bias of
    the order of 1 / ``sample_count`` far below its standard error; without, the estimate is unbiased. A channel in
    which no ray found light is stated as half of E_free, give or take half.

    Args:
        scene: Occluders; the work runs on its device.
        points: Surface points [m], ``(N, 3)`` float32, NumPy or a warp array of vec3 on the scene's device.
        normals: Unit outward normals, like ``points``.
        environment: Distant light; maps of more than 512 rows are reduced to 512, energy kept. A `PreparedEnvironment`
            saves preparing the same map again.
        sample_count: Rays per point, at least 2, and 4 for ``"mis"``; powers of two suit ``"owen"``.
        sampler: Sample sets: ``"owen"``, ``"stratified"`` or ``"iid"``; see `beam_warp.ambient_occlusion`.
        density: What directions are drawn by, as above.
        ratio: Whether to divide by the same rays' unshadowed light.
        offset: Distance [m] from point to ray origin along the normal, or ``"auto"``.
        options: What counts as a hit, and whether transmittances multiply or are sampled.
        seed: Same seed, same device, same bits.
        frame: Number of the frame; frames have independent noise, the same frame always the same.

    Returns:
        Irradiance over pi and its standard error; NumPy ``(N, 3)``, or warp arrays of vec3 if one came in.

    Raises:
        InvalidArrayError: A shape, type, non-finite or non-unit value breaks the contract above.
        InvalidOptionError: An option is out of range, or the environment is on another device.

    Source: BEAM Eq. 4; balance heuristic, Veach 1997; product of environment and cosine, Clarberg et al. 2005; ratio
    estimator, Heitz et al. 2018.
    """
    require_choice("density", density, DENSITIES)
    require_count("sample_count", sample_count, 4 if density == "mis" else 2, 1 << 20)
    parts = techniques(density, sampler, sample_count)
    at, up = checked_points(scene, points, normals, offset, seed, frame)
    if isinstance(environment, EnvironmentMap):
        environment = PreparedEnvironment(environment, scene.device)
    elif environment.device != scene.device:
        raise InvalidOptionError(
            f"environment must be on {scene.device}, got one on {environment.device}. Prepare it for that device."
        )
    value = wp.zeros(len(at), dtype=wp.vec3, device=scene.device)
    error = wp.zeros(len(at), dtype=wp.vec3, device=scene.device)
    count = parts[0].sample_count
    is_product = density == "product"
    is_bernoulli = options.acceptance == "bernoulli"
    unshadowed = wp.empty(len(at) if ratio else 0, dtype=wp.vec3, device=scene.device)
    if ratio:
        launch_sum_unshadowed(len(up), environment.moments, up, unshadowed, scene.device)
    counts = wp.vec2i(parts[0].samples.count, count - parts[0].samples.count)
    paired = wp.vec2i(int(parts[0].samples.columns > 0), int(parts[-1].samples.columns > 0))
    at_once = points_for_weights(scene.device) if is_product else None
    for batch in ray_batches(scene, at, up, offset, count, stream=(seed, frame), points_at_once=at_once):
        cumulative = wp.empty((len(batch.rows), 512) if is_product else (0, 0), dtype=float, device=scene.device)
        if is_product:
            launch_accumulate_block_weights(
                len(batch.normals), environment.blocks, batch.normals, cumulative, scene.device
            )
        rays = room_for_rays(batch, scene.device, bernoulli=is_bernoulli, reaches=True)
        weights = wp.empty(len(rays.origins), dtype=wp.vec3, device=scene.device)
        for part in parts:
            launch_draw_light(part, environment, cumulative, batch, rays, weights, scene.device)
        visible = wp.empty(len(rays.origins), dtype=float, device=scene.device)
        trace_rays(scene, options, rays, visible)
        launch_reduce_light(
            len(batch.rows), batch, weights, visible, counts, paired, unshadowed, value, error, scene.device
        )
    return Irradiance(download_like(value, points, normals), download_like(error, points, normals))
