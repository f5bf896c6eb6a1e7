"""Scores of an asset against the exact channels of a capture."""
