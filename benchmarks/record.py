"""What a result says of how it was made: program, options, commit, date, machine, and the code that it depends on.

A result file holds this under ``measured``, beside what was found. The code is every module of the package and of the
benchmarks that the program had loaded when it wrote, each with a digest; so whether a result is still that of the code
can be told without the history (`changed_since`). Comments, docstrings and blank lines do not count.
"""

from __future__ import annotations

import argparse
import ast
import functools
import hashlib
import io
import json
import os
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from timing import machine

from beam_warp.device.arrays import resolve_device
from beam_warp.jobs.report import versions

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
PICTURES = ROOT / "benchmarks" / "pictures"
"""Images that a GPU run brought along (``--pictures``), of which figures are drawn; not kept."""

MAPPED = ("kernels", "schema", "converters")
"""Packages that lie beside ``beam_warp`` in a checkout, and inside it where it is installed."""

CANNOT_CHANGE_A_NUMBER = (
    "beam_warp/__init__.py",
    "beam_warp/_version.py",
    "beam_warp/checks.py",
    "beam_warp/errors.py",
    "beam_warp/jobs/",
    "beam_warp/cli/",
    "benchmarks/record.py",
    "benchmarks/constants_registry.py",
)
"""Code that computes nothing: messages, progress, options; names of constants, which each row repeats."""


DIGITS = 8
"""Hexadecimal digits of a file's digest: enough to see that it has changed."""


def parser(
    about: str | None, *, device: bool = False, data: bool = False, quick: str = "", parts: Iterable[str] = ()
) -> argparse.ArgumentParser:
    """Return a parser with what benchmarks have in common; ``--out`` and ``--commit`` in any case.

    Args:
        about: The program's docstring.
        device: Whether there is ``--device``.
        data: Whether there is ``--data``, the folder of captures.
        quick: What ``--quick`` does; empty leaves it out.
        parts: What ``--parts`` chooses from; empty leaves it out.
    """
    made = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--out", type=Path, required=True, metavar="JSON", help="what is written, for tables.py to print")
    made.add_argument("--commit", default=commit(), help="recorded; by default that of this checkout")
    if device:
        first = str(resolve_device(None))
        made.add_argument("--device", default=first, help=f"by default the first GPU, or the CPU: here {first}")
    if data:
        made.add_argument("--data", type=Path, default=Path(os.environ.get("BEAM_DATA", ROOT.parent / "shared/data")))
    if quick:
        made.add_argument("--quick", action="store_true", help=quick)
    if parts:
        made.add_argument("--parts", nargs="+", default=(), choices=parts, metavar="PART", help="these parts only")
    return made


def write_result(arguments: argparse.Namespace, device: Any, result: Mapping[str, Any]) -> None:
    """Write a result with what it says of itself; as often as there is more.

    Args:
        arguments: The program's; paths among its options are recorded by their last part.
        device: Warp device that was measured.
        result: What was found: JSON-able.
    """
    head = {
        "program": f"benchmarks/{Path(sys.argv[0]).name}",
        "options": {k: v for k, v in sorted(vars(arguments).items()) if k not in ("out", "commit", "device") and v},
        "commit": arguments.commit,
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(device),
        "versions": versions(),
        "code": by_folder(loaded_code()),
    }
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    partial = arguments.out.with_suffix(".partial")
    partial.write_text(as_text({"measured": head, **result}), encoding="utf-8")
    partial.replace(arguments.out)


def as_text(result: Mapping[str, Any]) -> str:
    """Return a result as JSON: what holds nothing further stands on one line, numbers have eight digits."""
    text = json.dumps(_plain(result), indent=1)
    return re.sub(r"[\[{][^\[\]{}]*[\]}]", lambda found: re.sub(r"\n *", " ", found[0]), text) + "\n"


def _plain(value: Any) -> Any:
    """Return what JSON has: NumPy's numbers and arrays as lists, paths by their last part, numbers of eight digits."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(f"{value:.8g}")
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, Path):
        return value.name
    return _plain(value.tolist()) if hasattr(value, "tolist") else str(value)


def commit() -> str:
    """Return the checkout's commit, or 'unknown' outside one."""
    try:
        found = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=ROOT)
    except OSError:
        return "unknown"
    return found.stdout.strip() or "unknown"


def loaded_code() -> dict[str, str]:
    """Return the digest of every loaded module of the package and of the benchmarks, by its path in the repository."""
    found = {}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file is None or not file.endswith(".py"):
            continue
        path = Path(file).resolve()
        if name.partition(".")[0] == "beam_warp":
            place = name.replace(".", "/") + ("/__init__.py" if path.name == "__init__.py" else ".py")
            for mapped in MAPPED:
                place = place.replace(f"beam_warp/{mapped}/", f"{mapped}/", 1)
        elif path.parent == ROOT / "benchmarks":
            place = f"benchmarks/{path.name}"
        else:
            continue
        if not place.startswith(CANNOT_CHANGE_A_NUMBER):
            found[place] = _digest_of_file(path)
    return dict(sorted(found.items()))


def by_folder(code: Mapping[str, str]) -> dict[str, str]:
    """Return digests of files as a result file has them: ``{"beam_warp/world": "axes:cad7f293 camera:ec1f0425"}``."""
    found: dict[str, str] = {}
    for place, digest in code.items():
        folder, _, name = place.removesuffix(".py").rpartition("/")
        found[folder] = f"{found[folder]} {name}:{digest}" if folder in found else f"{name}:{digest}"
    return found


def _digests(code: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Yield files and digests of a result: its keys are folders (`by_folder`), or files."""
    for place, said in code.items():
        if place.endswith(".py"):
            yield place, said
        else:
            yield from ((f"{place}/{name}.py", digest) for name, digest in (word.split(":") for word in said.split()))


def changed_since(measured: Mapping[str, Any]) -> list[str]:
    """Return the files whose code is no longer what was measured; files that are gone are among them."""
    return [
        place
        for place, digest in _digests(measured["code"])
        if not place.startswith(CANNOT_CHANGE_A_NUMBER) and _digest_of_file(ROOT / place) != digest[:DIGITS]
    ]


@functools.cache
def _digest_of_file(path: Path) -> str | None:
    return code_digest(path.read_text(encoding="utf-8")) if path.is_file() else None


def code_digest(source: str) -> str:
    """Return the `DIGITS` digits of Python source without its comments, docstrings and blank lines."""
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            last = node.end_lineno or node.lineno
            lines[node.lineno - 1 : last] = [""] * (last - node.lineno + 1)
    code = "\n".join(line.rstrip() for line in lines if line.strip())
    return hashlib.sha256(code.encode()).hexdigest()[:DIGITS]


def content_digest(path: Path) -> str:
    """Return a digest of a file's bytes, 12 hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
