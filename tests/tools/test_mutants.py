"""Mutants of the mutation run: each changes one place, compiles, and is the same for the same seed."""

import ast
import json
from collections import Counter
from pathlib import Path

import pytest

from tools.mutations import AREAS, Mutant, compiles, drawn, mutants_of
from tools.reach import Reach

ROOT = Path(__file__).parents[2]

SOURCE = '''
"""Not -1."""
MIN_CHUNK = 4
LIMIT: float = 0.5


@wp.func
def f(a: float, b: float, c: int = 3) -> wp.array[1]:
    """Not 2 + 2."""
    if not (a < b) and c == -2:  # 1 + 1
        raise ValueError(f"{a + 1}")
    total = wp.clamp(x[0, c], 0.0, 1.0) * wp.sin(a)
    total += (a) / b
    return g(a, b, c, min(a, b), block_dim=64) if is_cuda else max(total, 7.0)
'''


def test_every_kind_of_mutant_and_no_other():
    found = {(mutant.line, mutant.before, mutant.after) for mutant in mutants_of("trace", "f.py", SOURCE.encode())}
    assert found == {
        (4, "0.5", "1.0"),
        (8, "3", "4"),
        (10, "not ", ""),
        (10, "<", "<="),
        (10, "<", ">"),
        (10, "and", "or"),
        (10, "==", "!="),
        (10, "-", ""),
        (10, "2", "3"),
        (12, "wp.clamp(x[0, c], 0.0, 1.0)", "x[0, c]"),
        (12, "0", "1"),
        (12, "0.0", "1.0"),
        (12, "1.0", "0.0"),
        (12, "*", "/"),
        (12, "sin", "cos"),
        (13, "total += (a) / b", "pass"),
        (13, "+", "-"),
        (13, "/", "*"),
        (14, "max", "min"),
        (14, "7.0", "14.0"),
    }


def test_arguments_are_swapped_where_their_kinds_are_equal():
    source = b"def f(a: int, b: float, c: float):\n    g(a, b, c)\n    dot(b, c)\n"
    swapped = [mutant for mutant in mutants_of("trace", "f.py", source) if mutant.kind == "arguments"]
    assert [(mutant.before, mutant.after, mutant.function) for mutant in swapped] == [("b, c", "c, b", 1)]


@pytest.fixture(scope="module")
def chosen():
    return drawn(ROOT, 1, ["raster", "converters"])


def test_one_seed_draws_the_same_mutants(chosen):
    assert drawn(ROOT, 1, ["converters"])["converters"] == chosen["converters"]
    assert drawn(ROOT, 2, ["converters"])["converters"] != chosen["converters"]


def test_mutants_change_one_place_of_a_line_each_and_compile(chosen):
    for area, mutants in chosen.items():
        assert len(mutants) > 100
        assert set(Counter((mutant.file, mutant.line) for mutant in mutants).values()) == {1}
        for mutant in mutants[:5]:
            assert mutant.file.startswith(f"{AREAS[area]}/")
            source = (ROOT / mutant.file).read_bytes()
            bad = mutant.applied(source)
            assert compiles(ROOT, mutant)
            assert ast.dump(ast.parse(bad)) != ast.dump(ast.parse(source))
            tail = len(source) - mutant.start - len(mutant.before.encode())
            assert (bad[: mutant.start], bad[len(bad) - tail :]) == (
                source[: mutant.start],
                source[len(source) - tail :],
            )


def test_mutants_meet_the_tests_that_reach_them_first():
    """Those of the module, then of the package, then short ones; what the budget leaves out is named."""
    reached, other = ["beam_warp/kernels/light/lobe.py:3"], ["beam_warp/trace/rays.py:1"]
    tests = {
        f"tests/{file}.py::test": {"seconds": seconds, "imported": [], "reached": places}
        for file, seconds, places in (
            ("cli/test_view", 3.0, reached),
            ("trace/test_rays", 1.0, reached + other),
            ("light/test_lobe", 9.0, reached),
            ("kernels/light/test_others", 2.0, reached),
            ("light/test_rest", 2.0, other),
            ("trace/test_lobe", 1.0, other),
        )
    }
    mutant = Mutant("kernels", "kernels/light/lobe.py", 5, 3, "constant", 0, "1", "2")
    files, first, left_out = Reach(tests, {}).plan(mutant, 12.0)
    assert files == ["tests/light/test_lobe.py", "tests/kernels/light/test_others.py", "tests/trace/test_rays.py"]
    assert left_out == ["tests/cli/test_view.py", "tests/light/test_rest.py"]
    assert first == {name for name, test in tests.items() if reached[0] in test["reached"]}


def test_the_kept_run_leaves_few_bugs_and_says_why():
    """Tests catch 95 % of the bugs that have an effect, of 200 or more; each of the others has a reason."""
    kept = json.loads((Path(__file__).parent / "mutants.json").read_text(encoding="utf-8"))
    left = [mutant for mutant in kept["mutants"] if mutant["verdict"] == "survived"]
    without_effect = [mutant for mutant in left if mutant["why"].startswith("The same")]
    assert len(kept["mutants"]) >= 200
    assert len(left) - len(without_effect) <= 0.05 * (len(kept["mutants"]) - len(without_effect))
    assert {mutant["area"] for mutant in kept["mutants"]} == set(AREAS)
    assert all(mutant["test"] for mutant in kept["mutants"] if mutant["verdict"] == "killed")
