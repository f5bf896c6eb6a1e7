"""Who the viewer lets in, and what a hostile page cannot do: asked over the wire, with the library that serves."""

import urllib.error
import urllib.request

import pytest

pytest.importorskip("viser")

import viser
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from beam_warp.view.admission import COOKIE, MAX_MESSAGE, Doorkeeper
from beam_warp.view.server import server_url, start_server, stop_server


@pytest.fixture(scope="module")
def server():
    served = start_server("127.0.0.1", 0, "figure")
    yield served
    stop_server(served)


def page(server, path="/", **headers):
    """The status, and the cookie that is set."""
    request = urllib.request.Request(f"http://127.0.0.1:{server.get_port()}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.headers["Set-Cookie"]
    except urllib.error.HTTPError as error:
        return error.code, error.headers["Set-Cookie"]


def talk(server, *, origin=None, token=None, **options):
    """Open a connection as a page does."""
    headers = {} if token is None else {"Cookie": f"other=1; {COOKIE}={token}"}
    return connect(
        f"ws://127.0.0.1:{server.get_port()}",
        origin=origin,
        additional_headers=headers,
        subprotocols=[f"viser-v{viser.__version__}"],
        compression=None,
        **options,
    )


def test_the_page_needs_the_token_and_keeps_it_in_a_cookie(server):
    token = server.doorkeeper.token
    assert len(token) >= 32
    assert page(server)[0] == page(server, "/?token=guess")[0] == page(server, "/?token=%ff")[0] == 403
    status, cookie = page(server, f"/?token={token}&fixedDpr=1")
    assert status == 200
    assert cookie == f"{COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/"
    assert page(server, Cookie=f"a=b; {COOKIE}={token}")[0] == 200
    assert page(server, Cookie=f"{COOKIE}={token[:-1]}")[0] == 403
    assert server_url(server).endswith(f"/?token={token}")


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "[", "", "192.0.2.1", "evil@"])
def test_names_that_others_may_point_here_are_refused(server, host):
    assert page(server, f"/?token={server.doorkeeper.token}", Host=host)[0] in (400, 403)


@pytest.mark.parametrize("host", ["localhost:8080", "127.0.0.1:9", "[::1]:8080"])
def test_a_forwarded_port_is_this_machine(server, host):
    assert page(server, f"/?token={server.doorkeeper.token}", Host=host)[0] == 200


def test_an_open_address_is_reached_by_its_numbers():
    request = type("Request", (), {"path": "/?token=t"})()
    for host, wanted in (("192.0.2.7:8080", True), ("[2001:db8::1]:8080", True), ("evil.example", False)):
        request.headers = viser.infra._infra.websockets.datastructures.Headers(Host=host)
        assert Doorkeeper("0.0.0.0", "t").admits(request) is wanted
        assert not Doorkeeper("127.0.0.1", "t").admits(request)


def test_a_foreign_page_is_not_connected(server):
    own, token = f"http://127.0.0.1:{server.get_port()}", server.doorkeeper.token
    for origin, brought in (("http://evil.example", token), ("null", token), (own, None), (own, "guess")):
        with pytest.raises(InvalidStatus, match="403"):
            talk(server, origin=origin, token=brought)
    with talk(server, origin=own, token=token) as connection:
        assert connection.recv(timeout=20)


def test_files_are_not_taken(server):
    """A page that uploads to a slider fills no memory: nothing listens to parts of files."""
    slider = server.gui.add_slider("a", 0, 1, 1, 0)
    for kind in (_messages.FileTransferStartUpload, _messages.FileTransferPart):
        assert kind not in server._websock_server._incoming_handlers
        assert kind not in server.gui._websock_interface._incoming_handlers
    assert server.gui._current_file_upload_states == {}
    slider.remove()


def test_a_large_message_ends_the_connection(server):
    with talk(server, token=server.doorkeeper.token) as connection:
        connection.send(b"x" * (MAX_MESSAGE + 1))
        with pytest.raises(ConnectionClosed) as closed:
            all(connection)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1009
