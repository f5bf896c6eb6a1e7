"""A hierarchy of four children a node in 48 bytes: its format and how a ray meets a node.

A node stores a corner and, for each axis, a power of two as step; its children's boxes are counted in steps from there,
in bytes, rounded outwards (Ylitie et al. 2017). Children lie next to each other, inner nodes from ``first_node`` and
leaves from ``first_leaf``, so that what remains to be visited below a node is one number, (first, mask), and the stack
holds one entry a level. A leaf is one Gaussian: boxes of several overlap too much to be worth testing together.
"""

import warp as wp

from beam_warp.kernels.common.constants import ALPHA_MAX, DIRECTION_FLOOR
from beam_warp.kernels.common.row_loads import load_row, load_words
from beam_warp.kernels.trace.gaussian import Gaussians, response
from beam_warp.kernels.trace.settings import TraceSettings

NODE_ROWS = wp.constant(3)
LEAF_ROWS = wp.constant(3)
LARGEST_DEPTH = 31
Stack = wp.types.vector(length=32, dtype=wp.int32)
"""One entry a level. A vector, because Warp's local arrays carry a header that every access would read."""

LARGEST_NODE_COUNT = 1 << 25
"""A stack's entry numbers a node beside an axis and a mask, six bits, in a signed word."""


@wp.struct
class WideTree:
    """Nodes and leaves of a hierarchy.

    A node is three rows of four words: corner x, y, z (float bits), and the exponents of the steps in three bytes with,
    in the fourth, from bit 24 three bits of the number of inner children, one of the axis along which they are in
    order, three of the number of children, and the axis' second bit; first node, first leaf, and lower x and y of the
    children; lower z and upper x, y, z. A leaf is three rows: centre and opacity; the six entries of the triangular
    whitening, row by row; the squared support radius and the Gaussian's number (int bits).
    """

    nodes: wp.array[wp.vec4i]
    leaves: wp.array[wp.vec4]


@wp.struct
class NodeHits:
    """Children of a node that a ray meets, as bits: inner ones from bit 0, and leaves from bit 0."""

    first_node: int
    first_leaf: int
    inner: int
    leaf: int
    axis: int  # along which the inner children are in ascending order, roughly


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(mask) - 1;
#else
    return __builtin_ctz((unsigned int)mask);
#endif
""")
def lowest_bit(mask: int) -> int:
    """Number of the lowest set bit; ``mask`` must not be 0."""
    ...


@wp.func
def first_bit(mask: int, backwards: bool) -> int:
    """Number of the lowest set bit of four, or of the highest."""
    bit = lowest_bit(mask)
    if backwards:
        bit = wp.where(mask >= 8, 3, wp.where(mask >= 4, 2, wp.where(mask >= 2, 1, 0)))
    return bit


@wp.func
def reciprocal(direction: wp.vec3) -> wp.vec3:
    """1 / direction, with zero components replaced: 0 * inf would be NaN and lose hits on box planes."""
    result = wp.vec3()
    for k in range(3):
        component = direction[k]
        if wp.abs(component) < DIRECTION_FLOOR:
            component = wp.where(component < 0.0, -DIRECTION_FLOOR, DIRECTION_FLOOR)
        result[k] = 1.0 / component
    return result


@wp.func_native("""
    // Near and far planes are chosen once by the direction's signs, then four boxes side by side.
    int near_x = inverse[0] < 0.0f ? row_2[1] : row_1[2], far_x = inverse[0] < 0.0f ? row_1[2] : row_2[1];
    int near_y = inverse[1] < 0.0f ? row_2[2] : row_1[3], far_y = inverse[1] < 0.0f ? row_1[3] : row_2[2];
    int near_z = inverse[2] < 0.0f ? row_2[3] : row_2[0], far_z = inverse[2] < 0.0f ? row_2[0] : row_2[3];
    union Word { int bits; float value; } x, y, z, sx, sy, sz;
    x.bits = row_0[0]; y.bits = row_0[1]; z.bits = row_0[2];
    sx.bits = (row_0[3] & 255) << 23; sy.bits = ((row_0[3] >> 8) & 255) << 23; sz.bits = ((row_0[3] >> 16) & 255) << 23;
    float corner_x = (x.value - origin[0]) * inverse[0], step_x = sx.value * inverse[0];
    float corner_y = (y.value - origin[1]) * inverse[1], step_y = sy.value * inverse[1];
    float corner_z = (z.value - origin[2]) * inverse[2], step_z = sz.value * inverse[2];
    int mask = 0;
#if defined(__CUDA_ARCH__)
    #pragma unroll
    for (int k = 0; k < 4; ++k) {
        float t_near = fmaxf(
            fmaxf(((near_x >> (8 * k)) & 255) * step_x + corner_x, ((near_y >> (8 * k)) & 255) * step_y + corner_y),
            fmaxf(((near_z >> (8 * k)) & 255) * step_z + corner_z, t_min));
        float t_far = fminf(
            fminf(((far_x >> (8 * k)) & 255) * step_x + corner_x, ((far_y >> (8 * k)) & 255) * step_y + corner_y),
            ((far_z >> (8 * k)) & 255) * step_z + corner_z);
        mask |= (t_near <= fminf(t_far * 1.000002f, t_max) ? 1 : 0) << k;
    }
#else
    typedef unsigned char bytes __attribute__((vector_size(4)));
    typedef float floats __attribute__((vector_size(16)));
    typedef int ints __attribute__((vector_size(16)));
    #define BYTES(word) __builtin_convertvector(__builtin_bit_cast(bytes, word), floats)
    floats zero = {0.0f, 0.0f, 0.0f, 0.0f};
    floats t_near = __builtin_elementwise_max(
        __builtin_elementwise_max(BYTES(near_x) * step_x + corner_x, BYTES(near_y) * step_y + corner_y),
        __builtin_elementwise_max(BYTES(near_z) * step_z + corner_z, zero + t_min));
    floats t_far = __builtin_elementwise_min(
        __builtin_elementwise_min(BYTES(far_x) * step_x + corner_x, BYTES(far_y) * step_y + corner_y),
        BYTES(far_z) * step_z + corner_z);
    #undef BYTES
    ints met = t_near <= __builtin_elementwise_min(t_far * 1.000002f, zero + t_max);
    mask = (met[0] & 1) | (met[1] & 2) | (met[2] & 4) | (met[3] & 8);
#endif
    return mask;
""")
def boxes_met(
    row_0: wp.vec4i, row_1: wp.vec4i, row_2: wp.vec4i, origin: wp.vec3, inverse: wp.vec3, t_min: float, t_max: float
) -> int:
    """Mask of the child boxes that the ray meets between ``t_min`` and ``t_max``.

    The far end of each slab is widened by 16 ulp, more than its rounding errors, those of fast-math division included:
    no box is missed (Ize 2013). The code is native: on the CPU it works on vectors of four, which Warp's own code does
    not become.
    """
    ...


@wp.func
def meet_node(tree: WideTree, node: int, origin: wp.vec3, inverse: wp.vec3, t_min: float, t_max: float) -> NodeHits:
    row = node * NODE_ROWS
    row_0 = load_words(tree.nodes, row)
    row_1 = load_words(tree.nodes, row + 1)
    row_2 = load_words(tree.nodes, row + 2)
    inner = (row_0[3] >> 24) & 7
    count = (row_0[3] >> 28) & 7
    mask = boxes_met(row_0, row_1, row_2, origin, inverse, t_min, t_max) & ((1 << count) - 1)
    hits = NodeHits()
    hits.first_node = row_1[0]
    hits.first_leaf = row_1[1]
    hits.inner = mask & ((1 << inner) - 1)
    hits.leaf = mask >> inner
    hits.axis = ((row_0[3] >> 27) & 1) | ((row_0[3] >> 30) & 2)
    return hits


@wp.struct
class Leaf:
    """A leaf's Gaussian."""

    center: wp.vec3
    opacity: float
    whitening_x: wp.vec3  # rows of the triangular whitening: from the first, the second and the third column on
    whitening_y: wp.vec2
    whitening_z: float
    radius_squared: float
    index: int


@wp.func
def load_leaf(tree: WideTree, leaf: int) -> Leaf:
    row_0 = load_row(tree.leaves, leaf * LEAF_ROWS)
    row_1 = load_row(tree.leaves, leaf * LEAF_ROWS + 1)
    row_2 = load_row(tree.leaves, leaf * LEAF_ROWS + 2)
    result = Leaf()
    result.center = wp.vec3(row_0[0], row_0[1], row_0[2])
    result.opacity = row_0[3]
    result.whitening_x = wp.vec3(row_1[0], row_1[1], row_1[2])
    result.whitening_y = wp.vec2(row_1[3], row_2[0])
    result.whitening_z = row_2[1]
    result.radius_squared = row_2[2]
    result.index = wp.cast(row_2[3], int)
    return result


@wp.func
def whiten(leaf: Leaf, v: wp.vec3) -> wp.vec3:
    return wp.vec3(
        leaf.whitening_x[0] * v[0] + leaf.whitening_x[1] * v[1] + leaf.whitening_x[2] * v[2],
        leaf.whitening_y[0] * v[1] + leaf.whitening_y[1] * v[2],
        leaf.whitening_z * v[2],
    )


@wp.struct
class CanonicalRay:
    """A ray in the space where a leaf's Gaussian is the unit sphere, by way of its point closest to the centre."""

    dd: float  # squared length of the whitened direction
    cc: float  # dd times the squared distance to the centre
    t_dd: float  # dd times t of the largest response


@wp.func
def canonical_ray(leaf: Leaf, origin: wp.vec3, direction: wp.vec3) -> CanonicalRay:
    """Arithmetic of `ray_peak`, without its divisions."""
    p = origin - leaf.center
    t_closest = -wp.dot(p, direction)
    q = whiten(leaf, p + direction * t_closest)
    d = whiten(leaf, direction)
    c = wp.cross(q, d)
    ray = CanonicalRay()
    ray.dd = wp.dot(d, d)
    ray.cc = wp.dot(c, c)
    ray.t_dd = t_closest * ray.dd - wp.dot(q, d)
    return ray


@wp.struct
class LeafAlpha:
    """How strongly a leaf's Gaussian acts on a ray, by the default rules."""

    alpha: float  # 0 where it does not count
    index: int


@wp.func
def meet_leaf_by_default(tree: WideTree, leaf: int, origin: wp.vec3, direction: wp.vec3, t_max: float) -> LeafAlpha:
    """Peak in front, no culling, degree 2: what almost every ray asks for, a tenth faster than `meet_leaf`."""
    gaussian = load_leaf(tree, leaf)
    ray = canonical_ray(gaussian, origin, direction)
    result = LeafAlpha()
    if ray.cc < gaussian.radius_squared * ray.dd and ray.t_dd > 0.0 and ray.t_dd < t_max * ray.dd:
        result.alpha = wp.min(ALPHA_MAX, gaussian.opacity * wp.exp(-0.5 * ray.cc / ray.dd))
        result.index = gaussian.index
    return result


@wp.struct
class LeafPeak:
    """Where and how strongly a leaf's Gaussian acts on a ray."""

    alpha: float  # 0 where it does not count
    t: float
    index: int


@wp.func
def meet_leaf(
    tree: WideTree,
    gaussians: Gaussians,
    settings: TraceSettings,
    leaf: int,
    origin: wp.vec3,
    direction: wp.vec3,
    t_max: float,
) -> LeafPeak:
    """The same as `ray_peak` and `counts`, from the leaf's own rows."""
    gaussian = load_leaf(tree, leaf)
    ray = canonical_ray(gaussian, origin, direction)
    peak = LeafPeak()
    if ray.cc < gaussian.radius_squared * ray.dd:
        distance_squared = ray.cc / ray.dd
        peak.t = ray.t_dd / ray.dd
        peak.index = gaussian.index
        start = peak.t
        if settings.entry_in_front == 1:
            start -= wp.sqrt((gaussian.radius_squared - distance_squared) / ray.dd)
        met = start > 0.0 and peak.t < t_max
        if met and settings.cull == 1:
            met = wp.dot(gaussians.normals[peak.index], direction) <= 0.0
        if met:
            peak.alpha = wp.min(ALPHA_MAX, gaussian.opacity * response(gaussians.degree, distance_squared))
    return peak
