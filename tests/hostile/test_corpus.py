"""Every spoiled file of the corpus ends in one line and exit code 2, soon and in little memory; others may be read."""

import dataclasses
import re
import shutil
import tempfile
import time
from pathlib import Path

import pytest
from hostile.corpus import READERS
from hostile.ways import cases

from beam_warp.cli.common.console import run_command

SECONDS = 2.0
MEMORY = 256 * 2**20
NAME_IN_STATUS = re.compile(r"VmHWM:\s+(\d+) kB")


def peak_memory(*, begin=False):
    """The most memory [byte] that this process has held since the last call with ``begin``; 0 where nobody counts."""
    try:
        if begin:
            Path("/proc/self/clear_refs").write_text("5")
        return 1024 * int(NAME_IN_STATUS.search(Path("/proc/self/status").read_text())[1])
    except OSError:
        return 0


def outcome(reader, path, capsys):
    """Return the exit code, what was printed, the processor's time and the memory; a traceback is told as such."""
    held, started = peak_memory(begin=True), time.process_time()
    try:
        code = run_command(lambda: 0 if reader.read(path) is not run_command else 1)
    except BaseException as error:
        code = f"{type(error).__name__}: {error}"
    return code, capsys.readouterr().err, time.process_time() - started, peak_memory() - held


def is_one_line(text):
    """True of an error in the words of the house."""
    one_line = text.startswith("error: ") and text.count("\n") == 1 and text[:-1].isprintable()
    return one_line and " must " in text and ", got " in text and len(text) < 1000


SLOW = {True: [pytest.mark.slow], False: []}


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW[it.is_slow]) for name, it in READERS.items()])
def test_spoiled_files(name, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    reader = READERS[name]
    path = reader.make(tmp_path)
    sound, beside = path.read_bytes(), {file.name for file in tmp_path.iterdir()}
    code, printed, *_ = outcome(reader, path, capsys)
    assert code == 0, printed
    faults = []
    for case in cases(reader, sound):
        path.write_bytes(case.content)
        code, printed, seconds, memory = outcome(reader, path, capsys)
        if not (code == 2 and is_one_line(printed)) and (case.is_fatal or code != 0):
            faults.append((case.name, code, printed[:200]))
        if not (seconds < SECONDS and memory < MEMORY + 2 * len(case.content)):
            faults.append((case.name, f"{seconds:.1f} s", f"{memory / 2**20:.0f} MiB"))
        if left := {file.name for file in tmp_path.iterdir()} - beside:
            faults.append((case.name, left))
            for file in left:
                shutil.rmtree(tmp_path / file, ignore_errors=True)
    assert not faults, "\n".join(map(str, faults))


def test_the_corpus_is_large(tmp_path):
    counts = {}
    for name, reader in READERS.items():
        folder = tmp_path / name
        folder.mkdir()
        plain = dataclasses.replace(reader, others=None)  # those that each format adds take longer to make
        counts[name] = sum(1 for _ in cases(plain, reader.make(folder).read_bytes()))
    assert sum(counts.values()) >= 300, counts
