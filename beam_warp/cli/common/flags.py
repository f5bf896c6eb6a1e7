"""Options that several commands share; how splats are drawn, unless the user overrules what the asset states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from beam_warp import converters
from beam_warp.checks import require_number
from beam_warp.cli.common.pages import SECOND_PAGE
from beam_warp.world.metadata import LOW_PASS_RANGE

if TYPE_CHECKING:
    from beam_warp.raster.records import RasterOptions
    from beam_warp.world.gaussians import GaussianSequence

Antialiased = Annotated[
    Literal["yes", "no"] | None,
    arg(help="Whether splats keep their opacity when the pixel filter widens them; by default as the asset says."),
]
LowPass = Annotated[
    float | None,
    arg(metavar="PX2", help="Variance of the pixel filter; by default as the asset says, 0.3 if it says nothing."),
]
SourceAxes = Annotated[
    str | None, arg(metavar="CODE", help="Where the input's x, y, z point, e.g. rdf; else its word, else rdf.")
]
MetersPerUnit = Annotated[
    float | None, arg(metavar="X", help="Length of the input's unit in metres; else its word, else 1.")
]
DropInvalid = Annotated[bool, arg(help="Leave out rows with NaN or zero quaternions, and say how many.")]
Workers = Annotated[
    str,
    arg(
        metavar="auto|N|gpus|3@gpus|ray://…",
        help="Who works: N processes, one (or 3) on each GPU, or a Ray cluster; by default two on the GPU.",
    ),
]
Keyed = Annotated[bool, arg(help="USD: time samples only where frames between them are not within bounds.")]
Seed = Annotated[int, arg(help="Same seed, same device: same result.")]
Device = Annotated[str | None, arg(help="cpu, cuda:0, …; the first GPU by default, if there is one.")]
Quiet = Annotated[bool, arg(help="Print nothing but errors.")]
Json = Annotated[bool, arg(help="Print the result as JSON.")]


@dataclass(frozen=True)
class ReadingFlags:
    """How an asset is read, and how its splats are drawn."""

    antialiased: Antialiased = None
    low_pass: LowPass = None
    source_axes: SourceAxes = None
    meters_per_unit: Annotated[MetersPerUnit, SECOND_PAGE] = None
    drop_invalid: DropInvalid = False

    def read(self, path: Path) -> GaussianSequence:
        """Read an asset."""
        return converters.read(
            path, source_axes=self.source_axes, meters_per_unit=self.meters_per_unit, drop_invalid=self.drop_invalid
        )

    def raster(self, sequence: GaussianSequence) -> RasterOptions:
        """Return how a sequence is drawn; see `raster_options`."""
        return raster_options(sequence.metadata, self.antialiased, self.low_pass)


def notes_of(sequence: GaussianSequence) -> list[str]:
    """Return the notes of an asset's reader: assumptions, and rows left out."""
    return [line for line in sequence.metadata.get("notes", "").splitlines() if line]


def stated(**options: Any) -> dict[str, Any]:
    """Return the options that were given: those that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def options_of(command: Any, kind: type, **others: Any) -> Any:
    """Return a record of options: those that a command has by the same names, and others."""
    names = {field.name for field in fields(kind)} & {field.name for field in fields(command)}
    return kind(**{name: getattr(command, name) for name in names - set(others)}, **others)


def raster_options(metadata: Mapping[str, str], antialiased: str | None, low_pass: float | None) -> RasterOptions:
    """Return how an asset is drawn: as its metadata say, but for what the user says.

    Raises:
        InvalidOptionError: The low-pass is out of range, or the metadata say something else than a filter.
    """
    from beam_warp.raster.records import RasterOptions

    if low_pass is not None:
        require_number("low-pass", low_pass, *LOW_PASS_RANGE)
    given = stated(antialiased=None if antialiased is None else antialiased == "yes", low_pass=low_pass)
    return replace(RasterOptions.from_metadata(metadata), **given)
