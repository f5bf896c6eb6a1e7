"""Told while Warp compiles kernels: the first use of each on a machine takes seconds, and Warp itself stays quiet."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, Protocol

import warp as wp

COMPILERS = ("build_cpu", "build_cuda")
"""Functions of ``warp._src.build`` that compile the code of one module; a module found in the cache calls neither.

Warp has no public hook before a module is compiled. Without these functions, in another version of it, nobody is told.
"""


class CompilationListener(Protocol):
    """Hears when Warp begins and ends to compile a module."""

    def __call__(self, module_count: int, seconds: float, *, is_running: bool) -> None:
        """Take how many modules were begun so far, and how long those that are done took together [s]."""


_listeners: list[CompilationListener] = []


def tell_of_compilation(module_count: int, seconds: float, *, is_running: bool) -> None:
    """Tell all who listen here of what another process compiles."""
    for listener in _listeners:
        listener(module_count, seconds, is_running=is_running)


@contextmanager
def compilation_heard(listener: CompilationListener) -> Iterator[None]:
    """Tell a listener of every module that is compiled within, in whichever thread, and of what others tell of."""
    home: Any = getattr(getattr(wp, "_src", None), "build", None)
    usual = {name: getattr(home, name) for name in COMPILERS if hasattr(home, name)}
    lock = threading.Lock()
    begun, spent = 0, 0.0

    def heard(compile_module: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(compile_module)
        def compiling(*arguments: Any, **options: Any) -> Any:
            nonlocal begun, spent
            with lock:
                begun += 1
                listener(begun, spent, is_running=True)
            started = time.perf_counter()
            try:
                return compile_module(*arguments, **options)
            finally:
                with lock:
                    spent += time.perf_counter() - started
                    listener(begun, spent, is_running=False)

        return compiling

    for name, compile_module in usual.items():
        setattr(home, name, heard(compile_module))
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)
        for name, compile_module in usual.items():
            setattr(home, name, compile_module)
