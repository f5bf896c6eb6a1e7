"""What the page on long takes says of takes of many frames on many GPUs."""

from __future__ import annotations

from statistics import mean
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
                f"{row['gpus']:,}",
                row["segment"],
                cell(row["hours"], ".1f"),
                f"{row['efficiency']:.0%}",
                cell(row["frames_per_hour_a_gpu"], ".0f"),
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


@table("scale_kills", "kills_real_cpu.json", "kills_real_h200.json", "kills_real_cluster_cpu.json")
def kills(on_cpu: Row, on_gpu: Row, cluster: Row) -> Rows:
    """Return how many were killed in takes of 20 frames that are whole, and what that cost."""
    kinds = {
        "worker": ("worker",),
        "server": ("server",),
        "raylet": ("raylet",),
        "driver": ("driver", "driver at the end"),
    }
    rows: list[list[Any]] = [["", "kills", *(f"of a {kind}" for kind in kinds), "takes", "executions of a step"]]
    for name, found in (
        ("three processes, two CPU cores", on_cpu["processes"]),
        ("three processes, one H200", on_gpu["processes"]),
        ("Ray cluster of three machines, two CPU cores", cluster["cluster"]),
    ):
        counts = [sum(found["killed"].get(name, 0) for name in names) or "" for names in kinds.values()]
        rows.append([name, found["kills"], *counts, found["takes"], f"{found['executions'] / found['steps']:.2f}"])
    return rows


@table("scale_workers_shared", "workers_h200.json")
@table("scale_workers", "workers_h200x2.json")
def workers(result: Row) -> Rows:
    """Return what a take costs processes on GPUs, and how long each kind of step takes."""
    kinds = {"key frame": "key frame", "frame": "tracked frame", "materials": "materials", "preview": "preview"}
    rows: list[list[Any]] = [
        [
            "GPUs",
            "processes",
            "seconds of steps",
            "busy",
            "frames an hour a GPU",
            "efficiency",
            *(f"{kind} [s]" for kind in kinds.values()),
        ]
    ]
    for row in result["take"]["rows"]:
        row = {"gpus": row["workers"], **row}
        row["steps"] = {"key frame": row["steps"]["frame"], **row["steps"]}
        rows.append(
            [
                row["gpus"],
                row["workers"],
                cell(row["working"], ".1f"),
                f"{row['busy']:.0%}",
                cell(row.get("frames_per_hour_a_gpu") or row["frames_per_hour_a_worker"], ".0f"),
                f"{row.get('efficiency', 1.0):.0%}",
                *(cell(row["steps"][kind]["median"], ".1f") for kind in kinds),
            ]
        )
    return rows


@table("scale_start", "start_cpu.json", "workers_start_h200.json")
def start(on_cpu: Row, on_gpu: Row) -> Rows:
    """Return how long a tiny take needs until its first step begins, and in all."""
    parts = {
        "before": "until the first step [s]",
        "working": "steps [s]",
        "after": "after them [s]",
        "whole": "all [s]",
    }
    return [
        ["on", "workers", *parts.values()],
        *(
            [device, row["workers"], *(cell(row[name], ".1f") for name in parts)]
            for device, result in (("two CPU cores", on_cpu), ("an H200", on_gpu))
            for row in result["start"]["rows"]
        ),
    ]


@table("scale_memory_receipts", "memory_cpu.json")
@table("scale_memory", "memory_h200.json")
def memory(result: Row) -> Rows:
    """Return what a process holds after the first tenth of a take and at its end."""
    rows: list[list[Any]] = [
        ["memory", "frames", "first [MB]", "last [MB]", "growth a frame [kB]", "over 1,000 frames"]
    ]
    for kind, found in ((kind, result[kind]) for kind in ("host", "device") if kind in result):
        slope, error = (round(found[name] / 1e3, 1) + 0.0 for name in ("bytes_a_frame", "standard_error"))
        ends = [cell(found[end], ".1f", factor=1e-6) for end in ("first_bytes", "last_bytes")]
        part = 1000.0 * 1e3 * slope / found["first_bytes"]
        rows.append([kind, result["take"]["frames"], *ends, f"{slope:.1f} ± {error:.1f}", f"{part:.1%}"])
    return rows


@table("scale_seams_faded", "seams_cpu.json")
@table("scale_seams", "seams_h200.json")
def seams(result: Row) -> Rows:
    """Return flicker of pairs of frames with a seam between them, of all others, and what the error is."""
    names = {"segments": "segments, cut", "faded": "segments, faded", "one": "one segment"}
    found = {label: result["flicker"][name] for name, label in names.items() if name in result["flicker"]}
    rows: list[list[Any]] = [["pairs of frames", *found]]
    for label, name in (("with a seam between them", "at_seams"), ("all others", "elsewhere")):
        rows.append([label, *(cell(row[name], ".2f") for row in found.values())])
    rows.append(["error itself", *(cell(mean(row["error"]), ".2f") for row in found.values())])
    return rows
