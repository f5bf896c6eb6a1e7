"""Imports point one way: packages import only packages of lower floors; no modules and no packages form a circle."""

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

FLOORS = """
errors checks digests archives blocks outputs kernels
image device
world
light schema jobs
plan
trace converters
raster capture
mesh render interop
materials reconstruction stage view
decomposition
evaluate demo study
reduction stability
cli
"""
"""Packages and single modules of `beam_warp` from the bottom up; those of one floor do not import each other."""

KERNEL_FLOORS = """
common
light raster
mesh
trace
render materials reconstruction reduction
"""
"""Families of kernels from the bottom up."""

ALLOWED = {
    ("checks", "errors"),
    ("digests", "errors"),
    ("digests", "checks"),
    ("outputs", "errors"),
    ("interop", "_version"),
}
"""Imports within a floor."""

WITHOUT_WARP = {
    "errors",
    "checks",
    "digests",
    "archives",
    "blocks",
    "outputs",
    "image",
    "world",
    "schema",
    "converters",
    "capture",
}
"""Packages that a converter or validator waits for: none of them imports Warp."""


def modules() -> dict[str, Path]:
    """Every module of the package, by its full name."""
    found = {}
    for folder in ("beam_warp", "kernels", "schema", "converters"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            parts = parts if folder == "beam_warp" else ("beam_warp", *parts)
            found[".".join(parts).removesuffix(".__init__")] = path
    return found


MODULES = modules()


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Every statement below a node, at any depth, type-checking blocks left out."""
    for part in ("body", "orelse", "handlers", "finalbody", "cases"):
        for inner in getattr(node, part, ()):
            if not (isinstance(inner, ast.If) and "TYPE_CHECKING" in ast.unparse(inner.test)):
                yield inner
                yield from statements(inner)


@cache
def imports(path: Path) -> set[str]:
    """Every module that a file imports, at any depth, type-checking blocks left out."""
    names = set()
    for node in statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the package"
            names |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def homes(place: int) -> dict[str, str]:
    """Module → its package (place 1), or its family of kernels (place 2)."""
    inside = "beam_warp." if place == 1 else "beam_warp.kernels."
    return {module: module.split(".")[place] for module in MODULES if module.startswith(inside)}


@pytest.mark.parametrize(("table", "place"), [(FLOORS, 1), (KERNEL_FLOORS, 2)], ids=["packages", "kernels"])
def test_imports_point_down(table, place):
    floors = {name: height for height, row in enumerate(table.strip().splitlines()) for name in row.split()}
    home = {module: name for module, name in homes(place).items() if name != "_version"}
    assert set(home.values()) == set(floors), "the table of floors must name every package once"
    for module, here in home.items():
        for name in imports(MODULES[module]) & set(home):
            there = home[name]
            down = floors[there] < floors[here] or here == there or (here, there) in ALLOWED
            assert down, f"{module} imports {name}, which is not below it"


def package_of(module: str) -> str:
    """The package that a module is in, sub-packages told apart from their parents."""
    return module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]


@pytest.mark.parametrize("home", [str, package_of], ids=["modules", "packages"])
def test_nothing_forms_a_circle(home):
    graph = {}
    for name, path in MODULES.items():
        graph.setdefault(home(name), set()).update(home(other) for other in imports(path) & set(MODULES))
    graph = {name: others - {name, "beam_warp"} for name, others in graph.items() if name != "beam_warp"}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as circle:
        pytest.fail(" → ".join(circle.args[1]))


@pytest.mark.parametrize("module", MODULES)
def test_heavy_packages_stay_where_they_belong(module):
    package = module.split(".")[1] if "." in module else ""
    names = imports(MODULES[module])
    heavy = {name.split(".")[0] for name in names}
    assert "torch" not in heavy or package == "interop"
    assert "pxr" not in heavy or package == "schema"
    ours = {name for name in names if name.startswith("beam_warp.")}
    if package in WITHOUT_WARP:
        assert "warp" not in heavy
        assert not any(name.startswith("beam_warp.kernels") for name in ours)
    if package == "kernels":
        assert all(name.startswith("beam_warp.kernels") for name in ours)
