"""Pytest plugin of `mutants`: which functions does a test reach, and which tests come first where a mutant is?

With ``MUTANTS_RECORD`` it writes, for every test, its seconds and the functions that it entered, as ``file:line``.
Functions of Warp never run as Python: they count as entered when a kernel is launched that can call them. With
``MUTANTS_PLAN`` it puts tests into an order and kills the process when a test takes too long.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest
import warp as wp

ROOT = Path.cwd()


def pytest_configure(config: pytest.Config) -> None:
    record, plan = os.environ.get("MUTANTS_RECORD"), os.environ.get("MUTANTS_PLAN")
    if record:
        config.pluginmanager.register(Recorder(Path(record)))
    if plan:
        config.pluginmanager.register(Planner(json.loads(Path(plan).read_text())))


class Recorder:
    """Notes what every test reaches."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.tests: dict[str, Any] = {}
        self.codes: dict[int, CodeType] = {}
        self.kernels: dict[int, Any] = {}
        self.known: dict[int, tuple[Any, list[CodeType]]] = {}  # what kernels can call; each is kept, so its id too
        self.launch = wp.launch
        wp.launch = self.note_launch
        threading.settrace(self.note_call)
        sys.settrace(self.note_call)

    def note_call(self, frame: FrameType, event: str, argument: object) -> None:
        self.codes[id(frame.f_code)] = frame.f_code

    def note_launch(self, kernel: Any, *arguments: Any, **words: Any) -> Any:
        self.kernels[id(kernel)] = kernel
        return self.launch(kernel, *arguments, **words)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        imported = self.taken()
        started = time.perf_counter()
        result = yield
        seconds = time.perf_counter() - started
        self.tests[item.nodeid] = {"seconds": seconds, "imported": imported, "reached": self.taken()}
        return result

    def taken(self) -> list[str]:
        """Return the places of the functions that were noted, and forget them."""
        codes = list(self.codes.values())
        for key, kernel in self.kernels.items():
            if key not in self.known:
                self.known[key] = kernel, device_functions(kernel.adj, {})
            codes += self.known[key][1]
        self.codes, self.kernels = {}, {}
        places = (f"{code.co_filename}:{code.co_firstlineno}" for code in codes)
        return sorted({place.removeprefix(f"{ROOT}/") for place in places if place.startswith(f"{ROOT}/beam_warp/")})

    def pytest_sessionfinish(self) -> None:
        self.out.write_text(json.dumps(self.tests))


def device_functions(adjoint: Any, known: dict[int, CodeType]) -> list[CodeType]:
    """Return the code of a kernel or function of Warp, and of all that it may call."""
    if id(adjoint) not in known:
        known[id(adjoint)] = adjoint.func.__code__
        for function in (called for called in adjoint.get_references()[2] if not called.is_builtin()):
            forms = [*function.user_overloads.values(), *function.user_templates.values()]
            forms += [form for form in (function.custom_grad_func, function.custom_replay_func) if form is not None]
            for form in forms:
                if form.native_snippet is None:
                    device_functions(form.adj, known)
    return list(known.values())


class Planner:
    """Runs files in the order of the plan, in each the tests that reach the mutant first."""

    def __init__(self, plan: dict[str, Any]) -> None:
        self.files, self.first, self.limits = plan["files"], set(plan["first"]), plan["limits"]
        self.longest, self.doing = plan["longest"], Path(plan["doing"])
        self.doing.write_text("collection")
        signal.signal(signal.SIGALRM, signal.SIG_DFL)  # it ends the process, also within a kernel
        signal.setitimer(signal.ITIMER_REAL, self.longest)

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        place = {file: number for number, file in enumerate(self.files)}
        items.sort(key=lambda item: (place[item.nodeid.partition("::")[0]], item.nodeid not in self.first))

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.doing.write_text(nodeid)
        signal.setitimer(signal.ITIMER_REAL, self.limits.get(nodeid, self.longest))

    def pytest_sessionfinish(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
