"""A minute of fuzzing for each family of formats, and a check that the targets read what they should."""

import importlib.util
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fuzz.engine import prepare

FAMILIES = ("splats", "captures", "images")
SECONDS = 60


@pytest.mark.parametrize("family", FAMILIES)
def test_targets_read_sound_files_and_answer_spoiled_ones(family, tmp_path):
    read, seeds = prepare(family, tmp_path)
    assert len(seeds) >= 3
    rng = np.random.default_rng(17)
    read(b"")
    for seed in seeds:
        read(seed)
        for _ in range(20):
            damaged = bytearray(seed)
            for place in rng.integers(1, len(seed), 3):
                damaged[place] = rng.integers(256)
            read(bytes(damaged))


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_a_minute_of_fuzzing_finds_nothing(family, tmp_path):
    if importlib.util.find_spec("atheris") is None:
        pytest.skip("atheris is not installed (extra fuzz)")
    script = Path(__file__).with_name(f"{family}.py")
    command = [sys.executable, "-P", str(script), f"-max_total_time={SECONDS}", f"-artifact_prefix={tmp_path}/"]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True, timeout=10 * SECONDS, check=False)
        if done.returncode != -signal.SIGALRM:  # libFuzzer's own timer ended it, once in a dozen runs: run it again
            break
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Done" in done.stderr
