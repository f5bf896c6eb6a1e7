"""Zip the add-on with its decoder, to be installed from disk: ``python engines/blender/zip_addon.py TARGET.zip``."""

import sys
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
DECODER = HERE.parents[1] / "converters" / "delivery" / "decoder.py"


def build(target: Path) -> None:
    """Write the extension: the files of the add-on, and the decoder that it shares with the converters."""
    files = {path.name: path for path in sorted((HERE / "beam_relightable").iterdir()) if path.is_file()}
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, path in (files | {"decoder.py": DECODER, "LICENSE": HERE.parents[1] / "LICENSE"}).items():
            archive.write(path, name)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("target must be one path, got none. Run python engines/blender/zip_addon.py beam_relightable.zip.")
    build(Path(sys.argv[1]))
