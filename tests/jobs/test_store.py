"""Finished frames on disk: whole or not there, and fresh only under their key."""

import numpy as np
import pytest

from beam_warp.errors import OutputError
from beam_warp.jobs.store import frame_key, kept_frame, read_frame, write_frame


def test_round_trip(tmp_path, rng):
    arrays = {"a": rng.normal(size=(5, 3)).astype(np.float32), "b": np.arange(4), "empty": np.zeros((0, 3))}
    write_frame(tmp_path / "f.h5", "key", arrays)
    back = read_frame(tmp_path / "f.h5")
    assert set(back) == set(arrays)
    assert all(np.array_equal(back[name], arrays[name]) for name in arrays)
    assert frame_key(tmp_path / "f.h5") == "key"


def test_missing_and_cut_files_have_no_key(tmp_path):
    assert frame_key(tmp_path / "none.h5") is None
    write_frame(tmp_path / "f.h5", "key", {"a": np.zeros(1000)})
    (tmp_path / "f.h5").write_bytes((tmp_path / "f.h5").read_bytes()[:300])
    assert frame_key(tmp_path / "f.h5") is None


def test_what_is_kept_is_made_once_for_each_key(tmp_path):
    made = []

    def make():
        made.append(len(made))
        return {"a": np.array(made)}

    for key, count in (("one", 1), ("one", 1), ("two", 2)):
        assert len(kept_frame(tmp_path / "f.h5", key, make)["a"]) == count


def test_nothing_is_left_of_a_failed_write(tmp_path):
    with pytest.raises(OutputError, match=r"must be a writable file, got .* \(No such file"):
        write_frame(tmp_path / "missing" / "f.h5", "key", {"a": np.zeros(3)})
    assert not list(tmp_path.iterdir())
