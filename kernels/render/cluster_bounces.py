"""Light from surface to surface, between clusters of Gaussians: a radiosity whose amount ambient occlusion knows.

A Gaussian of ambient occlusion V sees surfaces with 1 - V of its cosine-weighted hemisphere. What these send is the
mean over the clusters that face it, weighted by their form factors as if nothing were between:

    E = (1 - V) sum_j F_ij B_j / sum_j F_ij,   F_ij = A_j max(0, n_i.d) max(0, -n_j.d) / (r^2 + A_j / pi),

with B_j the radiosity of cluster j and d the unit way to it, r long. As a ratio it needs no visibility to be of the
right size, and overlapping Gaussians count once. Facing clusters behind others count as well.

Source: disc to point form factor as in Bunnell 2005; the ratio is ours.
"""

import warp as wp

from beam_warp.kernels.common.constants import PI
from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.light.brdf import specular_albedo
from beam_warp.kernels.render.gaussian_light import (
    ARRIVING,
    NORMAL,
    OCCLUSION,
    OPENNESS,
    POINT_CHUNK,
    ROUGHNESS,
    row_vector,
)

wp.set_module_options({"enable_backward": False})


MEAN_COSINE = wp.constant(0.6666667)
"""Mean cosine of cosine-weighted directions: the specular lobe's albedo there stands for that of diffuse light."""


@wp.struct
class Clusters:
    """Runs of Gaussians that are near to each other."""

    order: wp.array[int]  # Gaussians, cluster by cluster
    positions: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]  # unit, or 0 where they cancel
    areas: wp.array[float]  # [m^2], up to a factor that all share
    occlusion: wp.array[float]  # 1 - ambient occlusion, mean
    reflectance: wp.array[wp.vec3]  # mean
    sent: wp.array[wp.vec3]  # radiosity by what arrives from lights [W/m^2]


@wp.func
def specular_share(values: wp.array2d[float], i: int, albedo_table: wp.array2d[wp.vec2]) -> float:
    return specular_albedo(albedo_table, MEAN_COSINE, values[i, ROUGHNESS])


@wp.kernel
def sum_clusters_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    values: wp.array2d[float],
    lit: wp.array[wp.vec3],
    albedo_table: wp.array2d[wp.vec2],
    out_clusters: Clusters,
):
    """Means over a cluster, weighted by area times opacity, in the order of its Gaussians."""
    c = first + wp.tid()
    count = out_clusters.order.shape[0]
    clusters = out_clusters.areas.shape[0]
    begin = int(wp.int64(c) * wp.int64(count) / wp.int64(clusters))
    end = int(wp.int64(c + 1) * wp.int64(count) / wp.int64(clusters))
    area = float(0.0)
    position = wp.vec3()
    normal = wp.vec3()
    occlusion = float(0.0)
    reflectance = wp.vec3()
    sent = wp.vec3()
    for k in range(begin, end):
        i = out_clusters.order[k]
        s = scales[i]
        least = wp.min(s[0], wp.min(s[1], s[2]))
        # of the two larger scales; the product of all over the least one, unless that is 0
        face = wp.max(s[0] * s[1], wp.max(s[1] * s[2], s[0] * s[2]))
        weight = 2.0 * PI * opacities[i] * wp.max(face, least * least) + 1.0e-20
        specular = specular_share(values, i, albedo_table)
        reflects = row_vector(values, i, 0) * (1.0 - specular) + wp.vec3(specular)
        area += weight
        position += weight * positions[i]
        normal += weight * row_vector(values, i, NORMAL)
        occlusion += weight * (1.0 - values[i, OCCLUSION])
        reflectance += weight * reflects
        sent += weight * wp.cw_mul(reflects, lit[i])
    out_clusters.areas[c] = area
    out_clusters.positions[c] = position / area
    out_clusters.normals[c] = wp.normalize(normal)
    out_clusters.occlusion[c] = wp.clamp(occlusion / area, 0.0, 1.0)
    out_clusters.reflectance[c] = reflectance / area
    out_clusters.sent[c] = sent / area


@wp.func
def facing_radiosity(clusters: Clusters, radiosity: wp.array[wp.vec3], point: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Mean radiosity of what faces a point, by form factors; 0 if nothing does."""
    total = wp.vec3()
    weight = float(0.0)
    for j in range(clusters.areas.shape[0]):
        away = clusters.positions[j] - point
        here = wp.dot(away, normal)
        there = -wp.dot(away, clusters.normals[j])
        if here > 0.0 and there > 0.0:
            area = clusters.areas[j]
            squared = wp.dot(away, away)
            factor = area * here * there / (squared * (squared + area / PI) + 1.0e-20)
            total += factor * radiosity[j]
            weight += factor
    mean = wp.vec3()
    if weight > 0.0:
        mean = total / weight
    return mean


@wp.kernel
def bounce_clusters_kernel(
    first: int, clusters: Clusters, radiosity: wp.array[wp.vec3], out_radiosity: wp.array[wp.vec3]
):
    """One bounce: what clusters send by lights and by what the others sent."""
    c = first + wp.tid()
    arriving = facing_radiosity(clusters, radiosity, clusters.positions[c], clusters.normals[c]) * clusters.occlusion[c]
    out_radiosity[c] = clusters.sent[c] + wp.cw_mul(clusters.reflectance[c], arriving)


@wp.kernel
def gather_bounces_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    arriving: wp.array[wp.vec4],
    clusters: Clusters,
    radiosity: wp.array[wp.vec3],
    out_values: wp.array2d[float],
):
    """Write what arrives at each Gaussian from the environment and from surfaces, and the former's openness."""
    i = first + wp.tid()
    straight = arriving[i]
    total = wp.vec3(straight[0], straight[1], straight[2])
    occlusion = 1.0 - out_values[i, OCCLUSION]
    if occlusion > 0.0 and radiosity.shape[0] > 0:
        total += facing_radiosity(clusters, radiosity, positions[i], row_vector(out_values, i, NORMAL)) * occlusion
    for c in range(3):
        out_values[i, ARRIVING + c] = total[c]
    out_values[i, OPENNESS] = straight[3]


def launch_sum_clusters(gaussians, lit, albedo_table, out_clusters, device):
    """Sum what clusters are made of."""
    launch(
        sum_clusters_kernel,
        len(out_clusters.areas),
        inputs=[gaussians.positions, gaussians.scales, gaussians.opacities, gaussians.values, lit, albedo_table],
        outputs=[out_clusters],
        device=device,
        block_dim=32,
        min_chunk=16,
    )


launch_bounce_clusters = launcher(bounce_clusters_kernel, block_dim=32, min_chunk=16)
"""Let light bounce once between clusters."""


launch_gather_bounces = launcher(gather_bounces_kernel, block_dim=128, min_chunk=POINT_CHUNK)
"""Write what arrives at Gaussians; without clusters' radiosity (an empty array) from the environment alone."""
