"""The words of ``beam`` and their help: a first page of at most 20 options, and a second one with all of them."""

import re
import subprocess
import sys
from dataclasses import dataclass, field
from typing import Annotated

import pytest
from tyro.conf import OmitArgPrefixes, arg

from beam_warp.cli.common.pages import MORE, SECOND_PAGE, parse
from beam_warp.cli.convert import main as convert
from beam_warp.cli.main import COMMANDS, main

MOST = 20
"""Options on a first page, that for help among them."""


def options_of(said):
    return set(re.findall(r"^\W*(?:-h, )?--([a-z][a-z-]*)", said, re.MULTILINE))


def help_of(command, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        command(words)
    assert stopped.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    [*([word] for word in COMMANDS if word != "chart"), ["chart", "tracing"], ["chart", "materials"]],
    ids=" ".join,
)
def test_first_pages_are_short_and_second_pages_whole(words, capsys):
    first = help_of(main, [*words, "--help"], capsys)
    whole = help_of(main, [*words, "--help-all"], capsys)
    assert len(options_of(first)) <= MOST
    assert options_of(first) <= options_of(whole)
    assert first.count(MORE) == (options_of(first) != options_of(whole))
    assert MORE not in whole
    assert f"Example: beam {' '.join(words)}" in " ".join(first.split())
    if words == ["render"]:
        assert len(options_of(whole)) > 40
        for example in ("--frames 0:150 --mode path --out turntable.mp4", "--speed 0.25", "--turns 1"):
            assert example in " ".join(first.split())


def test_beam_convert_has_one_short_page(capsys):
    assert 3 < len(options_of(help_of(convert, ["--help"], capsys))) <= MOST


def test_the_overview_names_every_command(capsys):
    assert main(["--help"]) == 0
    said = capsys.readouterr().out
    for word, command in COMMANDS.items():
        assert re.search(rf"^  {word} +{re.escape(command.line)}$", said, re.MULTILINE)
    assert main([]) == 2


def test_a_word_that_is_no_command(capsys):
    assert main(["relight"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: command must be one of run, reconstruct, decompose, render, channel, view,")
    assert error.endswith(", got relight. See beam --help.\n")


@dataclass(frozen=True)
class Inner:
    """A group."""

    low: int = 1
    high: Annotated[int, arg(help="More."), SECOND_PAGE] = 2


@dataclass(frozen=True)
class Outer:
    """A command."""

    out: str
    group: OmitArgPrefixes[Inner] = field(default_factory=Inner)


def test_options_of_the_second_page_are_read_like_others(capsys):
    assert parse(Outer, ["--out", "x", "--high", "5"], "x") == Outer("x", Inner(1, 5))
    assert options_of(help_of(lambda words: parse(Outer, words, "x"), ["--help"], capsys)) == {"help", "out", "low"}


def test_help_and_mistakes_do_not_wait_for_warp(tmp_path):
    script = (
        "import sys\nfrom beam_warp.cli.main import main\n"
        "assert main(['--help']) == 0\nassert 'warp' not in sys.modules\n"
        "assert main(['run', 'none.ply', '--environment', 'x.exr', '--out', 'y']) == 2\n"
        "assert not {'warp', 'pxr'} & set(sys.modules), sorted(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
