import pytest
from engines.unity.csharp import HERE, PARSER, compiled


@pytest.fixture(scope="session")
def dump(tmp_path_factory):
    """The parser as a program; see Dump.cs."""
    program = tmp_path_factory.mktemp("dump") / "dump.exe"
    said = compiled([HERE / "Dump.cs", *PARSER], program)
    assert not said, said
    return program
