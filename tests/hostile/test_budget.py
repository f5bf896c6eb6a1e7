"""What bad input may cost: 2 s, 256 MiB and twice the file, one line, and nothing left behind; measured in programs."""

import os
import struct
import subprocess
import sys

import numpy as np
import OpenEXR
import pytest
from hostile import corpus

from beam_warp.schema.files import require_opens

resource = pytest.importorskip("resource", reason="Windows does not count")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is KiB on Linux alone")

SECONDS = 2.0
PROBE_SECONDS = 0.3
MEMORY = 256 * 2**20

MEASURED = """
import resource, sys
from beam_warp.cli.common import console
from importlib import import_module
module, *words = sys.argv[1:]
main = import_module(module).main
if words[0] == "render":
    import_module("beam_warp.render.deferred")  # Warp takes its share before any input is met
begun = resource.getrusage(resource.RUSAGE_SELF)
code = main(words)
own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
seconds = own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime
seconds -= begun.ru_utime + begun.ru_stime
print(code, seconds, max(own.ru_maxrss - begun.ru_maxrss, children.ru_maxrss) * 1024)
"""


def bomb_exr(folder):
    """A constant environment of 16384 x 8192 pixels says so in 300 bytes."""
    path = folder / "a.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: np.ones((16, 32), np.float16) for name in "RGB"}).write(str(path))
    old, new = struct.pack("<4i", 0, 0, 31, 15), struct.pack("<4i", 0, 0, 32767, 16383)
    path.write_bytes(path.read_bytes().replace(old, new))
    words = ("render", corpus.ply(folder), "--environment", path, "--out", folder / "o.png")
    return path, ("beam_warp.cli.main", *words)


def huge_ply(folder):
    """A thousand million Gaussians, in a file of three."""
    path = corpus.ply(folder)
    path.write_bytes(path.read_bytes().replace(b"element vertex 3", b"element vertex 1000000000"))
    return path, ("beam_warp.cli.convert", path, folder / "out.ply")


def hollow_ply(folder):
    """The same with a body of zeros that takes no room on the disk: quaternions of length 0."""
    path = corpus.ply(folder)
    head, _, _ = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(head.replace(b"element vertex 3", b"element vertex 200000") + b"end_header\n")
    os.truncate(path, path.stat().st_size + 200_000 * 200)
    return path, ("beam_warp.cli.convert", path, folder / "out.usdc")


def counting_usd(folder):
    """More frames than memory holds."""
    path = corpus.usda(folder)
    path.write_text(path.read_text().replace("frameCount = 1", "frameCount = 2147483647"))
    return path, ("beam_warp.cli.convert", "inspect", path)


def listed_json(folder):
    """Eight million lists."""
    path = folder / "transforms.json"
    path.write_text("[" + "[]," * 8_000_000 + "[]]")
    return path, ("beam_warp.cli.main", "inspect", folder)


def bomb_stage(folder):
    """A stage of thirty thousand million images."""
    path = corpus.stage(folder)
    path.write_text(path.read_text().replace('"duration": 1.5', '"duration": 1e12'))
    return path, ("beam_warp.cli.main", "render", path, "--out", folder / "o.png")


def test_what_an_asset_names_beside_layers_is_not_read(tmp_path):
    """The child process that opens an asset first spends no more if a sound of 8 GiB, here a hole, is named there."""
    path = corpus.usda(tmp_path)
    seconds = []
    for layer in ("", 'def SpatialAudio "Sound"\n{\n    uniform asset filePath = @sound.wav@\n}\n'):
        path.write_text(path.read_text() + layer)
        (tmp_path / "sound.wav").touch()
        os.truncate(tmp_path / "sound.wav", 2**33)
        begun = resource.getrusage(resource.RUSAGE_CHILDREN)
        require_opens(path)
        done = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(done.ru_utime + done.ru_stime - begun.ru_utime - begun.ru_stime)
    assert seconds[1] < seconds[0] + PROBE_SECONDS


@pytest.mark.parametrize("make", [bomb_exr, huge_ply, hollow_ply, counting_usd, listed_json, bomb_stage])
def test_the_budget_of_bad_input(make, tmp_path):
    path, words = make(tmp_path)
    before = {file.name for file in tmp_path.iterdir()}
    command = [sys.executable, "-P", "-c", MEASURED, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    code, seconds, memory = (float(word) for word in done.stdout.split()[-3:])
    assert code == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert seconds < 2 * SECONDS  # the processor's time of both processes; either has its own cores
    assert memory < MEMORY + 2 * path.stat().st_size
    assert {file.name for file in tmp_path.iterdir()} == before
