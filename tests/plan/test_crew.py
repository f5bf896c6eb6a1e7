"""Who works, by the words of a command line."""

import pytest
from support.toy_work import toy_plan

from beam_warp.cli import main
from beam_warp.errors import InvalidOptionError
from beam_warp.jobs.listeners import no_progress
from beam_warp.plan import crew
from beam_warp.plan.workers import InProcess


@pytest.fixture
def started(monkeypatch):
    """What processes would be started with, on a machine with two GPUs."""
    found = []
    monkeypatch.setattr(crew, "Processes", lambda works, terms, settings, progress: found.extend(settings))
    monkeypatch.setattr(crew, "visible_gpus", lambda: ["3", "5"])
    return found


@pytest.mark.parametrize(
    ("words", "named", "gpus"),
    [
        ("auto", None, ["3", "3"]),
        ("auto", "cuda:1", [None, None]),  # all find it by its name
        ("3", None, ["3", "5", "3"]),
        ("gpus", None, ["3", "5"]),
        ("2@gpus", None, ["3", "5", "3", "5"]),
    ],
)
def test_processes_share_gpus(tmp_path, started, words, named, gpus):
    crew.crew_of(words, named)(toy_plan(tmp_path), "cuda", no_progress)
    assert [setting.get("CUDA_VISIBLE_DEVICES") for setting in started] == gpus


@pytest.mark.parametrize("words", ["auto", "1"])
def test_without_a_gpu_this_process_works(tmp_path, words):
    assert isinstance(crew.crew_of(words, None)(toy_plan(tmp_path), "cpu", no_progress), InProcess)


@pytest.mark.parametrize("words", ["", "0", "257", "two", "@gpus", "1@ray@", "auto@gpus"])
def test_words_that_mean_nothing_are_refused(words):
    with pytest.raises(InvalidOptionError, match="workers must be auto, a number from 1 to 256"):
        crew.crew_of(words, None)


@pytest.mark.parametrize(
    ("words", "forks"),
    [
        ("run x", True),
        ("run x --workers auto --device cuda:0", True),
        ("run x --device cpu", False),
        ("run x --device=cpu --workers=2", True),
        ("run x --workers 1", False),
    ],
)
def test_a_server_is_started_early_where_it_will_be_needed(tmp_path, monkeypatch, words, forks):
    monkeypatch.setattr(main, "GPU_DRIVERS", (tmp_path,))
    assert main._forks(words.split()) == forks
    monkeypatch.setattr(main, "GPU_DRIVERS", (tmp_path / "none",))
    assert main._forks(words.split()) == (forks and "2" in words)
