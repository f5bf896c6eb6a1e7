"""What the page on targets says of how often they are met."""

from __future__ import annotations

from typing import Any

import numpy as np
from tables import Row, Rows, cell, table

TARGETS = "targets_cpu.json"


@table("targets", TARGETS)
def targets(result: Row) -> Rows:
    """Return runs and targets met by command and kind of target, and what was reached beside what was asked."""
    rows: list[list[Any]] = [["command", "target", "runs", "met", "refused first", "reached / asked, median", "worst"]]
    kinds = dict.fromkeys((row["command"], row["target"]) for row in result["rows"])
    for command, name in kinds:
        runs = [row for row in result["rows"] if (row["command"], row["target"]) == (command, name)]
        ratios = [row["reached"] / row["asked"] for row in runs if row["reached"] is not None]
        worst = (min if name == "fps" else max)(ratios)
        refused = sum(row["refused_first"] for row in runs)
        met = sum(row["met"] for row in runs)
        rows.append(
            [
                f"`beam {command}`",
                name,
                str(len(runs)),
                str(met),
                str(refused),
                cell(float(np.median(ratios)), ".2f"),
                cell(worst, ".2f"),
            ]
        )
    rows.append(["all", "", str(result["runs"]), str(result["met"]), "", "", ""])
    return rows


@table("targets_reduce", "targets_reduce_cpu.json")
def of_reduce(result: Row) -> Rows:
    """Return the same for `beam reduce`."""
    return targets(result)


@table("targets_unseen", "targets_h200.json")
def unseen(result: Row) -> Rows:
    """Return the same of targets drawn with another seed, on a GPU."""
    return targets(result)
