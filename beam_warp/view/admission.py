"""Who may talk to a viewer: pages of its own address that bring its token, as with Jupyter."""

from __future__ import annotations

import http
import ipaddress
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

MAX_MESSAGE = 2**18
"""Largest message taken from a page [byte]; what our pages send is a few hundred."""

COOKIE = "beam-view-token"
"""Cookie that holds the token once a page was opened with it, since its later requests have no query."""

_REFUSAL = "Open the address that beam view printed, with its token.\n"


@dataclass(frozen=True)
class Doorkeeper:
    """Decides about requests by their ``Host``, ``Origin`` and token.

    Attributes:
        host: Address that the server listens at.
        token: Secret of this server.
    """

    host: str
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    def admits(self, request: Request) -> bool:
        """Return True for a request to this machine by name, from a page of the same address, with the token."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return False
        if any(urlsplit(origin).netloc != hosts[0] for origin in origins):
            return False
        brought = [*_asked(request), *_remembered(request)]
        return any(secrets.compare_digest(word.encode(), self.token.encode()) for word in brought)

    def _is_own(self, host: str) -> bool:
        """Return True for a name that no foreign name server can point at this machine; forwarded ports may differ."""
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if name in {"localhost", self.host, socket.gethostname().lower()}:
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or self.host in ("0.0.0.0", "::")

    def let_in(self, response: Response) -> None:
        """Let a page that was opened with the token remember it, out of reach of its scripts and of other sites."""
        response.headers["Set-Cookie"] = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        response.headers["Referrer-Policy"] = "no-referrer"


def _asked(request: Request) -> list[str]:
    return parse_qs(urlsplit(request.path).query).get("token", [])


def _remembered(request: Request) -> list[str]:
    words = []
    for line in request.headers.get_all("Cookie"):
        for pair in line.split(";"):
            try:
                words += [morsel.value for name, morsel in SimpleCookie(pair).items() if name == COOKIE]
            except CookieError:  # another program's cookie of this address
                continue
    return words


@contextmanager
def admitting(doorkeeper: Doorkeeper) -> Iterator[None]:
    """Let servers of websockets that start meanwhile ask a doorkeeper, and bound what they take."""
    from websockets.asyncio import server as websockets

    serve = websockets.serve

    def guarded(*args: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        def answer(connection: ServerConnection, request: Request) -> Any:
            if not doorkeeper.admits(request):
                return connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSAL)
            response = process_request(connection, request) if process_request is not None else None
            if response is not None:
                doorkeeper.let_in(response)
            return response

        return serve(*args, process_request=answer, **{**options, "max_size": MAX_MESSAGE})

    websockets.serve = guarded  # type: ignore[assignment]
    try:
        yield
    finally:
        websockets.serve = serve
