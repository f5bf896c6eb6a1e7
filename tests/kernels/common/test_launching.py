"""Launching: kernels with atomics must not be spread over CPU threads."""

import ast
import os
import signal
import time
from pathlib import Path
from threading import get_ident
from types import SimpleNamespace

import numpy as np
import pytest
from support.shapes import random_cloud, random_rays

from beam_warp import Scene, visibility
from beam_warp.kernels.common import launching

KERNELS = sorted((Path(__file__).parents[3] / "kernels").rglob("*.py"))


def kernels_with_atomics(tree):
    """Kernels of a file that use atomics, or a function of that file that does."""
    nodes = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    functions = {name for name, node in nodes.items() if any("func" in words(it) for it in node.decorator_list)}
    racing = {name for name, node in nodes.items() if any(word.startswith("atomic_") for word in words(node))}
    while more := {name for name, node in nodes.items() if racing & functions & words(node)} - racing:
        racing |= more
    return racing - functions


def words(node):
    inner = list(ast.walk(node))
    names = {it.id for it in inner if isinstance(it, ast.Name)}
    return names | {it.attr for it in inner if isinstance(it, ast.Attribute)}


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: path.stem)
def test_kernels_with_atomics_are_launched_in_order(path):
    """Warp's CPU atomics are plain additions: two threads lose some, and a tree comes out with lost leaves."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    racing = kernels_with_atomics(tree)
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") in ("launch", "launcher"):
            kernel = getattr(call.args[0], "id", "")
            if kernel in racing:
                assert any(word.arg == "in_order" for word in call.keywords), kernel
                racing.discard(kernel)
    assert not racing, f"not launched here: {racing}"


def test_a_scene_is_the_same_with_many_threads(monkeypatch, rng):
    cloud, rays = random_cloud(rng, 20_000, scale=(-5.0, 0.5)), random_rays(rng, 2_000)
    monkeypatch.setenv("BEAM_WARP_THREADS", "1")
    alone = visibility(Scene.from_gaussians(cloud, "cpu"), *rays)
    monkeypatch.setenv("BEAM_WARP_THREADS", "16")
    monkeypatch.setattr(launching, "MIN_CHUNK", 64)
    monkeypatch.setattr(launching, "WORTH_SPREADING", 0.0)
    for build in ("quality", "fast"):
        scene = Scene.from_gaussians(cloud, "cpu", build=build)
        assert np.sort(scene._tree.layout.items.numpy()).tolist() == np.flatnonzero(cloud.opacities > 1 / 255).tolist()
    assert np.array_equal(visibility(Scene.from_gaussians(cloud, "cpu"), *rays), alone)


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [1, 9, 10, 11, 20, 401])
def test_every_item_is_worked_on_once(monkeypatch, threads, count):
    """Chunks of 10 and more; sizes straddle one and two of them, and are more than all threads take at a time."""
    monkeypatch.setattr(launching, "WORTH_SPREADING", 0.0)
    done = []
    cpu = SimpleNamespace(is_cuda=False)
    launching._run_in_chunks(
        lambda start, length: done.extend(range(start, start + length)), range(count), cpu, threads, 10
    )
    assert sorted(done) == list(range(count))


def test_work_that_is_short_stays_on_one_thread(monkeypatch):
    monkeypatch.setattr(launching, "WORTH_SPREADING", 1e9)
    threads = set()
    cpu = SimpleNamespace(is_cuda=False)
    launching._run_in_chunks(lambda start, length: threads.add(get_ident()), range(1000), cpu, 4, 10)
    assert threads == {get_ident()}


def test_an_error_in_a_chunk_is_raised(monkeypatch):
    """Whichever thread it happens on, and no chunk is begun after the call has ended."""
    monkeypatch.setattr(launching, "WORTH_SPREADING", 0.0)

    def run(start, length):
        if start > 100:
            raise ValueError("chunk")

    with pytest.raises(ValueError, match="chunk"):
        launching._run_in_chunks(run, range(1000), SimpleNamespace(is_cuda=False), 3, 10)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_has_threads_of_its_own(monkeypatch):
    """Threads do not survive a fork: work handed to those of the parent would never be done."""
    monkeypatch.setattr(launching, "WORTH_SPREADING", 0.0)
    done, cpu = [], SimpleNamespace(is_cuda=False)
    launching._run_in_chunks(lambda start, count: done.append(count), range(70), cpu, 3, 7)
    child = os.fork()
    if not child:  # nothing of pytest's may run here
        code = 1
        try:
            launching._run_in_chunks(lambda start, count: done.append(count), range(70), cpu, 3, 7)
            code = 0 if sum(done) == 140 else 2
        finally:
            os._exit(code)
    for _ in range(200):
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
        time.sleep(0.05)
    else:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        pytest.fail("the child hangs")
    assert os.waitstatus_to_exitcode(status) == 0
