"""Steps that are taken again: each call is one step, recorded or not, and what was recorded can be forgotten."""

import gc

import pytest
import warp as wp

from beam_warp.device.arrays import resolve_device
from beam_warp.device.graphs import StepGraphs


def adder(array, amount, calls):
    def step():
        calls.append(amount)
        wp.map(lambda a, b: a + b, array, amount, out=array)

    return step


@pytest.mark.parametrize("rounds", [1, 3])
def test_every_call_is_one_step(device, rounds):
    """The first of a key too, which on CUDA is recorded and then replayed."""
    target = resolve_device(device)
    array, calls = wp.zeros(5, dtype=float, device=target), []
    steps = {key: adder(array, float(key), calls) for key in (1, 10)}
    for step in steps.values():
        step()  # loads the module
    array.zero_()
    calls.clear()
    graphs = StepGraphs(target)
    for _ in range(rounds):
        for key, step in steps.items():
            graphs.run(key, step)
    assert array.numpy().tolist() == [11.0 * rounds] * 5
    assert len(calls) == (2 if target.is_cuda else 2 * rounds)
    graphs.clear()
    graphs.run(1, steps[10])  # another step under the same key
    assert array.numpy().tolist() == [11.0 * rounds + 10.0] * 5


def test_nothing_is_freed_while_a_step_is_recorded(device):
    """CUDA refuses to free an array then, and garbage is found at any time; elsewhere nothing is recorded."""
    target, enabled = resolve_device(device), []
    StepGraphs(target).run("step", lambda: enabled.append(gc.isenabled()))
    assert enabled == [not target.is_cuda]
    assert gc.isenabled()
