"""Copies of the checkout in which tests run, each with the packages where they are installed and its own kernels."""

from __future__ import annotations

import compileall
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
MAPPED = ("kernels", "schema", "converters")
"""Folders that are installed inside of ``beam_warp``."""

READ = ("beam_warp", *MAPPED, "tests", "benchmarks", "docs")
"""Folders that tests read."""

READS_KERNELS = "tests/kernels/common/test_launching.py::test_kernels_with_atomics_are_launched_in_order"
"""A test of sources, which a mutant could break without doing harm."""


def installed(file: str) -> str:
    """Return where a source file of the checkout lies in a tree."""
    return f"beam_warp/{file}" if file.split("/")[0] in MAPPED else file


@dataclass
class Tree:
    """A copy of the checkout in which the packages lie as they are installed, with a kernel cache of its own."""

    folder: Path
    kernels: Path
    warm: set[Path] = field(default_factory=set)

    @classmethod
    def of_checkout(cls, folder: Path, kernels: Path) -> Tree:
        shutil.rmtree(folder, ignore_errors=True)
        for name in READ:
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".*"))
        for path in filter(Path.is_file, ROOT.iterdir()):
            shutil.copy2(path, folder)
        for name in MAPPED:
            (folder / name).rename(folder / "beam_warp" / name)
            (folder / name).symlink_to(Path("beam_warp") / name)
        compileall.compile_dir(folder, quiet=2, workers=0)
        kernels.mkdir(parents=True, exist_ok=True)
        return cls(folder, kernels)

    def copied(self, folder: Path) -> Tree:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.folder, folder / "tree", symlinks=True)
        shutil.copytree(self.kernels, folder / "kernels", copy_function=os.link)
        return Tree(folder / "tree", folder / "kernels", set(folder.glob("kernels/*/*")))

    def cool(self) -> None:
        """Remove the kernels of the last mutant."""
        for path in set(self.kernels.glob("*/*")) - self.warm:
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def pytest(self, files: list[str], scratch: Path, stop: float, **words: str) -> tuple[int, str]:
        """Run test files; return pytest's exit status, or minus a signal, and what it said."""
        shutil.rmtree(scratch, ignore_errors=True)
        (scratch / "hypothesis").mkdir(parents=True)
        threads = dict.fromkeys(("BEAM_WARP_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        paths = [str(self.folder), str(self.folder / "tests"), os.environ.get("PYTHONPATH", "")]
        places = {"BEAM_DATA": str(scratch / "no data"), "HYPOTHESIS_STORAGE_DIRECTORY": str(scratch / "hypothesis")}
        places |= {"PYTHONPATH": os.pathsep.join(filter(None, paths)), "WARP_CACHE_PATH": str(self.kernels)}
        places |= {"CUDA_VISIBLE_DEVICES": "", "PYTHONDONTWRITEBYTECODE": "1"}
        command = [
            sys.executable,
            "-P",
            "-m",
            "pytest",
            "-p",
            "tools.plugin",
            "-p",
            "no:cacheprovider",
            "-x",
            "--deselect",
            READS_KERNELS,
        ]
        command += ["-m", "not slow", "--hypothesis-seed=0", f"--basetemp={scratch / 'tmp'}", *files]
        environment = os.environ | threads | places | words
        with (scratch / "said").open("wb") as said:
            process = subprocess.Popen(
                command, cwd=self.folder, env=environment, stdout=said, stderr=said, start_new_session=True
            )
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, stop - time.monotonic()))
            with contextlib.suppress(ProcessLookupError):  # else what it started, or itself, still runs
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        return process.returncode, (scratch / "said").read_text(errors="replace")
