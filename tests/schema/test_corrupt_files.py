"""Cut and damaged files give one error that names the file: no traceback of USD, no crash of this process."""

import json
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from beam_warp.errors import AssetFormatError, BeamError
from beam_warp.schema.reader import read_asset
from beam_warp.schema.validator import validate
from beam_warp.schema.writer import write_asset

CUTTER = textwrap.dedent("""
    import json, sys
    from pathlib import Path
    from beam_warp.errors import AssetFormatError
    from beam_warp.schema.reader import read_asset
    path = Path(sys.argv[1])
    data = path.read_bytes()
    answers = {}
    for size in map(int, sys.argv[2:]):
        path.write_bytes(data[:size])
        try:
            read_asset(path)
            answers[size] = "no error"
        except AssetFormatError as error:
            answers[size] = str(error)
    print(json.dumps(answers))
""")


def cut(path, sizes):
    """Read a file cut to each size in another process, so that an abort is seen as one."""
    done = subprocess.run(
        [sys.executable, "-c", CUTTER, str(path), *map(str, sizes)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", ["a.usdc", "a.usdz"])
def test_cut_binary_files(tmp_path, sequence, name):
    write_asset(sequence(3), tmp_path / name)
    size = (tmp_path / name).stat().st_size
    sizes = [*range(0, 128, 9), *np.linspace(128, size - 1, 60, dtype=int)]
    for length, answer in cut(tmp_path / name, sizes).items():
        assert answer.startswith(f"{tmp_path / name} must "), (length, answer)
        assert "Traceback" not in answer


def test_cut_text_layer(tmp_path, sequence):
    write_asset(sequence(65), tmp_path / "a.usda")
    size = (tmp_path / "a.usda").stat().st_size
    answers = cut(tmp_path / "a.usda", [0, size // 2, size - 3])
    assert all(answer.startswith(f"{tmp_path / 'a.usda'} must ") for answer in answers.values()), answers


@pytest.mark.parametrize(
    ("name", "missing"),
    [("a.000030.usdc", False), ("a.static.usdc", False), ("a.static.usdc", True), ("a.manifest.usda", True)],
)
def test_cut_and_missing_layers_of_a_whole_root(tmp_path, sequence, name, missing):
    write_asset(sequence(65), tmp_path / "a.usda")
    data = (tmp_path / name).read_bytes()
    if missing:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(AssetFormatError, match=rf"a\.usda must open in OpenUSD, got .*{name}"):
        read_asset(tmp_path / "a.usda")


def test_flipped_bits_never_crash(tmp_path, sequence, rng):
    path = tmp_path / "a.usdc"
    write_asset(sequence(2), path)
    data = path.read_bytes()
    refused = 0
    for _ in range(3):
        damaged = bytearray(data)
        for place in rng.integers(len(data) // 2, len(data), 4):
            damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            found = read_asset(path)
            [found[frame] for frame in range(len(found))]
        except BeamError:
            refused += 1
    assert refused


def test_a_crash_of_the_child_is_one_error(tmp_path, sequence, monkeypatch):
    from beam_warp.schema import files

    monkeypatch.setattr(files.sys, "executable", "/bin/false")
    write_asset(sequence(1), tmp_path / "a.usdc")
    with pytest.raises(AssetFormatError, match=r"got a crash of the child process \(exit code 1: no message\)"):
        read_asset(tmp_path / "a.usdc")
    with pytest.raises(AssetFormatError, match="a crash of the child process"):
        validate(tmp_path / "a.usdc")


def test_packages_that_reach_outside_are_refused(tmp_path):
    import zipfile

    for name, match in (("../a.usda", "distinct names inside itself"), ("a.usda", "64-byte aligned")):
        with zipfile.ZipFile(tmp_path / "a.usdz", "w") as archive:
            archive.writestr(name, "#usda 1.0\n")
        with pytest.raises(AssetFormatError, match=match):
            read_asset(tmp_path / "a.usdz")
    with zipfile.ZipFile(tmp_path / "a.usdz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.usda", "#usda 1.0\n" * 100)
    with pytest.raises(AssetFormatError, match="store its files as they are"):
        read_asset(tmp_path / "a.usdz")
