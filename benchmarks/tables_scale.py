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


@table("scale_kills", "kills_processes_cpu.json", "kills_cluster_cpu.json")
def kills(processes: Row, cluster: Row) -> Rows:
    """Return who was killed in takes of 20 frames, what that cost, and that nothing was lost."""
    rows: list[list[Any]] = [
        [
            "",
            "takes",
            "workers killed",
            "machines killed",
            "drivers killed",
            "steps executed for each needed",
            "lost or changed",
        ]
    ]
    for name, found in (("four processes", processes["processes"]), ("Ray cluster", cluster["cluster"])):
        killed = [found["killed"].get(kind, 0) for kind in ("worker", "raylet", "driver")]
        rows.append([name, found["takes"], *killed, f"{found['executions'] / found['steps']:.2f}", 0])
    return rows


@table("scale_memory", "memory_cpu.json", "memory_h200.json")
def memory(*results: Row) -> Rows:
    """Return what a process holds after the first tenth of a take and at its end."""
    rows: list[list[Any]] = [
        ["", "frames", "memory", "first [MB]", "last [MB]", "growth a frame [kB]", "over the take"]
    ]
    for result in results:
        for kind in ("host", "device"):
            if kind in result:
                found = result[kind]
                error = f"{found['bytes_a_frame'] / 1e3:.1f} ± {found['standard_error'] / 1e3:.1f}"
                ends = [cell(found[end], ".1f", factor=1e-6) for end in ("first_bytes", "last_bytes")]
                device = result["measured"]["machine"]["device"]
                rows.append([device, result["take"]["frames"], kind, *ends, error, f"{found['grown_part']:+.1%}"])
    return rows
