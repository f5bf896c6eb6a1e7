"""Where a constant is, what it is, and how it is changed for a while: a number of a module, an option, a default.

A place is a module and a path: ``beam_warp.render.arriving:CLUSTER_COUNT`` is a number of a module,
``beam_warp.reconstruction.fit:FitOptions.rates.positions`` what options hold that nobody gave, and
``beam_warp.reconstruction.joints.graph:JointGraph.build(neighbor_count)`` the default of an argument.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp

PACKAGES = ("reconstruction", "materials", "mesh", "render", "light", "trace", "raster", "evaluate", "kernels")
"""Packages whose modules may hold a constant."""

ARGUMENT = re.compile(r"(?P<function>.+)\((?P<name>\w+)\)")


def value_of(place: str) -> Any:
    """Return the value at a place: a number, several, or a vector.

    Raises:
        AttributeError: There is no such thing.
    """
    module, _, path = place.partition(":")
    argument = ARGUMENT.fullmatch(path)
    found: Any = importlib.import_module(module)
    for name in (argument["function"] if argument else path).split("."):
        found = getattr(found if hasattr(found, name) else found(), name)
    if argument is None:
        return found
    return inspect.signature(found).parameters[argument["name"]].default


def numbers_of(value: Any) -> tuple[float, ...]:
    """Return the numbers in a value; nothing if it is no number, or holds something else."""
    if isinstance(value, bool | str) or value is None:
        return ()
    if isinstance(value, int | float | np.number):
        return (float(value),)
    try:
        items = value.values() if isinstance(value, Mapping) else value
        return tuple(number for item in items for number in numbers_of(item))
    except TypeError:
        return ()


def is_option(place: str) -> bool:
    """Return whether a place is a field of options, which are given to what is run."""
    return "." in place.partition(":")[2] and ARGUMENT.fullmatch(place) is None


def option_paths(options: Any) -> Iterator[str]:
    """Return the paths of all numbers that options hold, in their order; of those of a class, ``Class.path``."""
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from (
                f"{type(options).__name__}.{field.name}.{path.partition('.')[2]}" for path in option_paths(value)
            )
        elif numbers_of(value):
            yield f"{type(options).__name__}.{field.name}"


def scaled(value: Any, factor: float, most: float = float("inf")) -> Any:
    """Return a value times a factor, at most ``most``; whole numbers stay whole, and change by at least one."""
    if isinstance(value, int):
        step = 1 if factor > 1.0 else -1
        return max(0, int(min(most, step * max(step * round(factor * value), step * value + 1))))
    if isinstance(value, float | np.number):
        return float(min(factor * value, most))
    parts = [scaled(part, factor, most) for part in value]
    return np.array(parts) if isinstance(value, np.ndarray) else type(value)(parts)


def with_option(options: Any, path: Sequence[str], change: Callable[[Any], Any]) -> Any:
    """Return options of which one field is changed."""
    name, *rest = path
    value = getattr(options, name)
    return replace(options, **{name: with_option(value, rest, change) if rest else change(value)})


def load_packages() -> None:
    """Import every module that may hold a constant: one that is imported later would keep a changed one."""
    for package in PACKAGES:
        top = importlib.import_module(f"beam_warp.{package}")
        for entry in pkgutil.walk_packages(top.__path__, f"{top.__name__}."):
            importlib.import_module(entry.name)


def _copies(module: str, name: str) -> Iterator[tuple[ModuleType, str]]:
    """Return which modules imported a name from a module, and as what."""
    for other in list(sys.modules.values()):
        if not getattr(other, "__name__", "").startswith("beam_warp.") or not (other.__file__ or "").endswith(".py"):
            continue
        source = inspect.getsource(other)
        for node in ast.walk(ast.parse(source)) if f"from {module} import" in source and name in source else ():
            if isinstance(node, ast.ImportFrom) and node.module == module:
                yield from ((other, alias.asname or name) for alias in node.names if alias.name == name)


@contextmanager
def changed(place: str, value: Any) -> Iterator[None]:
    """Let a number of a module, or a default, be another one; kernels that know it are compiled anew when they run.

    Only modules that are loaded see it: call `load_packages` before.
    """
    module, _, path = place.partition(":")
    argument = ARGUMENT.fullmatch(path)
    before = value_of(place)
    if argument is not None:
        function: Any = importlib.import_module(module)
        for name in argument["function"].split("."):
            function = getattr(function, name)
        function = getattr(function, "__func__", function.__init__ if isinstance(function, type) else function)

        def give(new: Any) -> None:
            _set_default(function, argument["name"], new)
    else:
        holders = [(importlib.import_module(module), path), *_copies(module, path)]

        def give(new: Any) -> None:
            for holder, name in holders:
                setattr(holder, name, new)
            if any(holder.__name__.startswith("beam_warp.kernels.") for holder, _ in holders):
                _forget_kernels()

    give(value)
    try:
        yield
    finally:
        give(before)


def _set_default(function: Any, name: str, value: Any) -> None:
    """Replace the default of one argument."""
    if name in (function.__kwdefaults__ or {}):
        function.__kwdefaults__ = {**function.__kwdefaults__, name: value}
        return
    named = [p.name for p in inspect.signature(function).parameters.values() if p.default is not p.empty]
    positional = [each for each in named if each not in (function.__kwdefaults__ or {})]
    defaults = list(function.__defaults__)
    defaults[positional.index(name)] = value
    function.__defaults__ = tuple(defaults)


def _forget_kernels() -> None:
    """Let Warp look at the constants of all kernels again: what changed is compiled, the rest is found in its cache."""
    from beam_warp.kernels.common.launching import kernel_for

    kernel_for.cache_clear()
    for name in list(sys.modules):
        if name.startswith("beam_warp.kernels."):
            wp.get_module(name).mark_modified()
