"""USD as a format of `beam_warp.converters`, by the reader and writer of `beam_warp.schema`."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from pathlib import Path

from beam_warp.converters.colors import resize_bands
from beam_warp.converters.options import ReadOptions, WriteOptions
from beam_warp.errors import InvalidOptionError
from beam_warp.schema.reader import read_asset
from beam_warp.schema.writer import write_asset
from beam_warp.world.axes import TARGETS, change_axes
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence


def read(path: Path, options: ReadOptions) -> GaussianSequence:
    """Read an asset; a stage states its own axes, units and activations."""
    del options  # none means anything here
    return read_asset(path)


def write(sequence: GaussianSequence, path: Path, options: WriteOptions) -> list[Path]:
    """Write an asset, y up and in metres.

    Raises:
        InvalidOptionError: The axes of another target are requested.
    """
    if options.target not in (None, "usd"):
        raise InvalidOptionError(
            f"target must be usd for a USD output, got {options.target}. Write PLY for {options.target}."
        )
    axes, _ = TARGETS["usd"]

    @lru_cache(maxsize=1)  # a writer asks for the first frame more than once
    def prepared(frame: int) -> GaussianCloud:
        cloud = change_axes(sequence[frame], axes)
        if cloud.radiance is None or options.sh_degree is None:
            return cloud
        return cloud.with_arrays(radiance=resize_bands(cloud.radiance, options.sh_degree))

    # Notes tell of the reading of another file; in this asset they would be told again of a file that is sound.
    provenance = {key: value for key, value in sequence.metadata.items() if key != "notes"}
    prepared_sequence = dataclasses.replace(sequence, read_frame=prepared, metadata=provenance)
    return write_asset(
        prepared_sequence, path, full_float=options.full_float, lighting_variants=options.lighting_variants
    )
