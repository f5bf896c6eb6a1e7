"""`beam view` as a user meets it: it says where the page is, ends with Ctrl-C, and refuses what cannot be served."""

import json
import signal
import socket
import threading
import urllib.request

import numpy as np
import pytest
from support.commands import beam
from support.drawn_ball import drawn_ball

from beam_warp import converters
from beam_warp.cli.common.flags import ReadingFlags
from beam_warp.cli.view import ViewCommand, environments, shown
from beam_warp.errors import AssetFormatError, MissingFileError
from beam_warp.image.files import write_exr
from beam_warp.world.gaussians import GaussianSequence


@pytest.fixture(scope="module")
def asset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("person")
    converters.write(GaussianSequence.from_clouds([drawn_ball()] * 2), folder / "asset.usda")
    return folder


@pytest.fixture
def lights(tmp_path):
    folder = tmp_path / "hdri"
    folder.mkdir()
    for name in ("noon.exr", "evening.exr"):
        write_exr(folder / name, dict.fromkeys("RGB", np.ones((16, 32), np.float32)))
    (folder / "readme.txt").write_text("lights")
    return folder


def test_it_says_where_it_is_and_ends_with_ctrl_c(asset, lights, capsys, monkeypatch):
    from beam_warp.view.viewer import Viewer

    wait, reports = Viewer.wait, []

    def wait_for_ctrl_c(viewer):
        reports.append(json.loads(capsys.readouterr().out))
        with urllib.request.urlopen(reports[0]["url"], timeout=20) as page:
            assert page.status == 200
        threading.Timer(0.2, signal.raise_signal, (signal.SIGINT,)).start()
        wait(viewer)

    monkeypatch.setattr(Viewer, "wait", wait_for_ctrl_c)
    # a suite that runs in the background of a shell is handed down that SIGINT is ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert beam("view", asset, "--environment", lights, "--port", 0, "--json", "--device", "cpu") == 0
    finally:
        signal.signal(signal.SIGINT, before)
    assert reports[0] == {"url": reports[0]["url"], "frames": 2, "notes": []}
    assert capsys.readouterr() == ("", "")


def test_a_taken_port_is_one_clear_line(asset, refused):
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        refused("view", asset, "--port", port, "--no-open", says=f"error: --port must be free at 127.0.0.1, got {port}")


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["--open", "--no-open"], "error: --open must be given once"),
        (["--longest", "3"], "error: --longest must be an integer in"),
        (["--environment", "nowhere.hdr"], "error: --environment must be a file or a folder, got nowhere.hdr"),
        (["--port", "0", "--no-open"], "error: "),
    ],
)
def test_mistakes_are_found_before_anything_is_read(words, error, refused):
    refused("view", "no such asset", *words, says=error)


def test_a_container_is_served_as_it_is_unless_it_is_read_otherwise(asset, tmp_path):
    path = tmp_path / "ball.b4d"
    converters.write(converters.read(asset), path)
    sequence, parts = shown(ViewCommand(asset=path), {})
    assert parts["file"] == path
    (ground,) = {make().surface.vertices[0, 2] for make in parts["grounds"].values()}
    assert ground == pytest.approx(-0.5, abs=0.02)
    sequence, parts = shown(ViewCommand(asset=path, reading=ReadingFlags(low_pass=0.1)), {})
    assert parts["file"] is None
    assert sequence.metadata["raster_low_pass"] == "0.1"


def test_a_stage_says_itself_how_assets_are_read(refused, tmp_path):
    (tmp_path / "set.json").write_text("{}")
    refused("view", tmp_path / "set.json", "--low-pass", 0.1, says="error: a stage must state how its assets are read")


def test_lights_are_those_given_then_those_built_in(lights):
    found = environments((lights / "noon.exr", lights))
    assert list(found) == ["noon", "evening", "noon 2", "studio (built in)", "sunset (built in)", "stage (built in)"]
    assert found["noon"]().height == 16
    assert found["stage (built in)"]().height == 64


def test_lights_that_are_none(lights, tmp_path):
    with pytest.raises(AssetFormatError, match=r"\.exr or \.hdr file, got .*readme\.txt"):
        environments((lights / "readme.txt",))
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingFileError, match="folder with"):
        environments((tmp_path / "empty",))
