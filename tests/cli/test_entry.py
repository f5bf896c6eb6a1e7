"""Programs from their first moment: Ctrl-C stops them, native libraries are not heard, nothing ends in a traceback."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from beam_warp.cli.common.console import escaped, run_command
from beam_warp.errors import AssetFormatError

ENTRY = "import sys; sys.argv[0] = 'beam'; from beam_warp.cli import entry; sys.exit(entry.{}())"


def program(*words, name="beam", **options):
    """Run a program as its script does."""
    command = [sys.executable, "-c", ENTRY.format(name), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, **options)


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (AssetFormatError("a.ply must\x1b[31m be\nwhole"), r"a.ply must\x1b[31m be\nwhole"),
        (OSError(36, "File name too long", "x.ply"), "x.ply must be within reach, got File name too long."),
        (PermissionError(13, "Permission denied", "a"), "a must be within reach, got Permission denied."),
        (OSError("no reason"), "files must be within reach, got no reason."),
        (UnicodeEncodeError("utf-8", "\udc80", 0, 1, "surrogates not allowed"), "names and texts must be UTF-8, got"),
        (MemoryError(), "memory must hold what is worked on, got too little of it."),
    ],
)
def test_what_the_caller_can_mend_is_one_line(error, says, capsys):
    def fails():
        raise error

    assert run_command(fails) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"error: {says}")
    assert printed.count("\n") == 1
    assert printed.rstrip("\n").isprintable()


def test_what_does_not_print_is_escaped():
    assert escaped("Gräfin ρ × –") == "Gräfin ρ × –"
    assert escaped("\x1b]0;evil\x07\r\n\x9b31m\u202e\udc80") == r"\x1b]0;evil\x07\r\n\x9b31m\u202e\udc80"


def test_a_fault_of_ours_keeps_its_traceback():
    def fails():
        raise TypeError("ours")

    with pytest.raises(TypeError, match="ours"):
        run_command(fails)


@pytest.mark.parametrize("name", ["beam", "beam_convert", "beam_validate"])
def test_names_that_no_file_can_have(name, tmp_path):
    words = {"beam": ["inspect"], "beam_convert": ["inspect"], "beam_validate": []}[name]
    for place in (f"{'x' * 300}.usda", b"\xff.usda".decode("utf-8", "surrogateescape")):
        done = program(*words, os.fsencode(tmp_path / place).decode("utf-8", "surrogateescape"), name=name)
        assert done.returncode == 2
        assert done.stderr.startswith("error: ")
        assert done.stderr.count("\n") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="signals as POSIX has them")
def test_ctrl_c_during_an_import_stops(tmp_path):
    """The interrupt comes in the middle of an import that swallows it, as extension modules do."""
    interrupted = tmp_path / "wait.py"
    interrupted.write_text(
        f"import signal, sys, time\nsys.path.insert(0, {str(tmp_path)!r})\n"
        "from beam_warp.cli import entry\n"
        "signal.signal(signal.SIGINT, entry.interrupt)\n"
        "import swallows\n"
        "time.sleep(20)\n"
    )
    (tmp_path / "swallows.py").write_text(
        "import signal\ntry:\n    signal.raise_signal(signal.SIGINT)\nexcept BaseException:\n    pass\n"
    )
    done = subprocess.run([sys.executable, str(interrupted)], capture_output=True, text=True, timeout=15, check=False)
    assert "KeyboardInterrupt" in done.stderr
    assert done.returncode == -signal.SIGINT


def test_native_libraries_are_heard_only_where_we_say_nothing(tmp_path):
    script = tmp_path / "work.py"
    script.write_text(
        "import os, sys\n"
        "from beam_warp.cli.entry import with_streams_of_our_own\n"
        "def work():\n"
        "    os.write(1, b'native out\\n'); os.write(2, b'native err\\n')\n"
        "    print('ours \\udc80'); print('said', file=sys.stderr)\n"
        "    return int(sys.argv[1])\n"
        "sys.exit(with_streams_of_our_own(work))\n"
    )
    for code, noise in ((2, ""), (0, "native out\nnative err\n")):
        done = subprocess.run([sys.executable, script, str(code)], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (code, "ours \\udc80\n", f"said\n{noise}")


def test_a_damaged_exr_is_one_line(tmp_path):
    """OpenEXR itself writes two more."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: np.ones((16, 32), np.float16) for name in "RGB"}).write(str(tmp_path / "a.exr"))
    content = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(content[:-30])
    words = ("render", "x.ply", "--environment", tmp_path / "a.exr", "--out", tmp_path / "o.png")
    (tmp_path / "x.ply").write_bytes(b"ply\n")
    done = program(*words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("given", "used"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")])
def test_blas_has_one_thread_unless_the_user_says_otherwise(given, used):
    script = "import os, sys; sys.argv[1:] = ['--version']; from beam_warp.cli import entry; assert 'numpy' not in "
    script += "sys.modules; entry.beam(); print(os.environ['OPENBLAS_NUM_THREADS'])"
    plain = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"} | given
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=plain, check=False)
    assert done.stdout.split()[-1] == used, done.stderr


def test_nobody_reads_the_output():
    command = [sys.executable, "-c", ENTRY.format("beam"), "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.close()
        assert child.stderr is not None
        assert b"Traceback" not in child.stderr.read()


@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is KiB on Linux alone")
@pytest.mark.parametrize("columns", ["1", "-5", "100000000"])
def test_help_in_any_width(columns):
    """Help in one column took 100 s and 914 MiB."""
    code = (
        "import resource, sys; from beam_warp.cli.main import main\n"
        "begun = resource.getrusage(resource.RUSAGE_SELF)\n"
        "try:\n    main(['run', '--help'])\n"
        "finally:\n    used = resource.getrusage(resource.RUSAGE_SELF)\n"
        "    print(used.ru_utime, used.ru_maxrss - begun.ru_maxrss, file=sys.stderr)\n"
    )
    command = [sys.executable, "-P", "-c", code]
    options = {"capture_output": True, "text": True, "timeout": 90, "check": True}
    done = subprocess.run(command, env={**os.environ, "COLUMNS": columns}, **options)
    seconds, memory = map(float, done.stderr.split()[-2:])
    assert "--environment" in done.stdout
    assert seconds < 10.0
    assert memory < 256 * 1024
