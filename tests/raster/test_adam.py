"""Adam: the float64 twin, first steps again, visibility, rates, graphs, refusals."""

import numpy as np
import pytest
import warp as wp
from support.float32 import EPSILON

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.raster.adam import Adam, Parameters

KINDS = {"position": wp.vec3, "orientation": wp.quat, "opacity": float, "harmonics": (float, 9)}
RATES = {"position": 1.6e-4, "orientation": 1e-3, "opacity": 0.05, "harmonics": 2.5e-3}


def device_rows(values, kind, device):
    """Rows (N, K) as an array of a kind."""
    if isinstance(kind, tuple):
        return wp.array(values, dtype=float, device=device)
    return wp.array(values[:, 0] if kind is float else values, dtype=kind, device=device)


def width(kind):
    if isinstance(kind, tuple):
        return kind[1]
    return 1 if kind is float else kind._length_


def random_rows(rng, count):
    return {name: rng.standard_normal((count, width(kind))).astype(np.float32) for name, kind in KINDS.items()}


def parameters_of(values, device):
    return {
        name: Parameters(
            device_rows(values[name], kind, device), device_rows(0.0 * values[name], kind, device), RATES[name]
        )
        for name, kind in KINDS.items()
    }


def set_gradients(adam, gradients):
    for name, kind in KINDS.items():
        wp.copy(adam.parameters[name].gradients, device_rows(gradients[name], kind, adam.device))


def values_of(adam):
    """Copies: on the CPU the array itself would move with the next step."""
    return {name: group.values.numpy().reshape(len(group.values), -1).copy() for name, group in adam.parameters.items()}


def both_of(values, device):
    return Adam(parameters_of(values, device)), Twin(values, RATES)


def step_both(adam, twin, gradients, visible=None):
    set_gradients(adam, gradients)
    adam.step(None if visible is None else wp.array(visible, dtype=bool, device=adam.device))
    twin.step(gradients, visible)


class Twin:
    """Adam in float64, row by row."""

    def __init__(self, values, rates, epsilon=1e-15):
        self.values = {name: array.astype(np.float64) for name, array in values.items()}
        self.means = {name: 0.0 * array for name, array in self.values.items()}
        self.squares = {name: 0.0 * array for name, array in self.values.items()}
        self.steps = np.zeros(len(next(iter(values.values()))))
        self.rates, self.epsilon = dict(rates), epsilon

    def step(self, gradients, visible=None):
        rows = np.arange(len(self.steps)) if visible is None else np.flatnonzero(visible)
        self.steps[rows] += 1
        t = self.steps[rows, None]
        for name, gradient in gradients.items():
            g = gradient[rows].astype(np.float64)
            self.means[name][rows] = m = 0.9 * self.means[name][rows] + 0.1 * g
            self.squares[name][rows] = v = 0.999 * self.squares[name][rows] + 0.001 * g**2
            root = np.sqrt(v / (1.0 - 0.999**t)) + self.epsilon
            self.values[name][rows] -= self.rates[name] * (m / (1.0 - 0.9**t)) / root


def assert_close(found, twin, steps):
    """A step is the rate times a quotient of at most 4: 16 roundings of that, and one of the value, a step.

    Signs change from step to step, so that mean gradients cancel: their roundings count by the gradients, not by them.
    """
    for name, expected in twin.values.items():
        size = 16.0 * 4.0 * twin.rates[name] + np.abs(expected).max()
        assert np.abs(found[name] - expected).max() <= steps * EPSILON * size


@pytest.mark.parametrize("count", [1, 257])
class TestTwin:
    def test_many_steps(self, device, rng, count):
        adam, twin = both_of(random_rows(rng, count), device)
        for _ in range(20):
            step_both(adam, twin, random_rows(rng, count))
        assert_close(values_of(adam), twin, 20)

    def test_only_visible_rows_move(self, device, rng, count):
        adam, twin = both_of(random_rows(rng, count), device)
        for _ in range(10):
            gradients, visible = random_rows(rng, count), rng.uniform(size=count) < 0.4
            before = values_of(adam)
            step_both(adam, twin, gradients, visible)
            for name, found in values_of(adam).items():
                assert (found[~visible] == before[name][~visible]).all()
        assert_close(values_of(adam), twin, 10)


class TestRestart:
    def test_rows_begin_again_and_the_others_go_on(self, device, rng):
        adam, twin = both_of(random_rows(rng, 257), device)
        marks = rng.uniform(size=257) < 0.5
        for step in range(8):
            if step == 5:
                adam.restart(marks)
                for part in (twin.means, twin.squares):
                    for array in part.values():
                        array[marks] = 0.0
                twin.steps[marks] = 0.0
            step_both(adam, twin, random_rows(rng, 257))
        assert_close(values_of(adam), twin, 8)

    def test_nothing_else_changes(self, device, rng):
        """No value moves, no array is another one: steps that were captured go on."""
        values = random_rows(rng, 257)
        adam = Adam(parameters_of(values, device))
        set_gradients(adam, random_rows(rng, 257))
        adam.step()
        before, places = values_of(adam), [group.values.ptr for group in adam.parameters.values()]
        adam.restart(np.ones(257, bool))
        assert [group.values.ptr for group in adam.parameters.values()] == places
        for name, found in values_of(adam).items():
            assert (found == before[name]).all()
        gradients = random_rows(rng, 257)
        set_gradients(adam, gradients)
        adam.step()
        for name, found in values_of(adam).items():  # a first step again: the rate, against the sign
            bound = 8.0 * EPSILON * RATES[name] + 2.0 * EPSILON * (np.abs(before[name]) + RATES[name])
            assert (np.abs(found - before[name] + RATES[name] * np.sign(gradients[name])) <= bound).all()


class TestLearningRates:
    def test_zero_learning_rate_and_zero_gradient(self, device, rng):
        values = random_rows(rng, 9)
        adam = Adam(parameters_of(values, device))
        adam.step()  # gradients are 0: 0 / (0 + epsilon)
        set_gradients(adam, random_rows(rng, 9))
        for name in KINDS:
            adam.set_learning_rate(name, 0.0)
        adam.step()
        assert all((found == values[name]).all() for name, found in values_of(adam).items())

    def test_a_changed_rate(self, device, rng):
        values, gradients = random_rows(rng, 6), random_rows(rng, 6)
        adam = Adam(parameters_of(values, device))
        adam.set_learning_rate("opacity", 0.25)
        set_gradients(adam, gradients)
        adam.step()
        twin = Twin(values, {**RATES, "opacity": 0.25})
        twin.step(gradients)
        assert_close(values_of(adam), twin, 1)

    def test_capture_in_a_graph(self, device, rng):
        if device == "cpu":
            pytest.skip("CUDA graphs are for CUDA")
        values, gradients = random_rows(rng, 300), random_rows(rng, 300)
        adam, twin = both_of(values, device)
        step_both(adam, twin, gradients)  # loads the module
        with wp.ScopedCapture(device) as capture:
            adam.step()
        for rate in (0.1, 0.02, 0.3):
            adam.set_learning_rate("opacity", rate)
            twin.rates["opacity"] = rate
            wp.capture_launch(capture.graph)
            twin.step(gradients)
        assert_close(values_of(adam), twin, 4)


def test_gradients_in_wider_rows(device, rng):
    """Gradients may be some columns of what a backward pass sums for every row."""
    wide = rng.standard_normal((20, 15)).astype(np.float32)
    columns = wp.array(wide, dtype=float, device=device)[:, 4:7]
    apart = wp.array(np.ascontiguousarray(wide[:, 4:7]), dtype=wp.vec3, device=device)
    found = []
    for gradients in (columns, apart):
        values = wp.zeros(20, dtype=wp.vec3, device=device)
        Adam({"position": Parameters(values, gradients, 0.1)}).step()
        found.append(values.numpy())
    assert (found[0] == found[1]).all()
    assert (np.abs(found[0]) > 0.0).all()


def test_same_bits_for_every_number_of_threads(device, rng, monkeypatch):
    values, gradients = random_rows(rng, 3000), random_rows(rng, 3000)
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("BEAM_WARP_THREADS", threads)
        adam = Adam(parameters_of(values, device))
        set_gradients(adam, gradients)
        adam.step()
        adam.step()
        found.append(values_of(adam))
    assert all((found[0][name] == found[1][name]).all() for name in KINDS)


def test_no_rows(device):
    adam = Adam({"position": Parameters(*(wp.zeros(0, dtype=wp.vec3, device=device) for _ in range(2)), 0.1)})
    adam.step()
    assert len(adam.parameters["position"].values) == 0


class TestRefusals:
    def one(self, values=None, gradients=None, rate=0.1):
        kept = wp.zeros(4, dtype=wp.vec3, device="cpu")
        return {"a": Parameters(kept if values is None else values, kept if gradients is None else gradients, rate)}

    def test_arrays(self):
        other = wp.zeros(5, dtype=wp.vec3, device="cpu")
        with pytest.raises(InvalidArrayError, match=r"parameters\['a'\].gradients must have as many rows as the first"):
            Adam(self.one(gradients=other))
        with pytest.raises(InvalidArrayError, match=r"gradients must have the shape of its values, \(4, 3\), got \(4,"):
            Adam(self.one(gradients=wp.zeros(4, dtype=float, device="cpu")))
        with pytest.raises(InvalidArrayError, match="array must hold contiguous rows of float32, got dtype vec3d"):
            Adam(self.one(values=wp.zeros(4, dtype=wp.vec3d, device="cpu")))
        with pytest.raises(InvalidArrayError, match="gradients must be a warp array on cpu, got ndarray"):
            Adam(self.one(gradients=np.zeros((4, 3))))
        with pytest.raises(InvalidArrayError, match="must have at least one float in a row"):
            Adam(self.one(*(wp.zeros((4, 0), dtype=float, device="cpu") for _ in range(2))))

    def test_options(self):
        with pytest.raises(InvalidOptionError, match="parameters must name at least one group"):
            Adam({})
        with pytest.raises(InvalidOptionError, match="beta2 must be a number in"):
            Adam(self.one(), beta2=1.0)
        with pytest.raises(InvalidOptionError, match=r"parameters\['a'\].learning_rate must be a number in"):
            Adam(self.one(rate=np.nan))
        with pytest.raises(InvalidOptionError, match="name must be one of a, got 'b'"):
            Adam(self.one()).set_learning_rate("b", 0.1)

    def test_masks(self):
        adam = Adam(self.one())
        with pytest.raises(InvalidArrayError, match="visible must be a warp array of 4 bool on cpu, got int32"):
            adam.step(wp.zeros(4, dtype=int, device="cpu"))
        with pytest.raises(InvalidArrayError, match="rows must have shape"):
            adam.restart(np.ones(5, bool))
