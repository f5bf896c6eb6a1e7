"""Minor versions: an asset of 1.0 reads and is valid today, and a reader of 1.0 takes of a new one what it knows."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd

from beam_warp.schema import reader
from beam_warp.schema.layout import CHANNELS
from beam_warp.schema.reader import read_asset
from beam_warp.schema.validation.validator import validate_stage
from beam_warp.schema.writer import write_asset
from beam_warp.world.metadata import stated_capture_frames, stated_raster

OLD_ASSET = Path(__file__).parent / "asset_1_0.usda"
"""Written by the package as it was at version 1.0 of the schema."""

SINCE_1_1 = {"roughness_error"}


def test_an_asset_of_1_0_reads_as_it_did():
    found = read_asset(OLD_ASSET, trusted=True)
    assert found.metadata["schema_version"] == "1.0"
    assert "notes" not in found.metadata
    assert stated_raster(found.metadata) is None
    assert stated_capture_frames(found.metadata, 2) is None
    cloud = found[1]
    assert cloud.arrays().keys() == set(CHANNELS) - {"metallic"} - SINCE_1_1
    assert np.array_equal(cloud.roughness, np.float16([0.144531, 0.782227, 0.655273]).astype(np.float32))
    assert np.array_equal(cloud.observability, [13, 8, 8])
    assert cloud.positions[1, 0] == np.float32(-1.3031572)


def test_an_asset_of_1_0_is_valid_without_a_word():
    assert validate_stage(Usd.Stage.Open(str(OLD_ASSET))).findings == ()


def test_an_asset_of_1_0_becomes_one_of_today_by_writing_it(tmp_path):
    old = read_asset(OLD_ASSET, trusted=True)
    write_asset(old, tmp_path / "new.usdc")
    new = read_asset(tmp_path / "new.usdc", trusted=True)
    assert new.metadata["schema_version"] == "1.3"
    for frame in range(2):
        for name, array in old[frame].arrays().items():
            assert np.array_equal(array, new[frame].arrays()[name]), name


def test_a_reader_of_1_0_ignores_what_came_later_and_says_so(tmp_path, sequence, monkeypatch):
    stated = {"raster_antialiased": "true", "raster_low_pass": "0.1", "capture_frames": "4 5"}
    source = sequence(2, metadata=stated)
    write_asset(source, tmp_path / "a.usdc", full_float=True)
    known = {name: channel for name, channel in CHANNELS.items() if name not in SINCE_1_1}
    monkeypatch.setattr(reader, "CHANNELS", known)
    monkeypatch.setattr(reader, "SCHEMA_VERSION", "1.0")
    with pytest.warns(UserWarning, match="schema version 1.3 is newer than 1.0: what it added is not read"):
        found = read_asset(tmp_path / "a.usdc", trusted=True)
    for frame in range(2):
        wanted = source[frame].with_arrays(roughness_error=None).arrays()
        assert found[frame].arrays().keys() == wanted.keys()
        for name in wanted.keys() - {"orientations"}:
            assert np.array_equal(found[frame].arrays()[name], wanted[name]), name
