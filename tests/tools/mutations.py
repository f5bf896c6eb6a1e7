"""Small deliberate bugs: which could a file have? Each replaces one piece of text and leaves the rest as it is."""

from __future__ import annotations

import ast
import random
import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

AREAS = {name: f"beam_warp/{name}" for name in ("materials", "trace", "raster", "render")}
AREAS |= {name: name for name in ("kernels", "converters", "schema")}

UNTOUCHED_FILES = {
    "kernels/raster/back_projection_cuda.py": "runs on GPUs only",
    "kernels/raster/composite_cuda.py": "runs on GPUs only",
    "kernels/raster/composite_adjoint_cuda.py": "runs on GPUs only",
    "kernels/common/lanes.py": "runs on GPUs only",
    "kernels/common/launching.py": "how work is cut up; results must not depend on it",
}

PERFORMANCE = re.compile(
    r".*(_AT_ONCE|_CHUNK|_A_THREAD|_A_LANE|_ON_CUDA|_THREADS)|GROUP_SPLATS|GROUP_PIXELS"
    r"|block_dim|min_chunk|maxsize|REGISTERS|THREADS_TO_FILL|SUM_BLOCK|STRIP|LANES|RUN|MIN_TILES|MIN_LINES|WARP_TILE"
    r"|SPARE_CAPACITY|MAX_BAND_PAIRS|MAX_ROW_PAIRS|CHECKPOINT_SECONDS|PROBE_SECONDS|_BLOCK_ROWS"
)
"""Names and keywords whose values decide only how fast a result comes, or how much memory it takes."""

UNTOUCHED_CALLS = {"set_module_options", "warn", "print", "debug", "info", "warning"}
SYMMETRIC = {"min", "max", "minimum", "maximum", "dot", "distance", "hypot", "isclose", "allclose", "array_equal"}
"""Functions that do not care about the order of their arguments."""

OTHER_OPERATOR: dict[type[ast.AST], tuple[bytes, tuple[str, ...]]] = {
    ast.Add: (b"+", ("-",)),
    ast.Sub: (b"-", ("+",)),
    ast.Mult: (b"*", ("/",)),
    ast.Div: (b"/", ("*",)),
    ast.Lt: (b"<", ("<=", ">")),
    ast.LtE: (b"<=", ("<", ">=")),
    ast.Gt: (b">", (">=", "<")),
    ast.GtE: (b">=", (">", "<=")),
    ast.Eq: (b"==", ("!=",)),
    ast.NotEq: (b"!=", ("==",)),
    ast.And: (b"and", ("or",)),
    ast.Or: (b"or", ("and",)),
}
OTHER_FUNCTION = {"sin": "cos", "min": "max", "minimum": "maximum", "fmin": "fmax"}
OTHER_FUNCTION |= {other: name for name, other in OTHER_FUNCTION.items()}


@dataclass(frozen=True)
class Mutant:
    """One bug: at byte ``start`` of a file, ``before`` becomes ``after``."""

    area: str
    file: str
    line: int
    function: int  # first line of the function around it, decorators included; 0 outside of functions
    kind: str
    start: int
    before: str
    after: str

    def applied(self, source: bytes) -> bytes:
        """Return the source with the bug."""
        before = self.before.encode()
        found = source[self.start : self.start + len(before)]
        assert found == before, f"{self.file} must be the file that the mutant was made for, got {found!r}"
        return source[: self.start] + self.after.encode() + source[self.start + len(before) :]


class _Finder(ast.NodeVisitor):
    """Collects the mutants of a file."""

    def __init__(self, area: str, file: str, source: bytes) -> None:
        self.area, self.file, self.source = area, file, source
        self.line_starts = [0, *(end.end() for end in re.finditer(b"\n", source))]
        self.function = 0
        self.kinds: dict[str, str] = {}  # of the arguments of the functions around
        self.found: list[Mutant] = []
        self.visit(ast.parse(source))

    def start(self, node: ast.expr | ast.stmt) -> int:
        return self.line_starts[node.lineno - 1] + node.col_offset

    def end(self, node: ast.expr | ast.stmt) -> int:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self.line_starts[node.end_lineno - 1] + node.end_col_offset

    def text(self, node: ast.expr | ast.stmt) -> str:
        return self.source[self.start(node) : self.end(node)].decode()

    def replace(self, kind: str, start: int, end: int, after: str) -> None:
        line = self.source.count(b"\n", 0, start) + 1
        before = self.source[start:end].decode()
        self.found.append(Mutant(self.area, self.file, line, self.function, kind, start, before, after))

    def replace_operator(self, kind: str, left_end: int, right_start: int, operator: ast.AST) -> None:
        """Between two operands there are only the operator, spaces and brackets."""
        token, others = OTHER_OPERATOR.get(type(operator), (b"", ()))
        place = self.source.find(token, left_end, right_start)
        if place >= 0 and b"#" not in self.source[left_end:right_start]:
            for other in others:
                self.replace(kind, place, place + len(token), other)

    def equal_kind(self, one: ast.expr, other: ast.expr) -> bool:
        """Whether two arguments may be swapped: of kinds that are not known, Warp refuses unequal ones itself."""
        kinds = {self.kinds.get(self.text(argument)) for argument in (one, other)}
        warp = self.area == "kernels" and isinstance(one, (ast.Name, ast.Attribute, ast.Subscript))
        return warp if None in kinds else len(kinds) == 1

    # What is left as it is.

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for default in (*node.args.defaults, *filter(None, node.args.kw_defaults)):
            self.visit(default)
        outside = self.function, self.kinds
        arguments = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
        self.kinds = self.kinds | {word.arg: ast.unparse(word.annotation) for word in arguments if word.annotation}
        self.function = min([node.lineno, *(line.lineno for line in node.decorator_list)])
        for statement in node.body:
            self.visit(statement)
        self.function, self.kinds = outside

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for statement in node.body:
            self.visit(statement)

    def visit_Raise(self, node: ast.Raise) -> None: ...

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None: ...

    def visit_Assert(self, node: ast.Assert) -> None:
        self.visit(node.test)

    def visit_Assign(self, node: ast.Assign) -> None:
        if not PERFORMANCE.fullmatch(self.text(node.targets[0])):
            self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value and not PERFORMANCE.fullmatch(self.text(node.target)):
            self.visit(node.value)

    def visit_If(self, node: ast.If | ast.IfExp) -> None:
        if re.search("TYPE_CHECKING|is_cuda", ast.unparse(node.test)):
            for statement in node.orelse if isinstance(node.orelse, list) else [node.orelse]:
                self.visit(statement)
        else:
            self.generic_visit(node)

    visit_IfExp = visit_If

    # What is changed.

    def visit_BinOp(self, node: ast.BinOp) -> None:
        texts = (ast.Constant, ast.JoinedStr, ast.List, ast.Tuple)
        joins = any(isinstance(side, texts) and not is_number(side) for side in (node.left, node.right))
        if not joins and not re.search("path|folder|parent", self.text(node.left)):
            self.replace_operator("arithmetic", self.end(node.left), self.start(node.right), node.op)
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self.replace_operator("arithmetic", self.end(node.target), self.start(node.value), node.op)
        if isinstance(node.op, ast.Add):
            self.replace("statement", self.start(node), self.end(node), "pass")
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        for left, operator, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
            self.replace_operator("comparison", self.end(left), self.start(right), operator)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for left, right in zip(node.values, node.values[1:], strict=False):
            self.replace_operator("logic", self.end(left), self.start(right), node.op)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        for operator, token, kind in ((ast.Not, rb"not\b\s*", "logic"), (ast.USub, rb"-", "sign")):
            found = re.compile(token).match(self.source, self.start(node))
            if isinstance(node.op, operator) and found:
                self.replace(kind, found.start(), found.end(), "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if is_number(node) and not isinstance(node.value, complex):
            value: int | float = node.value  # pyright: ignore[reportAssignmentType]
            step = 2 * value if isinstance(value, float) else value + 1
            after = 1 - value if value in (0, 1) else step
            self.replace("constant", self.start(node), self.end(node), repr(type(value)(after)))

    def visit_Subscript(self, node: ast.Subscript) -> None:
        self.visit(node.value)
        for index in node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]:
            if isinstance(index, ast.Constant) and type(index.value) is int:
                self.replace("index", self.start(index), self.end(index), str(index.value - 1 if index.value else 1))
            else:
                self.visit(index)

    def visit_Call(self, node: ast.Call) -> None:
        name = re.split(r"\W", self.text(node.func))[-1]
        if name in UNTOUCHED_CALLS:
            return
        if name in OTHER_FUNCTION:
            end = self.end(node.func)
            self.replace("function", end - len(name), end, OTHER_FUNCTION[name])
        if name in ("clamp", "clip") and len(node.args) == 3:
            self.replace("clamp", self.start(node), self.end(node), self.text(node.args[0]))
        for one, other in zip(node.args, node.args[1:], strict=False) if name not in SYMMETRIC else ():
            if type(one) is type(other) and self.equal_kind(one, other):
                between = self.source[self.end(one) : self.start(other)].decode()
                swapped = self.text(other) + between + self.text(one)
                self.replace("arguments", self.start(one), self.end(other), swapped)
        self.visit(node.func)
        for value in (*node.args, *(word.value for word in node.keywords if not PERFORMANCE.fullmatch(word.arg or ""))):
            self.visit(value)


def is_number(node: ast.AST) -> bool:
    """Whether a node is a number that is written out."""
    return isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and not isinstance(node.value, bool)


def mutants_of(area: str, file: str, source: bytes) -> list[Mutant]:
    """Return all mutants of a file that change it."""
    return [mutant for mutant in _Finder(area, file, source).found if mutant.before != mutant.after]


def drawn(root: Path, seed: int, areas: Iterable[str] = AREAS) -> dict[str, list[Mutant]]:
    """Return mutants of every area in random order: one a line, of a kind that is drawn before the mutant."""
    chosen = {}
    for area in areas:
        draw = random.Random(f"{seed} {area}")
        by_line: dict[tuple[str, int], dict[str, list[Mutant]]] = defaultdict(lambda: defaultdict(list))
        for path in sorted((root / AREAS[area]).rglob("*.py")):
            file = path.relative_to(root).as_posix()
            if file not in UNTOUCHED_FILES:
                for mutant in mutants_of(area, file, path.read_bytes()):
                    by_line[mutant.file, mutant.line][mutant.kind].append(mutant)
        mutants = [draw.choice(draw.choice(list(kinds.values()))) for kinds in by_line.values()]
        draw.shuffle(mutants)
        chosen[area] = mutants
    return chosen


def compiles(root: Path, mutant: Mutant) -> bool:
    """Whether Python takes the file with the bug."""
    try:
        compile(mutant.applied((root / mutant.file).read_bytes()), mutant.file, "exec")
    except SyntaxError:
        return False
    return True
