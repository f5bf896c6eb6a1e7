"""Zip archives that strangers made, opened only if their directory is small: each entry costs memory and time."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FEW_FILES = 1 << 17
"""Bytes of a directory that lists a thousand files [byte]."""

MANY_FILES = 1 << 21
"""Bytes of a directory that lists twenty thousand files [byte]."""


class _Measured(io.BufferedReader):
    """A file that refuses to return many bytes at once, while ``most`` is set [byte]."""

    most: int | None = None

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes; a directory is read at once, and nothing else is as long when an archive is opened."""
        content = super().read(size)
        if self.most is not None and len(content) > self.most:
            raise zipfile.BadZipFile(f"a directory of {len(content)} bytes")
        return content


@contextmanager
def open_zip(path: Path, most_bytes: int = FEW_FILES) -> Iterator[zipfile.ZipFile]:
    """Open an archive for reading.

    Args:
        path: The archive.
        most_bytes: Largest directory that is read [byte], at least `FEW_FILES`.

    Raises:
        OSError: It cannot be opened.
        zipfile.BadZipFile, ValueError, NotImplementedError, struct.error: It is malformed, or lists too many files.
    """
    with _Measured(io.FileIO(path)) as stream:
        stream.most = most_bytes
        with zipfile.ZipFile(stream) as archive:
            stream.most = None
            yield archive
