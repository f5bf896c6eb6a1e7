"""What the threads of a CUDA block tell each other: by votes and exchanges in a warp of 32 lanes, by shared memory.

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
    __syncthreads();
#endif
""")
def wait_for_block():
    """Return when all threads of the block are here, and see what they wrote."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ int greatest[32];
    const int own = __reduce_max_sync(0xffffffffu, value);
    if ((threadIdx.x & 31) == 0)
        greatest[threadIdx.x >> 5] = own;
    __syncthreads();
    int found = greatest[0];
    for (int i = 1; i < blockDim.x / 32; ++i)
        found = max(found, greatest[i]);
    return found;
#else
    return value;
#endif
""")
def greatest_of_block(value: int) -> int:
    """The greatest value of all threads of the block. All must call it together, once in a kernel."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __syncthreads_or(flag);
#else
    return flag;
#endif
""")
def any_of_block(flag: int) -> int:
    """Whether the flag of any thread of the block is not 0. All must call it together."""
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


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(bits);
#else
    return __builtin_popcount(bits);
#endif
""")
def count_bits(bits: int) -> int:
    """Number of lanes of a ballot that are not 0."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(bits & ((1u << (threadIdx.x & 31)) - 1u));
#else
    return 0;
#endif
""")
def bits_below_lane(bits: int) -> int:
    """Number of lanes before this one of a ballot that are not 0."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def wait_for_warp():
    """Return when all lanes of the warp are here, and see what they wrote."""
    ...


_SHARE_ROW = """
#if defined(__CUDA_ARCH__)
    __shared__ float4 shared[KINDS * COUNT];
    float4* place = shared + kind * COUNT + index;
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

_SHARE_SPLATS = """
    wp::vec_t<LENGTH, float> found;
#if defined(__CUDA_ARCH__)
    __shared__ float4 shared[(KINDS + LENGTH / 4) * COUNT];
    float4* place = shared + index;
    const auto get = [&](int i, const float4& part) {
        found[4 * i] = part.x;
        found[4 * i + 1] = part.y;
        found[4 * i + 2] = part.z;
        found[4 * i + 3] = part.w;
    };
    if (action == 0) {
        place[kind * COUNT] = make_float4(row[0], row[1], row[2], row[3]);
    } else if (action == 1) {
        const char* row = reinterpret_cast<const char*>(channels.data) + size_t(splat) * channels.strides[0];
        const float4* source = reinterpret_cast<const float4*>(row);
        #pragma unroll
        for (int i = 0; i < LENGTH / 4; ++i)
            place[(KINDS + i) * COUNT] = __ldg(source + i);
    } else if (action == 2) {
        get(0, place[kind * COUNT]);
    } else {
        #pragma unroll
        for (int i = 0; i < LENGTH / 4; ++i)
            get(i, place[(KINDS + i) * COUNT]);
    }
#endif
    return found;
"""

_HALVE = """
        {
            const bool upper = (lane & STEP) != 0;
            #pragma unroll
            for (int i = 0; i < HALF; ++i) {
                const float given = upper ? held[i] : held[i + HALF];
                const float kept = upper ? held[i + HALF] : held[i];
                held[i] = kept + __shfl_xor_sync(0xffffffffu, given, STEP);
            }
            place += upper ? HALF : 0;
        }
"""

_ADD_WHOLE = """
        held[0] += __shfl_xor_sync(0xffffffffu, held[0], STEP);
"""

_SUM_LANES = """
        {
            float held[WIDTH];
            #pragma unroll
            for (int i = 0; i < WIDTH; ++i)
                held[i] = FIRST + i < LENGTH ? numbers[FIRST + i] : 0.0f;
            int place = FIRST;
HALVINGS            if (lane % (32 / WIDTH) == 0 && place < LENGTH)
                parts[(pair * WARPS + warp) * LENGTH + place] = held[0];
        }
"""

_SUM_BLOCK = """
#if defined(__CUDA_ARCH__)
    __shared__ float parts[32 * WARPS * LENGTH];
    __shared__ int present[32 * WARPS];
    __shared__ int slots[32];
    const int warp = threadIdx.x >> 5;
    const int lane = threadIdx.x & 31;
    if (action == 0) {
        present[threadIdx.x] = 0;
        if (warp == 0)
            slots[lane] = pair;
    } else if (action == 1) {
SUM_LANES        if (lane == 0)
            present[pair * WARPS + warp] = 1;
    } else {
        for (int i = threadIdx.x; i < 32 * LENGTH; i += 32 * WARPS) {
            const int listed = i / LENGTH;
            if (slots[listed] >= 0) {
                float total = 0.0f;
                #pragma unroll
                for (int w = 0; w < WARPS; ++w)
                    if (present[listed * WARPS + w])
                        total += parts[(listed * WARPS + w) * LENGTH + i % LENGTH];
                reinterpret_cast<float*>(out_rows.data)[size_t(slots[listed]) * LENGTH + i % LENGTH] = total;
            }
        }
    }
#endif
"""


@cache
def share_row_function(kinds: int, count: int):
    """Return the function that puts a row into shared memory or, with ``store`` 0, takes it from there.

    A block has ``count`` rows of each of some kinds.
    """
    snippet = _SHARE_ROW.replace("KINDS", str(kinds)).replace("COUNT", str(count))

    @wp.func_native(snippet)
    def share_row(store: int, kind: int, index: int, row: wp.vec4) -> wp.vec4: ...

    return share_row


PUT_ROW, PUT_CHANNELS, ROW, CHANNELS = (wp.constant(k) for k in range(4))


@cache
def share_splats_functions(Channels, kinds: int, count: int):
    """Return the function that keeps ``count`` splats in shared memory, and one that takes a row from there.

    A splat has some kinds of rows, and channels. The first function does one of these:

    - `PUT_ROW` writes a row.
    - `PUT_CHANNELS` copies a splat's channels.
    - `ROW` returns a row as the first four of its numbers.
    - `CHANNELS` returns channels.

    All is one array, so that one register tells where a splat is.
    """
    snippet = _SHARE_SPLATS.replace("LENGTH", str(Channels._length_))
    snippet = snippet.replace("KINDS", str(kinds)).replace("COUNT", str(count))

    @wp.func_native(snippet)
    def share_splats(
        action: int, kind: int, index: int, row: wp.vec4, channels: wp.array[Channels], splat: int
    ) -> Channels: ...

    @wp.func
    def shared_row(kind: int, index: int, channels: wp.array[Channels]) -> wp.vec4:
        row = share_splats(ROW, kind, index, wp.vec4(), channels, 0)
        return wp.vec4(row[0], row[1], row[2], row[3])

    return share_splats, shared_row


BEGIN_SUMS, ADD_TO_SUMS, END_SUMS = (wp.constant(k) for k in range(3))


@cache
def sum_block_function(length: int, warps: int):
    """Return the function that sums ``length`` numbers, at most 32, over a block, for 32 pairs at a time.

    - `BEGIN_SUMS`: every lane of the first warp names the slot of its pair, -1 for none.
    - `ADD_TO_SUMS`: the lanes of a warp bring their numbers for a pair. They halve what they hold in each of five
      steps, as in a transpose, until it is one: 32 numbers take 31 exchanges, 16 take 16 and 4 take 6, where one sum
      after the other would take five each. So 19 numbers go as 16 and 4.
    - `END_SUMS`: the sums of the warps that brought some, in their order, go to the rows of the slots; zeros for none.

    All threads must wait for each other between the three. The order of additions is fixed.
    """
    Numbers = wp.types.vector(length=length, dtype=float)
    # Written out step by step: NVRTC keeps an array that is indexed by a loop it does not unroll in slow local memory.
    parts = [(0, 16), (16, 4 if length <= 20 else 8)] if 16 < length <= 24 else [(0, _width_of(length))]
    snippet = _SUM_BLOCK.replace("SUM_LANES", "".join(_sum_lanes(first, width) for first, width in parts))
    snippet = snippet.replace("LENGTH", str(length)).replace("WARPS", str(warps))

    @wp.func_native(snippet)
    def sum_block(action: int, pair: int, numbers: Numbers, out_rows: wp.array[Numbers]): ...

    return sum_block


def _width_of(length: int) -> int:
    """Return how many numbers are halved together."""
    return next(n for n in (4, 8, 16, 32) if length <= n)


def _sum_lanes(first: int, width: int) -> str:
    """Return the part of a snippet that sums ``width`` numbers from the first on over the lanes of a warp."""
    steps = [(16 >> i, width >> (i + 1)) for i in range(5)]
    halvings = [
        (_HALVE if half else _ADD_WHOLE).replace("STEP", str(step)).replace("HALF", str(half)) for step, half in steps
    ]
    snippet = _SUM_LANES.replace("HALVINGS", "".join(halvings))
    return snippet.replace("FIRST", str(first)).replace("WIDTH", str(width))
