"""Lists of the splats that each tile draws on CUDA: count, plan, emit; each tile's block then sorts its own list.

A pair of tile and splat is an entry of its tile: the splat's depth and the pair's slot in one number. Slots follow the
order of the splats, so that equal depths keep that order. A block sorts the nearest entries of its tile first, and as
many more as its pixels look at: where the front hides the rest, most of a long list is never sorted.

Entries are emitted by atomics, in any order; once they are sorted nothing of it is left.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.common.launching import launch, launcher
from beam_warp.kernels.common.row_loads import load_row
from beam_warp.kernels.raster.bin_tiles import Band, SplatOrder, TileLists, tile_box, tile_columns
from beam_warp.kernels.raster.project import CameraMove, Projection, RasterView, Splats, project_still

# Pairs are counted by one kernel and emitted by another, which must find the same tiles to the last bit: a pair that is
# counted and not emitted leaves what an earlier frame wrote. So each operation is rounded by itself: which products and
# sums a compiler fuses depends on the code around them.
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fuse_fp": False})

SORTED = 1024
"""Most entries that a block sorts at a time."""

SPREAD = wp.constant(8)
"""Numbers of a tile's tally: atomics on one sector of 32 bytes wait for each other. The first is that of its pairs."""

NEXT_PLACE = wp.constant(4)
"""The number of a tally that tells where, among all entries, the tile's next one goes."""

AHEAD = 4
"""Tiles of a row whose pairs are emitted together."""

Places = wp.types.vector(length=AHEAD, dtype=int)

FEW = 128
"""Most entries of a list that are compared with each other: a thread each."""

SPLATS_A_BLOCK = 128
"""Threads of the blocks that count and emit, a splat each: its rows of tiles are many or few, and a block ends with its
last thread."""

PLANNERS = 1024
"""Threads of a block that plans."""

MOST_PLANS = 32
"""Most blocks that plan: each looks at all tiles."""

NO_SLOT = wp.constant(wp.uint64(1 << 63))
"""The bit of entries of pairs that have no slot; they come last."""


@wp.func
def count_entries(splat: int, splats: Splats, view: RasterView, band: Band, tallies: wp.array[int]) -> int:
    """Number of a splat's pairs, each added to its tile's tally."""
    center = splats.centers[splat]
    count = int(0)
    if center[2] > -wp.inf:
        shape = splats.shapes[splat]
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
    out_counts[splat] = count_entries(splat, splats, views[splat / gaussian_count], band, out_tallies)


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
    splat = first + wp.tid()
    view = views[splat / positions.shape[0]]
    project_still(splat, positions, orientations, scales, opacities, view, CameraMove(), projection, out_splats)
    out_counts[splat] = count_entries(splat, out_splats, view, band, out_tallies)


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
def write_entry(lists: TileLists, at: int, depth: wp.uint64, splat: int, slot: int, end: int):
    """Write the pair of a tile and a splat, and who owns its slot; ``end`` is that of the splat's slots."""
    has_slot = slot >= 0 and slot < end
    if has_slot:
        lists.owners[slot] = splat
    if at < lists.entries.shape[0]:
        lists.entries[at] = wp.where(has_slot, depth | wp.uint64(slot), NO_SLOT | wp.uint64(at))


@wp.kernel
def emit_entries_kernel(
    first: int,
    order: SplatOrder,
    splats: Splats,
    views: wp.array[RasterView],
    gaussian_count: int,
    band: Band,
    tallies: wp.array[int],
    out_lists: TileLists,
):
    """Entries beyond a tile's room are left out; a pair without a slot, beyond the capacity, leaves a last entry.

    The numbers of pairs in the tallies go back to 0, for the next frame.
    """
    splat = first + wp.tid()
    for tile in range(splat, band.end_tile - band.first_tile, order.counts.shape[0]):
        tallies[tile * SPREAD] = 0
    count = order.counts[splat]
    if count <= 0:
        return
    end = wp.min(order.ends[splat], out_lists.owners.shape[0])
    slot = order.ends[splat] - count
    center = load_row(splats.centers, splat)
    shape = load_row(splats.shapes, splat)
    view = views[splat / gaussian_count]
    box = tile_box(center, shape, view, band)
    depth = wp.uint64(wp.cast(center[3], int)) << wp.uint64(32)  # bits of a positive float sort like an integer
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
                    write_entry(out_lists, upper_places[k], depth, splat, slot + at, end)
                if at < counts[1]:
                    write_entry(out_lists, lower_places[k], depth, splat, slot + counts[0] + at, end)
        slot += counts[0] + counts[1]


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
):
    """Places of the tiles' lists, one after the other, and the order in which tiles are drawn; by blocks.

    A block plans ``own_count`` tiles. What begins last should not take longest: long lists lie where a surface is seen
    edge on. Tiles whose lists do not fit have none. Tallies are told where entries begin.
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
):
    plan_tiles(tallies, tile_count, own_count, capacity, out_ranges, out_order)


_SORT_ENTRIES = """
#if defined(__CUDA_ARCH__)
    typedef unsigned long long Entry;
    __shared__ Entry held[SORTED];
    __shared__ int bins[4 * THREADS];
    __shared__ int parts[THREADS];  // ends of the parts of a long list
    __shared__ Entry least[THREADS / 32], greatest[THREADS / 32];  // of each warp
    __shared__ int sums[THREADS / 32];
    __shared__ Entry bound;  // every entry of a part before it is listed
    __shared__ int fitting, count;  // bins to be listed, and entries in them
    const int thread = threadIdx.x, lane = thread & 31, warp = thread >> 5;
    const Entry* from = reinterpret_cast<const Entry*>(entries.data);
    Entry low, high;
    int shift;
    const auto visit = [&](auto look) {
        for (int i = begin + thread; i < end; i += 4 * THREADS) {
            Entry four[4];
            #pragma unroll
            for (int k = 0; k < 4; ++k)
                four[k] = from[min(i + k * THREADS, end - 1)];
            #pragma unroll
            for (int k = 0; k < 4; ++k)
                if (i + k * THREADS < end)
                    look(four[k]);
        }
    };
    const auto find_range = [&](Entry start) {
        low = ~Entry(0);
        high = 0;
        visit([&](Entry entry) {
            if (entry >= start) {
                low = min(low, entry);
                high = max(high, entry);
            }
        });
        for (int step = 16; step > 0; step /= 2) {
            low = min(low, __shfl_xor_sync(0xffffffffu, low, step));
            high = max(high, __shfl_xor_sync(0xffffffffu, high, step));
        }
        if (lane == 0) {
            least[warp] = low;
            greatest[warp] = high;
        }
        __syncthreads();
        for (int i = 0; i < THREADS / 32; ++i) {
            low = min(low, least[i]);
            high = max(high, greatest[i]);
        }
    };
    const auto sum_before = [&](int own) {
        int sum = own;
        for (int step = 1; step < 32; step *= 2) {
            const int other = __shfl_up_sync(0xffffffffu, sum, step);
            sum += lane >= step ? other : 0;
        }
        if (lane == 31)
            sums[warp] = sum;
        __syncthreads();
        for (int i = 0; i < warp; ++i)
            sum += sums[i];
        return sum - own;
    };
    const auto write = [&](int place, Entry entry) {
        const int slot = (long long)entry < 0 ? -1 : (int)entry;
        slots.data[listed + place] = slot;
        splats.data[listed + place] = slot < 0 ? -1 : owners.data[slot];
    };
    const int length = end - begin;
    if (length <= FEW) {
        Entry entry = 0;
        if (thread < length)
            entry = held[thread] = from[begin + thread];
        __syncthreads();
        if (thread < length) {
            int place = 0;
            for (int k = 0; k < length; ++k)
                place += held[k] < entry;
            write(place, entry);
        }
        __syncthreads();
        return end;
    }
    Entry start = 0;
    if (length > SORTED) {
        Entry* to = reinterpret_cast<Entry*>(parted.data);
        if (listed == begin) {
            find_range(0);
            shift = max(0, 64 - __clzll(high - low) - BITS);
            parts[thread] = 0;
            __syncthreads();
            visit([&](Entry entry) { atomicAdd(parts + (int)((entry - low) >> shift), 1); });
            __syncthreads();
            parts[thread] = sum_before(parts[thread]);
            __syncthreads();
            visit([&](Entry entry) { to[begin + atomicAdd(parts + (int)((entry - low) >> shift), 1)] = entry; });
            __syncthreads();
        }
        from = to;
        const int done = listed - begin;
        const int part = __syncthreads_count(parts[thread] <= done);
        const int part_begin = part > 0 ? parts[part - 1] : 0;
        const int fit = __syncthreads_count(parts[thread] <= part_begin + SORTED);
        if (part_begin < done)
            start = bound;
        end = begin + parts[part_begin == done && fit > part ? fit - 1 : part];
        begin += part_begin;
    }
    find_range(start);
    // Narrow the range until its first bins hold few enough; no two entries are equal.
    for (bool few = false; !few;) {
        shift = max(0, 64 - __clzll(high - low) - BITS - 2);
        int* four = bins + 4 * thread;
        for (int k = 0; k < 4; ++k)
            four[k] = 0;
        __syncthreads();
        visit([&](Entry entry) {
            if (entry >= low && entry <= high)
                atomicAdd(bins + (int)((entry - low) >> shift), 1);
        });
        __syncthreads();
        int sum = sum_before(four[0] + four[1] + four[2] + four[3]);
        for (int k = 0; k < 4; ++k) {
            const int before = sum;
            sum += four[k];
            four[k] = before;
            const bool is_last = thread == THREADS - 1 && k == 3;
            if (before <= SORTED && (sum > SORTED || is_last)) {
                fitting = 4 * thread + k + (sum <= SORTED);
                count = sum <= SORTED ? sum : before;
            }
        }
        __syncthreads();
        few = fitting > 0;
        if (fitting < 4 * THREADS)
            high = min(high, low + ((Entry)max(fitting, 1) << shift) - 1);
    }
    visit([&](Entry entry) {
        if (entry >= low && entry <= high)
            held[atomicAdd(bins + (int)((entry - low) >> shift), 1)] = entry;
    });
    __syncthreads();
    const int found = count;
    if (thread == 0)
        bound = high + 1;
    for (int i = thread; i < found; i += THREADS) {
        const Entry entry = held[i];
        const int bin = (int)((entry - low) >> shift);
        int place = bin > 0 ? bins[bin - 1] : 0;
        const int bin_end = bins[bin];
        for (int k = place; k < bin_end; ++k)
            place += held[k] < entry;
        write(place, entry);
    }
    __syncthreads();
    return listed + found;
#else
    return end;
#endif
"""


@cache
def sort_entries_function(threads: int):
    """Return the function with which a block of so many threads, a power of two, sorts a tile's list part by part."""
    snippet = _SORT_ENTRIES.replace("THREADS", str(threads)).replace("BITS", str(threads.bit_length() - 1))

    @wp.func_native(snippet.replace("SORTED", str(SORTED)).replace("FEW", str(FEW)))
    def sort_entries(
        entries: wp.array[wp.uint64],
        owners: wp.array[int],
        begin: int,
        listed: int,
        end: int,
        parted: wp.array[wp.uint64],
        splats: wp.array[int],
        slots: wp.array[int],
    ) -> int:
        """List the next entries of a tile in order, at most `SORTED`, after those ``listed``; return the new end.

        ``begin`` and ``end`` are the tile's range; a long list is parted by depth first, into ``parted``. Entries of a
        part are counted in bins, four a thread, and those of a bin compared with each other. All threads of the block
        call it together.
        """
        ...

    return sort_entries


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


def launch_plan_tiles(tallies, tile_count, capacity, lists, device):
    """Give every tile of a band its room and its turn."""
    blocks = min(-(-tile_count // PLANNERS), MOST_PLANS)
    inputs, outputs = [tallies, tile_count, -(-tile_count // max(blocks, 1)), capacity], [lists.ranges, lists.order]
    count = blocks * PLANNERS
    launch(plan_tiles_kernel, count, inputs=inputs, outputs=outputs, device=device, block_dim=PLANNERS)


def launch_emit_entries(order, splats, views, gaussian_count, band, tallies, lists, device):
    """Write the entries of all tiles of a band, and the owner of every slot."""
    inputs = [order, splats, views, gaussian_count, band, tallies]
    launch(
        emit_entries_kernel,
        len(splats.centers),
        inputs=inputs,
        outputs=[lists],
        device=device,
        block_dim=SPLATS_A_BLOCK,
        in_order=True,
    )
