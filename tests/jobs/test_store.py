"""Frames on disk: whole or not there."""

import numpy as np
import pytest

from beam_warp.errors import OutputError
from beam_warp.jobs.store import read_frame, write_frame


def test_round_trip(tmp_path, rng):
    arrays = {"a": rng.normal(size=(5, 3)).astype(np.float32), "b": np.arange(4), "empty": np.zeros((0, 3))}
    write_frame(tmp_path / "f.h5", arrays)
    back = read_frame(tmp_path / "f.h5")
    assert set(back) == set(arrays)
    assert all(np.array_equal(back[name], arrays[name]) for name in arrays)


def test_nothing_is_left_of_a_failed_write(tmp_path):
    with pytest.raises(OutputError, match=r"must be a writable file, got .* \(No such file"):
        write_frame(tmp_path / "missing" / "f.h5", {"a": np.zeros(3)})
    assert not list(tmp_path.iterdir())
