"""The table of formats: which suffix is read and written by which module.

A module that reads has ``decode(path, options)`` and ``probe(path)``, or, if its files hold sequences,
``read(path, options)``. A module that writes has ``encode(frame, path, options)``, or, if its files hold sequences,
``write(sequence, path, options)``. Frames in and out are described in `beam_warp.converters.common.frames`. Modules
are imported when their suffix is met, so that PLY costs no USD.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from beam_warp.converters.common.options import ReadOptions
from beam_warp.errors import InvalidOptionError

OF_ANY_FORMAT = frozenset({"source_axes", "meters_per_unit", "drop_invalid"})
"""Options of `beam_warp.converters.common.options.ReadOptions` that say something of every format."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """One format.

    Attributes:
        name: What people call it.
        reader: Module of this package that reads it; None if it is only written.
        writer: Module of this package that writes it; None if it is only read.
        holds_sequences: True if one file holds all frames.
        is_index: True if the file describes one frame whose Gaussians lie in files beside it or in folders there.
        axes: Axes that the format's text asks for; None if it says nothing.
        axes_to_write: Axes that a file may be written in; None if any.
        keeps_axes: True if a file states its axes and no viewer reads it, so that it is written in those of the cloud.
        read_options: Options of `ReadOptions` that mean something for it.
    """

    name: str
    reader: str | None = None
    writer: str | None = None
    holds_sequences: bool = False
    is_index: bool = False
    axes: str | None = None
    axes_to_write: tuple[str, ...] | None = None
    keeps_axes: bool = False
    read_options: frozenset[str] = OF_ANY_FORMAT

    def of_reader(self, function: str) -> Callable[..., Any]:
        """Return a function of the reading module."""
        return getattr(import_module(f"beam_warp.converters.{self.reader}"), function)

    def of_writer(self, function: str) -> Callable[..., Any]:
        """Return a function of the writing module."""
        return getattr(import_module(f"beam_warp.converters.{self.writer}"), function)

    def require_meaningful(self, options: ReadOptions, path: Path) -> None:
        """Refuse options that say nothing of this format.

        Raises:
            InvalidOptionError: One is given.
        """
        defaults = ReadOptions()
        given = [f.name for f in dataclasses.fields(options) if getattr(options, f.name) != getattr(defaults, f.name)]
        if without := [name for name in given if name not in self.read_options]:
            raise InvalidOptionError(
                f"{', '.join(without)} must be left out for {self.name}, where it means nothing, got {path.name}. "
                "Drop the option."
            )


_USD = Format(
    name="USD",
    reader="usd",
    writer="usd",
    holds_sequences=True,
    axes="rub",
    axes_to_write=("rub",),
    read_options=OF_ANY_FORMAT - {"drop_invalid"},
)
_GLTF = Format(
    name="glTF",
    reader="gltf.reader",
    writer="gltf.writer",
    axes="rub",
    axes_to_write=("rub", "luf", "bul", "fur"),  # those with y up of a right hand
)
_DELIVERY = Format(
    name="b4d",
    reader="delivery.reader",
    writer="delivery.writer",
    holds_sequences=True,
    axes="rub",
    axes_to_write=("rub",),
)
_H5 = Format(name="HDF5", reader="arrays", holds_sequences=True)

FORMATS: dict[str, Format] = {
    ".ply": Format(
        name="PLY",
        reader="ply.reader",
        writer="ply.writer",
        read_options=OF_ANY_FORMAT | {"activation", "material_activation"},
    ),
    ".compressed.ply": Format(name="compressed PLY", reader="ply.reader", writer="ply.compressed_writer"),
    ".spz": Format(name="SPZ", reader="spz.reader", writer="spz.writer", axes="rub"),
    **dict.fromkeys((".gltf", ".glb"), _GLTF),
    ".sog": Format(name="SOG", reader="sog.reader", writer="sog.writer"),
    "meta.json": Format(name="SOG", reader="sog.reader", writer="sog.writer", is_index=True),
    "lod-meta.json": Format(name="streamed SOG", reader="sog.streamed", writer="sog.streamed_writer", is_index=True),
    ".lcc": Format(name="LCC", reader="lcc", is_index=True),
    ".lcc2": Format(name="LCC2", reader="lcc2", is_index=True),
    ".splat": Format(name="splat", reader="splat", writer="splat"),
    ".ksplat": Format(name="ksplat", reader="ksplat"),
    ".npz": Format(name="NumPy", reader="arrays", writer="arrays", keeps_axes=True),
    **dict.fromkeys((".h5", ".hdf5"), _H5),
    ".zip": Format(
        name="zipped frames",
        reader="zipped",
        holds_sequences=True,
        read_options=OF_ANY_FORMAT | {"activation", "material_activation"},
    ),
    **dict.fromkeys((".b4d", "manifest.json"), _DELIVERY),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _USD),
}
"""Suffix → format. Of two suffixes that fit a name, the longer one counts."""


def suffix_of(name: str) -> str:
    """Return the suffix of `FORMATS` in which a file's name ends, or an empty string."""
    return max((suffix for suffix in FORMATS if name.lower().endswith(suffix)), key=len, default="")


def format_of(path: Path) -> Format:
    """Return the format that a file's name tells.

    Raises:
        InvalidOptionError: No format has such names.
    """
    if suffix := suffix_of(path.name):
        return FORMATS[suffix]
    raise InvalidOptionError(
        f"file name must end in one of {', '.join(FORMATS)}, got {path.name}. Rename it or convert it elsewhere."
    )


def decode(path: Path, options: ReadOptions) -> Any:
    """Read a file that holds one frame by the module of its format; see `beam_warp.converters.common.frames`."""
    return format_of(path).of_reader("decode")(path, options)


def probe(path: Path) -> None:
    """Refuse a file that holds one frame and is malformed, as far as its header tells."""
    format_of(path).of_reader("probe")(path)
