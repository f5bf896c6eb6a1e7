"""A binary hierarchy from sorted Morton codes alone, every node at once: quick to build, for geometry that moves.

Source: Karras 2012, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees". Node i of the M - 1
inner nodes covers a run of leaves that begins or ends at leaf i; the run ends where codes share fewer leading bits.
Equal codes are told apart by their places.
"""

import warp as wp

from beam_warp.kernels.common.launching import launcher
from beam_warp.kernels.trace.tree_build import BinaryTree

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return x == 0 ? 64 : __clzll(x);
#else
    return x == 0 ? 64 : __builtin_clzll((unsigned long long)x);
#endif
""")
def leading_zeros(x: wp.int64) -> int: ...


@wp.func
def shared_bits(keys: wp.array[wp.int64], count: int, i: int, j: int) -> int:
    """Leading bits that two leaves' codes share, those of their places appended; -1 beyond the ends."""
    result = int(-1)
    if j >= 0 and j < count:
        difference = keys[i] ^ keys[j]
        result = leading_zeros(difference)
        if difference == wp.int64(0):
            result = 64 + leading_zeros(wp.int64(i ^ j))
    return result


@wp.kernel
def split_runs_kernel(first: int, keys: wp.array[wp.int64], count: int, out_tree: BinaryTree):
    """Children of inner node i; inner nodes are numbered from ``count``, the root is the first of them."""
    i = first + wp.tid()
    step = int(1)
    if shared_bits(keys, count, i, i + 1) < shared_bits(keys, count, i, i - 1):
        step = -1
    fewest = shared_bits(keys, count, i, i - step)
    # The run's other end: double the reach until it is too far, then halve towards it.
    reach = int(2)
    while shared_bits(keys, count, i, i + reach * step) > fewest:
        reach *= 2
    length = int(0)
    part = reach / 2
    while part > 0:
        if shared_bits(keys, count, i, i + (length + part) * step) > fewest:
            length += part
        part /= 2
    end = i + length * step
    # The split: the last leaf that shares more with this end than the two ends share.
    common = shared_bits(keys, count, i, end)
    offset = int(0)
    part = length
    while part > 1:
        part = (part + 1) / 2
        if shared_bits(keys, count, i, i + (offset + part) * step) > common:
            offset += part
    split = i + offset * step + wp.min(step, 0)
    low = wp.min(i, end)
    high = wp.max(i, end)
    left = split
    if low != split:
        left += count
    right = split + 1
    if high != split + 1:
        right += count
    out_tree.left[count + i] = left
    out_tree.right[count + i] = right
    out_tree.size[count + i] = high - low + 1


launch_split_runs = launcher(split_runs_kernel)
"""Make the ``count - 1`` inner nodes."""
