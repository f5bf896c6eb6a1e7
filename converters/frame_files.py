"""Writing of sequences in formats that keep one frame a file: axes, units, numbers, and files that appear together."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from beam_warp.converters.common.frames import FrameToWrite
from beam_warp.converters.common.importers import IMPORTERS, RDF
from beam_warp.converters.common.options import WriteOptions
from beam_warp.converters.formats import Format, suffix_of
from beam_warp.converters.numbering import numbered_path
from beam_warp.converters.staging import folders_made
from beam_warp.image.files import replacing
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import stated_raster

Encode = Callable[[FrameToWrite, Path, WriteOptions], None]
"""Writes one frame to a file, whose place is temporary."""


def written_axes(path: Path, options: WriteOptions, form: Format) -> str | None:
    """Return the axes in which a file is written; None for those of the cloud.

    They are those asked for, else the importer's, which may differ from the format's text, else those of that text,
    else `RDF`: viewers assume it of a file that no importer is named for, and show it upright.
    """
    if options.axes is None and options.target is not None:
        return IMPORTERS[options.target].axes_of(suffix_of(path.name))
    return options.axes or form.axes or (None if form.keeps_axes else RDF)


def write_frames(sequence: GaussianSequence, path: Path, options: WriteOptions, form: Format) -> list[Path]:
    """Write one file, or one for each frame numbered from the given name.

    Axes are those of `written_axes`.

    Raises:
        InvalidOptionError: The metadata that state how the Gaussians are to be drawn break the contract of
            `beam_warp.world.metadata`, or the importer or the format refuses an option.
        OutputError: A file cannot be written; nothing of the call is left behind.
    """
    count = len(sequence)
    paths = [path] if count == 1 else [numbered_path(path, frame) for frame in range(count)]
    raster, others = stated_raster(sequence.metadata), list[Path]()
    importer = IMPORTERS[options.target] if options.target is not None else None
    axes = written_axes(path, options, form)
    units_per_meter = importer.units_per_meter if importer else 1.0
    encode: Encode = form.of_writer("encode")
    with ExitStack() as outputs:

        def beside(name: str) -> Path:
            others.append(path.parent / name)
            outputs.enter_context(folders_made(others[-1].parent))
            return outputs.enter_context(replacing(others[-1]))

        for number, final in enumerate(paths):
            cloud = sequence[number]
            cloud = change_axes(cloud, axes or cloud.axes, scale=units_per_meter)
            frame = FrameToWrite(
                name=final.stem,
                cloud=cloud,
                number=number,
                frames_per_second=sequence.frames_per_second,
                units_per_meter=units_per_meter,
                raster=raster,
                beside=beside,
            )
            degree = importer.sh_degree(cloud.sh_degree or 0, options.sh_degree) if importer else options.sh_degree
            encode(frame, outputs.enter_context(replacing(final)), replace(options, sh_degree=degree))
    return paths + others
