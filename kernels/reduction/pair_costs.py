"""What it costs in relit images to merge two clusters of Gaussians."""

import warp as wp

from beam_warp.kernels.common.launching import launcher

wp.set_module_options({"enable_backward": False})

MATERIALS = wp.constant(8)


@wp.struct
class Clusters:
    """Sums over the members of clusters, and their means in some frames."""

    weights: wp.array[float]  # visible pixels
    edges: wp.array[float]  # squared slope of images, times these
    forms: wp.array3d[float]  # (K, 8, 8), quadratic form of the materials, times these
    materials: wp.array3d[float]  # (F, K, 8)
    places: wp.array2d[wp.vec3]  # (F, K)


@wp.kernel
def pair_costs_kernel(
    first: int, pairs: wp.array[wp.vec2i], clusters: Clusters, pixel: float, spread: float, out_costs: wp.array[float]
):
    """Cost of each pair, added over frames; ``spread`` is the cost of a distance along the surface over one across."""
    i = first + wp.tid()
    one = pairs[i][0]
    two = pairs[i][1]
    heavy = clusters.weights[one]
    light = clusters.weights[two]
    total = heavy + light
    slope = (clusters.edges[one] + clusters.edges[two]) / (pixel * pixel)
    cost = float(0.0)
    for frame in range(clusters.materials.shape[0]):
        for row in range(MATERIALS):
            away = clusters.materials[frame, one, row] - clusters.materials[frame, two, row]
            inner = float(0.0)
            for column in range(MATERIALS):
                other = clusters.materials[frame, one, column] - clusters.materials[frame, two, column]
                inner += (clusters.forms[one, row, column] + clusters.forms[two, row, column]) * other
            cost += away * inner
        normal = wp.vec3()
        for axis in range(3):
            normal[axis] = clusters.materials[frame, one, 5 + axis] + clusters.materials[frame, two, 5 + axis]
        apart = clusters.places[frame, one] - clusters.places[frame, two]
        across = wp.dot(apart, wp.normalize(normal))
        along = wp.dot(apart, apart) - across * across
        cost += slope * (across * across + spread * along)
    out_costs[i] = cost * heavy * light / (total * total)


launch_pair_costs = launcher(pair_costs_kernel)
