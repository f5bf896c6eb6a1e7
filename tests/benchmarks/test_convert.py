"""What conversions are judged by: looks in float64, their differences, and what a process costs."""

import json
import subprocess
import sys
from dataclasses import replace

import convert
import convert_looks
import npm_packages
import numpy as np
import pytest
from support.radiant_cloud import radiant_cloud

from beam_warp.world.axes import axes_matrix, change_axes
from beam_warp.world.harmonics import sh_basis

NOTHING = {"rms": 0.0, "largest": 0.0}


@pytest.fixture
def bench(tmp_path):
    """Few Gaussians, and no other program."""
    return convert.Bench(
        count=300,
        sog_count=200,
        error_count=200,
        repeats=1,
        sequence=(2, 50),
        folder=tmp_path,
        theirs=(),
        reads=frozenset(),
        writes=frozenset(),
        data=tmp_path,
    )


def test_scipys_harmonics_are_those_of_3dgs():
    towards = convert_looks.directions()
    assert np.abs(convert_looks.harmonics(towards, 25) - sh_basis(towards, 4)).max() < 1e-14


@pytest.mark.parametrize("axes", ["rub", "rdf", "fru", "luf"])
def test_a_cloud_in_other_axes_looks_the_same_when_it_is_turned_back(axes):
    cloud = radiant_cloud(40, 3, scales=np.random.default_rng(0).uniform(0.1, 1.0, (40, 3)))
    turned = convert_looks.looks_of_cloud(change_axes(cloud, axes), axes_matrix(axes, cloud.axes))
    found = convert_looks.difference(turned, convert_looks.looks_of_cloud(cloud))
    assert found["unmatched"] == 0
    # float32 rounds the quaternion, the scales and sixteen products of harmonics of size 4
    assert max(found[look]["largest"] for look in ("position", "covariance", "opacity", "color")) < 1e-5


def test_gaussians_are_compared_with_their_nearest_in_any_order():
    looks = convert_looks.looks_of_cloud(radiant_cloud(40, 1))
    mixed = looks.of(np.random.default_rng(1).permutation(40))
    same = convert_looks.difference(mixed, looks)
    assert same == {"gaussians": 40, "unmatched": 0} | dict.fromkeys(
        ("position", "covariance", "opacity", "color"), NOTHING
    )
    changed = convert_looks.difference(replace(mixed, opacities=mixed.opacities + 0.1 * (np.arange(40) == 7)), looks)
    assert changed["opacity"] == pytest.approx({"rms": 0.1 / np.sqrt(40), "largest": 0.1})
    assert changed["color"] == NOTHING


def test_missing_and_doubled_gaussians_are_counted():
    looks = convert_looks.looks_of_cloud(radiant_cloud(40, 0))
    assert convert_looks.difference(looks.of(np.arange(30)), looks)["unmatched"] == 10
    assert convert_looks.difference(looks.of([*range(39), 0]), looks)["unmatched"] == 1


def test_a_process_costs_its_own_memory_and_a_failed_one_is_an_error():
    small = convert.run([sys.executable, "-S", "-c", "pass"])
    large = convert.run([sys.executable, "-S", "-c", "bytearray(b'x') * (100 << 20)"])
    assert large.mib - small.mib == pytest.approx(100.0, abs=5.0)  # an interpreter of 10 MiB, of which some is shared
    assert large.cpu_seconds > 0.0
    with pytest.raises(RuntimeError, match="fails: oh no"):
        convert.run([sys.executable, "-S", "-c", "import sys; sys.exit('oh no')"])


def test_every_format_that_we_write_is_judged_without_the_other_program(bench):
    *_, found = convert.errors(bench)
    judged = {row["name"].partition(",")[0]: row["written"] for row in found["rows"]}
    scenes = {"lod-meta.json", ".lcc", ".lcc2 of .sog", ".lcc2 of .spz"}
    assert set(judged) == scenes | {end for end in convert.ONE_FILE if all(convert.roles(end))}
    for ending, written in judged.items():
        assert (written["gaussians"], written["unmatched"]) == (200, 0), ending
        assert written["position"]["largest"] < 1e-3, ending
    for exact in (".ply", ".glb"):
        assert max(judged[exact][look]["largest"] for look in ("position", "covariance", "opacity", "color")) < 1e-6


@pytest.mark.slow
def test_conversions_are_timed_alone_where_the_other_program_is_absent(bench):
    row = convert.timed(bench, convert.source_file(bench, 300), ".ply")
    assert set(row) == {"ours"}
    assert row["ours"]["bytes"] > 300 * 41 * 4  # 41 floats: degree 2
    assert row["ours"]["seconds"]["median"] > 0.0


@pytest.mark.slow
def test_a_sequence_is_written_and_read_in_a_process_of_its_own(tmp_path):
    program = convert.Path(convert.__file__).with_name("convert_sequence.py")
    command = [sys.executable, "-P", str(program), str(tmp_path / "asset.usda"), "3", "50"]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert found["megabytes"] > 3 * 50 * 60e-6  # a frame of every channel takes more than 60 bytes a Gaussian
    assert 0.0 < found["usd_frame_ms"] < found["write_seconds"] * 1e3


def test_packages_that_cannot_be_fetched_are_an_error_of_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("BEAM_NPM", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", str(tmp_path))
    npm_packages.packages.cache_clear()
    with pytest.raises(npm_packages.MissingPackagesError, match=r"^npm is not installed$"):
        npm_packages.packages()
    assert convert.splat_transform() == []
    npm_packages.packages.cache_clear()
