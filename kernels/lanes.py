"""What the 32 lanes of a CUDA warp tell each other. On the CPU a thread is alone: it is its own lane 0."""

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
    return __shfl_sync(0xffffffffu, value, lane);
#else
    return value;
#endif
""")
def from_lane(value: int, lane: int) -> int:
    """The value of a lane. All lanes must call it together."""
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
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest_lane(bits: int) -> int:
    """Number of the lowest lane of a ballot that is not 0."""
    ...


_LOAD_CHANNELS = """
#if defined(__CUDA_ARCH__)
    const float4* source = reinterpret_cast<const float4*>(channels.data) + size_t(index) * (LENGTH / 4);
    wp::vec_t<LENGTH, float> row;
    #pragma unroll
    for (int i = 0; i < LENGTH / 4; ++i) {
        const float4 part = __ldg(source + i);
        row[4 * i] = part.x;
        row[4 * i + 1] = part.y;
        row[4 * i + 2] = part.z;
        row[4 * i + 3] = part.w;
    }
    return row;
#else
    return channels.data[index];
#endif
"""

_STORE_LANE_SUMS = """
    float* target = reinterpret_cast<float*>(out_rows.data) + size_t(row) * LENGTH;
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
        target[place] = held[0];
#else
    for (int i = 0; i < LENGTH; ++i)
        target[i] = numbers[i];
#endif
"""


@cache
def load_channels_function(Channels):
    """Return the function that reads a row of channels, a multiple of 4, in 16-byte loads."""
    snippet = _LOAD_CHANNELS.replace("LENGTH", str(Channels._length_))

    @wp.func_native(snippet)
    def load_channels(channels: wp.array[Channels], index: int) -> Channels: ...

    return load_channels


@cache
def store_lane_sums_function(length: int):
    """Return the function that stores the sums over all lanes of ``length`` numbers, a multiple of 4, at most 32.

    Lanes halve what they hold in each of five steps, as in a transpose: 16 numbers take 16 exchanges, 32 take 31, where
    one sum after the other would take five each. The order of additions is fixed.
    """
    Numbers = wp.types.vector(length=length, dtype=float)
    snippet = _STORE_LANE_SUMS.replace("LENGTH", str(length)).replace("WIDTH", "16" if length <= 16 else "32")

    @wp.func_native(snippet)
    def store_lane_sums(out_rows: wp.array[Numbers], row: int, numbers: Numbers): ...

    return store_lane_sums
