"""Docstrings can be read alone: none begins with a bare preposition or pronoun, which needs the name above it."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
FILES = sorted(
    path.relative_to(ROOT)
    for folder in ("beam_warp", "kernels", "schema", "converters", "tests", "benchmarks")
    for path in (ROOT / folder).rglob("*.py")
)
BARE = re.compile(r"(Of|In|It|At|By|For|From|With|To|On|As|Its|They|Them|This is it|Takes it)\b")
QUOTED = re.compile(f"[\"']{BARE.pattern}")
"""Strings that begin so: files without any need not be parsed."""


def docstrings(tree: ast.Module) -> list[tuple[int, str]]:
    """Line and text of every docstring, those below constants and fields included."""
    return [
        (here.lineno, here.value.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        for above, here in zip([None, *node.body], node.body, strict=False)
        if above is None or isinstance(above, ast.Assign | ast.AnnAssign)
        if isinstance(here, ast.Expr) and isinstance(here.value, ast.Constant) and isinstance(here.value.value, str)
    ]


def test_no_docstring_begins_with_a_bare_preposition_or_pronoun():
    sources = {path: (ROOT / path).read_text(encoding="utf-8") for path in FILES}
    bare = [
        f"{path}:{line} {text.splitlines()[0]}"
        for path, source in sources.items()
        if QUOTED.search(source)
        for line, text in docstrings(ast.parse(source))
        if BARE.match(text)
    ]
    assert not bare, "\n".join(bare)


def test_docstrings_below_constants_are_found():
    tree = ast.parse('"""A."""\nX = 1\n"""Of Gaussians."""\nclass C:\n    y: int = 0\n    """At most."""\n')
    assert [line for line, text in docstrings(tree) if BARE.match(text)] == [3, 6]
