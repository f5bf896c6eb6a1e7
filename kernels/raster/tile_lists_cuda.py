"""Lists of the splats that each tile draws on CUDA: count, plan, emit; each tile's block then sorts its own list.

A pair of tile and splat is an entry of its tile: the splat's depth, its number, and the pair's rank among the splat's
pairs in one, so that equal depths keep the order of the splats. Entries are emitted by atomics, in any order; once they
are sorted (`sort_entries_cuda`) nothing of it is left. From ranks follow the slots of pairs (`pair_slots_cuda`).
"""

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.raster.bin_tiles import Band, TileLists, tile_box, tile_columns
from beam_warp.kernels.raster.project import CameraMove, Projection, RasterView, Splats, project_still, write_splat
from beam_warp.kernels.raster.strided_rows import load_row

# Pairs are counted by one kernel and emitted by another, which must find the same tiles to the last bit: a pair that is
# counted and not emitted leaves what an earlier frame wrote. So each operation is rounded by itself: which products and
# sums a compiler fuses depends on the code around them.
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fuse_fp": False})

SPREAD = wp.constant(8)
"""Numbers of a tile's tally: atomics on one sector of 32 bytes wait for each other. The first is that of its pairs."""

NEXT_PLACE = wp.constant(4)
"""The number of a tally that tells where, among all entries, the tile's next one goes."""

AHEAD = 4
"""Tiles of a row whose pairs are emitted together."""

Places = wp.types.vector(length=AHEAD, dtype=int)

SPLATS_A_BLOCK = 128
"""Threads of the blocks that count and emit, a splat each: its rows of tiles are many or few, and a block ends with its
last thread."""

PLANNERS = 1024
"""Threads of a block that plans."""

MOST_PLANS = 32
"""Most blocks that plan: each looks at all tiles."""

NUMBER_BITS = 33
"""Bits of an entry besides its depth, which is positive: as many as it takes for the splat's number, others for the
rank."""

MOST_RANK_BITS = 16
"""Most bits of a rank."""


@wp.func
def count_entries(center: wp.vec4, shape: wp.vec4, view: RasterView, band: Band, tallies: wp.array[int]) -> int:
    """Number of a splat's pairs, each added to its tile's tally."""
    count = int(0)
    if center[2] > -wp.inf:
        box = tile_box(center, shape, view, band)
        for row in range(box[1], box[3]):
            columns = tile_columns(center, shape, view, box, row)
            tile = view.first_tile - band.first_tile + row * view.columns
            for column in range(columns[0], columns[1]):
                wp.atomic_add(tallies, (tile + column) * SPREAD, 1)
            count += columns[1] - columns[0]
    return count


@wp.kernel
def count_entries_kernel(
    first: int,
    splats: Splats,
    views: wp.array[RasterView],
    gaussian_count: int,
    band: Band,
    out_counts: wp.array[int],
    out_tallies: wp.array[int],
):
    splat = first + wp.tid()
    center = load_row(splats.centers, splat)
    shape = load_row(splats.shapes, splat)
    out_counts[splat] = count_entries(center, shape, views[splat / gaussian_count], band, out_tallies)


@wp.kernel(launch_bounds=(SPLATS_A_BLOCK, 8))
def project_entries_kernel(
    first: int,
    positions: wp.array[wp.vec3],
    orientations: wp.array[wp.quat],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    views: wp.array[RasterView],
    projection: Projection,
    band: Band,
    out_splats: Splats,
    out_counts: wp.array[int],
    out_tallies: wp.array[int],
):
    """`kernels.raster.project` and counting in one: a frame of few Gaussians takes as long as its launches."""
    i = first + wp.tid()
    count = positions.shape[0]
    gaussian = i % count
    view = views[i / count]
    splat = project_still(gaussian, positions, orientations, scales, opacities, view, CameraMove(), projection)
    write_splat(i, splat, out_splats)
    out_counts[i] = count_entries(splat.center, splat.shape, view, band, out_tallies)


@wp.func_native(
    """
    wp::vec_t<AHEAD, int> places;
#if defined(__CUDA_ARCH__)
    #pragma unroll
    for (int k = 0; k < AHEAD; ++k)
        places[k] = k < count ? atomicAdd(tallies.data + (tile + k) * SPREAD + NEXT_PLACE, 1) : 0;
#endif
    return places;
""".replace("AHEAD", str(AHEAD))
    .replace("SPREAD", str(SPREAD))
    .replace("NEXT_PLACE", str(NEXT_PLACE))
)
def take_places(tallies: wp.array[int], tile: int, count: int) -> Places:
    """Places among all entries for one of each of ``count`` tiles side by side, at most `AHEAD`."""
    ...


@wp.func
def last_rank(lists: TileLists) -> int:
    """The rank that stands for all from there on, where a splat reaches more tiles than there are bits for."""
    return (1 << lists.rank_bits) - 1


@wp.func
def write_entry(lists: TileLists, at: int, first: wp.uint64, rank: int):
    """Write a pair of a splat, unless the tile has no room; ``first`` is the entry of the splat's first pair."""
    if at < lists.entries.shape[0]:
        lists.entries[at] = first | wp.uint64(wp.min(rank, last_rank(lists)))


@wp.kernel
def emit_entries_kernel(
    first: int,
    splats: Splats,
    views: wp.array[RasterView],
    gaussian_count: int,
    band: Band,
    tallies: wp.array[int],
    out_lists: TileLists,
):
    """Entries of tiles without room are left out. Numbers of pairs in the tallies go back to 0, for the next frame."""
    splat = first + wp.tid()
    for tile in range(splat, band.end_tile - band.first_tile, splats.centers.shape[0]):
        tallies[tile * SPREAD] = 0
    center = load_row(splats.centers, splat)
    if not (center[2] > -wp.inf):
        return
    shape = load_row(splats.shapes, splat)
    view = views[splat / gaussian_count]
    box = tile_box(center, shape, view, band)
    # The bits of a positive float sort like an integer.
    entry = wp.uint64(wp.cast(center[3], int)) << wp.uint64(wp.static(NUMBER_BITS))
    entry = entry | wp.uint64(splat) << wp.uint64(out_lists.rank_bits)
    rank = int(0)
    # Two rows at a time, some columns of each: a thread does not wait for one atomic after the other.
    for row in range(box[1], box[3], 2):
        tile = view.first_tile - band.first_tile + row * view.columns
        upper = tile_columns(center, shape, view, box, row)
        lower = wp.vec2i(0, 0)
        if row + 1 < box[3]:
            lower = tile_columns(center, shape, view, box, row + 1)
        counts = wp.vec2i(upper[1] - upper[0], lower[1] - lower[0])
        upper_tile = tile + upper[0]
        lower_tile = tile + view.columns + lower[0]
        for column in range(0, wp.max(counts[0], counts[1]), AHEAD):
            upper_places = take_places(tallies, upper_tile + column, counts[0] - column)
            lower_places = take_places(tallies, lower_tile + column, counts[1] - column)
            for k in range(AHEAD):
                at = column + k
                if at < counts[0]:
                    write_entry(out_lists, upper_places[k], entry, rank + at)
                if at < counts[1]:
                    write_entry(out_lists, lower_places[k], entry, rank + counts[0] + at)
        rank += counts[0] + counts[1]


_PLAN_TILES = """
#if defined(__CUDA_ARCH__)
    // Classes of lengths, four an octave; those of longer lists are drawn first, empty ones last.
    __shared__ int classes[128], places[128];
    __shared__ unsigned long long sums[PLANNERS / 32];  // of each warp
    const int thread = threadIdx.x, lane = thread & 31, warp = thread >> 5;
    const int first = min(blockIdx.x * own_count, tile_count), end = min(first + own_count, tile_count);
    // Above the 40 bits of a sum of lengths is the number of empty tiles.
    typedef unsigned long long Sum;
    const auto weight = [](int length) { return length > 0 ? (Sum)length : (Sum)1 << 40; };
    const auto class_of = [](int length) { return min(127, (int)(__float_as_uint((float)length) >> 21) - 507); };
    const auto sum_of_warps = [&](int count) {
        Sum sum = 0;
        for (int i = 0; i < count; ++i)
            sum += sums[i];
        return sum;
    };
    if (thread < 128)
        classes[thread] = places[thread] = 0;
    __syncthreads();
    // Every block looks at all tiles, which takes less time than to wait for each other.
    Sum before = 0;
    for (int base = thread; base < tile_count; base += 8 * PLANNERS) {
        int lengths[8];  // loaded together: a thread does not wait for one after the other
        #pragma unroll
        for (int k = 0; k < 8; ++k)
            lengths[k] = tallies.data[min(base + k * PLANNERS, tile_count - 1) * SPREAD];
        #pragma unroll
        for (int k = 0; k < 8; ++k) {
            const int i = base + k * PLANNERS;
            if (i < tile_count && lengths[k] > 0)
                atomicAdd(classes + class_of(lengths[k]), 1);
            if (i < first && lengths[k] > 0)
                atomicAdd(places + class_of(lengths[k]), 1);
            before += i < first ? weight(lengths[k]) : 0;
        }
    }
    for (int step = 16; step > 0; step /= 2)
        before += __shfl_xor_sync(0xffffffffu, before, step);
    if (lane == 0)
        sums[warp] = before;
    __syncthreads();
    before = sum_of_warps(PLANNERS / 32);
    if (thread < 128)
        for (int i = thread + 1; i < 128; ++i)
            places[thread] += classes[i];
    for (int base = first; base < end; base += PLANNERS) {
        const int i = base + thread;
        const int length = i < end ? tallies.data[i * SPREAD] : 0;
        Sum sum = weight(length);
        for (int step = 1; step < 32; step *= 2) {
            const Sum other = __shfl_up_sync(0xffffffffu, sum, step);
            sum += lane >= step ? other : 0;
        }
        __syncthreads();
        if (lane == 31)
            sums[warp] = sum;
        __syncthreads();
        const Sum own_before = before + sum_of_warps(warp) + sum - weight(length);
        const Sum start = own_before & (((Sum)1 << 40) - 1);
        if (i < end) {
            const bool fits = start + length <= capacity;
            const int begin = fits ? (int)start : capacity;
            ranges.data[i] = wp::vec2i(begin, fits ? begin + length : capacity);
            tallies.data[i * SPREAD + NEXT_PLACE] = begin;
            const int empty = (int)(own_before >> 40);
            order.data[length > 0 ? atomicAdd(places + class_of(length), 1) : tile_count - 1 - empty] = i;
        }
        before += sum_of_warps(PLANNERS / 32);
    }
    if (end == tile_count && thread == 0)
        total.data[0] = (int)min(before & (((Sum)1 << 40) - 1), (Sum)0x7fffffff);
#endif
"""


_PLAN_TILES = _PLAN_TILES.replace("SPREAD", str(SPREAD)).replace("NEXT_PLACE", str(NEXT_PLACE))


@wp.func_native(_PLAN_TILES.replace("PLANNERS", str(PLANNERS)))
def plan_tiles(
    tallies: wp.array[int],
    tile_count: int,
    own_count: int,
    capacity: int,
    ranges: wp.array[wp.vec2i],
    order: wp.array[int],
    total: wp.array[int],
):
    """Places of the tiles' lists, one after the other, and the order in which tiles are drawn; by blocks.

    A block plans ``own_count`` tiles. What begins last should not take longest: long lists lie where a surface is seen
    edge on. Tiles whose lists do not fit have none. Tallies are told where entries begin. The total of all pairs is
    limited to the range of integers.
    """
    ...


@wp.kernel
def plan_tiles_kernel(
    first: int,
    tallies: wp.array[int],
    tile_count: int,
    own_count: int,
    capacity: int,
    out_ranges: wp.array[wp.vec2i],
    out_order: wp.array[int],
    out_total: wp.array[int],
):
    plan_tiles(tallies, tile_count, own_count, capacity, out_ranges, out_order, out_total)


launch_count_entries = launcher(count_entries_kernel, in_order=True)
"""Count the pairs of every splat and, added to zeros, those of every tile of a band."""


def launch_project_entries(gaussians, views, projection, band, splats, counts, tallies, device):
    """Project every Gaussian into every view, and count as `launch_count_entries` does."""
    inputs = [*gaussians, views, projection, band]
    outputs = [splats, counts, tallies]
    launch(
        project_entries_kernel,
        len(counts),
        inputs=inputs,
        outputs=outputs,
        device=device,
        block_dim=SPLATS_A_BLOCK,
        in_order=True,
    )


def launch_plan_tiles(tallies, tile_count, capacity, lists, total, device):
    """Give every tile of a band its room and its turn, and write the number of all pairs."""
    blocks = min(-(-tile_count // PLANNERS), MOST_PLANS)
    inputs = [tallies, tile_count, -(-tile_count // max(blocks, 1)), capacity]
    outputs = [lists.ranges, lists.order, total]
    count = blocks * PLANNERS
    launch(plan_tiles_kernel, count, inputs=inputs, outputs=outputs, device=device, block_dim=PLANNERS)


def launch_emit_entries(splats, views, gaussian_count, band, tallies, lists, device):
    """Write the entries of all tiles of a band."""
    launch(
        emit_entries_kernel,
        len(splats.centers),
        inputs=[splats, views, gaussian_count, band, tallies],
        outputs=[lists],
        device=device,
        block_dim=SPLATS_A_BLOCK,
        in_order=True,
    )


def rank_bits(splat_count):
    """Return how many bits of an entry are left for a rank, where there are so many splats."""
    return min(NUMBER_BITS - max(splat_count - 1, 1).bit_length(), MOST_RANK_BITS)
