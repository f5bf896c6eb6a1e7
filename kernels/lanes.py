"""What the 32 lanes of a CUDA warp tell each other: by votes, by exchanges, by shared memory.

Nothing here does anything sensible on the CPU, where a thread is alone; the kernels that call it are for CUDA.
"""

from functools import cache

import warp as wp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return static_cast<int>(__ballot_sync(0xffffffffu, flag != 0));
#else
    return flag != 0 ? 1 : 0;
#endif
""")
def ballot(flag: int) -> int:
    """Bits of the lanes whose flag is not 0. All lanes must call it together."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __reduce_max_sync(0xffffffffu, value);
#else
    return value;
#endif
""")
def greatest_of_lanes(value: int) -> int:
    """The greatest value of all lanes. All lanes must call it together."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def wait_for_lanes():
    """Return when all lanes are here, and see what they wrote."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest_lane(bits: int) -> int:
    """Number of the lowest lane of a ballot that is not 0."""
    ...


_SHARE_ROW = """
#if defined(__CUDA_ARCH__)
    __shared__ float4 shared[GROUPS * KINDS * 32];
    float4* place = shared + ((threadIdx.x >> 5) % GROUPS * KINDS + kind) * 32 + index;
    if (store) {
        *place = make_float4(row[0], row[1], row[2], row[3]);
        return row;
    }
    const float4 found = *place;
    return wp::vec4(found.x, found.y, found.z, found.w);
#else
    return row;
#endif
"""

_SHARE_CHANNELS = """
    wp::vec_t<LENGTH, float> row;
#if defined(__CUDA_ARCH__)
    __shared__ float4 shared[GROUPS * 8 * LENGTH];
    float4* place = shared + (threadIdx.x >> 5) % GROUPS * (8 * LENGTH) + index;
    const float4* source = reinterpret_cast<const float4*>(channels.data) + size_t(splat) * (LENGTH / 4);
    #pragma unroll
    for (int i = 0; i < LENGTH / 4; ++i) {
        if (store) {
            place[32 * i] = __ldg(source + i);
        } else {
            const float4 part = place[32 * i];
            row[4 * i] = part.x;
            row[4 * i + 1] = part.y;
            row[4 * i + 2] = part.z;
            row[4 * i + 3] = part.w;
        }
    }
#endif
    return row;
"""

_STORE_LANE_SUMS = """
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31;
    float held[WIDTH];
    #pragma unroll
    for (int i = 0; i < WIDTH; ++i)
        held[i] = i < LENGTH ? numbers[i] : 0.0f;
    int place = 0;
    #pragma unroll
    for (int step = 16; step > 0; step >>= 1) {
        const int half = WIDTH * step / 32;
        const bool upper = (lane & step) != 0;
        if (half > 0) {
            #pragma unroll
            for (int i = 0; i < half; ++i) {
                const float given = upper ? held[i] : held[i + half];
                const float kept = upper ? held[i + half] : held[i];
                held[i] = kept + __shfl_xor_sync(0xffffffffu, given, step);
            }
            place += upper ? half : 0;
        } else {
            held[0] += __shfl_xor_sync(0xffffffffu, held[0], step);
        }
    }
    if ((WIDTH == 32 || (lane & 1) == 0) && place < LENGTH)
        reinterpret_cast<float*>(out_rows.data)[size_t(row) * LENGTH + place] = held[0];
#endif
"""


@cache
def share_row_function(kinds: int, groups: int):
    """Return the function that puts a row into shared memory or, with ``store`` 0, takes it from there.

    There are 32 rows of each of some kinds, for every warp of ``groups`` in a block.
    """
    snippet = _SHARE_ROW.replace("KINDS", str(kinds)).replace("GROUPS", str(groups))

    @wp.func_native(snippet)
    def share_row(store: int, kind: int, index: int, row: wp.vec4) -> wp.vec4: ...

    return share_row


@cache
def share_channels_function(Channels, groups: int):
    """Return the function that copies a splat's channels to shared memory or, with ``store`` 0, takes them from there.

    There are 32 rows for every warp of ``groups`` in a block.
    """
    snippet = _SHARE_CHANNELS.replace("LENGTH", str(Channels._length_)).replace("GROUPS", str(groups))

    @wp.func_native(snippet)
    def share_channels(store: int, index: int, channels: wp.array[Channels], splat: int) -> Channels: ...

    return share_channels


@cache
def store_lane_sums_function(length: int):
    """Return the function that stores the sums over all lanes of ``length`` numbers, at most 32, as a row.

    Lanes halve what they hold in each of five steps, as in a transpose: 16 numbers take 16 exchanges, where one sum
    after the other would take five each. The order of additions is fixed.
    """
    Numbers = wp.types.vector(length=length, dtype=float)
    snippet = _STORE_LANE_SUMS.replace("LENGTH", str(length)).replace("WIDTH", "16" if length <= 16 else "32")

    @wp.func_native(snippet)
    def store_lane_sums(out_rows: wp.array[Numbers], row: int, numbers: Numbers): ...

    return store_lane_sums
