"""Write the .meta files of the Unity package: without them, Unity ignores what is in a package from git.

    python engines/unity/metas.py

An identity is the digest of the path, so that it never changes.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

PACKAGE = Path(__file__).parent / "com.beam.relightable"


def metas() -> dict[Path, str]:
    """Return every .meta file and its text; folders that end in ``~`` are hidden from Unity."""
    found = {}
    for path in sorted(PACKAGE.rglob("*")):
        inside = path.relative_to(PACKAGE)
        if path.suffix == ".meta" or any(part.endswith("~") for part in inside.parts):
            continue
        guid = hashlib.md5(f"com.beam.relightable/{inside.as_posix()}".encode(), usedforsecurity=False).hexdigest()
        folder = "folderAsset: yes\n" if path.is_dir() else ""
        found[path.with_name(path.name + ".meta")] = f"fileFormatVersion: 2\nguid: {guid}\n{folder}"
    return found


if __name__ == "__main__":
    for meta, text in metas().items():
        meta.write_text(text, encoding="utf-8")
