"""Every spoiled file of the corpus ends in one line and exit code 2, soon; what is not fatal may be read instead."""

import shutil
import time

import pytest
from hostile.corpus import READERS, cases

from beam_warp.cli.common.console import run_command

SECONDS = 2.0
COUNTS = {}


def outcome(reader, path, capsys):
    """Return the exit code and what was printed, with the processor's time; a traceback is told as such."""
    started = time.process_time()
    try:
        code = run_command(lambda: 0 if reader.read(path) is not run_command else 1)
    except BaseException as error:
        code = f"{type(error).__name__}: {error}"
    taken = time.process_time() - started
    return code, capsys.readouterr(), taken


@pytest.mark.parametrize("name", READERS)
def test_spoiled_files(name, tmp_path, capsys):
    reader = READERS[name]
    path = reader.make(tmp_path)
    sound, beside = path.read_bytes(), {file.name for file in tmp_path.iterdir()}
    assert outcome(reader, path, capsys)[0] == 0
    faults, count = [], 0
    for case in cases(reader, sound):
        path.write_bytes(case.content)
        code, printed, taken = outcome(reader, path, capsys)
        count += 1
        one_line = printed.err.startswith("error: ") and printed.err.count("\n") == 1 and printed.err[:-1].isprintable()
        if not (code == 2 and one_line) and (case.is_fatal or code != 0):
            faults.append((case.name, code, printed.err[:200]))
        if not taken < SECONDS:
            faults.append((case.name, f"{taken:.1f} s"))
        if left := {file.name for file in tmp_path.iterdir()} - beside:
            faults.append((case.name, left))
            for file in left:
                shutil.rmtree(tmp_path / file, ignore_errors=True)
    assert faults == []
    COUNTS[name] = count


def test_the_corpus_is_large(tmp_path):
    counts = {}
    for name, reader in READERS.items():
        folder = tmp_path / name
        folder.mkdir()
        counts[name] = sum(1 for _ in cases(reader, reader.make(folder).read_bytes()))
    assert sum(counts.values()) >= 300, counts
