"""What a killed program leaves."""

import subprocess
import sys
from pathlib import Path

from beam_warp.outputs import temporary_path


def temporary_of_the_dead(path):
    """A temporary name beside a path, of a process that has ended."""
    code = "import sys, pathlib, beam_warp.outputs as o; print(o.temporary_path(pathlib.Path(sys.argv[1])))"
    done = subprocess.run([sys.executable, "-P", "-c", code, str(path)], capture_output=True, text=True, check=True)
    found = Path(done.stdout.rstrip("\n"))
    assert found.parent == temporary_path(path).parent
    return found
