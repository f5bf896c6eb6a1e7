"""The constants that somebody chose: all are known, each can be varied, and the tables say what came out."""

import ast
import importlib
import inspect
import math
import pkgutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import constants as benchmark
import numpy as np
import pytest
import tables_constants
import warp as wp
from constants_places import ARGUMENT, changed, is_option, numbers_of, option_paths, scaled, value_of
from constants_registry import GROUPS, SIDES, UNTUNED, Constant, untuned_places

from beam_warp.materials.bake import BakeOptions
from beam_warp.materials.images import ImagePathOptions
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.raster import resolution
from beam_warp.reconstruction import densify, initial
from beam_warp.reconstruction.fit import FitOptions
from beam_warp.reconstruction.job import ReconstructOptions
from beam_warp.reconstruction.joints.graph import JointGraph
from beam_warp.reconstruction.track import TrackOptions
from beam_warp.render.options import DeferredOptions
from beam_warp.render.path import PathOptions

CONSTANTS = [constant for group in GROUPS.values() for constant in group]
KNOWN = {place for constant in CONSTANTS for place in constant.places}
OPTIONS = (
    FitOptions,
    TrackOptions,
    ReconstructOptions,
    MaterialOptions,
    ImagePathOptions,
    BakeOptions,
    DeferredOptions,
    PathOptions,
)
PACKAGES = ("reconstruction", "materials", "render", "kernels.reconstruction", "kernels.materials", "kernels.render")


def modules():
    """Every module of the packages that solve for an asset or draw it."""
    for package in PACKAGES:
        top = importlib.import_module(f"beam_warp.{package}")
        for entry in pkgutil.walk_packages(top.__path__, f"{top.__name__}."):
            yield importlib.import_module(entry.name)


def names_of(module):
    """Names in capital letters that a module gives to numbers itself."""
    for node in ast.parse(inspect.getsource(module)).body:
        given = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        for target in given:
            for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                if isinstance(name, ast.Name) and name.id.isupper() and numbers_of(getattr(module, name.id)):
                    yield name.id


def test_every_number_of_a_module_is_known():
    """A new constant is either among those that were chosen, or says why it is what it is; none is gone."""
    there = {f"{module.__name__}:{name}" for module in modules() for name in names_of(module)}
    untuned = {place for place in untuned_places() if ":" in place}
    assert there - KNOWN - untuned == set()
    assert untuned - there == set()
    assert untuned & KNOWN == set()


def test_every_number_of_the_options_is_known():
    """The same of what options hold that nobody gave; ``refinement.weights`` stands for all weights in it."""
    there = {path for options in OPTIONS for path in option_paths(options())}
    chosen = {place.partition(":")[2] for place in KNOWN if is_option(place)}
    untuned = {place for place in untuned_places() if ":" not in place}
    assert {path for path in there - chosen if not any(f"{path}.".startswith(f"{each}.") for each in untuned)} == set()
    assert {each for each in untuned if not any(f"{path}.".startswith(f"{each}.") for path in there)} == set()


@pytest.mark.parametrize("constant", CONSTANTS, ids=lambda constant: constant.name)
def test_a_constant_is_there_and_can_be_varied(constant):
    """The value of every constant is a number of the code, and what is tried instead differs from it."""
    for place in constant.places:
        value = value_of(place)
        assert numbers_of(value)
        for side in () if constant.not_varied else SIDES:
            if is_option(place):
                assert benchmark.FULL.changed(place, constant, side) != benchmark.FULL
            tried = constant.tried(side, value)
            assert numbers_of(tried) != numbers_of(value)
            assert max(numbers_of(tried)) <= max(constant.most, max(numbers_of(value)))


def test_values_are_scaled_in_their_own_kind():
    """Whole numbers stay whole and differ, fractions stop at their most, and several are scaled one by one."""
    assert [scaled(n, 0.5) for n in (64, 3, 2, 1)] == [32, 2, 1, 0]
    assert [scaled(n, 1.5) for n in (64, 3, 1)] == [96, 4, 2]
    assert scaled(0.8, 1.5, most=1.0) == 1.0
    assert scaled((16, 32), 0.5) == (8, 16)
    assert tuple(scaled(wp.vec4(0.1, 0.2, 0.6, 1.0), 2.0, 1.0)) == pytest.approx((0.2, 0.4, 1.0, 1.0))


def test_a_changed_number_reaches_its_copies_and_comes_back():
    """Modules that imported it see the other one; a default is another one in calls; kernels are no longer the same."""
    place = "beam_warp.raster.resolution:DISC_WIDTH"
    with changed(place, 0.1):
        assert (initial.DISC_WIDTH, resolution.DISC_WIDTH) == (0.1, 0.1)
    assert initial.DISC_WIDTH == resolution.DISC_WIDTH != 0.1

    points = np.random.default_rng(0).normal(size=(40, 3))
    with changed("beam_warp.reconstruction.joints.graph:JointGraph.build(neighbor_count)", 3):
        assert JointGraph.build(points).neighbors.shape[1] == 3
    assert JointGraph.build(points).neighbors.shape[1] != 3

    kernels = wp.get_module("beam_warp.kernels.materials.residues")
    before = kernels.get_module_hash()
    with changed("beam_warp.kernels.materials.residues:GRAZING", 0.1):
        assert kernels.get_module_hash() != before
    assert kernels.get_module_hash() == before


def test_a_failure_is_undone():
    """What was changed comes back although the work in between failed."""
    before = densify.SPLIT_OFFSET
    with pytest.raises(ZeroDivisionError), changed("beam_warp.reconstruction.densify:SPLIT_OFFSET", 9.0):
        _ = 1 / 0
    assert before == densify.SPLIT_OFFSET


@pytest.fixture
def fake_runs(monkeypatch):
    """Parts that score what the seed and one constant are; the other group fails."""

    def score(subject, setup):
        return {"chamfer": 1.0 + 0.1 * setup.fit.seed + densify.SPLIT_OFFSET}

    monkeypatch.setattr(benchmark, "RUNS", {"reconstruction": score, "meshing": lambda *_: 1 / 0})
    monkeypatch.setattr(benchmark, "make_unchanged", lambda name: None)
    monkeypatch.setattr(benchmark, "_worker", {"setup": benchmark.QUICK, "subjects": {"ball": None}})


SPLIT = "beam_warp.reconstruction.densify:SPLIT_OFFSET"


def test_rows_are_kept_and_not_made_twice(fake_runs):
    """Each row has its scores; one that fails says so, and what is there stays."""
    task = benchmark.Task
    tasks = [task("reconstruction", "", "0"), task("reconstruction", SPLIT, "less"), task("meshing", "", "0")]
    result = {"captures": ["ball"], "seeds": {"reconstruction": {"0": "as it was"}}, "constants": {}}
    kept = []
    with ThreadPoolExecutor(1) as pool:
        benchmark.measure(tasks, result, pool, 1, lambda: kept.append(1))
        benchmark.measure(tasks, result, pool, 1, lambda: kept.append(1), until=-math.inf)
    assert len(kept) == 2  # at the end of each run
    assert result["seeds"]["reconstruction"]["0"] == "as it was"
    half = 0.5 * densify.SPLIT_OFFSET
    assert result["constants"][SPLIT]["less"] == {"tried": (half,), "chamfer": [1.0 + half]}
    assert result["seeds"]["meshing"]["0"]["failed"].startswith("ZeroDivisionError")


def made_up():
    """Two seeds that are 0.1 apart, so that two runs differ by 0.1 in root mean square, and one constant."""
    seeds = {"0": {"chamfer": [2.0]}, "1": {"chamfer": [2.1]}}
    rows = {"less": {"chamfer": [2.29]}, "more": {"chamfer": [1.69]}}
    return {"captures": ["ball"], "seeds": {"reconstruction": seeds}, "constants": {SPLIT: rows}}


def test_the_tables_print_changes_beyond_the_noise_in_bold():
    """The noise is that of a difference; a change of 2.9 of it is plain, one of 3.1 bold, and a failure is named."""
    result = made_up()
    assert tables_constants.noise([result], "reconstruction", 0, "chamfer") == pytest.approx(0.1)
    rows = tables_constants.constant_rows(result, group="reconstruction")
    at = next(i for i, row in enumerate(rows) if "`SPLIT_OFFSET`" in row[0])
    value = densify.SPLIT_OFFSET
    assert [row[3:] for row in rows[at : at + 2]] == [
        [f"{value / 2:.4g}", "+0.29"],
        [f"{1.5 * value:.4g}", "**−0.31**"],
    ]
    assert rows[at][1] == f"{value:.4g}"
    result["constants"][SPLIT]["more"]["tried"] = [0.5]  # measured when the value was another
    assert tables_constants.constant_rows(result, group="reconstruction")[at + 1][3:] == ["0.5", "**−0.31**"]
    result["constants"][SPLIT]["less"] = {"failed": "ValueError: no"}
    assert tables_constants.constant_rows(result, group="reconstruction")[at][4] == "fails: ValueError"
    assert tables_constants.floor_rows(result, result)[1] == ["reconstruction", "surface [mm]", "2.00 ± 0.100"]


def test_all_tables_are_rectangular_and_name_every_constant():
    """No constant is missing from the page, and each links to a file of the repository."""
    result = made_up()
    tables = [tables_constants.constant_rows(result, group=group) for group in GROUPS]
    tables += [tables_constants.fixed_rows(result), tables_constants.untuned_rows(result)]
    assert all(len(row) == len(table[0]) for table in tables for row in table)
    named = " ".join(row[0] for table in tables for row in table)
    assert all(f"`{constant.name}`" in named for constant in CONSTANTS)
    assert len(tables[-1]) == 1 + len(UNTUNED)
    root = Path(benchmark.__file__).parent.parent
    for constant in CONSTANTS:
        link = tables_constants.where(constant).partition("](")[2].rstrip(")")
        assert (root / "docs" / link).is_file()


def test_a_constant_of_two_places_has_both_names():
    """The names of a pair stand side by side, without modules, arguments with their functions."""
    pair = Constant("a.b:ONE a.b:Two.three", "nothing", "Nothing.")
    assert (pair.places, pair.name) == (("a.b:ONE", "a.b:Two.three"), "ONE, Two.three")
    assert ARGUMENT.fullmatch("Anchors.fit(neighbor_count)")["name"] == "neighbor_count"


@pytest.mark.slow
def test_all_parts_run(tiny_capture, tmp_path):
    """Every part scores the demo's capture, and a constant of kernels changes what is relit."""
    benchmark.start_worker({"demo": tiny_capture.folder}, "cpu", tmp_path, benchmark.QUICK)
    for group in GROUPS:
        row = benchmark.run_task(benchmark.Task(group, "", "0"))
        assert "failed" not in row
        assert all(np.isfinite(values).all() for score, values in row.items() if score != "relit")  # it has none
    place = "beam_warp.kernels.materials.residues:RELATIVE_SPREAD beam_warp.kernels.materials.residues:LEAST_SPREAD"
    usual, other = (
        benchmark.run_task(benchmark.Task("materials", *task))["base_color"] for task in (("", "0"), (place, "less"))
    )
    assert usual != other
    assert benchmark.run_task(benchmark.Task("materials", "", "0"))["base_color"] == usual
