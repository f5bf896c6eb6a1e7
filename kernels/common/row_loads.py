"""Rows of 16 bytes read in one instruction.

Warp's own indexing of a ``vec4`` array becomes four loads of 4 bytes (seen in the generated PTX), and the tracer's time
goes into loads. The data must not be written while a kernel reads it this way (CUDA's read-only path).
"""

import warp as wp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 row = __ldg(reinterpret_cast<const float4*>(rows.data) + index);
    return wp::vec4(row.x, row.y, row.z, row.w);
#else
    return rows.data[index];
#endif
""")
def load_row(rows: wp.array[wp.vec4], index: int) -> wp.vec4:
    """Return ``rows[index]``."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int4 row = __ldg(reinterpret_cast<const int4*>(rows.data) + index);
    return wp::vec4i(row.x, row.y, row.z, row.w);
#else
    return rows.data[index];
#endif
""")
def load_words(rows: wp.array[wp.vec4i], index: int) -> wp.vec4i:
    """Return ``rows[index]``."""
    ...
