"""Which deliberate bugs does ``make test`` let through? ``python -P tests/tools/mutants.py --work W --out O``.

Mutants are drawn evenly over the areas of `mutations.AREAS`. Each is put into a copy of the tree with a copy of Warp's
compiled kernels. The tests of the healthy tree, run once, tell which test files reach which functions: a mutant meets
the files that reach its function, those of its own module and package first, until one fails.

``O/results.jsonl`` gets a line a mutant, so that a stopped run goes on; ``O/mutants.json`` sums up and
``O/survivors.json`` can be given to ``--only``, with ``--all-tests`` to try the other tests on them.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from tools.mutations import AREAS, Mutant, compiles, drawn
from tools.reach import COMPARES_TEXT, Reach, importers_of, measured
from tools.trees import ROOT, Tree, installed

INVALID = ("Error while parsing function", "WarpCodegen", "Failed to load CPU module", "build failed")
"""What Warp says of a kernel that it cannot compile."""

TIMES, SLACK, COMPILING = 8.0, 60.0, 240.0
"""A test may take so many times as long as without the mutant, and some seconds more: a lot if kernels are compiled."""


def judged(mutant: Mutant, tree: Tree, reach: Reach, budget: float, passed: list[str], stop: float) -> dict[str, Any]:
    """Put a mutant into a tree, run the tests that reach it, and say what became of it."""
    path = tree.folder / installed(mutant.file)
    source, status = path.read_bytes(), path.stat()
    started = time.monotonic()
    files, first, left_out = reach.plan(mutant, budget)
    if budget == float("inf"):
        files += sorted(set(reach.seconds) - set(files), key=lambda file: reach.seconds[file])
    files = [file for file in files if file not in passed]
    result = {**asdict(mutant), "verdict": "survived", "test": None, "passed": passed + files, "left_out": left_out}
    path.write_bytes(mutant.applied(source))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns + 10**12))  # compiled Python of equal size is not taken
    slack = COMPILING if mutant.area == "kernels" else SLACK
    scratch = tree.folder.parent / "scratch"
    try:
        for group in filter(None, (files[:4], files[4:])):
            plan, doing = tree.folder.parent / "plan.json", tree.folder.parent / "doing"
            limits = {test: slack + TIMES * found["seconds"] for test, found in reach.tests.items()}
            order = {"files": group, "first": sorted(first), "doing": str(doing)}
            plan.write_text(json.dumps(order | {"limits": limits, "longest": 2 * slack}))
            code, said = tree.pytest(group, scratch, stop, MUTANTS_PLAN=str(plan))
            if time.monotonic() >= stop:
                return {}
            if code == 3 and "SystemExit" not in said:  # a module that ends the process when imported is a bug found
                raise RuntimeError(f"pytest must run, got exit status {code}:\n{said[-6000:]}")
            if code not in (0, 5):
                invalid = any(sign in said for sign in INVALID)
                how = "failed" if code > 0 else "took too long" if code == -signal.SIGALRM else f"signal {-code}"
                result |= {"verdict": "invalid" if invalid else "killed", "how": how}
                result |= {"test": doing.read_text(), "passed": []}
                break
    finally:
        path.write_bytes(source)
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
        tree.cool()
    return result | {"seconds": round(time.monotonic() - started, 1)}


class Queue:
    """Hands out mutants until each area has enough that are valid, and writes the results."""

    def __init__(self, chosen: dict[str, list[Mutant]], per_area: int, results: Path) -> None:
        self.waiting = {area: iter(mutants) for area, mutants in chosen.items()}
        self.counted: Counter[str] = Counter()
        self.per_area, self.results = per_area, results
        lines = results.read_text().splitlines() if results.exists() else []
        self.known = {key(record): record for record in map(json.loads, lines)}
        self.lock = threading.Lock()

    def __iter__(self) -> Iterator[Mutant]:
        while (mutant := self.next()) is not None:
            yield mutant

    def next(self) -> Mutant | None:
        with self.lock:
            for area in sorted(self.waiting, key=lambda area: self.counted[area]):
                while self.counted[area] < self.per_area and (mutant := next(self.waiting[area], None)):
                    known = self.known.get(key(asdict(mutant)))
                    if known is None and not compiles(ROOT, mutant):
                        continue
                    self.counted[area] += known is None or known["verdict"] != "invalid"
                    if known is None:
                        return mutant
        return None

    def add(self, result: dict[str, Any]) -> None:
        with self.lock, self.results.open("a") as file:
            self.counted[result["area"]] -= result["verdict"] == "invalid"
            file.write(json.dumps(result) + "\n")
            self.known[key(result)] = result
            what = f"{result['file']}:{result['line']}  {result['before']} -> {result['after']}"
            print(f"{result['verdict']:9} {result['seconds']:6.1f} s  {what}  {result['test'] or ''}", flush=True)


def key(record: dict[str, Any]) -> tuple[Any, ...]:
    """What identifies a mutant."""
    return tuple(record[name] for name in ("file", "start", "before", "after"))


def summary(records: list[dict[str, Any]], seed: int, commit: str) -> dict[str, Any]:
    """Return counts by area, the share that was killed, and every mutant."""
    valid = [record for record in records if record["verdict"] != "invalid"]
    areas = {area: dict(Counter(found["verdict"] for found in records if found["area"] == area)) for area in AREAS}
    killed = sum(record["verdict"] == "killed" for record in valid)
    share = killed / max(1, len(valid))
    return {"seed": seed, "commit": commit, "count": len(valid), "killed": share, "areas": areas, "mutants": records}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--work", type=Path, required=True, help="folder for trees and kernels, outside the checkout")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results; a run goes on in it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--per-area", type=int, default=30)
    parser.add_argument("--areas", nargs="*", default=list(AREAS), choices=list(AREAS))
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--seconds-per-mutant", type=float, default=120.0, help="healthy seconds of its tests")
    parser.add_argument("--limit-seconds", type=float, default=1e9, help="stop after this long")
    parser.add_argument("--only", type=Path, help="a survivors.json: try these mutants")
    parser.add_argument("--all-tests", action="store_true", help="try all other tests, too")
    parser.add_argument("--tests", nargs="*", default=[""], help="folders or files below tests/ to run; default: all")
    parser.add_argument("--without", nargs="*", default=[], help="files below tests/ to leave out")
    parser.add_argument("--commit", help="what is written as the commit; default: that of the checkout")
    parser.add_argument("--dry-run", action="store_true", help="list the mutants")
    args = parser.parse_args()
    stop = time.monotonic() + args.limit_seconds

    passed: dict[tuple[Any, ...], list[str]] = {}
    if args.only:
        args.per_area, chosen = 10**9, {area: [] for area in AREAS}
        for record in json.loads(args.only.read_text()):
            chosen[record["area"]].append(Mutant(**{name: record[name] for name in Mutant.__dataclass_fields__}))
            passed[key(record)] = record["passed"]
    else:
        chosen = drawn(ROOT, args.seed, args.areas)
    args.out.mkdir(parents=True, exist_ok=True)
    queue = Queue(chosen, args.per_area, args.out / "results.jsonl")
    if args.dry_run:
        for mutant in queue:
            print(f"{mutant.file}:{mutant.line}  {mutant.kind}  {mutant.before} -> {mutant.after}")
        return

    git = ["git", "rev-parse", "HEAD"]
    commit = args.commit or subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    base = Tree.of_checkout(args.work / "base", args.work / "kernels")
    paths = sorted((base.folder / "tests").rglob("test_*.py"), key=lambda path: -path.stat().st_size)
    names = [path.relative_to(base.folder / "tests").as_posix() for path in paths]
    left = (*COMPARES_TEXT, *args.without)
    names = [name for name in names if name.startswith(tuple(args.tests)) and name not in left]
    reach = Reach(measured(base, names, args.work, args.workers, stop), importers_of(base.folder))
    budget = float("inf") if args.all_tests else args.seconds_per_mutant

    def work(number: int) -> None:
        tree = base.copied(args.work / f"worker_{number}")
        for mutant in queue:
            result = judged(mutant, tree, reach, budget, passed.get(key(asdict(mutant)), []), stop)
            if not result:
                return
            queue.add(result)

    with ThreadPoolExecutor(args.workers) as pool:
        list(pool.map(work, range(args.workers)))
    found = summary(list(queue.known.values()), args.seed, commit.strip())
    (args.out / "mutants.json").write_text(json.dumps(found, indent=1))
    survivors = [record for record in found["mutants"] if record["verdict"] == "survived"]
    (args.out / "survivors.json").write_text(json.dumps(survivors, indent=1))
    print(f"{found['count']} mutants, {100 * found['killed']:.1f} % killed, {len(survivors)} survivors")


if __name__ == "__main__":
    main()
