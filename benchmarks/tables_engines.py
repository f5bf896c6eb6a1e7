"""What the pages on engines say of pictures against the deferred renderer."""

from __future__ import annotations

from typing import Any

from tables import Row, Rows, cell, table

ENGINES = "engine_shading_cpu.json"


@table("engine_shading", ENGINES)
def shading(result: Row) -> Rows:
    """Return PSNR by probe, lighting and language."""
    rows: list[list[Any]] = [["probe", "light", "WGSL [dB]", "HLSL [dB]", "GLSL ES [dB]"]]
    for row in result["rows"]:
        values = [cell(row["psnr"].get(target), ".0f") for target in ("wgsl", "hlsl", "glsl")]
        rows.append([row["probe"], row["lighting"], *values])
    return rows
