"""Sample sets by name: which points of the unit square become directions."""

from __future__ import annotations

import math
from typing import Literal

from beam_warp.checks import require_choice, require_count
from beam_warp.kernels.common.sampling import INDEPENDENT, OWEN, STRATIFIED, SampleSet

Sampler = Literal["owen", "stratified", "iid"]

SAMPLERS = ("owen", "stratified", "iid")
"""``"owen"``: Owen-scrambled Sobol' sets; a count that is a power of two fills every elementary interval once.
``"stratified"``: one point in each cell of the squarest grid of as many cells. ``"iid"``: independent points."""


def squarest_grid(count: int) -> tuple[int, int]:
    """Return columns and rows, columns first and never more than rows, whose product is ``count``.

    They are the two factors nearest to each other: 6 x 10 of 60. A prime has none but itself: it is 1 x count, strata
    in one dimension, and hardly better than independent points in the other; so prefer counts that factor.
    """
    columns = math.isqrt(count)
    while count % columns:
        columns -= 1
    return columns, count // columns


def sample_set(sampler: Sampler, count: int) -> SampleSet:
    """Return the sets of ``count`` points that ``sampler`` names, as kernels take them.

    Raises:
        InvalidOptionError: There is no such sampler, or the count is out of range.
    """
    require_choice("sampler", sampler, SAMPLERS)
    samples = SampleSet()
    samples.count = require_count("sample_count", count, 1, 1 << 20)
    samples.kind = int((OWEN, STRATIFIED, INDEPENDENT)[SAMPLERS.index(sampler)])
    bits = count.bit_length() - 1
    if sampler == "owen" and count == 1 << bits and bits > 0:
        samples.column_bits, samples.row_bits = bits // 2, bits - bits // 2
        samples.columns, samples.rows = 1 << samples.column_bits, 1 << samples.row_bits
    elif sampler == "stratified":
        samples.columns, samples.rows = squarest_grid(count)
    return samples
