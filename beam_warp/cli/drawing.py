"""Options of commands that draw an asset: it says itself how it is to be drawn, and the user may say otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

if TYPE_CHECKING:
    from beam_warp.raster.records import RasterOptions

Antialiased = Annotated[
    Literal["yes", "no"] | None,
    arg(help="Whether splats keep their opacity when the pixel filter widens them; by default as the asset says."),
]

LowPass = Annotated[
    float | None,
    arg(metavar="PX2", help="Variance of the pixel filter; by default as the asset says, 0.3 if it says nothing."),
]


def raster_options(metadata: Mapping[str, str], antialiased: str | None, low_pass: float | None) -> RasterOptions:
    """Return how an asset is drawn: as its metadata say, but for what the user says.

    Raises:
        InvalidOptionError: The low-pass is out of range, or the metadata say something else than a filter.
    """
    from beam_warp.raster.records import RasterOptions

    given: dict[str, Any] = {} if antialiased is None else {"antialiased": antialiased == "yes"}
    if low_pass is not None:
        given["low_pass"] = low_pass
    return replace(RasterOptions.from_metadata(metadata), **given)
