"""Two commits beside each other: what a change costs, from results of the same benchmarks on both trees.

    python benchmarks/compare.py --before A1.json A2.json --after B1.json B2.json --commits 99364bf 4dd7d0f --out C.json

Run the benchmarks on one machine, the trees in turns. Every figure that has a median and a range in results of both
trees becomes a row. A row whose ranges do not overlap is printed: the change made it faster or slower.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

RANGE = {"median", "lowest", "highest"}
REPEATS = {"all_ms", "seconds"}
"""Lists of every repeat, from which median and range are taken."""


def figures(result: Any, name: str = "") -> Iterator[tuple[str, Mapping[str, float]]]:
    """Return every figure with a median and a range, by the names on the way to it."""
    if not isinstance(result, dict):
        return
    if set(result) >= RANGE:
        yield name, result
        return
    for key, value in result.items():
        if key in REPEATS and isinstance(value, list):
            yield f"{name}, {key}", {"median": median(value), "lowest": min(value), "highest": max(value)}
        else:
            yield from figures(value, f"{name}, {key}" if name else key)


def compare(before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the figures of both trees, run by run and their whole range, with the ratio of medians."""
    trees = []
    for results in (before, after):
        found = defaultdict(list)
        for result in results:
            for name, figure in figures(result, result.get("benchmark", "")):
                found[name].append(figure)
        trees.append(found)
    rows = {}
    for name in trees[0]:
        if name in trees[1]:
            old, new = (_row(tree[name]) for tree in trees)
            is_apart = old["highest"] < new["lowest"] or new["highest"] < old["lowest"]
            ratio = median(new["medians"]) / median(old["medians"])
            rows[name] = {"before": old, "after": new, "after_over_before": round(ratio, 4), "apart": is_apart}
    return rows


def _row(runs: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Put a figure of several runs together."""
    lowest, highest = min(run["lowest"] for run in runs), max(run["highest"] for run in runs)
    return {"medians": [run["median"] for run in runs], "lowest": lowest, "highest": highest}


def main() -> int:
    """Compare results and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for tree in ("before", "after"):
        parser.add_argument(f"--{tree}", nargs="+", type=Path, required=True, metavar="JSON", help=f"results {tree}")
    parser.add_argument("--commits", nargs=2, required=True, metavar=("BEFORE", "AFTER"), help="what was measured")
    parser.add_argument("--out", type=Path, required=True, help="JSON to write")
    given = parser.parse_args()
    trees = [[json.loads(path.read_text("utf-8")) for path in paths] for paths in (given.before, given.after)]
    rows = compare(*trees)
    last = trees[1][-1]
    written = {
        "benchmark": "compare",
        "commits": dict(zip(("before", "after"), given.commits, strict=True)),
        "machine": last.get("machine"),
        "versions": last.get("versions"),
        "rows": rows,
    }
    given.out.write_text(json.dumps(written, indent=1) + "\n", "utf-8")
    apart = {name: row for name, row in rows.items() if row["apart"]}
    print(f"{len(rows)} rows, the ranges of {len(apart)} apart")
    for name, row in apart.items():
        print(f"  {row['after_over_before']:6.3f} x  {name}: {row['before']['medians']} → {row['after']['medians']}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
