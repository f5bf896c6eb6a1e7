"""How much work rays are: nodes visited, Gaussians tested, hits that count."""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch
from beam_warp.kernels.trace.gaussian import Gaussians, ray_peak
from beam_warp.kernels.trace.settings import TraceSettings, counts
from beam_warp.kernels.trace.warp_tree import WarpTree, box_test_direction
from beam_warp.kernels.trace.wide_tree import Stack, WideTree, lowest_bit, meet_leaf, meet_node, reciprocal

wp.set_module_options({"enable_backward": False})


@wp.func
def traversal_counts(
    tree: WideTree, gaussians: Gaussians, settings: TraceSettings, origin: wp.vec3, direction: wp.vec3, t_max: float
) -> wp.vec3i:
    """(nodes, tested, hits) of the traversal of `wide_tree_transmittance`, stop included."""
    inverse = reciprocal(direction)
    stack = Stack()
    depth = int(0)
    first_node = int(0)
    inner = int(1)
    v = float(1.0)
    nodes = int(0)
    tested = int(0)
    hits = int(0)
    while inner != 0:
        node = first_node + lowest_bit(inner)
        inner = inner & (inner - 1)
        if inner != 0:
            stack[depth] = (first_node << 4) | inner
            depth += 1
        met = meet_node(tree, node, origin, inverse, 0.0, t_max)
        nodes += 1
        first_node = met.first_node
        inner = met.inner
        leaf = met.leaf
        while leaf != 0:
            peak = meet_leaf(tree, gaussians, settings, met.first_leaf + lowest_bit(leaf), origin, direction, t_max)
            leaf = leaf & (leaf - 1)
            tested += 1
            if peak.alpha > 0.0:
                hits += 1
                v *= 1.0 - peak.alpha
                if v < settings.stop:
                    leaf = 0
                    inner = 0
                    depth = 0
        if inner == 0 and depth > 0:
            depth -= 1
            first_node = stack[depth] >> 4
            inner = stack[depth] & 15
    return wp.vec3i(nodes, tested, hits)


@wp.func
def traversal_counts(  # noqa: F811
    tree: WarpTree, gaussians: Gaussians, settings: TraceSettings, origin: wp.vec3, direction: wp.vec3, t_max: float
) -> wp.vec3i:
    """The same; ``wp.Bvh`` does not tell its nodes, which count as 0."""
    v = float(1.0)
    tested = int(0)
    hits = int(0)
    query = wp.bvh_query_ray(tree.bvh, origin, box_test_direction(direction))
    index = int(0)
    while wp.bvh_query_next(query, index, t_max):
        peak = ray_peak(gaussians, index, origin, direction)
        tested += 1
        if counts(gaussians, settings, index, peak, direction, t_max):
            hits += 1
            v *= 1.0 - peak.alpha
            if v < settings.stop:
                break
    return wp.vec3i(0, tested, hits)


@wp.kernel
def count_traversal_kernel(
    first: int,
    occluders: Any,
    settings: TraceSettings,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    reaches: wp.array[float],
    out_counts: wp.array[wp.vec3i],
):
    i = first + wp.tid()
    t_max = reaches[wp.min(i, reaches.shape[0] - 1)]
    out_counts[i] = traversal_counts(
        occluders.tree, occluders.gaussians, settings, origins[i] - occluders.origin, directions[i], t_max
    )


def launch_count_traversal(occluders, settings, origins, directions, reaches, out_counts, device):
    """Count the work of each ray."""
    launch(
        count_traversal_kernel,
        len(origins),
        inputs=[occluders, settings, origins, directions, reaches],
        outputs=[out_counts],
        device=device,
        block_dim=64,
    )
