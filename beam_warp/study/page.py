"""Tables of studies as one self-contained HTML page: pointing shows settings, toggles choose what is compared."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any

from beam_warp.checks import require_package
from beam_warp.image.files import replacing
from beam_warp.study.table import TOLERANCE, Table

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.2em auto; max-width: 1500px; padding: 0 1em; color: #222; }
h1 { font-size: 1.35em; } h2 { font-size: 1.1em; margin-bottom: 0; }
.controls { display: flex; flex-wrap: wrap; gap: 0.6em; }
fieldset { border: 1px solid #ccc; border-radius: 4px; padding: 0.2em 0.7em; }
fieldset label { margin-right: 0.7em; white-space: nowrap; }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(560px, 100%), 1fr)); gap: 1.2em; }
section { min-width: 0; }
table { border-collapse: collapse; width: 100%; font-size: 0.9em; }
th { text-align: left; color: #555; border-bottom: 1px solid #ccc; } th, td { padding: 0.15em 0.5em; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.1em 1em; font-size: 0.9em; color: #555; }
dt { font-weight: bold; } dd { margin: 0; }
"""


EACH = """
for (const data of JSON.parse(document.getElementById("data").textContent))
  chart(data, document.body.appendChild(document.createElement("main")));
"""
"""Script that draws every table of a page."""


def write_page(tables: Sequence[Table], path: Path) -> None:
    """Write tables, at least one, as one HTML file that needs no network.

    Raises:
        InvalidOptionError: plotly is not installed.
        OutputError: The file cannot be written.
    """
    require_package("plotly")
    from plotly.offline import get_plotlyjs

    script = files("beam_warp.study").joinpath("page.js").read_text(encoding="utf-8")
    # "<" is escaped, so that no text in the data can end the element that holds it
    data = json.dumps([_data(table) for table in tables], ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(tables[0].subject.title)}</title>\n<style>{STYLE}</style>\n"
        f"<script>{get_plotlyjs()}</script>\n</head>\n<body>\n"
        f'<script type="application/json" id="data">{data}</script>\n'
        f"<script>function chart(data, root) {{\n{script}}}{EACH}</script>\n</body>\n</html>\n"
    )
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _data(table: Table) -> dict[str, Any]:
    """Return a table as the page's script reads it: an interval is [value, low, high]."""

    rows = [{"settings": dict(row.settings), "cost": row.cost, "errors": dict(row.errors)} for row in table.rows]
    return {"subject": asdict(table.subject), "rows": rows, "tolerance": TOLERANCE}
