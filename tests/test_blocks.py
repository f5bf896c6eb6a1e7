"""Work in blocks: every row once, whatever their number; errors come out of threads; damage makes no warnings."""

import threading
import time
import warnings

import numpy as np
import pytest

from beam_warp import blocks
from beam_warp.blocks import BLOCK_ROWS, for_each_block, replace_rows


@pytest.mark.parametrize("cores", [1, 4])
@pytest.mark.parametrize("count", [0, 1, BLOCK_ROWS - 1, BLOCK_ROWS, BLOCK_ROWS + 1, 3 * BLOCK_ROWS])
def test_every_row_once(monkeypatch, cores, count):
    monkeypatch.setattr(blocks, "_core_count", lambda: cores)
    met = np.zeros(count, np.int64)

    def work(part):
        assert 0 < part.stop - part.start <= BLOCK_ROWS
        met[part] += 1

    for_each_block(work, count)
    assert (met == 1).all()


def test_one_core_means_this_thread(monkeypatch):
    monkeypatch.setattr(blocks, "_core_count", lambda: 1)
    threads = []
    for_each_block(lambda part: threads.append(threading.current_thread()), 3 * BLOCK_ROWS)
    assert threads == [threading.current_thread()] * 3


def test_the_first_error_comes_out_and_the_rest_is_left(monkeypatch):
    monkeypatch.setattr(blocks, "_core_count", lambda: 2)
    done = []

    def work(part):
        done.append(part)
        time.sleep(1e-3 * (part.start > 0))
        raise ValueError(f"at {part.start}")

    with pytest.raises(ValueError, match="at 0"):
        for_each_block(work, 1000 * BLOCK_ROWS)
    assert len(done) < 1000


def test_rows_are_replaced_without_warnings():
    array = np.full(2 * BLOCK_ROWS, 1e30, np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        replace_rows(lambda rows: rows * rows - np.inf, array)
    assert np.isnan(array).all()
