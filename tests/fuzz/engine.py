"""What the fuzz targets share: bytes become a file, errors of the package are answers, any other is a find."""

import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path


def prepare(family: str, folder: Path) -> tuple[Callable[[bytes], None], list[bytes]]:
    """Return a function that reads bytes as one of a family's formats, and data with which it reads sound files.

    The first byte chooses the format, among those of the family in `hostile.corpus.READERS`; the rest is the file.
    """
    sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))  # the corpus uses a writer of theirs
    from hostile.corpus import READERS

    from beam_warp.errors import BeamError

    readers = [reader for reader in READERS.values() if reader.family == family]
    paths, seeds = [], []
    for index, reader in enumerate(readers):
        inner = folder / str(index)
        inner.mkdir()
        paths.append(reader.make(inner))
        seeds.append(bytes([index]) + paths[-1].read_bytes())

    def read(data: bytes) -> None:
        index = data[0] % len(readers) if data else 0
        paths[index].write_bytes(data[1:])
        try:
            readers[index].read(paths[index])
        except BeamError:
            return

    return read, seeds


def fuzz(family: str) -> None:
    """Fuzz a family of formats with Atheris, from sound files, by the options of libFuzzer on the command line."""
    import atheris

    warnings.simplefilter("error", RuntimeWarning)
    scratch = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=scratch if scratch.is_dir() else None) as folder:
        corpus = Path(folder) / "corpus"
        corpus.mkdir()
        with atheris.instrument_imports(include=["beam_warp"]):
            read, seeds = prepare(family, Path(folder))
        for index, seed in enumerate(seeds):
            (corpus / str(index)).write_bytes(seed)
        atheris.Setup([sys.argv[0], "-rss_limit_mb=2048", "-timeout=10", str(corpus), *sys.argv[1:]], read)
        atheris.Fuzz()
