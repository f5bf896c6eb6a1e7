"""Random streams, sample sets and maps from the unit square: each map with its density and its inverse.

A stream is a 32-bit number derived from (seed, frame, point); a sample set is indexed within it. Results therefore do
not depend on launch order, chunking or device.
"""

import warp as wp

from beam_warp.kernels.common.constants import PI

# Literals above 2^31 - 1 would be signed in generated code; as constants they keep their type.
U_85EBCA6B = wp.constant(wp.uint32(0x85EBCA6B))
U_C2B2AE35 = wp.constant(wp.uint32(0xC2B2AE35))
U_9E3779B9 = wp.constant(wp.uint32(0x9E3779B9))
U_FF00FF00 = wp.constant(wp.uint32(0xFF00FF00))
U_F0F0F0F0 = wp.constant(wp.uint32(0xF0F0F0F0))
U_CCCCCCCC = wp.constant(wp.uint32(0xCCCCCCCC))
U_AAAAAAAA = wp.constant(wp.uint32(0xAAAAAAAA))
U_B82F1E52 = wp.constant(wp.uint32(0xB82F1E52))
U_C7AFE638 = wp.constant(wp.uint32(0xC7AFE638))
U_8D22F6E6 = wp.constant(wp.uint32(0x8D22F6E6))
U_80000000 = wp.constant(wp.uint32(0x80000000))


@wp.func
def hash_word(x: wp.uint32) -> wp.uint32:
    """Mix 32 bits; the finaliser of MurmurHash3 (Appleby 2011), a bijection."""
    h = x
    h ^= h >> wp.uint32(16)
    h *= U_85EBCA6B
    h ^= h >> wp.uint32(13)
    h *= U_C2B2AE35
    h ^= h >> wp.uint32(16)
    return h


@wp.func
def hash_combine(a: wp.uint32, b: wp.uint32) -> wp.uint32:
    """Hash of an ordered pair."""
    return hash_word(hash_word(a) ^ (b * U_9E3779B9 + wp.uint32(0x7F4A7C15)))


@wp.func
def stream_of(seed: wp.uint32, frame: wp.uint32, point: wp.uint32) -> wp.uint32:
    """The random stream of one point."""
    return hash_combine(hash_combine(seed, frame), point)


@wp.func
def unit_float(bits: wp.uint32) -> float:
    """Uniform in [0, 1): the upper 24 bits, so that rounding never reaches 1."""
    return float(bits >> wp.uint32(8)) * 5.9604644775390625e-8


@wp.func
def reverse_bits(x: wp.uint32) -> wp.uint32:
    r = x
    r = (r << wp.uint32(16)) | (r >> wp.uint32(16))
    r = ((r & wp.uint32(0x00FF00FF)) << wp.uint32(8)) | ((r & U_FF00FF00) >> wp.uint32(8))
    r = ((r & wp.uint32(0x0F0F0F0F)) << wp.uint32(4)) | ((r & U_F0F0F0F0) >> wp.uint32(4))
    r = ((r & wp.uint32(0x33333333)) << wp.uint32(2)) | ((r & U_CCCCCCCC) >> wp.uint32(2))
    r = ((r & wp.uint32(0x55555555)) << wp.uint32(1)) | ((r & U_AAAAAAAA) >> wp.uint32(1))
    return r


@wp.func
def owen_scramble(x: wp.uint32, seed: wp.uint32) -> wp.uint32:
    """Nested uniform scramble of a sequence's bits by hashing (Laine and Karras 2011; constants Burley 2020)."""
    r = reverse_bits(x) + seed
    r ^= r * wp.uint32(0x6C50B47C)
    r ^= r * U_B82F1E52
    r ^= r * U_C7AFE638
    r ^= r * U_8D22F6E6
    return reverse_bits(r)


@wp.func
def sobol_second_dimension(index: wp.uint32) -> wp.uint32:
    """Second dimension of Sobol's sequence: the generator matrix is Pascal's triangle modulo 2."""
    result = wp.uint32(0)
    column = U_80000000
    i = index
    while i != wp.uint32(0):
        if (i & wp.uint32(1)) != wp.uint32(0):
            result ^= column
        i = i >> wp.uint32(1)
        column = column ^ (column >> wp.uint32(1))
    return result


@wp.func
def owen_sobol_x(index: int, stream: wp.uint32) -> wp.uint32:
    """First coordinate of an Owen-scrambled Sobol' point, as 32 bits after the binary point."""
    return owen_scramble(reverse_bits(wp.uint32(index)), hash_combine(stream, wp.uint32(1)))


@wp.func
def owen_sobol_y(index: int, stream: wp.uint32) -> wp.uint32:
    """Second coordinate."""
    return owen_scramble(sobol_second_dimension(wp.uint32(index)), hash_combine(stream, wp.uint32(2)))


@wp.func
def stratum(x: wp.uint32, y: wp.uint32, x_bits: int, y_bits: int) -> int:
    """Cell of a point in the grid of 2^x_bits columns by 2^y_bits rows, columns first.

    The first 2^(x_bits + y_bits) points of the sequence occupy each cell exactly once ((0,2)-sequence), scrambled or
    not; neighbouring cells are neighbouring numbers.
    """
    column = int(0)
    row = int(0)
    if x_bits > 0:
        column = int(x >> wp.uint32(32 - x_bits))
    if y_bits > 0:
        row = int(y >> wp.uint32(32 - y_bits))
    return column * (1 << y_bits) + row


OWEN = wp.constant(0)
STRATIFIED = wp.constant(1)
INDEPENDENT = wp.constant(2)


@wp.struct
class SampleSet:
    """What sets of points in the unit square look like; built in beam_warp.trace.sampling."""

    kind: int  # OWEN, STRATIFIED or INDEPENDENT
    count: int  # points a set
    columns: int  # strata side by side; 0 where there are none
    rows: int  # strata one above the other
    column_bits: int  # log2 of both, for OWEN
    row_bits: int


@wp.struct
class SquareSample:
    """A point of a set."""

    u: float
    v: float
    slot: int  # its place in the order of strata, where neighbours share an edge; its number where there are none


@wp.func
def in_cell(cell: int, count: int, jitter: float) -> float:
    """Where ``jitter`` in [0, 1) lies when ``cell`` of ``count`` is all there is; rounding never reaches 1."""
    return wp.min((float(cell) + jitter) / float(count), 0.99999994)


@wp.func
def draw_square(samples: SampleSet, index: int, stream: wp.uint32) -> SquareSample:
    """Point number ``index`` of the set of one stream.

    OWEN: an Owen-scrambled Sobol' set. STRATIFIED: one uniform point in each cell of the grid, columns walked up and
    down in turn. INDEPENDENT: hashes of (stream, index).
    """
    sample = SquareSample()
    sample.slot = index
    if samples.kind == OWEN:
        x = owen_sobol_x(index, stream)
        y = owen_sobol_y(index, stream)
        sample.u = unit_float(x)
        sample.v = unit_float(y)
        if samples.columns > 0:
            sample.slot = stratum(x, y, samples.column_bits, samples.row_bits)
    else:
        sample.u = unit_float(hash_combine(hash_combine(stream, wp.uint32(1)), wp.uint32(index)))
        sample.v = unit_float(hash_combine(hash_combine(stream, wp.uint32(2)), wp.uint32(index)))
        if samples.kind == STRATIFIED:
            column = index / samples.rows
            row = index % samples.rows
            if column % 2 == 1:
                row = samples.rows - 1 - row
            sample.u = in_cell(column, samples.columns, sample.u)
            sample.v = in_cell(row, samples.rows, sample.v)
    return sample


@wp.func
def tangent_frame(n: wp.vec3) -> wp.mat33:
    """Columns: two tangents and ``n``; no branch at the poles (Duff et al. 2017)."""
    s = wp.where(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (s + n[2])
    b = n[0] * n[1] * a
    t = wp.vec3(1.0 + s * n[0] * n[0] * a, s * b, -s * n[0])
    u = wp.vec3(b, s + n[1] * n[1] * a, -n[1])
    return wp.mat33(t[0], u[0], n[0], t[1], u[1], n[1], t[2], u[2], n[2])


@wp.func
def square_to_cosine_hemisphere(u: float, v: float) -> wp.vec3:
    """Concentric map (Shirley and Chiu 1997) lifted to the hemisphere around +z (Malley); keeps stratification."""
    a = 2.0 * u - 1.0
    b = 2.0 * v - 1.0
    radius = float(0.0)
    phi = float(0.0)
    if a * a > b * b:
        radius = a
        phi = (PI / 4.0) * (b / a)
    elif b != 0.0:
        radius = b
        phi = PI / 2.0 - (PI / 4.0) * (a / b)
    x = radius * wp.cos(phi)
    y = radius * wp.sin(phi)
    return wp.vec3(x, y, wp.sqrt(wp.max(1.0 - x * x - y * y, 0.0)))


@wp.func
def square_to_cosine_hemisphere_pdf(direction: wp.vec3) -> float:
    return wp.max(direction[2], 0.0) / PI
