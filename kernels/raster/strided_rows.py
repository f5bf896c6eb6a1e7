"""Rows of 16 bytes, any distance apart, read or written in one instruction.

Warp's own indexing of a ``vec4`` array becomes four loads or stores of 4 bytes. `kernels.common.row_loads` reads rows
that lie side by side, which takes an operation less.
"""

import warp as wp


@wp.func_native("""
    const char* place = reinterpret_cast<const char*>(rows.data) + size_t(index) * rows.strides[0];
#if defined(__CUDA_ARCH__)
    const float4 row = __ldg(reinterpret_cast<const float4*>(place));
    return wp::vec4(row.x, row.y, row.z, row.w);
#else
    return *reinterpret_cast<const wp::vec4*>(place);
#endif
""")
def load_row(rows: wp.array[wp.vec4], index: int) -> wp.vec4:
    """Return ``rows[index]``; the data must not be written while a kernel reads it this way."""
    ...


@wp.func_native(
    """
    char* place = reinterpret_cast<char*>(rows.data) + size_t(index) * rows.strides[0];
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<float4*>(place) = make_float4(row[0], row[1], row[2], row[3]);
#else
    *reinterpret_cast<wp::vec4*>(place) = row;
#endif
""",
    """
    const char* place = reinterpret_cast<const char*>(rows.grad) + size_t(index) * rows.strides[0];
    if (rows.grad)
        adj_row += *reinterpret_cast<const wp::vec4*>(place);
""",
)
def store_row(rows: wp.array[wp.vec4], index: int, row: wp.vec4):
    """Write ``rows[index]``; the adjoint of ``row`` is read from the array's ``grad``."""
    ...
