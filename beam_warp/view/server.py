"""A viser server on one address or none, silent, never shared with the world, and only for who has its token."""

from __future__ import annotations

import importlib.util
import socket
from typing import TYPE_CHECKING, Any

from beam_warp.checks import require_count
from beam_warp.errors import InvalidOptionError, MissingPackageError
from beam_warp.view.admission import Doorkeeper, admitting

if TYPE_CHECKING:
    import viser

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080


def start_server(host: str, port: int, label: str) -> viser.ViserServer:
    """Start a server.

    Args:
        host: Address of this machine to listen at.
        port: Port to listen at; 0 takes any that is free.
        label: Title above the controls.

    Raises:
        MissingPackageError: viser is not installed.
        InvalidOptionError: The port is taken, or the address is none of this machine's.
    """
    if importlib.util.find_spec("viser") is None:
        raise MissingPackageError(
            "viser must be installed to view, got none. Install it with pip install 'beam-warp[viewer]'."
        )
    require_count("port", port, 0, 65535)
    _require_free(host, port)

    import rich
    import viser
    from viser import _messages

    class Server(viser.ViserServer):
        """Asks no other machine to let the world in, whatever a page asks for."""

        doorkeeper = Doorkeeper(host)

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    console = rich.get_console()
    was_quiet, console.quiet = console.quiet, True  # viser prints a panel of its own, whatever it is told
    try:
        with admitting(Server.doorkeeper):
            server: Any = Server(host=host, port=port, label=label, verbose=False)
    finally:
        console.quiet = was_quiet
    if port and server.get_port() != port:  # somebody was faster; viser took the next one
        stop_server(server)
        raise _taken(host, port, "address already in use")
    for upload in (_messages.FileTransferStartUpload, _messages.FileTransferPart):  # none of our controls takes files
        server._websock_server.unregister_handler(upload)
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server, silently."""
    import rich

    console = rich.get_console()
    was_quiet, console.quiet = console.quiet, True
    try:
        server.stop()
    finally:
        console.quiet = was_quiet


def server_url(server: viser.ViserServer) -> str:
    """Return what to type into a browser on this machine, with the token."""
    host = server.get_host()
    name = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{name}:{server.get_port()}/?token={server.doorkeeper.token}"  # type: ignore[attr-defined]


def _require_free(host: str, port: int) -> None:
    """Refuse what viser would wait for, or leave for another port in silence."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise InvalidOptionError(
            f"host must be an address of this machine, got {host!r} ({error}). Try {DEFAULT_HOST}."
        ) from error
    with socket.socket(family, kind, protocol) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
            probe.listen()
        except OSError as error:
            raise _taken(host, port, (error.strerror or str(error)).lower()) from error


def _taken(host: str, port: int, reason: str) -> InvalidOptionError:
    return InvalidOptionError(
        f"port must be free at {host}, got {port} ({reason}). Choose another one with --port, or 0 for any."
    )
