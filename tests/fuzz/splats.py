"""Fuzzes the readers of splats: ``python tests/fuzz/splats.py -max_total_time=3600``, with the options of libFuzzer."""

import sys
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent))
    from fuzz.engine import fuzz

    fuzz(Path(__file__).stem)
