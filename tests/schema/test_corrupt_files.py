"""Cut and damaged files give one error that names the file: no traceback of USD, no crash of this process."""

import json
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from beam_warp.errors import AssetFormatError, BeamError
from beam_warp.schema.probe import fault
from beam_warp.schema.reader import read_asset
from beam_warp.schema.validation.validator import validate
from beam_warp.schema.writer import write_asset

CUTTER = textwrap.dedent("""
    import json, sys
    from pathlib import Path
    from beam_warp.errors import AssetFormatError
    from beam_warp.schema.reader import read_asset
    answers = []
    for name, sizes in json.loads(sys.argv[1]).items():
        path = Path(name)
        data = path.read_bytes()
        for size in sizes:
            path.write_bytes(data[:size])
            try:
                read_asset(path)
                answers.append([name, size, "no error"])
            except AssetFormatError as error:
                answers.append([name, size, str(error)])
    print(json.dumps(answers))
""")


def test_cut_files(tmp_path, sequence):
    """Files cut to many sizes are read in another process, so that an abort is seen as one."""
    sizes = {}
    for name, frames, cuts in (("a.usdc", 3, 60), ("a.usdz", 3, 60), ("b.usda", 65, 0)):
        path = write_asset(sequence(frames), tmp_path / name)[-1]
        size = path.stat().st_size
        binary = [*range(0, 128, 9), *np.linspace(128, size - 1, cuts, dtype=int).tolist()]
        sizes[str(path)] = binary if cuts else [0, size - 3]
    command = [sys.executable, "-c", CUTTER, json.dumps(sizes)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answers = json.loads(done.stdout.splitlines()[-1])
    assert len(answers) == 2 * 75 + 2
    for path, size, answer in answers:
        assert answer.startswith(f"{path} must "), (size, answer)
        assert "Traceback" not in answer


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
    assert name in fault(tmp_path / "a.usda")


def test_a_fault_that_the_child_finds_is_an_error(tmp_path, sequence):
    write_asset(sequence(65), tmp_path / "a.usda")
    (tmp_path / "a.static.usdc").unlink()
    with pytest.raises(AssetFormatError, match=r"a\.usda must open in OpenUSD, got .*a\.static\.usdc"):
        read_asset(tmp_path / "a.usda")


@pytest.mark.parametrize("trusted", [False, True])
def test_what_openusd_says_is_told_without_its_source_lines(tmp_path, sequence, trusted):
    write_asset(sequence(3), tmp_path / "a.usda")
    text = (tmp_path / "a.usda").read_text()
    (tmp_path / "a.usda").write_text(text.replace("{", "<", 1))
    with pytest.raises(AssetFormatError, match=r"must open in OpenUSD, got .*a\.usda:\d+:\d+: parse error") as said:
        read_asset(tmp_path / "a.usda", trusted=trusted)
    assert "pxrInternal" not in str(said.value)
    assert "/USD/" not in str(said.value)
    assert "\n" not in str(said.value)


def test_flipped_bits_never_crash(tmp_path, sequence, rng):
    path = tmp_path / "a.usdc"
    write_asset(sequence(2), path)
    data = path.read_bytes()
    refused = 0
    for _ in range(2):
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


def test_the_child_works_in_one_thread(tmp_path, sequence):
    """Each thread takes memory: with one for each of 64 cores, the child's limit left none for a sound file."""
    path = write_asset(sequence(1), tmp_path / "a.usdc")[-1]
    program = (
        "import sys; from pathlib import Path; from pxr import Work; from beam_warp.schema.probe import limit_memory;"
        "limit_memory(Path(sys.argv[1])); print(Work.GetConcurrencyLimit())"
    )
    done = subprocess.run([sys.executable, "-P", "-c", program, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1"]


def test_packages_that_reach_outside_are_refused(tmp_path):
    import zipfile

    with zipfile.ZipFile(tmp_path / "a.usdz", "w") as archive:
        archive.writestr("../a.usda", "#usda 1.0\n")
    with pytest.raises(AssetFormatError, match="distinct names inside itself"):
        read_asset(tmp_path / "a.usdz")
    with zipfile.ZipFile(tmp_path / "a.usdz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.usda", "#usda 1.0\n" * 100)
    with pytest.raises(AssetFormatError, match="store its files as they are"):
        read_asset(tmp_path / "a.usdz")
