"""Misfit of candidate roughnesses to the views of points whose light is known.

The rays that gathered a point's light also say which share of each view's specular lobe is open, as in
`beam_warp.kernels.materials.residues`. That share changes slowly with roughness and costs a loop over the rays, so it
is taken at four roughnesses and interpolated; the lobe's own radiance and its directional albedo, which change fast,
are looked up for every candidate, once for all rounds of the fit.
"""

import warp as wp

from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.light.brdf import (
    ALPHA_FLOOR,
    fresnel_schlick,
    ggx_distribution,
    smith_visibility,
    specular_albedo,
)
from beam_warp.kernels.light.lights import Lights
from beam_warp.kernels.materials.residues import (
    ROUNDS,
    GatheredLight,
    LightRays,
    Observations,
    ReflectedLight,
    brightness,
    facing_weight,
    source_towards,
    specular_residue,
)
from beam_warp.kernels.trace.surface_rays import RayBatch

wp.set_module_options({"enable_backward": False})

SHARE_ROUGHNESS = wp.constant(wp.vec4(0.15, 0.35, 0.6, 1.0))
"""Perceptual roughnesses at which the open share of the lobe is summed over rays."""

SPREAD_PART = wp.constant(0.06)
"""Residual at which a view counts half, as a part of what a white surface would show with nothing in the way.

Errors of normals, visibility and bounces grow with the light, not with the colour that it falls on."""

PARTS = wp.constant(3)
"""All views, the even ones, the odd ones: the last two have nothing in common and tell what the first is worth."""


@wp.func
def lobes_without_fresnel(n_dot_l: float, n_dot_v: float, n_dot_h: float) -> wp.vec4:
    """D times masking at `SHARE_ROUGHNESS`; Fresnel's factor is common to all."""
    value = wp.vec4()
    for k in range(4):
        alpha = wp.max(SHARE_ROUGHNESS[k] * SHARE_ROUGHNESS[k], ALPHA_FLOOR)
        value[k] = ggx_distribution(n_dot_h, alpha) * smith_visibility(n_dot_l, n_dot_v, alpha)
    return value


@wp.kernel
def lobe_shares_kernel(
    first: int,
    batch: RayBatch,
    rays: LightRays,
    light: GatheredLight,
    normals: wp.array[wp.vec3],
    views: Observations,
    sources: Lights,
    out_shares: wp.array2d[wp.vec4],
):
    """Part of the lobe's light that nothing is in the way of, for one view of one point; small sources are left out."""
    item = first + wp.tid()
    view_count = views.colors.shape[0]
    place = item / view_count
    view = item % view_count
    row = batch.rows[place]
    n = normals[row]
    v = views.directions[view, row]
    cosine = wp.dot(n, v)
    if not (facing_weight(cosine) > 0.0 and views.colors[view, row][3] > 0.0):
        return
    begin = place * batch.sample_count
    free = wp.vec4()
    seen = wp.vec4()
    for k in range(batch.sample_count):
        towards = rays.directions[begin + k]
        power = brightness(rays.weights[begin + k])
        n_dot_l = wp.dot(n, towards)
        if power > 0.0 and n_dot_l > 0.0 and source_towards(sources, towards) < 0:
            h = wp.normalize(v + towards)
            part = lobes_without_fresnel(n_dot_l, cosine, wp.dot(n, h)) * (power * fresnel_schlick(wp.dot(v, h)))
            free += part
            seen += part * rays.visibility[begin + k]
    unshadowed = brightness(light.unshadowed[row])
    share = wp.vec4(1.0, 1.0, 1.0, 1.0)  # where no ray is in the lobe: that of the diffuse light
    for k in range(4):
        if free[k] > 0.0:
            share[k] = seen[k] / free[k]
        elif unshadowed > 0.0:
            share[k] = brightness(light.arriving[row]) / unshadowed
    out_shares[place, view] = share


@wp.func
def share_at(shares: wp.vec4, roughness: float) -> float:
    """Interpolate linearly among `SHARE_ROUGHNESS`."""
    share = shares[0]
    for k in range(3):  # unrolled: an index that is not known when compiling would go through local memory
        if roughness > SHARE_ROUGHNESS[k]:
            f = wp.min((roughness - SHARE_ROUGHNESS[k]) / (SHARE_ROUGHNESS[k + 1] - SHARE_ROUGHNESS[k]), 1.0)
            share = shares[k] * (1.0 - f) + shares[k + 1] * f
    return share


@wp.func
def view_weight(sample: wp.vec4, cosine: float) -> float:
    """A view counts by the pixels that it shows, up to one: what it shows more often has the same errors."""
    return wp.min(sample[3], 1.0) * facing_weight(cosine)


@wp.kernel
def reflections_kernel(
    first: int,
    rows: wp.array[int],
    light: GatheredLight,
    reflected: ReflectedLight,
    normals: wp.array[wp.vec3],
    views: Observations,
    shares: wp.array2d[wp.vec4],
    candidates: wp.array[float],
    out_reflections: wp.array3d[wp.vec4],
):
    """L_S of one view of one point at one candidate, and the lobe's albedo; candidates are neighbours."""
    item = first + wp.tid()
    candidate = item % candidates.shape[0]
    view = (item / candidates.shape[0]) % views.colors.shape[0]
    place = item / (candidates.shape[0] * views.colors.shape[0])
    row = rows[place]
    n = normals[row]
    v = views.directions[view, row]
    cosine = wp.dot(n, v)
    if not (view_weight(views.colors[view, row], cosine) > 0.0):
        return
    roughness = candidates[candidate]
    open_share = share_at(shares[place, view], roughness)
    specular = specular_residue(reflected, light, row, n, v, roughness, open_share)
    albedo = specular_albedo(reflected.rest.albedo_terms, cosine, roughness)
    out_reflections[place, view, candidate] = wp.vec4(specular[0], specular[1], specular[2], albedo)


@wp.struct
class ProfileFit:
    """Misfit of candidates to the views of a part, by row; rows of other points are left as they are."""

    misfit: wp.array3d[float]  # (PARTS, row, candidate): sum over views of w log(1 + e^2 / s^2) at the best base color
    views: wp.array[float]  # sum of w over all views: how many views that see a whole pixel


@wp.kernel
def profile_kernel(
    first: int,
    rows: wp.array[int],
    light: GatheredLight,
    normals: wp.array[wp.vec3],
    views: Observations,
    reflections: wp.array3d[wp.vec4],
    out_fit: ProfileFit,
):
    """Robust misfit of one candidate for one part of the views of one point; candidates of a point are neighbours."""
    item = first + wp.tid()
    candidate = item % reflections.shape[2]
    part = (item / reflections.shape[2]) % PARTS
    place = item / (reflections.shape[2] * PARTS)
    row = rows[place]
    n = normals[row]
    arriving = light.arriving[row] + light.bounce[row]
    spread = SPREAD_PART * brightness(light.unshadowed[row]) / 3.0
    base_color = wp.vec3()
    misfit = float(0.0)
    weight_sum = float(0.0)
    step = wp.where(part == 0, 1, 2)
    start = wp.where(part == 2, 1, 0)
    for turn in range(ROUNDS + 1):
        numerator = wp.vec3()
        denominator = wp.vec3()
        misfit = float(0.0)
        weight_sum = float(0.0)
        for view in range(start, views.colors.shape[0], step):
            sample = views.colors[view, row]
            weight = view_weight(sample, wp.dot(n, views.directions[view, row]))
            if weight > 0.0 and spread > 0.0:
                reflection = reflections[place, view, candidate]
                diffuse = arriving * (1.0 - reflection[3])
                target = wp.vec3(sample[0] - reflection[0], sample[1] - reflection[1], sample[2] - reflection[2])
                weight_sum += weight
                if turn > 0:
                    off = target - wp.cw_mul(base_color, diffuse)
                    excess = wp.dot(off, off) / (spread * spread)
                    misfit += weight * wp.log(1.0 + excess)
                    weight = weight / (1.0 + excess)
                numerator += wp.cw_mul(diffuse, target) * weight
                denominator += wp.cw_mul(diffuse, diffuse) * weight
        if turn < ROUNDS:
            for c in range(3):
                base_color[c] = float(0.0)
                if denominator[c] > 0.0:
                    base_color[c] = wp.clamp(numerator[c] / denominator[c], 0.0, 1.0)
    out_fit.misfit[part, row, candidate] = misfit
    if part == 0 and candidate == 0:
        out_fit.views[row] = weight_sum


launch_lobe_shares = launcher(lobe_shares_kernel, block_dim=128)
"""Write the open share of every view's lobe of a batch's points, ``(points, views)`` vec4.

Views that count for nothing are left as they are.
"""


launch_reflections = launcher(reflections_kernel, block_dim=128)
"""Write what every candidate reflects towards every view of some points, ``(points, views, candidates)`` vec4.

Views that count for nothing are left as they are.
"""


launch_profile = launcher(profile_kernel, block_dim=128)
"""Write the misfit of every candidate and part of the views of some points."""
