"""What the page on Blender says of Cycles against our path tracer."""

from __future__ import annotations

from tables import Row, Rows, cell, table


@table("blender", "blender_cpu.json")
def blender(result: Row) -> Rows:
    """Return each probe under each light: how far Cycles' picture is from ours."""
    rows = [["probe", "Gaussians", "light", "PSNR [dB]", "of alpha [dB]", "brightness"]]
    for row in result["rows"]:
        scores = [cell(row[name], ".1f") for name in ("psnr", "alpha_psnr")]
        count = f"{row['gaussians']:,}"
        rows.append([row["probe"], count, row["light"], *scores, cell(row["brightness"], ".3f")])
    return rows
