"""The viewer's server: on its port or not at all, silent, and shared with nobody."""

import socket
import urllib.request

import pytest

from beam_warp.errors import InvalidOptionError, MissingPackageError
from beam_warp.view import server
from beam_warp.view.server import server_url, start_server, stop_server


@pytest.fixture
def taken_port():
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        yield holder.getsockname()[1]


def test_it_serves_its_page_on_this_machine(capsys):
    pytest.importorskip("viser")
    server = start_server("127.0.0.1", 0, "figure")
    try:
        url = server_url(server)
        assert url == f"http://127.0.0.1:{server.get_port()}/?token={server.doorkeeper.token}"
        with urllib.request.urlopen(url, timeout=20) as page:
            assert page.status == 200
        assert server.request_share_url() is None
    finally:
        stop_server(server)
    assert capsys.readouterr().out == ""


def test_a_taken_port_is_an_error(taken_port):
    pytest.importorskip("viser")
    with pytest.raises(InvalidOptionError, match=rf"port must be free at 127\.0\.0\.1, got {taken_port} .* --port"):
        start_server("127.0.0.1", taken_port, "figure")


@pytest.mark.parametrize("host", ["203.0.113.7", "no such host"])
def test_an_address_of_another_machine_is_an_error(host):
    pytest.importorskip("viser")
    with pytest.raises(InvalidOptionError, match="must be"):
        start_server(host, 0, "figure")


def test_a_port_is_a_number():
    pytest.importorskip("viser")
    with pytest.raises(InvalidOptionError, match="port must be an integer"):
        start_server("127.0.0.1", 70_000, "figure")


def test_without_viser_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(server.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"pip install 'beam-warp\[viewer\]'"):
        start_server("127.0.0.1", 0, "figure")
