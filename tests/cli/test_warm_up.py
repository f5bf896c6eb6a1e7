"""``beam warm-up``: after it, a job has nothing to compile."""

import json
from pathlib import Path

import pytest
from support.commands import beam

from beam_warp.demo.capture import write_demo_capture


@pytest.mark.slow
def test_a_job_has_nothing_left_to_compile(tmp_path, capsys):
    assert beam("warm-up", "--device", "cpu", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    known = set(Path(found["cache"]).glob("*/*"))
    assert any(path.suffix == ".o" for path in known)
    capture = write_demo_capture(
        tmp_path / "capture", frame_count=2, camera_count=6, test_camera_count=0, size=48, samples=1, device="cpu"
    )
    words = ("--preset", "draft", "--gaussians", 300, "--device", "cpu", "--quiet")
    assert beam("run", capture.folder, *words, "--out", tmp_path / "out") == 0
    assert set(Path(found["cache"]).glob("*/*")) == known
