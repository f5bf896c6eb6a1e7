"""What the page on long takes says of takes of many frames on many GPUs."""

from __future__ import annotations

from typing import Any

from tables import Row, Rows, cell, number, table

SCALE = "scale_cpu.json"


@table("scale_takes", SCALE)
def takes(result: Row) -> Rows:
    """Return hours and efficiency by GPUs and length of segments; the last were one process to write the assets."""
    head = ["GPUs", "frames of a segment", "hours", "efficiency", "frames an hour a GPU", "written by one process"]
    return [
        head,
        *(
            [
                f"{row['workers']:,}",
                row["segment"],
                cell(row["hours"], ".1f"),
                f"{row['efficiency']:.0%}",
                cell(row["frames_per_hour_a_worker"], ".0f"),
                f"{cell(row['hours_written_by_one'], '.1f')} h, {row['efficiency_written_by_one']:.0%}",
            ]
            for row in result["takes"]["rows"]
        ),
    ]


@table("scale_check", SCALE)
def check(result: Row) -> Rows:
    """Return the efficiency of processes that sleep beside that of the simulation."""
    rows: list[list[Any]] = [["processes", "steps", "efficiency", "simulated"]]
    for row in result["check"]["rows"]:
        rows.append([row["workers"], row["steps"], f"{row['efficiency']:.1%}", f"{row['simulated_efficiency']:.1%}"])
    return rows


@number("scale_asset_gigabytes", SCALE)
def asset_gigabytes(result: Row) -> float:
    """Return the size of the asset of the take [GB]."""
    return result["takes"]["frames"] * result["constants"]["written"]["bytes"] / 1e9
