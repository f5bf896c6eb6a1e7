"""Frames as files hold them, and sequences of such files in any format that keeps one frame a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beam_warp.converters.colors import CAPTURED
from beam_warp.converters.options import ReadOptions
from beam_warp.errors import AssetFormatError, InvalidArrayError
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.metadata import raster_metadata

DEFAULT_AXES = "rdf"
"""Axes of a file that does not state any: those of COLMAP, in which 3DGS is trained."""


@dataclass(frozen=True, kw_only=True)
class DecodedFrame:
    """One file as read, in its own axes and units.

    Attributes:
        fields: Arrays of a `beam_warp.world.gaussians.GaussianCloud` by name, activated (linear scales and opacities,
            unit quaternions xyzw), and ``radiance_color_space`` if there is radiance.
        format: Container, encoding and layout, in words.
        producer: Program that wrote the file, with the evidence.
        axes: Axes that the file states or that its format fixes; None if neither.
        meters_per_unit: Length of one unit of the file [m].
        frames_per_second: Playback rate.
        color_space_is_stated: True if the file or its format says in which colour space its colour is.
        radiance_meaning: What the colour is, one of `beam_warp.converters.colors`; None for captured radiance.
        raster: How splats are to be drawn: antialiased or not, and the low-pass [px²]; None if that is not stated.
        comments: Lines that the file carries for people.
        notes: Assumptions and omissions of the reader, one line each.
    """

    fields: Mapping[str, Any]
    format: str
    producer: str = "unknown"
    axes: str | None = None
    meters_per_unit: float = 1.0
    frames_per_second: float = 30.0
    color_space_is_stated: bool = False
    radiance_meaning: str | None = None
    raster: tuple[bool, float] | None = None
    comments: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())


Decode = Callable[[Path, ReadOptions], DecodedFrame]
"""Reads a file whole."""

Probe = Callable[[Path], Any]
"""Reads a file's header and refuses one that is malformed or truncated, at the cost of no more than its header."""


@dataclass(frozen=True)
class ReadFrame:
    """A frame in metres, with its provenance and notes."""

    cloud: GaussianCloud
    frames_per_second: float
    provenance: dict[str, str]
    notes: tuple[str, ...]


def cloud_of(decoded: DecodedFrame, name: str, options: ReadOptions) -> ReadFrame:
    """Settle axes and units of a frame.

    Args:
        decoded: The file as read.
        name: The file's name, for errors.
        options: What the caller states; it outranks what the file states.

    Raises:
        AssetFormatError: Values are outside their contract; the message names file and row.
    """
    fields, notes = dict(decoded.fields), list(decoded.notes)
    units = decoded.meters_per_unit if options.meters_per_unit is None else options.meters_per_unit
    if units != 1.0:
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is infinite, which a cloud refuses
            for array in ("positions", "scales"):
                fields[array] = fields[array] * units
    axes = options.source_axes or decoded.axes
    if axes is None:
        axes = DEFAULT_AXES
        notes.append(f"axes are not stated: taken as {axes} (3DGS training); pass --source-axes if they are others")
    try:
        if options.drop_invalid:
            cloud, invalid = GaussianCloud.leaving_out_invalid(**fields, axes=axes)
            if len(invalid):
                notes.append(f"{len(invalid)} of {len(cloud) + len(invalid)} Gaussians dropped: {invalid}")
        else:
            cloud = GaussianCloud(**fields, axes=axes)
    except InvalidArrayError as error:
        raise AssetFormatError(f"{name}: {error}") from error
    if not len(cloud):
        notes.append("holds no Gaussians")
    provenance = {"source_axes": axes, "source_units": "m" if units == 1.0 else f"{units:g} m"}
    if decoded.raster is not None:
        provenance |= raster_metadata(*decoded.raster)
    if cloud.radiance is not None:
        provenance["radiance_meaning"] = decoded.radiance_meaning or CAPTURED
    return ReadFrame(cloud, decoded.frames_per_second, provenance, tuple(notes))


def sequence_of(paths: Sequence[Path], decode: Decode, probe: Probe, options: ReadOptions) -> GaussianSequence:
    """Make a sequence of files, each of which is read when its frame is asked for.

    All headers are checked at once, so that a truncated file is found before any work is done.

    Raises:
        AssetFormatError, MissingFileError: A header or the first frame is refused.
    """
    for path in paths[1:]:
        probe(path)
    decoded = decode(paths[0], options)
    first = cloud_of(decoded, paths[0].name, options)
    return GaussianSequence(
        frame_count=len(paths),
        read_frame=lambda frame: (
            cloud_of(decode(paths[frame], options), paths[frame].name, options).cloud if frame else first.cloud
        ),
        frames_per_second=first.frames_per_second,
        constant=frozenset(first.cloud.arrays()) if len(paths) == 1 else frozenset(),
        topology="constant" if len(paths) == 1 else "perFrame",  # rows of separate files have no identity
        metadata={
            "source": paths[0].name,
            "producer": decoded.producer,
            **first.provenance,
            **({"notes": "\n".join(first.notes)} if first.notes else {}),
        },
    )
