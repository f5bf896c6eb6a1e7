"""PLY in and out: full, compressed, and with the materials of other producers."""
