"""The benchmark of exposures: what is put into a view is found in it, and nothing in the others."""

import exposures as benchmark
import pytest

pytestmark = pytest.mark.slow  # a benchmark's own tests


def test_errors_are_found_where_they_were_made(tiny_capture):
    views = [record.view() for record in tiny_capture.select(split="train", frames=[0])]
    found = benchmark.measure(views, "cpu")
    assert set(found["errors"]) == {"-1", "-0.5", "0.5", "1"}
    assert found["blamed"] == 0
    for stops in (-1.0, 1.0):
        error = found["errors"][f"{stops:g}"]
        assert error["found"] == error["cases"] == len(views)
        # Found over the middle view, which is off by no more than `sound`, as the view itself may be.
        assert abs(error["lowest"] - stops) <= found["sound"] + found["others"]
        assert abs(error["highest"] - stops) <= found["sound"] + found["others"]
