"""Tests of engines: a package, because `benchmarks/engines.py` has its name."""
