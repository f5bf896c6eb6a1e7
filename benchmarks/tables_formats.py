"""Tables of what is read and written, and of what importers want, from the package's own tables."""

from __future__ import annotations

from tables import Rows, table

from beam_warp.converters.common.importers import IMPORTERS, RDF
from beam_warp.converters.formats import FORMATS, Format


@table("formats")
def formats() -> Rows:
    """Return the formats, with the axes in which each is written."""
    rows = [["format", "files", "in", "out", "written axes"]]
    for name in dict.fromkeys(form.name for form in FORMATS.values()):
        of_name = {suffix: form for suffix, form in FORMATS.items() if form.name == name}
        readable = any(form.reader for form in of_name.values())
        written = next((form for form in of_name.values() if form.writer), None)
        axes = "" if written is None else _axes(written)
        suffixes = ", ".join(f"`{suffix}`" for suffix in of_name)
        rows.append([name, suffixes, "yes" if readable else "", "yes" if written else "", axes])
    return rows


def _axes(form: Format) -> str:
    """Return the axes in which a format is written, in words."""
    if form.keeps_axes:
        return "its own"
    first, others = form.axes or RDF, form.axes_to_write
    return f"{first}, or any" if others is None else ", ".join([first, *others[1:]])


@table("importers")
def importers() -> Rows:
    """Return what to pass for every importer, what to click there, and how this is known."""
    rows = [["importer", "pass", "axes", "unit", "SH degree", "reads", "then", "how this is known"]]
    for importer in dict.fromkeys(IMPORTERS.values()):
        words = " or ".join(f"`--for {word}`" for word, other in IMPORTERS.items() if other is importer)
        (least, greatest), others = importer.sh_degrees, importer.other_axes
        written = [suffix for suffix in importer.suffixes if suffix in FORMATS and FORMATS[suffix].writer]
        rows.append(
            [
                importer.name,
                words,
                ", ".join([importer.axes.upper(), *(f"{axes.upper()} in `{end}`" for end, axes in others.items())]),
                f"1/{importer.units_per_meter:g} m" if importer.units_per_meter != 1.0 else "m",
                f"padded to {least}" if least == greatest else f"{least} to {greatest}",
                ", ".join(f"`{suffix}`" for suffix in written),
                importer.to_do,
                f"{importer.evidence}; {importer.was_run or 'not run'}",
            ]
        )
    return rows
