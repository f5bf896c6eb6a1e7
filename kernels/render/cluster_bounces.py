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
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.light.brdf import specular_albedo
from beam_warp.kernels.raster.splat_rows import quick_divide
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


INVERSE_PI = wp.constant(1.0 / PI)

MEAN_COSINE = wp.constant(0.6666667)
"""Mean cosine of cosine-weighted directions: the specular lobe's albedo there stands for that of diffuse light."""


PARTS = wp.constant(32)
"""Parts that the work for a cluster is done in, side by side: there are far fewer clusters than a GPU has threads."""


@wp.struct
class Clusters:
    """Runs of Gaussians that are near to each other."""

    order: wp.array[int]  # Gaussians, cluster by cluster
    places: wp.array[wp.vec4]  # position, and area [m^2] up to a factor that all share
    sides: wp.array[wp.vec4]  # unit normal, or 0 where they cancel; mean of 1 - ambient occlusion
    reflectance: wp.array[wp.vec3]  # mean
    sent: wp.array[wp.vec4]  # radiosity by what arrives from lights [W/m^2]; 0


@wp.struct
class ClusterSums:
    """Sums over parts of clusters, weighted by area times opacity."""

    places: wp.array[wp.vec4]  # position; the weights
    sides: wp.array[wp.vec4]  # normal; 1 - ambient occlusion
    reflectance: wp.array[wp.vec3]
    sent: wp.array[wp.vec3]
    facing: wp.array[wp.vec4]  # radiosity of what faces a cluster, by form factors; their sum


@wp.func
def specular_share(values: wp.array2d[float], i: int, albedo_table: wp.array2d[wp.vec2]) -> float:
    return specular_albedo(albedo_table, MEAN_COSINE, values[i, ROUGHNESS])


@wp.func
def with_fourth(v: wp.vec3, fourth: float) -> wp.vec4:
    return wp.vec4(v[0], v[1], v[2], fourth)


@wp.func
def first_three(v: wp.vec4) -> wp.vec3:
    return wp.vec3(v[0], v[1], v[2])


@wp.kernel
def sum_parts_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    values: wp.array2d[float],
    lit: wp.array[wp.vec3],
    albedo_table: wp.array2d[wp.vec2],
    order: wp.array[int],
    out_sums: ClusterSums,
):
    """Sums over a part of a cluster, in the order of its Gaussians."""
    part = first + wp.tid()
    count = wp.int64(order.shape[0])
    parts = wp.int64(out_sums.places.shape[0])
    place = wp.vec4()
    side = wp.vec4()
    reflectance = wp.vec3()
    sent = wp.vec3()
    for k in range(int(wp.int64(part) * count / parts), int(wp.int64(part + 1) * count / parts)):
        i = order[k]
        s = scales[i]
        least = wp.min(s[0], wp.min(s[1], s[2]))
        # of the two larger scales; the product of all over the least one, unless that is 0
        face = wp.max(s[0] * s[1], wp.max(s[1] * s[2], s[0] * s[2]))
        weight = 2.0 * PI * opacities[i] * wp.max(face, least * least) + 1.0e-20
        specular = specular_share(values, i, albedo_table)
        reflects = row_vector(values, i, 0) * (1.0 - specular) + wp.vec3(specular)
        place += weight * with_fourth(positions[i], 1.0)
        side += weight * with_fourth(row_vector(values, i, NORMAL), 1.0 - values[i, OCCLUSION])
        reflectance += weight * reflects
        sent += weight * wp.cw_mul(reflects, lit[i])
    out_sums.places[part] = place
    out_sums.sides[part] = side
    out_sums.reflectance[part] = reflectance
    out_sums.sent[part] = sent


@wp.kernel
def sum_clusters_kernel(first: int, sums: ClusterSums, out_clusters: Clusters):
    """Means over a cluster, of its parts in order."""
    c = first + wp.tid()
    place = wp.vec4()
    side = wp.vec4()
    reflectance = wp.vec3()
    sent = wp.vec3()
    for part in range(c * PARTS, (c + 1) * PARTS):
        place += sums.places[part]
        side += sums.sides[part]
        reflectance += sums.reflectance[part]
        sent += sums.sent[part]
    area = place[3]
    out_clusters.places[c] = with_fourth(first_three(place) / area, area)
    occlusion = wp.clamp(side[3] / area, 0.0, 1.0)
    out_clusters.sides[c] = with_fourth(wp.normalize(first_three(side)), occlusion)
    out_clusters.reflectance[c] = reflectance / area
    out_clusters.sent[c] = with_fourth(sent / area, 0.0)


@wp.func
def facing_radiosity(
    clusters: Clusters, radiosity: wp.array[wp.vec4], point: wp.vec3, normal: wp.vec3, begin: int, end: int
) -> wp.vec4:
    """Radiosity of what faces a point among some clusters, summed by form factors, and their sum."""
    total = wp.vec4()
    for j in range(begin, end):
        place = load_row(clusters.places, j)
        away = first_three(place) - point
        here = wp.dot(away, normal)
        if here > 0.0:  # what most clusters fail is asked before more of them is loaded
            there = -wp.dot(away, first_three(load_row(clusters.sides, j)))
            if there > 0.0:
                squared = wp.dot(away, away)
                area = place[3] * here * there
                factor = quick_divide(area, squared * (squared + place[3] * INVERSE_PI) + 1.0e-20)
                total += factor * with_fourth(first_three(load_row(radiosity, j)), 1.0)
    return total


@wp.func
def mean_radiosity(total: wp.vec4) -> wp.vec3:
    """The mean by form factors; 0 if nothing faces."""
    mean = wp.vec3()
    if total[3] > 0.0:
        mean = first_three(total) / total[3]
    return mean


@wp.kernel
def face_parts_kernel(first: int, clusters: Clusters, radiosity: wp.array[wp.vec4], out_facing: wp.array[wp.vec4]):
    """What faces a cluster among a part of all others."""
    item = first + wp.tid()
    c = item / PARTS
    part = item % PARTS
    count = clusters.places.shape[0]
    point = first_three(load_row(clusters.places, c))
    normal = first_three(load_row(clusters.sides, c))
    begin = part * count / PARTS
    out_facing[item] = facing_radiosity(clusters, radiosity, point, normal, begin, (part + 1) * count / PARTS)


@wp.kernel
def bounce_clusters_kernel(first: int, clusters: Clusters, facing: wp.array[wp.vec4], out_radiosity: wp.array[wp.vec4]):
    """One bounce: what clusters send by lights and by what the others sent."""
    c = first + wp.tid()
    total = wp.vec4()
    for part in range(c * PARTS, (c + 1) * PARTS):
        total += facing[part]
    arriving = mean_radiosity(total) * clusters.sides[c][3]
    out_radiosity[c] = clusters.sent[c] + with_fourth(wp.cw_mul(clusters.reflectance[c], arriving), 0.0)


@wp.kernel
def gather_bounces_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    arriving: wp.array[wp.vec4],
    clusters: Clusters,
    radiosity: wp.array[wp.vec4],
    out_values: wp.array2d[float],
):
    """Write what arrives at each Gaussian from the environment and from surfaces, and the former's openness.

    In the clusters' order: neighbours are faced by the same clusters.
    """
    i = clusters.order[first + wp.tid()]
    straight = arriving[i]
    total = wp.vec3(straight[0], straight[1], straight[2])
    occlusion = 1.0 - out_values[i, OCCLUSION]
    if occlusion > 0.0 and radiosity.shape[0] > 0:
        normal = row_vector(out_values, i, NORMAL)
        facing = facing_radiosity(clusters, radiosity, positions[i], normal, 0, radiosity.shape[0])
        total += mean_radiosity(facing) * occlusion
    for c in range(3):
        out_values[i, ARRIVING + c] = total[c]
    out_values[i, OPENNESS] = straight[3]


def launch_sum_clusters(gaussians, lit, albedo_table, sums, out_clusters, device):
    """Sum what clusters are made of."""
    arrays = [gaussians.positions, gaussians.scales, gaussians.opacities, gaussians.values, lit, albedo_table]
    inputs = [*arrays, out_clusters.order]
    launch(sum_parts_kernel, len(sums.places), inputs=inputs, outputs=[sums], device=device, block_dim=64)
    count = len(out_clusters.places)
    launch(sum_clusters_kernel, count, inputs=[sums], outputs=[out_clusters], device=device, block_dim=32)


def launch_bounce_clusters(clusters, radiosity, sums, out_radiosity, device):
    """Let light bounce once between clusters."""
    inputs = [clusters, radiosity]
    launch(face_parts_kernel, len(sums.facing), inputs=inputs, outputs=[sums.facing], device=device, block_dim=64)
    inputs = [clusters, sums.facing]
    count = len(out_radiosity)
    launch(bounce_clusters_kernel, count, inputs=inputs, outputs=[out_radiosity], device=device, block_dim=32)


launch_gather_bounces = launcher(gather_bounces_kernel, block_dim=128, min_chunk=POINT_CHUNK)
"""Write what arrives at Gaussians; without clusters' radiosity (an empty array) from the environment alone."""
