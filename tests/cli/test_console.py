"""What commands print: stages, kernels that are compiled, and errors in the words of the command line."""

import io
from dataclasses import dataclass
from typing import Annotated

import pytest
import warp as wp
from tyro.conf import OmitArgPrefixes, Positional, arg

from beam_warp.cli.common.console import COMPILING, options_named, progress, rate_in_words
from beam_warp.device.arrays import resolve_device
from beam_warp.device.compilation import compilation_heard
from beam_warp.errors import InvalidOptionError


def fresh_kernel():
    """Return a kernel in a module of its own; the first launch loads it."""

    @wp.kernel(module="unique", enable_backward=False)
    def add_one_kernel(out_values: wp.array[float]):
        row = wp.tid()
        out_values[row] = out_values[row] + 1.0

    return add_one_kernel


def launch(kernel):
    values = wp.zeros(3, dtype=float, device="cpu")
    wp.launch(kernel, dim=3, outputs=[values], device="cpu")
    return values.numpy().tolist()


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(autouse=True)
def cold_cache(tmp_path, monkeypatch):
    resolve_device("cpu")  # Warp states where its cache is once it is initialised
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))


def test_compilation_is_told_once(tmp_path):
    """A cold cache tells of one module, a warm one of none; what is told before and after is not doubled."""
    told = []
    with compilation_heard(lambda count, seconds, *, is_running: told.append((count, seconds > 0.0, is_running))):
        kernel = fresh_kernel()
        assert launch(kernel) == [1.0] * 3
        assert told == [(1, False, True), (1, True, False)]
        kernel.module.unload()
        assert launch(kernel) == [1.0] * 3
    assert len(told) == 2
    for path in tmp_path.rglob("*.o"):
        path.unlink()
    kernel.module.unload()
    assert launch(kernel) == [1.0] * 3
    assert len(told) == 2


def test_a_terminal_shows_it_and_nothing_else_does(tmp_path, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "160")
    kernel = fresh_kernel()
    for stream, quiet, is_shown in (
        (Terminal(), False, True),
        (Terminal(), True, False),
        (io.StringIO(), False, False),
    ):
        monkeypatch.setattr("sys.stderr", stream)
        for path in tmp_path.rglob("*.o"):
            path.unlink()
        kernel.module.unload()
        with progress(quiet) as report:
            report("fit", 50, 100, "frame 0, 31.25 dB")
            report("fit", 1, 100, "frame 1, 12.00 dB")
            report("write asset", 1, 1)
            launch(kernel)
        assert (COMPILING in stream.getvalue()) == is_shown
        assert ("frame 1, 12.00 dB" in stream.getvalue()) == is_shown


def test_rates():
    assert rate_in_words(None) == rate_in_words(0.0) == ""
    assert rate_in_words(12.34) == "12.3/s"
    assert rate_in_words(0.125) == "8.0 s each"


@dataclass
class Inner:
    """Options of a group."""

    sh_degree: int = 0
    fps: float = 0.0


@dataclass
class Words:
    """Options of a command."""

    asset: Positional[str]
    inner: OmitArgPrefixes[Inner]
    target: Annotated[str | None, arg(name="for")] = None


def test_errors_name_the_options_that_they_are_about():
    for said, shown in (
        ("sh_degree must be 3, got sh_degree 1. Mend it.", "--sh-degree must be 3, got sh_degree 1. Mend it."),
        ("frames_per_second must be positive.", "--fps must be positive."),
        ("sh-degree, target and fps must go.", "--sh-degree, --for and --fps must go."),
        ("asset must be a file.", "asset must be a file."),  # no option sets it
        ("sh_degree and depth must go.", "sh_degree and depth must go."),
        ("a.ply: sh_degree must be 3.", "a.ply: sh_degree must be 3."),  # a file's own word
        ("no contract", "no contract"),
    ):
        with pytest.raises(InvalidOptionError) as error, options_named(Words):
            raise InvalidOptionError(said)
        assert str(error.value) == shown
