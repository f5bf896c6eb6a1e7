"""What the page on the web module says of its speed and memory."""

from __future__ import annotations

from tables import Row, Rows, cell, table

WEB = "web_player_cpu.json"


@table("web_players", WEB)
def players(result: Row) -> Rows:
    """Return how long seeking takes on each backend, and what playing keeps."""
    head = ["backend", "Gaussians", "frames", "opened [ms]", "decoded [ms]", "seek, median [ms]", "seek, longest [ms]"]
    rows = [[*head, "pictures/s", "played [s]", "heap grew [MB]", "textures [MB]", "textures grew [MB]"]]
    take = result["take"]
    for row in result["players"]["rows"]:
        last = row["samples"][-1]
        times = [cell(row[name], ".0f") for name in ("open_ms", "decode_ms", "seek_ms", "seek_worst_ms")]
        kept = [
            cell(row["heap_growth_mb"], ".1f"),
            cell(last["texture_mb"], ".0f"),
            cell(row["texture_growth_mb"], ".1f"),
        ]
        rate, length = cell(row["pictures_a_second"], ".1f"), cell(last["seconds"], ".0f")
        rows.append([row["name"], f"{take['gaussians']:,}", str(take["frames"]), *times, rate, length, *kept])
    return rows
