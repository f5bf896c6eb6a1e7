"""USD as a format of `beam_warp.converters`, by the reader and writer of `beam_warp.schema`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from beam_warp.converters.common.colors import resize_bands
from beam_warp.converters.common.frames import overruled
from beam_warp.converters.common.importers import IMPORTERS
from beam_warp.converters.common.options import ReadOptions, WriteOptions
from beam_warp.schema.files import unaligned_files
from beam_warp.schema.reader import read_asset
from beam_warp.schema.stage_queries import open_asset, stage_axes, stage_meters
from beam_warp.schema.writer import WrittenClips, write_asset
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence

MOST_KEPT = 2**29
"""Frames that a writer keeps in memory, at most, and one more [byte]."""


def read(path: Path, options: ReadOptions) -> GaussianSequence:
    """Read an asset; axes and units that the caller states outrank those of the stage, with a note."""
    sequence = read_asset(path)
    notes = sequence.metadata.get("notes", "").splitlines()
    if path.suffix.lower() == ".usdz" and (unaligned := unaligned_files(path)):
        notes.append(f"{len(unaligned)} files of the package are not 64-byte aligned, as USDZ demands: read anyway")
    read_frame = sequence.read_frame
    if options.source_axes is not None or options.meters_per_unit is not None:
        source, stage = open_asset(path, trusted=True)
        axes, meters = stage_axes(stage, source), stage_meters(stage, source)
        notes += overruled(options, axes, meters)
        read_frame = _Overruled(sequence, options.source_axes or axes, (options.meters_per_unit or meters) / meters)
    metadata = {**sequence.metadata, "notes": "\n".join(notes)} if notes else sequence.metadata
    return dataclasses.replace(sequence, read_frame=read_frame, metadata=metadata)


@dataclasses.dataclass(frozen=True)
class _Overruled:
    """Reads frames of an asset whose axes and units the caller states.

    Attributes:
        sequence: The asset as it states itself.
        axes: Axes in which its coordinates are taken.
        scale: Length of the caller's unit in that of the asset.
    """

    sequence: GaussianSequence
    axes: str
    scale: float

    def __call__(self, frame: int) -> GaussianCloud:
        """Return one frame."""
        cloud = self.sequence[frame]
        return change_axes(cloud, cloud.axes, scale=self.scale).with_arrays(axes=self.axes)


def write(
    sequence: GaussianSequence, path: Path, options: WriteOptions, clips: WrittenClips | None = None
) -> list[Path]:
    """Write an asset, y up and in metres, or complete one whose clips are written."""
    whole = prepared(sequence, options.sh_degree)
    return write_asset(
        dataclasses.replace(whole, read_frame=_kept(whole.read_frame)),
        path,
        full_float=options.full_float,
        lighting_variants=options.lighting_variants,
        clips=clips,
    )


def _kept(read: Callable[[int], GaussianCloud]) -> Callable[[int], GaussianCloud]:
    """Return a reader that keeps some frames: a writer reads each twice, which for short sequences makes once."""
    kept: dict[int, GaussianCloud] = {}

    def again(frame: int) -> GaussianCloud:
        if frame not in kept:
            if sum(array.nbytes for cloud in kept.values() for array in cloud.arrays().values()) > MOST_KEPT:
                kept.clear()
            kept[frame] = read(frame)
        return kept[frame]

    return again


def prepared(sequence: GaussianSequence, sh_degree: int | None = None) -> GaussianSequence:
    """Return a sequence as it is written: y up, with radiance of a degree."""
    axes = IMPORTERS["usd"].axes

    @lru_cache(maxsize=1)  # a writer asks for the first frame more than once
    def read(frame: int) -> GaussianCloud:
        cloud = change_axes(sequence[frame], axes)
        if cloud.radiance is None or sh_degree is None:
            return cloud
        return cloud.with_arrays(radiance=resize_bands(cloud.radiance, sh_degree))

    # Notes tell of the reading of another file; in this asset they would be told again of a file that is sound.
    provenance = {key: value for key, value in sequence.metadata.items() if key != "notes"}
    return dataclasses.replace(sequence, read_frame=read, metadata=provenance)
