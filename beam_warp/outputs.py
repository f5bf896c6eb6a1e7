"""Outputs that appear whole or not at all: temporary names, what a killed program left of them, files never replaced.

A temporary name states the process that writes it. So what is left of a process that has ended can be told from what a
living one is at, and is removed by the next job in the same folder.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from beam_warp.errors import BeamError, InvalidOptionError, OutputError

KEPT_BYTES = 160
"""Most of an output's name that its temporary name repeats [byte], so that this is a name, too."""

ROOM = 40
"""What is added to the name of an output for its frames and layers, at most [byte]."""

_HOST = hashlib.blake2b(platform.node().encode(errors="replace"), digest_size=4).hexdigest()
"""This machine in temporary names: others may write into the same folder, and their processes are not known here."""

_TEMPORARY = re.compile(rf"\..+\.(\d+)-{_HOST}\.[0-9a-f]{{8}}\.tmp(\.\w+)?")

_originals: list[dict[tuple[int, int], Path]] = []
"""Files that are read and must stay, by device and inode, so that links and other spellings of a name do not matter:
one table for each `originals_kept` that is entered."""


def temporary_path(path: Path) -> Path:
    """Return a hidden name beside a path that no other writer has."""
    start = path.name.encode(errors="replace")[:KEPT_BYTES].decode(errors="ignore")
    return path.with_name(f".{start}.{os.getpid()}-{_HOST}.{os.urandom(4).hex()}.tmp{path.suffix[:8]}")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path``; the file replaces ``path`` on success and is removed on failure.

    Raises:
        InvalidOptionError: The file is one of those that `originals_kept` protects.
        OutputError: It cannot be written.
    """
    require_apart([path])
    temporary = temporary_path(path)
    try:
        yield temporary
        temporary.replace(path)
    except BeamError:  # says already what is wrong
        raise
    except (OSError, RuntimeError) as error:
        number = getattr(error, "errno", None)
        reason = os.strerror(number) if number else " ".join(str(error).split())
        raise OutputError(
            f"output must be a writable file, got {path} ({reason}). Choose a folder that exists and has room."
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_leftovers(*folders: Path) -> list[str]:
    """Remove the temporary files and folders of processes that have ended, and say so in a note, if there were any.

    Files of living processes, of other machines and of others than this package stay.
    """
    count = 0
    for folder in folders:
        for path in folder.iterdir() if folder.is_dir() else ():
            match = _TEMPORARY.fullmatch(path.name)
            if match is None or is_alive(int(match[1])):
                continue
            with suppress(OSError):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
                count += 1
    return [f"removed {count} unfinished file{'s'[: count > 1]} that a stopped call had left"] if count else []


def is_alive(process: int) -> bool:
    """Return whether a process of this machine runs; where that cannot be asked, it does.

    A process that has ended keeps its number until its parent asks how. In a container whose first process never asks,
    that is for ever: so Linux is asked for the state, too.
    """
    if sys.platform == "win32":
        return True
    with suppress(OSError, IndexError):
        if Path(f"/proc/{process}/stat").read_text(errors="replace").rpartition(")")[2].split()[0] in "ZX":
            return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's
        return True
    return True


@contextmanager
def originals_kept() -> Iterator[None]:
    """Let `replacing` refuse inside what `keep_original` names: work that goes wrong must not cost the original."""
    _originals.append({})
    try:
        yield
    finally:
        _originals.pop()


def keep_original(*paths: Path) -> None:
    """Protect files that are read until the surrounding `originals_kept` ends; without one, nothing is done."""
    for path in paths if _originals else ():
        with suppress(OSError):
            _originals[-1][_identity(path)] = path


def keeps_originals() -> bool:
    """Return whether `keep_original` does anything."""
    return bool(_originals)


def kept_originals() -> list[Path]:
    """Return the files that are protected."""
    return [path for table in _originals for path in table.values()]


def require_apart(paths: Iterable[Path], name: str = "output") -> None:
    """Refuse to write over what is read.

    Raises:
        InvalidOptionError: A path is a file that `keep_original` named, by whatever name.
    """
    for path in paths if _originals else ():
        with suppress(OSError):
            identity = _identity(path)
            if any(identity in table for table in _originals):
                raise InvalidOptionError(
                    f"{name} must be another file than those that are read, got {path}. Rename it."
                )


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino
