"""Fixtures that every test may use: devices, a seeded generator, the external data folder."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

# Programs that tests start must not take the checkout in the working folder for the installed package.
os.environ.setdefault("PYTHONSAFEPATH", "1")

# A busy machine is no failure of a test.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")


def _devices() -> list[str]:
    from beam_warp.device.arrays import resolve_device

    return ["cpu", *(["cuda:0"] if resolve_device().is_cuda else [])]


def pytest_generate_tests(metafunc):
    """Run every test that takes ``device`` on the CPU and, where there is one, on the first GPU."""
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", _devices())


@pytest.fixture
def rng():
    return np.random.default_rng(20260)


@pytest.fixture
def coarse_irradiance(monkeypatch):
    """Irradiance of lights from a quarter of the rows: a sixteenth of the time, errors of 5e-5 of uniform light."""
    monkeypatch.setattr("beam_warp.world.environment.IRRADIANCE_ROWS", 128)


@pytest.fixture
def trusted_files(monkeypatch):
    """Open USD files without the trial in a process of its own, which takes longer than reading those of tests."""
    monkeypatch.setattr("beam_warp.schema.stage_queries.require_opens", lambda path: None)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of external captures and splats; tests that need it skip, saying so, where it is absent."""
    path = Path(os.environ.get("BEAM_DATA", Path(__file__).parent.parent.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"external data folder {path} is absent (set BEAM_DATA)")
    return path


@pytest.fixture(scope="session")
def tiny_capture(tmp_path_factory):
    """A capture of the demo figure with truth: 6 training cameras and 1 test camera, 2 frames of 64 x 64. Read only."""
    from beam_warp.demo.capture import write_demo_capture

    folder = tmp_path_factory.mktemp("captures") / "tiny"
    return write_demo_capture(folder, frame_count=2, camera_count=6, test_camera_count=1, size=64, device="cpu")


@pytest.fixture(scope="session")
def relit_capture(tmp_path_factory):
    """The same with truth under two more lights: 2 frames of 48 x 48 from 1 training and 2 test cameras. Read only."""
    from beam_warp.demo.capture import write_demo_capture
    from beam_warp.demo.lights import stage, sunset

    return write_demo_capture(
        tmp_path_factory.mktemp("captures") / "relit",
        frame_count=2,
        camera_count=1,
        test_camera_count=2,
        size=48,
        samples=4,
        relit={"sunset": sunset(), "stage": stage()},
        device="cpu",
    )
