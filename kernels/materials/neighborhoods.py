"""Surface around each Gaussian from its neighbours: their thinnest direction, the normal they agree on, its face."""

import warp as wp

from beam_warp.kernels.common.launching import launcher

wp.set_module_options({"enable_backward": False})


@wp.func
def covariance(orientation: wp.quat, scale: wp.vec3) -> wp.mat33:
    axes = wp.quat_to_matrix(wp.normalize(orientation)) * wp.diag(scale)
    return axes * wp.transpose(axes)


@wp.kernel
def thinnest_direction_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    orientations: wp.array[wp.quat],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    neighbors: wp.array2d[int],
    out_direction: wp.array[wp.vec3],
    out_planarity: wp.array[float],
):
    """Smallest principal axis of the neighbours' mixture, and 1 - lambda_0 / lambda_1.

    A mixture's covariance is the weighted mean of its members' covariances plus that of their centres. Weights are
    opacities times a Gaussian of half the distance to the farthest neighbour.
    """
    i = first + wp.tid()
    count = neighbors.shape[1]
    center = positions[i]
    reach = wp.max(wp.length(positions[neighbors[i, count - 1]] - center), 1.0e-12)
    total = float(1.0e-12)
    mean = wp.vec3()
    for k in range(count):
        offset = positions[neighbors[i, k]] - center
        distance = wp.length(offset) / reach
        weight = opacities[neighbors[i, k]] * wp.exp(-2.0 * distance * distance)
        total += weight
        mean += offset * weight
    mean /= total
    spread = wp.mat33()
    for k in range(count):
        j = neighbors[i, k]
        offset = positions[j] - center
        distance = wp.length(offset) / reach
        weight = opacities[j] * wp.exp(-2.0 * distance * distance) / total
        spread += (wp.outer(offset - mean, offset - mean) + covariance(orientations[j], scales[j])) * weight
    spread /= wp.max(wp.trace(spread), 1.0e-30)  # to order 1, where float32 iterations converge
    vectors, values = wp.eig3(spread)
    smallest = int(0)
    if values[1] < values[smallest]:
        smallest = 1
    if values[2] < values[smallest]:
        smallest = 2
    a = values[(smallest + 1) % 3]
    b = values[(smallest + 2) % 3]
    direction = wp.vec3(vectors[0, smallest], vectors[1, smallest], vectors[2, smallest])
    if not (wp.length(direction) > 0.5):
        direction = wp.vec3(0.0, 0.0, 1.0)  # coincident points without extent have no thinnest direction
    out_direction[i] = wp.normalize(direction)
    out_planarity[i] = wp.clamp(1.0 - values[smallest] / wp.max(wp.min(a, b), 1.0e-30), 0.0, 1.0)


@wp.kernel
def consult_neighbors_kernel(
    first: int,
    normals: wp.array[wp.vec3],
    certainty: wp.array[float],
    openness: wp.array[float],
    neighbors: wp.array2d[int],
    out_normals: wp.array[wp.vec3],
    out_agreement: wp.array[float],
):
    """Move each normal towards its neighbours' weighted mean as far as it is uncertain itself.

    Where rays do not tell the sides apart, the neighbours decide the sign. Agreement is the length of their mean.
    """
    i = first + wp.tid()
    total = float(1.0e-12)
    mean = wp.vec3()
    for k in range(1, neighbors.shape[1]):  # column 0 is the Gaussian itself
        j = neighbors[i, k]
        weight = certainty[j] * openness[j] + 1.0e-6
        total += weight
        mean += normals[j] * weight
    mean /= total
    length = wp.min(wp.length(mean), 1.0)
    direction = mean / wp.max(length, 1.0e-12)
    n = normals[i]
    if openness[i] < 0.25 and length > 0.5 and wp.dot(n, direction) < 0.0:
        n = -n
    share = (1.0 - wp.min(certainty[i] * (0.5 + openness[i]), 1.0)) * length
    mixed = n * (1.0 - share) + direction * share
    if wp.length(mixed) > 1.0e-6:
        n = wp.normalize(mixed)
    out_normals[i] = n
    out_agreement[i] = length


@wp.kernel
def mean_of_face_kernel(
    first: int,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    weights: wp.array[float],
    neighbors: wp.array2d[int],
    count: int,
    spread: float,
    out_normals: wp.array[wp.vec3],
):
    """Mean of the normals around a point, of those that differ from its own by little (Tomasi and Manduchi 1998).

    The first ``count`` neighbours have a part in it. Weights fall with distance, by half of the farthest one's, and
    with the difference of the normals, by ``spread`` [rad]: what lies beyond an edge does not count.
    """
    i = first + wp.tid()
    own = normals[i]
    reach = wp.max(wp.length(points[neighbors[i, count - 1]] - points[i]), 1.0e-12)
    total = wp.vec3()
    for k in range(count):
        j = neighbors[i, k]
        distance = wp.length(points[j] - points[i]) / reach
        difference = wp.length(normals[j] - own) / spread
        total += normals[j] * (weights[j] * wp.exp(-2.0 * distance * distance - 0.5 * difference * difference))
    if wp.length(total) > 1.0e-12:
        own = wp.normalize(total)
    out_normals[i] = own


@wp.struct
class FaceRule:
    """When a Gaussian takes the normal of a flat face beside it.

    Attributes:
        spread: Standard deviation of normals that belong to one face [rad].
        flat_spread: Standard deviation of normals within a flat face [rad].
        least_flat: Part of the neighbourhood that must differ by no more, for a face to be flat.
        around: Standard deviation of a neighbourhood [spacing].
        reach: Standard deviation of the distance to such a face [spacing].
        off_plane: Standard deviation of places about its plane [spacing].
        turn: Standard deviation of how much normals turn [rad].
    """

    spread: float
    flat_spread: float
    least_flat: float
    around: float
    reach: float
    off_plane: float
    turn: float


@wp.func
def bell(distance: float, deviation: float) -> float:
    part = distance / deviation
    return wp.exp(-0.5 * part * part)


@wp.func
def spacing_at(i: int, points: wp.array[wp.vec3], neighbors: wp.array2d[int]) -> float:
    """Distance to the eighth neighbour: a ring around a point."""
    last = wp.min(8, neighbors.shape[1] - 1)
    return wp.max(wp.length(points[neighbors[i, last]] - points[i]), 1.0e-12)


@wp.kernel
def judge_faces_kernel(
    first: int,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    weights: wp.array[float],
    neighbors: wp.array2d[int],
    rule: FaceRule,
    out_support: wp.array[float],
    out_flatness: wp.array[float],
):
    """Find which part of the surface around a point has its normal: about, and as exactly as a flat face has."""
    i = first + wp.tid()
    reach = rule.around * spacing_at(i, points, neighbors)
    total = float(1.0e-12)
    alike = float(0.0)
    flat = float(0.0)
    for k in range(neighbors.shape[1]):
        j = neighbors[i, k]
        weight = weights[j] * bell(wp.length(points[j] - points[i]), reach)
        difference = wp.length(normals[j] - normals[i])
        total += weight
        alike += weight * bell(difference, rule.spread)
        flat += weight * bell(difference, rule.flat_spread)
    out_support[i] = alike / total
    out_flatness[i] = flat / total


@wp.func
def speaks_for(offset: wp.vec3, own: wp.vec3, normal: wp.vec3, support: float, spacing: float, rule: FaceRule) -> float:
    """How likely a point belongs to the face of a neighbour: how much of the surface there has its normal, how near it
    is, how near the point is to its plane, and how little the normal would turn."""
    near = bell(wp.length(offset), rule.reach * spacing) * bell(wp.dot(offset, normal), rule.off_plane * spacing)
    return support * support * near * bell(wp.length(normal - own), rule.turn)


@wp.kernel
def take_faces_kernel(
    first: int,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    weights: wp.array[float],
    neighbors: wp.array2d[int],
    support: wp.array[float],
    flatness: wp.array[float],
    rule: FaceRule,
    out_normals: wp.array[wp.vec3],
):
    """Give a point the normal of the face in whose plane it lies, if that face is flat.

    Each neighbour stands for the face around it; the result is the mean of those that stand for the same face as the
    likeliest one.
    """
    i = first + wp.tid()
    spacing = spacing_at(i, points, neighbors)
    own = normals[i]
    best = int(i)
    most = float(0.0)
    for k in range(neighbors.shape[1]):
        j = neighbors[i, k]
        speaks = speaks_for(points[i] - points[j], own, normals[j], support[j], spacing, rule)
        if speaks > most:
            most = speaks
            best = j
    total = wp.vec3()
    for k in range(neighbors.shape[1]):
        j = neighbors[i, k]
        speaks = speaks_for(points[i] - points[j], own, normals[j], support[j], spacing, rule)
        total += normals[j] * (weights[j] * speaks * bell(wp.length(normals[j] - normals[best]), rule.spread))
    if flatness[best] > rule.least_flat and wp.length(total) > 1.0e-12:
        own = wp.normalize(total)
    out_normals[i] = own


launch_thinnest_direction = launcher(thinnest_direction_kernel)
"""Analyse every Gaussian's neighbourhood: in ``neighbors``, column 0 is the Gaussian itself."""


launch_consult_neighbors = launcher(consult_neighbors_kernel)
"""Do one pass of smoothing."""


launch_mean_of_face = launcher(mean_of_face_kernel)
"""Do one pass of smoothing that edges stop."""


launch_judge_faces = launcher(judge_faces_kernel)
"""Judge how flat the surface around every point is."""


launch_take_faces = launcher(take_faces_kernel)
"""Do one pass in which points take the normals of flat faces."""
