"""Which deliberate bugs does ``make test`` let through? ``python -P tests/tools/mutants.py --work W --out O``.

Mutants are drawn evenly over the areas of `mutations.AREAS`. Each is put into a copy of the tree with a copy of Warp's
compiled kernels. The tests of the healthy tree, run once, tell which test files reach which functions: a mutant meets
the files that reach its function, those of its own module and package first, until one fails.

``O/results.jsonl`` gets a line a mutant, so that a stopped run goes on; ``O/mutants.json`` sums up and
``O/survivors.json`` can be given to ``--only``, with ``--all-tests`` to try the other tests on them.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import contextlib
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from tools.mutations import AREAS, Mutant, compiles, drawn

ROOT = Path(__file__).parents[2]
MAPPED = ("kernels", "schema", "converters")
"""Folders that are installed inside of ``beam_warp``."""

READ = ("beam_warp", *MAPPED, "tests", "benchmarks", "docs")
"""Folders that tests read."""

COMPARES_TEXT = ("test_architecture.py", "test_docs.py", "test_english.py", "test_layers.py", "test_packaging.py")
COMPARES_TEXT += ("stability/test_page.py", "kernels/test_cuda_compile.py", "tools/test_mutants.py")
"""Test files that look at sources and pages, or build: what they say of a mutant is no merit of the tests."""

READS_KERNELS = "tests/kernels/common/test_launching.py::test_kernels_with_atomics_are_launched_in_order"

INVALID = ("Error while parsing function", "WarpCodegen", "Failed to load CPU module", "build failed")
"""What Warp says of a kernel that it cannot compile."""

TIMES, SLACK, COMPILING = 8.0, 60.0, 240.0
"""A test may take so many times as long as without the mutant, and some seconds more: a lot if kernels are compiled."""


@dataclass
class Tree:
    """A copy of the checkout in which the packages lie as they are installed, with a kernel cache of its own."""

    folder: Path
    kernels: Path
    warm: set[Path] = field(default_factory=set)

    @classmethod
    def of_checkout(cls, folder: Path, kernels: Path) -> Tree:
        shutil.rmtree(folder, ignore_errors=True)
        for name in READ:
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".*"))
        for path in filter(Path.is_file, ROOT.iterdir()):
            shutil.copy2(path, folder)
        for name in MAPPED:
            (folder / name).rename(folder / "beam_warp" / name)
            (folder / name).symlink_to(Path("beam_warp") / name)
        compileall.compile_dir(folder, quiet=2, workers=0)
        kernels.mkdir(parents=True, exist_ok=True)
        return cls(folder, kernels)

    def copied(self, folder: Path) -> Tree:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.folder, folder / "tree", symlinks=True)
        shutil.copytree(self.kernels, folder / "kernels", copy_function=os.link)
        return Tree(folder / "tree", folder / "kernels", set(folder.glob("kernels/*/*")))

    def cool(self) -> None:
        """Remove the kernels of the last mutant."""
        for path in set(self.kernels.glob("*/*")) - self.warm:
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def pytest(self, files: list[str], scratch: Path, stop: float, **words: str) -> tuple[int, str]:
        """Run test files; return pytest's exit status, or minus a signal, and the end of what it said."""
        shutil.rmtree(scratch, ignore_errors=True)
        (scratch / "hypothesis").mkdir(parents=True)
        threads = dict.fromkeys(("BEAM_WARP_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        paths = [str(self.folder), str(self.folder / "tests"), os.environ.get("PYTHONPATH", "")]
        places = {"BEAM_DATA": str(scratch / "no data"), "HYPOTHESIS_STORAGE_DIRECTORY": str(scratch / "hypothesis")}
        places |= {"PYTHONPATH": os.pathsep.join(filter(None, paths)), "WARP_CACHE_PATH": str(self.kernels)}
        environment = (
            os.environ | threads | places | {"CUDA_VISIBLE_DEVICES": "", "PYTHONDONTWRITEBYTECODE": "1"} | words
        )
        command = [sys.executable, "-P", "-m", "pytest", "-p", "tools.reached", "-p", "no:cacheprovider", "-x"]
        command += [
            "-m",
            "not slow",
            "--hypothesis-seed=0",
            f"--basetemp={scratch / 'tmp'}",
            "--deselect",
            READS_KERNELS,
        ]
        with (scratch / "said").open("wb") as said:
            process = subprocess.Popen(
                [*command, *files], cwd=self.folder, env=environment, stdout=said, stderr=said, start_new_session=True
            )
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, stop - time.monotonic()))
            with contextlib.suppress(ProcessLookupError):  # else what it started, or itself, still runs
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        return process.returncode, (scratch / "said").read_text(errors="replace")[-6000:]


class Reach:
    """Which test files reach a function, and how long they take; measured on the healthy tree."""

    def __init__(self, tests: dict[str, Any], importers: dict[str, set[str]]) -> None:
        self.tests = tests
        self.importers = importers
        self.seconds: dict[str, float] = defaultdict(float)
        self.of_place: dict[str, set[str]] = defaultdict(set)  # "file:first line of function" → tests that enter it
        self.files_of_place: dict[str, set[str]] = defaultdict(set)
        self.files_of_module: dict[str, set[str]] = defaultdict(set)
        for test, found in tests.items():
            file = test.partition("::")[0]
            self.seconds[file] += found["seconds"]
            for place in found["reached"]:
                self.of_place[place].add(test)
                self.files_of_module[place.rpartition(":")[0]].add(file)
            for place in (*found["reached"], *found["imported"]):
                self.files_of_place[place].add(file)

    def plan(self, mutant: Mutant, budget: float) -> tuple[list[str], set[str], list[str]]:
        """Return test files in the order of likelihood, tests to run first, and files that the budget leaves out.

        A constant outside of functions is reached by who reaches any function of its module, or of one that imports
        it. Tests of the same package come last when none of them seems to reach the mutant: some start processes.
        """
        module = installed(mutant.file)
        place = f"{module}:{mutant.function}"
        if mutant.function:
            files = self.files_of_place[place]
        else:
            files = set().union(*(self.files_of_module[name] for name in (module, *self.importers.get(module, ()))))
        area, stem = Path(mutant.file).parent.name, Path(mutant.file).stem

        def unlikeliness(file: str) -> tuple[int, float]:
            near = area in Path(file).parts
            return (0 if near and Path(file).stem == f"test_{stem}" else 1 if near else 2), self.seconds[file]

        order = sorted(files, key=unlikeliness)
        order += sorted(
            (file for file in self.seconds if area in Path(file).parts and file not in files), key=unlikeliness
        )
        spent, taken = 0.0, 0
        while taken < len(order) and (taken == 0 or spent + self.seconds[order[taken]] <= budget):
            spent, taken = spent + self.seconds[order[taken]], taken + 1
        return order[:taken], self.of_place[place], order[taken:]


def installed(file: str) -> str:
    """Return where a source file of the checkout lies in a tree."""
    return f"beam_warp/{file}" if file.split("/")[0] in MAPPED else file


def importers_of(tree: Path) -> dict[str, set[str]]:
    """Return, for every module, the modules that import it or a name from it."""
    found: dict[str, set[str]] = defaultdict(set)
    for path in sorted((tree / "beam_warp").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
                for name in names:
                    found[name.replace(".", "/") + ".py"].add(path.relative_to(tree).as_posix())
    return found


def healthy(tree: Tree, names: list[str], work: Path, workers: int, stop: float) -> dict[str, Any]:
    """Run test files on the healthy tree, each in a process; return what every test reaches. Exit if one fails."""
    digest = hashlib.sha256(repr(names).encode())
    for path in sorted(tree.folder.rglob("*.py")):
        digest.update(path.read_bytes())
    known = work / "healthy.json"
    if known.exists() and any(tree.kernels.iterdir()):
        found = json.loads(known.read_text())
        if found["digest"] == digest.hexdigest():
            return found["tests"]

    def run(name: str) -> tuple[int, str]:
        scratch = work / "healthy" / name.replace("/", "_")
        words = {"MUTANTS_RECORD": str(scratch.with_suffix(".json")), "PYTHONDONTWRITEBYTECODE": ""}
        return tree.pytest([f"tests/{name}"], scratch, stop, **words)

    with ThreadPoolExecutor(workers) as pool:
        runs = dict(zip(names, pool.map(run, names), strict=True))
    failed = {name: said for name, (status, said) in runs.items() if status not in (0, 5)}
    if failed:
        print(*failed.values(), sep="\n", file=sys.stderr)
        sys.exit(f"tests must pass in time without mutants, got {', '.join(failed)}. Mend them, or try --without them.")
    tests: dict[str, Any] = {}
    for name in names:
        tests |= json.loads((work / "healthy" / name.replace("/", "_")).with_suffix(".json").read_text())
    known.write_text(json.dumps({"digest": digest.hexdigest(), "tests": tests}))
    return tests


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
            words = {
                "files": group,
                "first": sorted(first),
                "limits": limits,
                "longest": 2 * slack,
                "doing": str(doing),
            }
            plan.write_text(json.dumps(words))
            code, said = tree.pytest(group, scratch, stop, MUTANTS_PLAN=str(plan))
            if time.monotonic() >= stop:
                return {}
            if code == 3:
                raise RuntimeError(f"pytest must run, got exit status {code}:\n{said}")
            if code not in (0, 5):
                invalid = any(words in said for words in INVALID)
                how = "failed" if code > 0 else "took too long" if code == -signal.SIGALRM else f"signal {-code}"
                result |= {
                    "verdict": "invalid" if invalid else "killed",
                    "test": doing.read_text(),
                    "how": how,
                    "passed": [],
                }
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
            place = f"{result['file']}:{result['line']}"
            what = f"{' '.join(result['before'].split())} -> {result['after']}"
            print(
                f"{result['verdict']:9} {result['seconds']:6.1f} s  {place}  {what}  {result['test'] or ''}", flush=True
            )


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
    parser.add_argument(
        "--seconds-per-mutant", type=float, default=120.0, help="tests to run, by their healthy seconds"
    )
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

    base = Tree.of_checkout(args.work / "base", args.work / "kernels")
    paths = sorted((base.folder / "tests").rglob("test_*.py"), key=lambda path: -path.stat().st_size)
    names = [path.relative_to(base.folder / "tests").as_posix() for path in paths]
    names = [
        name for name in names if name.startswith(tuple(args.tests)) and name not in (*COMPARES_TEXT, *args.without)
    ]
    reach = Reach(healthy(base, names, args.work, args.workers, stop), importers_of(base.folder))
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
    commit = (
        args.commit or subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=ROOT).stdout
    )
    found = summary(list(queue.known.values()), args.seed, commit.strip())
    (args.out / "mutants.json").write_text(json.dumps(found, indent=1))
    survivors = [record for record in found["mutants"] if record["verdict"] == "survived"]
    (args.out / "survivors.json").write_text(json.dumps(survivors, indent=1))
    print(f"{found['count']} mutants, {100 * found['killed']:.1f} % killed, {len(survivors)} survivors")


if __name__ == "__main__":
    main()
