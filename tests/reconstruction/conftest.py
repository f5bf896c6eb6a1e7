"""One thread for every test of reconstruction that does not ask for more, and a real capture's first frame."""

import pytest

from beam_warp.capture.capture import Capture


@pytest.fixture(autouse=True)
def one_thread(monkeypatch):
    """Images here are so small that threads only wait for one another."""
    monkeypatch.setenv("BEAM_WARP_THREADS", "1")


@pytest.fixture(scope="session")
def walker_views(data_dir):
    """What the training cameras of the walker see in its first frame."""
    records = Capture.read(data_dir / "captures" / "walker").select(split="train", frames=[0])
    return [record.view() for record in records]
