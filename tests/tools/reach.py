"""Which tests reach a place of the code, and how long do they take? Measured once, on the healthy tree."""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tools.mutations import Mutant
from tools.trees import Tree, installed

COMPARES_TEXT = ("test_architecture.py", "test_docs.py", "test_english.py", "test_layers.py", "test_packaging.py")
COMPARES_TEXT += ("stability/test_page.py", "kernels/test_cuda_compile.py", "tools/test_mutants.py")
"""Test files that look at sources and pages, or build: what they say of a mutant is no merit of the tests."""


def measured(tree: Tree, names: list[str], work: Path, workers: int, stop: float) -> dict[str, Any]:
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


def importers_of(tree: Path) -> dict[str, set[str]]:
    """Return, for every module, the modules that import it or a name from it."""
    found: dict[str, set[str]] = defaultdict(set)
    for path in sorted((tree / "beam_warp").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.ImportFrom) and node.module:
                for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                    found[name.replace(".", "/") + ".py"].add(path.relative_to(tree).as_posix())
    return found


class Reach:
    """Test files by the functions that they reach."""

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
        order += sorted({file for file in self.seconds if area in Path(file).parts} - files, key=unlikeliness)
        spent, taken = 0.0, 0
        while taken < len(order) and (taken == 0 or spent + self.seconds[order[taken]] <= budget):
            spent, taken = spent + self.seconds[order[taken]], taken + 1
        return order[:taken], self.of_place[place], order[taken:]
