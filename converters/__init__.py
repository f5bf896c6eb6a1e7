"""Files in and out, by the table of formats in `beam_warp.converters.formats`; nothing here imports Warp."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from beam_warp.checks import require_path
from beam_warp.converters.common.frames import sequence_of
from beam_warp.converters.common.importers import IMPORTERS
from beam_warp.converters.common.options import Activation, MaterialActivation, ReadOptions
from beam_warp.converters.common.options import WriteOptions as WriteOptions
from beam_warp.converters.formats import FORMATS, decode, format_of, probe, suffix_of
from beam_warp.converters.frame_files import write_frames
from beam_warp.converters.numbering import files_at, require_no_stale_frames
from beam_warp.converters.numbering import numbered_path as numbered_path
from beam_warp.converters.staging import folders_made, require_writable
from beam_warp.errors import InvalidOptionError, MissingFileError
from beam_warp.world.gaussians import GaussianSequence

if TYPE_CHECKING:
    from beam_warp.converters.inspection import Inspection


def read(
    path: str | Path,
    *,
    source_axes: str | None = None,
    meters_per_unit: float | None = None,
    material_activation: MaterialActivation | None = None,
    activation: Activation | None = None,
    drop_invalid: bool = False,
) -> GaussianSequence:
    """Read Gaussians: a file in one of `FORMATS`, or a folder with an asset, a SOG or numbered files of any format.

    What the reader had to assume or leave out is in ``sequence.metadata["notes"]``, one line each; who wrote the
    file, as far as it tells, in ``sequence.metadata["producer"]``.

    Args:
        path: File or folder; frames of a sequence are read when they are asked for.
        source_axes: Axes of the file (see `beam_warp.world.axes`); None takes the file's word, else ``rdf``.
        meters_per_unit: Length of the file's unit [m]; None takes the file's word, else 1.
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
    source = require_path("path", path)
    options = ReadOptions(
        source_axes=source_axes,
        meters_per_unit=meters_per_unit,
        activation=activation,
        material_activation=material_activation,
        drop_invalid=drop_invalid,
    )
    paths = files_at(source)
    form = format_of(paths[0])
    if not paths[0].is_file():
        raise MissingFileError(f"input must be an existing file or folder, got {source}. Check the path.")
    for other in dict.fromkeys(map(format_of, paths)):
        other.require_meaningful(options, source)
    if form.holds_sequences:
        return form.of_reader("read")(paths[0], options)
    for other in paths[1:]:  # so that a truncated file is found before any work is done
        probe(other)
    names = [file.name for file in paths]
    return sequence_of(names[0], names, lambda frame: decode(paths[frame], options), options)


def require_output(path: Path, options: WriteOptions = WriteOptions()) -> None:  # noqa: B008
    """Refuse an output that cannot be written, before any input is read.

    Raises:
        InvalidOptionError: The suffix is none that we write, or does not go with the importer or the axes.
        OutputError: The folder is closed, or cannot be made.
    """
    form = format_of(path)
    if form.writer is None:
        written = ", ".join(suffix for suffix, other in FORMATS.items() if other.writer)
        raise InvalidOptionError(
            f"output's name must end in one of {written}, got {path.name}: {form.name} is only read. Choose another."
        )
    if options.target is not None:
        IMPORTERS[options.target].require_reads(path, suffix_of(path.name))
    if options.axes and form.axes_to_write and options.axes not in form.axes_to_write:
        allowed = " or ".join(form.axes_to_write)
        raise InvalidOptionError(
            f"axes must be {allowed} for {form.name}, which fixes them, got {options.axes}. Leave them out."
        )
    require_writable(path, is_made=True)


def write(sequence: GaussianSequence, path: str | Path, options: WriteOptions = WriteOptions()) -> list[Path]:  # noqa: B008
    """Write Gaussians; the suffix chooses the format, several frames to PLY are numbered from the given name.

    Args:
        sequence: What to write, in metres; its frames are read one at a time.
        path: A name that ends in one of `FORMATS`. Folders that do not exist are made.
        options: Importer, axes, profile, bands, precision.

    Returns:
        The files that were written. They appear whole or not at all.

    Raises:
        InvalidOptionError: The suffix or an option does not fit.
        OutputError: The folder is closed, a file would be too large, or older frames are in the way.
    """
    final = require_path("path", path)
    require_output(final, options)
    form = format_of(final)
    with folders_made(final.parent):
        if form.holds_sequences:
            return form.of_writer("write")(sequence, final, options)
        if len(sequence) > 1 and form.is_index:
            raise InvalidOptionError(
                f"output must have a file for each of {len(sequence)} frames, got {final.name}, which describes one "
                "frame. Write .sog files, or frames to folders of their own."
            )
        if len(sequence) > 1:
            require_no_stale_frames(final, len(sequence))
        return write_frames(sequence, final, options, form)


def inspect(path: str | Path) -> Inspection:
    """Say what a file holds and what it leaves open, without converting it.

    Raises:
        MissingFileError, AssetFormatError, InvalidOptionError: As `read`.
    """
    from beam_warp.converters import inspection

    return inspection.inspect(read(path), Path(path))
