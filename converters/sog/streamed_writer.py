"""Writer of streamed SOG, version 1: regions of Gaussians at several levels of detail, which viewers load when near.

The cloud is halved along its longest side until a region has at most `REGION` Gaussians. Level 0 of a region is all of
them. Each further level keeps a quarter of the one before: those with the largest product of opacity and area, where
area is the mean over the three pairs of axes. They are scaled alike, so that the sum of these products over the region
stays what it was. Levels are added while the coarsest still has `COARSEST` Gaussians, up to `MOST_LEVELS`. A file holds
neighbouring regions of one level, up to `FILE` Gaussians.

Source of the format: PlayCanvas user manual, "The Streamed SOG Format".
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp._version import __version__
from beam_warp.converters.common.frames import FrameToWrite
from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.sog.files import META
from beam_warp.converters.sog.writer import sog_of, write_folder
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import rotation_matrices

REGION = 2**16
"""Gaussians of the largest region."""

FILE = 2**19
"""Gaussians of the largest file."""

MOST_LEVELS = 4

COARSEST = 2**12
"""Gaussians that a level beside the finest has at least."""

REACH = 3.0
"""Standard deviations of a Gaussian that lie within the bounds of its region."""


@dataclass
class _Region:
    """Gaussians that lie together.

    Attributes:
        rows: Their rows in the cloud; the ones that coarser levels keep come first, ``(N,)``.
        counts: How many of them each level keeps.
        factors: Factor of the scales at each level.
        bound: Least and greatest corner, ``(2, 3)``.
        places: File, first row in it and number of Gaussians, for each level.
    """

    rows: NDArray[np.intp]
    counts: list[int]
    factors: list[float]
    bound: NDArray[np.float64]
    places: list[tuple[int, int, int]] = field(default_factory=list)


_Tree = _Region | tuple["_Tree", "_Tree"]


def encode(frame: FrameToWrite, path: Path, options: WriteOptions) -> None:
    """Write one frame as an index, and its files in folders beside it.

    Raises:
        InvalidOptionError: Material channels or degree 4 are asked for, which SOG cannot hold.
    """
    cloud = frame.cloud
    levels = level_count(len(cloud))
    tree = _tree(cloud, np.arange(len(cloud)), levels)
    regions = list(_regions(tree))
    names: list[str] = []
    for level in range(levels):
        for number, group in enumerate(_groups(regions, level)):
            _write_file(frame, options, group, level, f"{level}_{number}", len(names))
            names.append(f"{level}_{number}/{META}")
    counts = [sum(region.counts[level] for region in regions) for level in range(levels)]
    index = {
        "version": 1,
        "asset": {"generator": f"beam-warp {__version__}"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": levels,
        "filenames": names,
        "tree": _node(tree),
    }
    path.write_text(json.dumps(index, separators=(",", ":")), encoding="utf-8")


def level_count(count: int) -> int:
    """Return how many levels a cloud of ``count`` Gaussians gets."""
    return 1 + sum(count >= COARSEST * 4**level for level in range(1, MOST_LEVELS))


def _tree(cloud: GaussianCloud, rows: NDArray[np.intp], levels: int) -> _Tree:
    """Halve the Gaussians along their longest side, until the parts are small."""
    if len(rows) <= REGION:
        return _region(cloud.select(rows), rows, levels)
    positions, half = cloud.positions[rows], len(rows) // 2
    order = np.argpartition(positions[:, np.argmax(np.ptp(positions, axis=0))], half)
    first, second = (_tree(cloud, rows[part], levels) for part in (order[:half], order[half:]))
    return first, second


def _region(cloud: GaussianCloud, rows: NDArray[np.intp], levels: int) -> _Region:
    """Choose what each level keeps of a cloud, whose rows in the whole are given."""
    order, counts, factors = coarser_levels(cloud, levels)
    axes = rotation_matrices(cloud.orientations.astype(np.float64)) * cloud.scales[:, None, :]
    largest = np.ones(len(cloud))  # the factor of the coarsest level that keeps each
    for count, factor in zip(counts, factors, strict=True):
        largest[order[:count]] = factor
    extents = REACH * largest[:, None] * np.sqrt(np.einsum("nij,nij->ni", axes, axes))
    corners = [(cloud.positions - extents).min(axis=0), (cloud.positions + extents).max(axis=0)] if len(cloud) else []
    return _Region(rows[order], counts, factors, np.array(corners or np.zeros((2, 3)), np.float64))


def coarser_levels(cloud: GaussianCloud, levels: int) -> tuple[NDArray[np.intp], list[int], list[float]]:
    """Return the order in which coarser levels keep Gaussians, and the number and the factor of scales of each level.

    Level k keeps the first ``counts[k]`` of the order, a quarter of the level before, rounded up; at its factor they
    have as large a sum of opacity times area as all of them.
    """
    sides = cloud.scales.astype(np.float64)
    weights = cloud.opacities * (sides * np.roll(sides, 1, axis=1)).mean(axis=1)
    order = np.argsort(-weights, kind="stable")
    counts = [-(-len(cloud) // 4**level) for level in range(levels)]
    sums = np.cumsum(weights[order])
    kept = [sums[count - 1] if count else 0.0 for count in counts]
    return order, counts, [float(np.sqrt(kept[0] / each)) if each > 0.0 else 1.0 for each in kept]


def _regions(tree: _Tree) -> Iterator[_Region]:
    """Yield the leaves in order."""
    if isinstance(tree, _Region):
        yield tree
    else:
        for child in tree:
            yield from _regions(child)


def _groups(regions: list[_Region], level: int) -> Iterator[list[_Region]]:
    """Yield neighbouring regions that share a file."""
    group: list[_Region] = []
    for region in regions:
        if group and sum(each.counts[level] for each in group) + region.counts[level] > FILE:
            yield group
            group = []
        group.append(region)
    yield group


def _write_file(
    frame: FrameToWrite, options: WriteOptions, group: list[_Region], level: int, folder: str, number: int
) -> None:
    """Write the Gaussians of a level of some regions, and note in these where they are."""
    counts = [region.counts[level] for region in group]
    rows = np.concatenate([region.rows[:count] for region, count in zip(group, counts, strict=True)])
    part = frame.cloud.select(rows)
    if level:
        factors = np.repeat([region.factors[level] for region in group], counts)
        part = part.with_arrays(scales=(part.scales * factors[:, None]).astype(np.float32))
    meta, textures = sog_of(part, frame, options, np.repeat(np.arange(len(group)), counts))
    write_folder(frame.beside(f"{folder}/{META}"), meta, textures, lambda name: frame.beside(f"{folder}/{name}"))
    for region, first, count in zip(group, np.cumsum([0, *counts]).tolist(), counts, strict=False):
        region.places.append((number, first, count))


def _node(tree: _Tree) -> dict[str, Any]:
    """Return a node of the index."""
    if isinstance(tree, _Region):
        lods = {
            str(level): {"file": file, "offset": first, "count": count}
            for level, (file, first, count) in enumerate(tree.places)
        }
        return {"bound": _bound(tree.bound), "lods": lods}
    children = [_node(child) for child in tree]
    low, high = (np.array([child["bound"][key] for child in children]) for key in ("min", "max"))
    return {"bound": _bound(np.stack([low.min(axis=0), high.max(axis=0)])), "children": children}


def _bound(corners: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return bounds with the seven digits that the format has."""
    low, high = ([float(f"{number:.7g}") for number in corner] for corner in corners)
    return {"min": low, "max": high}
