"""Digests of a capture's frames: two frames with the same digest reconstruct to the same bytes.

A digest covers everything that a record states (camera, lens, names) and the *content* of its files, so a capture may
be moved or copied. Content is read again only if a file's path, size, times or inode have changed since it was last
read, as in version control: reading gigabytes to learn that nothing has changed would be slow.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from beam_warp.capture.capture import CaptureRecord
from beam_warp.digests import content_digest, described, fields_of
from beam_warp.errors import MissingFileError, OutputError
from beam_warp.image.film import is_film
from beam_warp.outputs import replacing

UNREAD_FIELDS = frozenset({"truth_path", "relit_paths"})
"""Fields of a record that reconstruction never reads."""


class CaptureDigests:
    """Digests of frames, with a memory: one small file a frame that lists the digests of the images."""

    def __init__(self, folder: Path) -> None:
        """Keep the memory in a folder, which must exist."""
        self._folder = folder
        self._films: dict[str, list[Any]] = {}  # hold many frames, and are read once for all of them

    def of(self, frame: int, records: Sequence[CaptureRecord], pool: Executor) -> str:
        """Return the digest of one frame's records, in their order; the pool reads the files.

        Raises:
            MissingFileError: A file is not there or cannot be read.
        """
        memory = self._folder / f"frame_{frame:06d}.json"
        known = _remembered(memory)
        told = {**known, **self._films}
        paths = sorted({path for record in records for path in files_of(record)})
        found = dict(zip(paths, pool.map(lambda path: content_digest(path, told), paths), strict=True))
        fresh = {str(path): [*stamp, digest] for path, (stamp, digest) in found.items() if stamp is not None}
        self._films |= {name: entry for name, entry in fresh.items() if is_film(Path(name))}
        if fresh != known:
            _remember(memory, fresh)
        content = [
            described(
                {name: value for name, value in fields_of(record) if name not in UNREAD_FIELDS},
                lambda path: [path.suffix.lower(), found[path][1]],
            )
            for record in records
        ]
        return hashlib.blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=16).hexdigest()


def files_of(record: CaptureRecord) -> list[Path]:
    """Return the files of a record that reconstruction reads."""
    return [value for name, value in fields_of(record) if isinstance(value, Path) and name not in UNREAD_FIELDS]


def require_files(records: Iterable[CaptureRecord]) -> None:
    """Refuse records whose files are not there, before any work starts.

    Raises:
        MissingFileError: A file does not exist; the message names the first one and their number.
    """
    missing = [path for record in records for path in files_of(record) if not path.is_file()]
    if missing:
        raise MissingFileError(
            f"images of the capture must exist, got none at {missing[0]} ({len(missing)} missing in all). "
            "Restore them, or leave their records out."
        )


def _remembered(path: Path) -> dict[str, list[Any]]:
    """Read what is known of a frame's files; nothing is known if the memory is absent or damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): list(entry) for name, entry in content.items()}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}


def _remember(path: Path, content: Mapping[str, Any]) -> None:
    """Keep what is known; a failure to do so only costs time later."""
    with contextlib.suppress(OutputError), replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n", encoding="utf-8")
