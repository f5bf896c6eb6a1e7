"""One thread for every test of reconstruction that does not ask for more."""

import pytest


@pytest.fixture(autouse=True)
def one_thread(monkeypatch):
    """Images here are so small that threads only wait for one another."""
    monkeypatch.setenv("BEAM_WARP_THREADS", "1")
