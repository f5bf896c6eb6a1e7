"""Fixtures of all commands: light that is soon ready, files that are trusted, and what a mistake comes to."""

import pytest
from support.commands import beam


@pytest.fixture(autouse=True)
def quick_commands(coarse_irradiance, trusted_files):
    """No command's test looks at the light's last digits or at broken USD files."""


@pytest.fixture
def refused(capsys, tmp_path):
    """Check that ``beam`` refuses words: exit code 2, one clear line, and nothing that was not there before."""

    def check(*words, says):
        before = sorted(tmp_path.rglob("*"))
        capsys.readouterr()
        assert beam(*words) == 2
        said = capsys.readouterr()
        assert said.out == ""
        (line,) = said.err.strip().splitlines()
        assert line.startswith("error: ")
        assert says in line
        assert sorted(tmp_path.rglob("*")) == before

    return check
