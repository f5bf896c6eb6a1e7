"""Frames as files hold them, and sequences of such files in any format that keeps one frame a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from beam_warp.converters.common.colors import CAPTURED
from beam_warp.converters.common.importers import RDF
from beam_warp.converters.common.options import ReadOptions
from beam_warp.converters.common.vertical import contradictions
from beam_warp.errors import AssetFormatError, InvalidArrayError
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.metadata import raster_metadata

ASSUMED_AXES = "axes are not stated"
"""Beginning of the note on axes that neither the file nor the caller states."""


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
        radiance_meaning: What the colour is, one of `beam_warp.converters.common.colors`; None for captured radiance.
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


@dataclass(frozen=True)
class ReadFrame:
    """A frame in metres, with its provenance and notes."""

    cloud: GaussianCloud
    frames_per_second: float
    provenance: dict[str, str]
    notes: tuple[str, ...]


def overruled(options: ReadOptions, axes: str | None, meters_per_unit: float | None) -> list[str]:
    """Return notes on what a caller states otherwise than the file.

    Args:
        options: What the caller states.
        axes: Axes that the file states or that its format fixes; None if neither.
        meters_per_unit: Length of its unit [m]; None if it states none.
    """
    notes = []
    if options.source_axes is not None and axes not in (None, options.source_axes):
        notes.append(f"axes are taken as {options.source_axes}, by --source-axes; the file says {axes}")
    if options.meters_per_unit is not None and meters_per_unit not in (None, options.meters_per_unit):
        said = f"by --meters-per-unit; the file says {meters_per_unit:g} m"
        notes.append(f"one unit is taken as {options.meters_per_unit:g} m, {said}")
    return notes


def cloud_of(decoded: DecodedFrame, name: str, options: ReadOptions) -> ReadFrame:
    """Settle axes and units of a frame.

    Args:
        decoded: The file as read.
        name: The file's name, for errors.
        options: What the caller states; it outranks what the file states.

    Raises:
        AssetFormatError: Values are outside their contract; the message names file and row.
    """
    fields, notes = dict(decoded.fields), [*decoded.notes, *overruled(options, decoded.axes, decoded.meters_per_unit)]
    units = decoded.meters_per_unit if options.meters_per_unit is None else options.meters_per_unit
    if units != 1.0:
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is infinite, which a cloud refuses
            for array in ("positions", "scales"):
                fields[array] = fields[array] * units
    axes = options.source_axes or decoded.axes
    if axes is None:
        axes = RDF
        notes.append(f"{ASSUMED_AXES}: taken as {axes} (3DGS training); pass --source-axes if they are others")
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
    elif (options.source_axes or decoded.axes) is None:
        notes += contradictions(cloud)
    provenance = {"source_axes": axes, "source_units": "m" if units == 1.0 else f"{units:g} m"}
    if decoded.raster is not None:
        provenance |= raster_metadata(*decoded.raster)
    if cloud.radiance is not None:
        provenance["radiance_meaning"] = decoded.radiance_meaning or CAPTURED
    return ReadFrame(cloud, decoded.frames_per_second, provenance, tuple(notes))


def sequence_of(
    source: str, names: Sequence[str], decode: Callable[[int], DecodedFrame], options: ReadOptions
) -> GaussianSequence:
    """Make a sequence of frames, each of which is read when it is asked for; the first one is read at once.

    Args:
        source: Name of the file or folder.
        names: Name of each frame, for errors.
        decode: Reads the frame of a number.
        options: What the caller states.

    Raises:
        AssetFormatError, MissingFileError: The first frame is refused.
    """
    decoded = decode(0)
    first = cloud_of(decoded, names[0], options)
    return GaussianSequence(
        frame_count=len(names),
        read_frame=lambda frame: cloud_of(decode(frame), names[frame], options).cloud if frame else first.cloud,
        frames_per_second=first.frames_per_second,
        constant=frozenset(first.cloud.arrays()) if len(names) == 1 else frozenset(),
        topology="constant" if len(names) == 1 else "perFrame",  # rows of separate files have no identity
        metadata={
            "source": source,
            "producer": decoded.producer,
            **first.provenance,
            **({"notes": "\n".join(first.notes)} if first.notes else {}),
        },
    )


@dataclass(frozen=True, kw_only=True)
class FrameToWrite:
    """One frame as a file is to hold it.

    Attributes:
        name: Name of the file without its suffix.
        cloud: Gaussians in the axes and the units of the file.
        number: Number of the frame, from 0.
        frames_per_second: Playback rate.
        units_per_meter: Units of the file in a metre.
        raster: How splats are to be drawn: antialiased or not, and the low-pass [px²]; None if that is not stated.
        beside: Returns the temporary place of another file, which appears under the given name together with this one.
            A name may have folders in it, which are made.
    """

    name: str
    cloud: GaussianCloud
    number: int
    frames_per_second: float
    units_per_meter: float
    raster: tuple[bool, float] | None
    beside: Callable[[str], Path]

    @property
    def model(self) -> Literal["antialiased", "2dgs"] | None:
        """What other programs must know to draw the splats: that all are flat along z, or else drawn antialiased."""
        if len(self.cloud) and not self.cloud.scales[:, 2].any():
            return "2dgs"
        return "antialiased" if self.raster is not None and self.raster[0] else None
