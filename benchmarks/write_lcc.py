"""Scenes of XGRIDS with two levels, as their white papers word them: LCC, and LCC2 whose files a converter writes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beam_warp.world.gaussians import GaussianCloud

Bytes = NDArray[np.uint8]

CELLS = 2
"""Cells along x and y, each of which is a region."""

COARSER = 4
"""Every fourth Gaussian is in the coarser level."""


def regions(cloud: GaussianCloud) -> list[NDArray[np.intp]]:
    """Return the rows of every region."""
    edges = [np.quantile(cloud.positions[:, axis], np.linspace(0, 1, CELLS + 1)[1:-1]) for axis in range(2)]
    cell = sum(CELLS**axis * np.searchsorted(edges[axis], cloud.positions[:, axis]) for axis in range(2))
    return [np.flatnonzero(cell == number) for number in range(CELLS**2)]


def codes(values: NDArray[np.floating], low: NDArray[np.floating], high: NDArray[np.floating], bits: int) -> NDArray:
    """Return the nearest fractions between bounds, as whole numbers of so many bits."""
    return np.rint((values - low) / np.where(high > low, high - low, 1.0) * (2**bits - 1)).astype(np.uint32)


def rotation_words(orientations: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Return xyzw in 32 bits: three of them in 10 bits each, and the place of the largest."""
    largest = np.abs(orientations).argmax(axis=1)
    signs = np.sign(np.take_along_axis(orientations, largest[:, None], axis=1))
    others = np.array([[axis for axis in range(4) if axis != place] for place in range(4)])[largest]
    smaller = np.take_along_axis(orientations * signs, others, axis=1) / np.sqrt(2.0) + 0.5
    tens = np.rint(smaller * 1023.0).astype(np.uint32)
    return tens[:, 0] | tens[:, 1] << 10 | tens[:, 2] << 20 | largest.astype(np.uint32) << 30


def gaussians(cloud: GaussianCloud, scales: NDArray[np.floating], bands: NDArray[np.floating]) -> tuple[Bytes, Bytes]:
    """Return the 32 bytes and the 64 bytes of every Gaussian."""
    colors = 0.5 + cloud.radiance[:, 0] / (2.0 * np.sqrt(np.pi))
    rgba = np.column_stack([np.clip(colors, 0.0, 1.0), cloud.opacities])
    columns = [
        cloud.positions.astype("<f4"),
        np.rint(rgba * 255.0).astype("u1"),
        codes(cloud.scales, *scales, 16).astype("<u2"),
        rotation_words(cloud.orientations)[:, None].astype("<u4"),
        np.zeros((len(cloud), 3), "<u2"),
    ]
    data = np.concatenate([np.ascontiguousarray(column).view(np.uint8) for column in columns], axis=1)
    higher = np.zeros((len(cloud), 16, 3))
    higher[:, : cloud.radiance.shape[1] - 1] = cloud.radiance[:, 1:]
    red, green, blue = (codes(higher[..., c], *bands[:, c], bits) for c, bits in enumerate((11, 10, 11)))
    words = (red | green << 11 | blue << 21).astype("<u4")
    return data, words.view(np.uint8)


def write_lcc(cloud: GaussianCloud, path: Path) -> None:
    """Write a cloud with axes rfu as LCC with bands, one Gaussian of which is also its background."""
    bounds = np.stack([cloud.scales.min(axis=0), cloud.scales.max(axis=0)]).astype(np.float64)
    bands = np.array([[-1.0], [1.0]]) * max(np.abs(cloud.radiance[:, 1:]).max(initial=0.0), 0.1) * np.ones(3)
    data, shcoef = gaussians(cloud, bounds, bands)
    index, order, at = b"", [], 0
    for number, rows in enumerate(regions(cloud)):
        index += np.uint32(number % CELLS | number // CELLS << 16).tobytes()
        for level in (rows, rows[::COARSER]):
            index += np.array([(len(level), at, 32 * len(level))], "<u4,<u8,<u4").tobytes()
            order.append(level)
            at += 32 * len(level)
    rows = np.concatenate(order)
    contents = {"Index.bin": index, "Data.bin": data[rows].tobytes(), "Shcoef.bin": shcoef[rows].tobytes()}
    contents["Environment.bin"] = data[:1].tobytes() + shcoef[:1].tobytes()
    for name, content in contents.items():
        (path.parent / name.lower()).write_bytes(content)
    attributes = {"scale": bounds, "shcoef": bands}
    meta = {
        "version": "5.0",
        "totalSplats": len(rows),
        "totalLevel": 2,
        "indexDataSize": 36,
        "offset": [0, 0, 0],
        "epsg": 0,
        "splats": [len(cloud), len(rows) - len(cloud)],
        "encoding": "COMPRESS",
        "fileType": "Quality",
        "attributes": [
            {"name": name, "min": np.asarray(low).tolist(), "max": np.asarray(high).tolist()}
            for name, (low, high) in attributes.items()
        ],
    }
    path.write_text(json.dumps(meta), encoding="utf-8")


def write_lcc2(cloud: GaussianCloud, path: Path, kind: str, write: Callable[[GaussianCloud, Path], object]) -> None:
    """Write a cloud as LCC2: two leaves of each region share a file, and the coarser level has one of its own.

    Args:
        cloud: Gaussians with axes rfu.
        path: The index.
        kind: Ending of the files, ``.ply``, ``.sog`` or ``.spz``.
        write: Writes Gaussians in that order to such a file; SOG has an order of its own.
    """
    folder = path.parent / "data" / "3dgs"
    folder.mkdir(parents=True, exist_ok=True)
    names, children = list[str](), dict[str, object]()
    for number, rows in enumerate(regions(cloud)):
        files = {f"{number}_0": rows, f"{number}_1": rows[::COARSER]}
        for name, part in files.items():
            names.append(f"data/3dgs/{name}{kind}")
            write(cloud.select(part), path.parent / names[-1])
        half, fine = len(rows) // 2, 2 * number
        runs = [(0, half), (half, len(rows) - half)]
        leaves = [
            {
                "id": f"0-{number}-{place}",
                "childNum": 0,
                "data": {"3dgs": {"name": fine, "start": first, "count": count}},
            }
            for place, (first, count) in enumerate(runs)
        ]
        coarse = {"name": fine + 1, "start": 0, "count": len(rows[::COARSER])}
        children[str(number)] = {
            "id": f"0-{number}",
            "childNum": 2,
            "data": {"3dgs": coarse},
            "child": {str(place): leaf for place, leaf in enumerate(leaves)},
        }
    coarser = sum(len(rows[::COARSER]) for rows in regions(cloud))
    meta = {
        "version": "0.0.3",
        "totalSplats": len(cloud) + coarser,
        "lodSplats": [len(cloud), coarser],
        "totalLevels": 2,
        "splatType": kind,
        "env": None,
        "root": {"id": "0", "childNum": len(children), "splatFiles": names, "child": children},
    }
    path.write_text(json.dumps(meta), encoding="utf-8")
