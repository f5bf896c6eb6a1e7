"""A warp's own list on CUDA: those of the splats that its block sorted which reach its pixels.

A block's threads look at what was sorted, a splat each, and mark the warps that it reaches. Each warp then queues what
is marked for it, in order, so that it brings 32 splats at once to shared memory, whose centres and shapes were read
once for all warps.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from beam_warp.kernels.common.lanes import ballot, bits_below_lane, count_bits
from beam_warp.kernels.raster.bin_tiles import TileLists
from beam_warp.kernels.raster.project import Splats
from beam_warp.kernels.raster.sort_entries_cuda import SORTED
from beam_warp.kernels.raster.splat_rows import EXTENT_MARGIN, RELATIVE_MARGIN, quick_divide, squared_extent, whiten
from beam_warp.kernels.raster.strided_rows import load_row

LANES = wp.constant(32)

NOWHERE = wp.constant(wp.vec4(0.0, 0.0, -1.0e30, 0.0))
"""Centre of what reaches no pixel."""

QUEUE = wp.constant(64)
"""Places of a warp's queue: as many as a warp has lanes wait to be drawn, and fewer than that were left before them."""

PUT_BOX, BOX, PUT_MARKS, MARKS, PUT_QUEUED, QUEUED, PUT_SPLAT, SPLAT = (wp.constant(k) for k in range(8))


@wp.func
def reaches(center: wp.vec4, shape: wp.vec4, first: wp.vec2, last: wp.vec2) -> int:
    """1 if a splat reaches pixels, ``first`` and ``last`` being the centres of those at the corners of their box.

    Where their box, a little enlarged, does not hold the splat's centre, its least squared whitened distance is on one
    of the two sides that face the centre. No root and no exact quotient is needed.
    """
    x0 = first[0] - center[0]
    y0 = first[1] - center[1]
    x1 = last[0] - center[0]
    y1 = last[1] - center[1]
    farthest = wp.max(wp.max(-x0, x1), wp.max(-y0, y1))
    margin = RELATIVE_MARGIN * farthest + EXTENT_MARGIN
    x0 -= margin
    y0 -= margin
    x1 += margin
    y1 += margin
    x = wp.clamp(0.0, x0, x1)
    y = wp.clamp(0.0, y0, y1)
    across = whiten(shape, wp.vec2(x, wp.clamp(shape[1] * x, y0, y1)))
    e = shape[1] * shape[2]
    nearest = quick_divide(e * shape[2] * y, shape[0] * shape[0] + e * e)
    down = whiten(shape, wp.vec2(wp.clamp(nearest, x0, x1), y))
    least = wp.min(wp.dot(across, across), wp.dot(down, down))
    return wp.where(least <= squared_extent(center[2]), 1, 0)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned long long rows = static_cast<unsigned>(upper) | static_cast<unsigned long long>(lower) << 32;
    if (rows == 0)
        return -1;
    unsigned columns = static_cast<unsigned>(upper) | static_cast<unsigned>(lower);
    columns |= columns >> 16;
    columns = (columns | columns >> 8) & 255u;
    const int first = __ffs(columns) - 1 | (__ffsll(rows) - 1) / 8 << 4;
    return first | 31 - __clz(columns) << 8 | (63 - __clzll(rows)) / 8 << 12;
#else
    return 0;
#endif
""")
def box_of(upper: int, lower: int) -> int:
    """The box of a warp's pixels whose bits are set: first column and row, last column and row, four bits each.

    Bits are those of lanes, eight a row; those of ``lower`` are of rows below those of ``upper``. -1 stands for none.
    """
    ...


_SHARE_LISTS = """
#if defined(__CUDA_ARCH__)
    __shared__ int boxes[WARPS];
    __shared__ unsigned char marks[SORTED];
    __shared__ short queues[WARPS * QUEUE];
    __shared__ int splats[KEPT];
    switch (action) {
    case 0: boxes[index] = value; break;
    case 1: return boxes[index];
    case 2: marks[index] = value; break;
    case 3: return marks[index];
    case 4: queues[index] = value; break;
    case 5: return queues[index];
    case 6: splats[index] = value; break;
    case 7: return splats[index];
    }
#endif
    return 0;
"""


class WarpLists(NamedTuple):
    """Functions of blocks of so many threads, in the order of their use. Numbers of splats are those within a part.

    Attributes:
        put_box: ``(part, lane, column, row, box)`` tells which pixels of a warp still look, as `box_of` does from a
            column and row of the tile on. All threads then wait for each other.
        mark: ``(lists, splats, corner, begin, end, thread)`` marks the splats of a part of a list for the warps that
            they reach; ``corner`` is the centre of the tile's first pixel. All threads then wait for each other.
        queue: ``(part, lane, begin, place, stop, head, tail)`` queues what is marked for a warp, from a place in the
            lists on, until there are as many as lanes or none before ``stop``; returns the new place and tail.
        queued: ``(part, number)`` returns what was queued as the warp's first, second, … splat.
        splat: ``(lists, begin, k)`` returns which splat number k of the part that begins there is.
    """

    put_box: Any
    mark: Any
    queue: Any
    queued: Any
    splat: Any


@cache
def warp_lists_functions(threads: int) -> WarpLists:
    """Return the functions of blocks of so many threads: 128, or 256, which leave no room for splats' numbers."""
    warps = threads // 32
    keeps_splats = warps == 4
    snippet = _SHARE_LISTS.replace("WARPS", str(warps)).replace("KEPT", str(SORTED if keeps_splats else 1))

    @wp.func_native(snippet.replace("SORTED", str(SORTED)).replace("QUEUE", str(int(QUEUE))))
    def share(action: int, index: int, value: int) -> int: ...

    @wp.func
    def put_box(part: int, lane: int, column: int, row: int, box: int):
        if lane == 0:  # both corners move by the same column and row
            share(PUT_BOX, part, wp.where(box < 0, box, box + (column + 16 * row) * 257))

    @wp.func
    def mark(lists: TileLists, splats: Splats, corner: wp.vec2, begin: int, end: int, thread: int):
        place = begin + thread
        splat = listed_splat(lists, place, end)
        center = splat_row(splats.centers, splat)
        shape = splat_row(splats.shapes, splat)
        ahead = listed_splat(lists, place + threads, end)
        while place < end:
            marks = int(0)
            for warp in range(wp.static(warps)):
                box = share(BOX, warp, 0)
                first = corner + wp.vec2(float(box & 15), float(box >> 4 & 15))
                last = corner + wp.vec2(float(box >> 8 & 15), float(box >> 12 & 15))
                marks += wp.where(box >= 0, reaches(center, shape, first, last), 0) << warp
            share(PUT_MARKS, place - begin, marks)
            if wp.static(keeps_splats):
                share(PUT_SPLAT, place - begin, splat)
            # What is looked at next is on its way from memory meanwhile.
            place += threads
            splat = ahead
            center = splat_row(splats.centers, splat)
            shape = splat_row(splats.shapes, splat)
            ahead = listed_splat(lists, place + threads, end)

    @wp.func
    def queue(part: int, lane: int, begin: int, place: int, stop: int, head: int, tail: int) -> wp.vec2i:
        at = int(place)
        end = int(tail)
        while end - head < LANES and at < stop:
            k = at + lane - begin
            wanted = int(0)
            if at + lane < stop:
                wanted = share(MARKS, k, 0) >> part & 1
            waiting = ballot(wanted)
            if wanted != 0:
                share(PUT_QUEUED, part * QUEUE + ((end + bits_below_lane(waiting)) & (QUEUE - 1)), k)
            end += count_bits(waiting)
            at = wp.min(at + LANES, stop)
        return wp.vec2i(at, end)

    @wp.func
    def queued(part: int, number: int) -> int:
        return share(QUEUED, part * QUEUE + (number & (QUEUE - 1)), 0)

    @wp.func
    def splat(lists: TileLists, begin: int, k: int) -> int:
        if wp.static(keeps_splats):
            found = share(SPLAT, k, 0)
        else:
            found = lists.splats[begin + k]
        return found

    return WarpLists(put_box, mark, queue, queued, splat)


@wp.func
def listed_splat(lists: TileLists, place: int, end: int) -> int:
    """The splat at a place in the lists; -1 from ``end`` on."""
    splat = int(-1)
    if place < end:
        splat = lists.splats[place]
    return splat


@wp.func
def splat_row(rows: wp.array[wp.vec4], splat: int) -> wp.vec4:
    """The row of a splat, or `NOWHERE`."""
    row = NOWHERE
    if splat >= 0:
        row = load_row(rows, splat)
    return row
