"""Fuzzes the readers of captures: ``python tests/fuzz/captures.py -max_total_time=3600``, or any libFuzzer option."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent))
    from fuzz.engine import fuzz

    fuzz(Path(__file__).stem)
