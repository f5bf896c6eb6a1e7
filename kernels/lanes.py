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


@cache
def load_channels_function(Channels):
    """Return the function that reads a row of channels, a multiple of 4, in 16-byte loads."""

    @wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    constexpr int rows = {Channels._length_ // 4};
    const float4* source = reinterpret_cast<const float4*>(channels.data) + size_t(index) * rows;
    wp::vec_t<{Channels._length_}, float> row;
    #pragma unroll
    for (int i = 0; i < rows; ++i) {{
        const float4 part = __ldg(source + i);
        row[4 * i] = part.x;
        row[4 * i + 1] = part.y;
        row[4 * i + 2] = part.z;
        row[4 * i + 3] = part.w;
    }}
    return row;
#else
    return channels.data[index];
#endif
""")
    def load_channels(channels: wp.array[Channels], index: int) -> Channels: ...

    return load_channels


@cache
def store_lane_sums_function(length: int):
    """Return the function that stores the sums over all lanes of ``length`` numbers, a multiple of 4, at most 32.

    Lanes halve what they hold in each of five steps, as in a transpose: 16 numbers take 16 exchanges, 32 take 31, where
    one sum after the other would take five each. The order of additions is fixed.
    """
    Numbers = wp.types.vector(length=length, dtype=float)
    width = 16 if length <= 16 else 32

    @wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31;
    float held[{width}];
    #pragma unroll
    for (int i = 0; i < {width}; ++i)
        held[i] = i < {length} ? numbers[i] : 0.0f;
    int place = 0;
    #pragma unroll
    for (int half = {width} / 2, step = 16; step > 0; half >>= 1, step >>= 1) {{
        const bool upper = (lane & step) != 0;
        if (half > 0) {{
            #pragma unroll
            for (int i = 0; i < half; ++i) {{
                const float given = upper ? held[i] : held[i + half];
                const float kept = upper ? held[i + half] : held[i];
                held[i] = kept + __shfl_xor_sync(0xffffffffu, given, step);
            }}
            place += upper ? half : 0;
        }} else {{
            held[0] += __shfl_xor_sync(0xffffffffu, held[0], step);
        }}
    }}
    const bool mine = {width} == 32 || (lane & 1) == 0;
    if (mine && place < {length})
        reinterpret_cast<float*>(out_rows.data)[size_t(row) * {length} + place] = held[0];
#else
    for (int i = 0; i < {length}; ++i)
        reinterpret_cast<float*>(out_rows.data)[size_t(row) * {length} + i] = numbers[i];
#endif
""")
    def store_lane_sums(out_rows: wp.array[Numbers], row: int, numbers: Numbers): ...

    return store_lane_sums
