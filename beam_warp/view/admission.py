"""Who may talk to a viewer: who brings its token, asks for this machine by name, and comes from no other page."""

from __future__ import annotations

import ipaddress
import secrets
import socket
from dataclasses import dataclass, field
from email.message import Message
from urllib.parse import urlsplit


@dataclass(frozen=True)
class Doorkeeper:
    """Decides about requests by their ``Host``, ``Origin`` and token.

    Attributes:
        host: Address that the server listens at.
        token: Secret of this server, the first folder of every address.
    """

    host: str
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    def admitted(self, path: str, headers: Message) -> str | None:
        """Return what a request asks for, behind the token; None for who is not let in."""
        hosts, origins = headers.get_all("Host", []), headers.get_all("Origin", [])
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return None
        if any(urlsplit(origin).netloc != hosts[0] for origin in origins):
            return None
        token, slash, asked = urlsplit(path).path.removeprefix("/").partition("/")
        return asked if slash and secrets.compare_digest(token.encode(), self.token.encode()) else None

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
