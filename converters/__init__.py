"""Files in and out: one table of formats.

A format is a module with ``read(path, options)`` and ``write(sequence, path, options)``, imported when its suffix is
met, so that PLY costs no USD; nothing here imports Warp.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beam_warp.converters.numbering import numbered_files, require_no_stale_frames
from beam_warp.converters.numbering import numbered_path as numbered_path
from beam_warp.converters.options import Activation, MaterialActivation, ReadOptions
from beam_warp.converters.options import WriteOptions as WriteOptions
from beam_warp.converters.staging import require_writable
from beam_warp.errors import InvalidOptionError, MissingFileError
from beam_warp.world.gaussians import GaussianSequence

if TYPE_CHECKING:
    from beam_warp.converters.inspection import Inspection


FORMATS = {".ply": ("ply", "ply_writer"), **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), ("usd", "usd"))}
"""Suffix → the modules of this package that read and write files of that format."""


def _modules_of(path: Path) -> tuple[str, str]:
    if path.suffix.lower() not in FORMATS:
        raise InvalidOptionError(
            f"file name must end in one of {', '.join(FORMATS)}, got {path.name}. Rename it or convert it elsewhere."
        )
    return FORMATS[path.suffix.lower()]


def _module(name: str) -> Any:
    """Import a format's module, now that it is needed."""
    return import_module(f"beam_warp.converters.{name}")


def read(
    path: str | Path,
    *,
    source_axes: str | None = None,
    meters_per_unit: float | None = None,
    material_activation: MaterialActivation | None = None,
    activation: Activation | None = None,
    drop_invalid: bool = False,
) -> GaussianSequence:
    """Read Gaussians: a PLY or USD file, or a folder of numbered PLY files.

    What the reader had to assume or leave out is in ``sequence.metadata["notes"]``, one line each; who wrote the
    file, as far as it tells, in ``sequence.metadata["producer"]``.

    Args:
        path: File, or folder of numbered files; frames of a folder are read when they are asked for.
        source_axes: Axes of a PLY (see `beam_warp.world.axes`); None takes the file's word, else ``rdf``.
        meters_per_unit: Length of a PLY's unit [m]; None takes the file's word, else 1.
        material_activation: Whose material channels a PLY holds; None reads only those that state their form.
        activation: ``linear`` for a PLY with linear scales and opacities, ``log`` to accept one that looks so.
        drop_invalid: Leave out rows with non-finite values or zero quaternions instead of refusing the file.

    Returns:
        Clouds in metres, in the axes that each states.

    Raises:
        MissingFileError: There is nothing at ``path``.
        AssetFormatError: The content is malformed; the message names file, place and remedy.
        InvalidOptionError: An option or the suffix is not one.
    """
    source = Path(path)
    options = ReadOptions(
        source_axes=source_axes,
        meters_per_unit=meters_per_unit,
        activation=activation,
        material_activation=material_activation,
        drop_invalid=drop_invalid,
    )
    if source.is_dir():
        return _module("ply").read_numbered(numbered_files(source), options)
    reader, _ = _modules_of(source)
    if not source.is_file():
        raise MissingFileError(f"input must be an existing file or folder, got {source}. Check the path.")
    return _module(reader).read(source, options)


def require_output(path: Path) -> None:
    """Refuse an output that cannot be written, before any input is read.

    Raises:
        InvalidOptionError: The suffix is none that we write.
        OutputError: The folder is missing or closed.
    """
    _modules_of(path)
    if path.name.lower().endswith(".compressed.ply"):
        raise InvalidOptionError(
            f"output must be a plain .ply, got {path.name}: the compressed form is only read. Drop .compressed."
        )
    require_writable(path)


def write(sequence: GaussianSequence, path: str | Path, options: WriteOptions = WriteOptions()) -> list[Path]:  # noqa: B008
    """Write Gaussians; the suffix chooses the format, several frames to PLY are numbered from the given name.

    Args:
        sequence: What to write, in metres; its frames are read one at a time.
        path: ``.ply`` or ``.usd``, ``.usda``, ``.usdc``, ``.usdz``, in a folder that exists.
        options: Target, profile, bands, precision.

    Returns:
        The files that were written. They appear whole or not at all.

    Raises:
        InvalidOptionError: The suffix or an option does not fit.
        OutputError: The folder is missing or closed, a file would be too large, or older frames are in the way.
    """
    final = Path(path)
    require_output(final)
    if final.suffix.lower() == ".ply" and len(sequence) > 1:
        require_no_stale_frames(final, len(sequence))
    _, writer = _modules_of(final)
    return _module(writer).write(sequence, final, options)


def inspect(path: str | Path) -> Inspection:
    """Say what a file holds and what it leaves open, without converting it.

    Raises:
        MissingFileError, AssetFormatError, InvalidOptionError: As `read`.
    """
    return _module("inspection").inspect(read(path), Path(path))
