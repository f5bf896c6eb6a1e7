"""Sorting a tile's list on CUDA by its block, part by part: as many of the nearest entries as its pixels look at.

Where the front hides the rest, most of a long list is never sorted.
"""

from functools import cache

import warp as wp

from beam_warp.kernels.raster.tile_lists_cuda import NUMBER_BITS

SORTED = 1024
"""Most entries that a block sorts at a time."""

FEW = 128
"""Most entries of a list that are compared with each other: a thread each."""

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
        const Entry number = entry & (((Entry)1 << NUMBER_BITS) - 1);
        splats.data[listed + place] = (int)(number >> rank_bits);
        ranks.data[listed + place] = (unsigned short)(number & ((1u << rank_bits) - 1));
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
    snippet = _SORT_ENTRIES.replace("NUMBER_BITS", str(NUMBER_BITS))
    snippet = snippet.replace("THREADS", str(threads)).replace("BITS", str(threads.bit_length() - 1))

    @wp.func_native(snippet.replace("SORTED", str(SORTED)).replace("FEW", str(FEW)))
    def sort_entries(
        entries: wp.array[wp.uint64],
        begin: int,
        listed: int,
        end: int,
        parted: wp.array[wp.uint64],
        splats: wp.array[int],
        ranks: wp.array[wp.uint16],
        rank_bits: int,
    ) -> int:
        """List the next entries of a tile in order, at most `SORTED`, after those ``listed``; return the new end.

        ``begin`` and ``end`` are the tile's range; a long list is parted by depth first, into ``parted``. Entries of a
        part are counted in bins, four a thread, and those of a bin compared with each other. All threads of the block
        call it together.
        """
        ...

    return sort_entries
