"""Visibility of given rays, the fast way: the lanes of a warp work through a pool of rays in one loop.

A warp is done when its slowest lane is, and rays differ: on the benchmark's torus one in ten meets 85 nodes and 89
Gaussians, the others a dozen nodes and few Gaussians. So a lane that has finished its ray takes the next one of its
warp's pool at once, in the same loop as the traversal of the others (Aila and Laine 2009). Measured on an H200, rays in
millions a second: one ray a lane 730, a fixed share of 8 for each lane 920, a pool of 8 a lane 1,110.
"""

from typing import Any

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.common.sampling import hash_combine, unit_float
from beam_warp.kernels.mesh.occluder import MeshOccluder, mesh_blocks
from beam_warp.kernels.trace.occluders import transmittance
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.wide_tree import Stack, WideTree, lowest_bit, meet_leaf_by_default, meet_node, reciprocal

# Fast math: divisions and the exponential of a hit within 2 ulp; 9 % more rays a second on an H200. The stability suite
# holds with it on both devices.
wp.set_module_options({"enable_backward": False, "fast_math": True})

RAYS_A_LANE = 8
"""Rays in a pool for each lane. Measured on an H200 among 4, 8, 16, 32 and 64 (1,018, 1,113, 1,075, 905, 726 Mray/s);
large pools leave the last warps alone on the device."""

REGISTERS = 80
"""Registers a thread; the compiler would take 96. A fifth more warps at once, 3 to 5 % more rays a second (H200)."""

THREADS_TO_FILL = 1 << 17
"""Fewer threads than this do not fill a large GPU; small batches get fewer rays a lane."""


@wp.struct
class Rays:
    """A batch of rays.

    ``reaches`` holds one number, or one for each ray; below 0 the ray is blocked already. Bernoulli acceptance draws
    from (the ray's stream, Gaussian): ``streams`` where it is given, so that the order of rays does not matter, else
    from ``stream`` and the ray's number.
    """

    origins: wp.array[wp.vec3]
    directions: wp.array[wp.vec3]
    reaches: wp.array[float]
    base: wp.vec3  # subtracted from the origins
    stream: wp.uint32
    streams: wp.array[wp.uint32]  # one for each ray, or none


@wp.func
def stream_of_ray(rays: Rays, ray: int) -> wp.uint32:
    stream = hash_combine(rays.stream, wp.uint32(ray))
    if rays.streams.shape[0] > 0:
        stream = rays.streams[ray]
    return stream


@wp.kernel
def block_rays_kernel(first: int, mesh: MeshOccluder, rays: Rays, out_reaches: wp.array[float]):
    """Reach of each ray, -1 if a triangle lies before it."""
    i = first + wp.tid()
    t_max = rays.reaches[wp.min(i, rays.reaches.shape[0] - 1)]
    if t_max >= 0.0 and mesh_blocks(mesh, rays.origins[i] - rays.base, rays.directions[i], t_max):
        t_max = -1.0
    out_reaches[i] = t_max


@wp.kernel
def trace_rays_kernel(first: int, occluders: Any, settings: TraceSettings, rays: Rays, out_visibility: wp.array[float]):
    """One ray a thread, through any occluders: the readable form."""
    i = first + wp.tid()
    t_max = rays.reaches[wp.min(i, rays.reaches.shape[0] - 1)]
    v = float(0.0)
    if t_max >= 0.0:
        v = transmittance(
            occluders, settings, rays.origins[i] - rays.base, rays.directions[i], t_max, stream_of_ray(rays, i)
        )
    out_visibility[i] = v


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ int taken[32];
    const int warp = threadIdx.x >> 5;
    if (start) {
        if ((threadIdx.x & 31) == 0)
            taken[warp] = 0;
        __syncwarp();
        return 0;
    }
    return atomicAdd(&taken[warp], 1);
#else
    return own;
#endif
""")
def take_ray(start: int, own: int) -> int:
    """Number of the next ray of the warp's pool; with ``start`` 1, begin a pool. On the CPU a thread has its own.

    Who takes which ray depends on the order of lanes; a ray's result depends on the ray alone.
    """
    ...


@wp.kernel(cuda_max_registers=REGISTERS)
def trace_rays_wide_kernel(
    first: int,
    tree: WideTree,
    settings: TraceSettings,
    rays: Rays,
    lanes: int,
    share: int,
    out_visibility: wp.array[float],
):
    """Trace rays by the default rules, in pools of ``lanes`` times ``share`` neighbouring rays."""
    thread = first + wp.tid()
    count = rays.origins.shape[0]
    begin = (thread / lanes) * lanes * share
    end = wp.min(begin + lanes * share, count)
    ray = int(0)
    taken = int(0)
    take_ray(1, 0)
    stack = Stack()
    depth = int(0)
    first_node = int(0)
    inner = int(0)
    origin = wp.vec3()
    direction = wp.vec3()
    inverse = wp.vec3()
    t_max = float(0.0)
    v = float(1.0)
    working = int(1)
    while working == 1:
        if inner == 0:
            if depth > 0:
                depth -= 1
                first_node = stack[depth] >> 4
                inner = stack[depth] & 15
            else:
                ray = begin + take_ray(0, taken)
                taken += 1
                if ray < end:
                    origin = rays.origins[ray] - rays.base
                    direction = rays.directions[ray]
                    inverse = reciprocal(direction)
                    t_max = rays.reaches[wp.min(ray, rays.reaches.shape[0] - 1)]
                    v = wp.where(t_max < 0.0, 0.0, 1.0)
                    first_node = 0
                    inner = 1
                else:
                    working = 0
        if working == 1:
            node = first_node + lowest_bit(inner)
            inner = inner & (inner - 1)
            if inner != 0:
                stack[depth] = (first_node << 4) | inner
                depth += 1
            hits = meet_node(tree, node, origin, inverse, 0.0, t_max)
            first_node = hits.first_node
            inner = hits.inner
            leaf = hits.leaf
            while leaf != 0:
                met = meet_leaf_by_default(tree, hits.first_leaf + lowest_bit(leaf), origin, direction, t_max)
                leaf = leaf & (leaf - 1)
                if met.alpha > 0.0:
                    if settings.bernoulli == 1:
                        if unit_float(hash_combine(stream_of_ray(rays, ray), wp.uint32(met.index))) < met.alpha:
                            v = 0.0
                    else:
                        v *= 1.0 - met.alpha
                    if v < settings.stop or v == 0.0:
                        leaf = 0
                        inner = 0
                        depth = 0
            if inner == 0 and depth == 0:
                out_visibility[ray] = v


launch_block_rays = launcher(block_rays_kernel, block_dim=64)
"""Find which rays triangles block."""


launch_trace_rays = launcher(trace_rays_kernel, block_dim=64)
"""Trace a batch of rays through any occluders, one a thread."""


def launch_trace_rays_wide(tree, settings, rays, out_visibility, device):
    """Trace a batch of rays through a wide tree by the default rules."""
    count = len(rays.origins)
    cuda = wp.get_device(device).is_cuda
    lanes = 32 if cuda else 1
    share = min(RAYS_A_LANE, max(count // THREADS_TO_FILL, 1)) if cuda else RAYS_A_LANE
    launch(
        trace_rays_wide_kernel,
        -(-count // (lanes * share)) * lanes,
        inputs=[tree, settings, rays, lanes, share],
        outputs=[out_visibility],
        device=device,
        block_dim=64,
    )
