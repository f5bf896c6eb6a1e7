"""Tables of what is read and written, and of what importers want, from the package's own tables."""

from __future__ import annotations

from tables import Rows, table

from beam_warp.converters.common.importers import IMPORTERS
from beam_warp.converters.formats import FORMATS


@table("formats")
def formats() -> Rows:
    """Return the formats, with the axes in which each is written."""
    rows = [["format", "files", "in", "out", "written axes"]]
    for name in dict.fromkeys(form.name for form in FORMATS.values()):
        of_name = {suffix: form for suffix, form in FORMATS.items() if form.name == name}
        readable = any(form.reader for form in of_name.values())
        written = next((form for form in of_name.values() if form.writer), None)
        axes = "" if written is None else written.axes or ("its own" if written.keeps_axes else "rdf, or any")
        suffixes = ", ".join(f"`{suffix}`" for suffix in of_name)
        rows.append([name, suffixes, "yes" if readable else "", "yes" if written else "", axes])
    return rows


@table("importers")
def importers() -> Rows:
    """Return what to pass for every importer, what to click there, and how this is known."""
    rows = [["importer", "pass", "axes", "unit", "SH degree", "reads", "then", "how this is known"]]
    for importer in dict.fromkeys(IMPORTERS.values()):
        words = " or ".join(f"`--for {word}`" for word, other in IMPORTERS.items() if other is importer)
        least, greatest = importer.sh_degrees
        written = [suffix for suffix in importer.suffixes if suffix in FORMATS and FORMATS[suffix].writer]
        rows.append(
            [
                importer.name,
                words,
                importer.axes.upper(),
                f"1/{importer.units_per_meter:g} m" if importer.units_per_meter != 1.0 else "m",
                f"padded to {least}" if least == greatest else f"{least} to {greatest}",
                ", ".join(f"`{suffix}`" for suffix in written),
                importer.to_do,
                f"{importer.evidence}; {importer.was_run or 'not run'}",
            ]
        )
    return rows
