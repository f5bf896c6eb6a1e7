"""The digest of the code: the same wherever it lies, another when a source changes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from beam_warp import digests
from beam_warp.digests import code_digest, content_digest, source_digest


def write(folder, files):
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder


SOURCES = {
    "a.py": b"x = 1\ny = 2\n",
    "trace/rays.py": b"z = 3\n",
    "kernels/bvh.py": b"k = 4\n",
    "schema/s.usda": b"#\n",
}


@pytest.fixture
def wheel(tmp_path):
    """All packages in one folder."""
    return {"": write(tmp_path / "wheel", SOURCES)}


def test_a_checkout_has_the_digest_of_its_wheel(wheel, tmp_path):
    """There, some packages lie beside the others, lines may end as on Windows, and compiled files lie around."""
    as_on_windows = {name: SOURCES[name].replace(b"\n", b"\r\n") for name in ("a.py", "trace/rays.py")}
    others = {"__pycache__/a.pyc": b"?", "py.typed": b"", "page.js": b""}
    checkout = {
        "schema": write(tmp_path / "checkout" / "schema", {"s.usda": SOURCES["schema/s.usda"]}),
        "kernels": write(tmp_path / "checkout" / "kernels", {"bvh.py": SOURCES["kernels/bvh.py"]}),
        "": write(tmp_path / "checkout" / "beam_warp", as_on_windows | others),
    }
    assert source_digest(checkout) == source_digest(wheel)
    assert source_digest({**wheel, "kernels": wheel[""] / "kernels"}) == source_digest(wheel)


@pytest.mark.parametrize(
    "change",
    [
        {"a.py": b"x = 1\ny = 3\n"},
        {"kernels/bvh.py": b"k = 5\n"},
        {"schema/s.usda": b"#usda\n"},
        {"new.py": b""},
        {"a.py": b"x = 1\n", "b.py": b"y = 2\n"},  # a line that moved to another file
    ],
)
def test_any_change_of_a_source_shows(wheel, change):
    before = source_digest(wheel)
    write(wheel[""], change)
    assert source_digest(wheel) != before


def test_the_digest_of_this_package_is_found_once():
    assert len(code_digest()) == 32
    assert code_digest() is code_digest()


def test_a_checkout_in_the_way_of_the_installed_package_is_named():
    """Python, and so Ray, looks in the working folder first, where ``kernels`` lies beside ``beam_warp``."""
    checkout = Path(__file__).parents[1]
    if not (checkout / "kernels").is_dir():
        pytest.skip("tests of an installed package lie beside no checkout")
    program = "from beam_warp.digests import code_digest; code_digest()"
    usual = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    said = subprocess.run(
        [sys.executable, "-c", program], cwd=checkout, env=usual, capture_output=True, text=True, check=False
    )
    assert said.stderr.splitlines()[-1].startswith(
        "beam_warp.errors.MissingPackageError: beam_warp must be the installed package, got the folder of a checkout"
    )


@pytest.mark.parametrize("at", [0, 7, 8, 19])
def test_any_change_of_a_file_shows_in_whichever_part_it_is(tmp_path, monkeypatch, at):
    monkeypatch.setattr(digests, "PART_BYTES", 8)
    path, content = tmp_path / "a", bytearray(range(20))
    path.write_bytes(content)
    before = content_digest(path, {})[1]
    assert content_digest(path, {})[1] == before
    content[at] ^= 1
    path.write_bytes(content)
    assert content_digest(path, {})[1] != before
