"""``beam`` in this process."""

from beam_warp.cli.main import main


def beam(*words):
    """Return the exit code."""
    return main([str(word) for word in words])
