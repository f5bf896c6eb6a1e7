"""What rays meet: Gaussians, with or without triangles among them.

Kernels take occluders as ``Any`` and are compiled for each structure (`beam_warp.kernels.common.launching`), so that
Gaussians alone do not pay for the registers of a triangle query.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.mesh.occluder import MeshOccluder, NoMesh, mesh_blocks, nearest_on_mesh
from beam_warp.kernels.trace.gaussian import Gaussians
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.surface_layer import height_and_thickness
from beam_warp.kernels.trace.wide_traversal import tree_layer, tree_sampled_hit, tree_transmittance
from beam_warp.kernels.trace.wide_tree import WideTree


@wp.struct
class GaussianOccluders:
    """Gaussians and the hierarchy over them."""

    tree: WideTree
    mesh: NoMesh
    gaussians: Gaussians
    origin: wp.vec3  # world position that everything here is relative to


@wp.struct
class GaussianAndMeshOccluders:
    """Gaussians with triangles among them; each has a hierarchy of its own."""

    tree: WideTree
    mesh: MeshOccluder
    gaussians: Gaussians
    origin: wp.vec3


@wp.func
def transmittance(
    occluders: Any, settings: TraceSettings, origin: wp.vec3, direction: wp.vec3, t_max: float, stream: wp.uint32
) -> float:
    """V = product of (1 - alpha) over what the ray meets, in any order, or one Bernoulli sample of it.

    Args:
        occluders: Any of the structures above.
        settings: What counts as a hit, and when to stop.
        origin: Relative to ``occluders.origin`` [m]: subtract that first and offset then, or the offset is
            rounded away far from the world's origin.
        direction: Unit vector.
        t_max: Reach [m].
        stream: Random stream of the ray; Bernoulli acceptance draws from (stream, Gaussian), so that the result does
            not depend on traversal order.
    """
    v = float(0.0)
    if not mesh_blocks(occluders.mesh, origin, direction, t_max):
        v = tree_transmittance(occluders.tree, occluders.gaussians, settings, origin, direction, t_max, stream)
    return v


@wp.func
def sampled_hit(
    occluders: Any, settings: TraceSettings, origin: wp.vec3, direction: wp.vec3, t_max: float, stream: wp.uint32
) -> int:
    """Index of a Gaussian drawn with probability alpha times the transmittance before it, or -1 for none.

    Each Gaussian stops the ray with probability alpha, independently; the nearest that does wins. One unsorted
    traversal with a shrinking ``t_max`` is enough (Sun et al. 2025). Triangles block: what lies behind one is not
    hit, and the triangle itself counts as -1. Arguments as `transmittance`.
    """
    reach = nearest_on_mesh(occluders.mesh, origin, direction, t_max).t
    return tree_sampled_hit(occluders.tree, occluders.gaussians, settings, origin, direction, reach, stream)


@wp.func
def surface_layer(occluders: Any, point: wp.vec3, normal: wp.vec3) -> wp.vec2:
    """(height, thickness) [m] along ``normal`` of the layer of Gaussians around a point, relative as above."""
    return height_and_thickness(tree_layer(occluders.tree, occluders.gaussians, point, normal))


OCCLUDER_TYPES = (GaussianOccluders, GaussianAndMeshOccluders)
"""Structures without and with triangles."""
