"""A web server on one address or none, silent, and only for who has its token: the standard library's."""

from __future__ import annotations

import json
import os
import re
import socket
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from beam_warp.checks import require_count
from beam_warp.errors import BeamError, InvalidOptionError
from beam_warp.view.admission import Doorkeeper

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080

MAX_MESSAGE = 2**18
"""Largest message taken from a page [byte]; what our pages send is a few hundred."""

IDLE_SECONDS = 60.0
"""Time after which a connection that says nothing is closed [s]."""

_REFUSAL = "Open the address that beam view printed, with its token."
_RANGE = re.compile(r"bytes=(\d{1,18})-(\d{0,18})")
_CHUNK = 2**20


@dataclass(frozen=True)
class Content:
    """What a page is given.

    Attributes:
        source: Bytes, or the file that holds them.
        kind: Media type.
    """

    source: bytes | Path
    kind: str = "application/octet-stream"

    def parts(self, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes of a range."""
        if isinstance(self.source, bytes):
            yield self.source[start:stop]
            return
        with self.source.open("rb") as file:
            file.seek(start)
            while start < stop and (part := file.read(min(_CHUNK, stop - start))):
                start += len(part)
                yield part

    @property
    def size(self) -> int:
        """Number of bytes; raises OSError if the file is gone."""
        return len(self.source) if isinstance(self.source, bytes) else self.source.stat().st_size


class PageServer(ThreadingHTTPServer):
    """Answers requests in threads of their own.

    Attributes:
        doorkeeper: Decides who is answered.
        find: Returns what is at an address, or None; called in many threads.
        work: Returns the lines of an answer to a message, one after the other; called in many threads.
    """

    daemon_threads = True
    allow_reuse_address = os.name != "nt"  # there it would share a port that is taken

    def __init__(
        self, host: str, port: int, find: Callable[[str], Content | None], work: Callable[[Any], Generator[Any]]
    ) -> None:
        """Listen; nothing is answered before ``serve_forever``.

        Args:
            host: Address of this machine to listen at.
            port: Port to listen at; 0 takes any that is free.
            find: See the attribute.
            work: See the attribute.

        Raises:
            InvalidOptionError: The port is taken, or the address is none of this machine's.
        """
        require_count("port", port, 0, 65535)
        self.doorkeeper, self.find, self.work = Doorkeeper(host), find, work
        try:
            self.address_family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        except (OSError, UnicodeError) as error:
            raise InvalidOptionError(
                f"host must be an address of this machine, got {host!r} ({error}). Try {DEFAULT_HOST}."
            ) from error
        try:
            super().__init__((host, port), _Handler)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise InvalidOptionError(
                f"port must be free at {host}, got {port} ({reason}). Choose another one with --port, or 0 for any."
            ) from error

    @property
    def url(self) -> str:
        """What to type into a browser on this machine."""
        host = self.doorkeeper.host
        name = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
        return f"http://{name}:{self.server_address[1]}/{self.doorkeeper.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a page that is closed breaks its connections."""


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: PageServer
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "beam", ""
    timeout = IDLE_SECONDS

    def do_GET(self) -> None:
        """Give what is at an address, or a range of it."""
        asked = self._admitted()
        if asked is None:
            return
        try:
            found = self.server.find(asked)
            if found is None:
                return self._say(404, "Not found")
            size = found.size
            start, stop, is_part = self._range(size)
            if is_part and start >= stop:
                return self._say(416, f"The range must begin within {size} bytes")
            parts = found.parts(start, stop)
            first = next(parts, b"")  # what cannot be read is said before anything is sent
        except (BeamError, OSError) as error:
            return self._say(500, str(error))
        self._begin(206 if is_part else 200, found.kind, stop - start)
        if is_part:
            self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{size}")
        self.end_headers()
        sent = 0
        for part in (first, *parts):
            sent += self.wfile.write(part)
        self.close_connection |= sent < stop - start  # a file that was cut meanwhile

    def do_POST(self) -> None:
        """Take a message, and answer line by line as the answer comes about."""
        asked = self._admitted()
        if asked is None:
            return
        self.close_connection = True
        length = self.headers.get("Content-Length", "")
        if asked != "stills" or not (length.isdecimal() and len(length) < 9 and int(length) <= MAX_MESSAGE):
            return self._say(413 if asked == "stills" else 404, f"A message must have at most {MAX_MESSAGE} bytes")
        try:
            message = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            return self._say(400, "A message must be JSON")
        self._begin(200, "application/x-ndjson", None)
        self.end_headers()
        with closing(self.server.work(message)) as lines:
            for line in lines:  # ends where nobody listens any more: writing fails
                self.wfile.write(json.dumps(line).encode() + b"\n")
                self.wfile.flush()

    def _admitted(self) -> str | None:
        """Return what is asked for; who is not let in is told."""
        asked = self.server.doorkeeper.admitted(self.path, self.headers)
        if asked is None:
            self.close_connection = True
            self._say(403, _REFUSAL)
        return asked

    def _range(self, size: int) -> tuple[int, int, bool]:
        """Return the bytes that are wanted, and whether they are a part."""
        wanted = _RANGE.fullmatch(self.headers.get("Range", ""))
        if wanted is None:
            return 0, size, False
        start = int(wanted[1])
        return start, min(size, int(wanted[2]) + 1) if wanted[2] else size, True

    def _begin(self, status: int, kind: str, size: int | None) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        if size is not None:
            self.send_header("Content-Length", str(size))
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")

    def _say(self, status: int, words: str) -> None:
        """Answer with a sentence."""
        content = " ".join(words.split()).encode(errors="replace")
        self._begin(status, "text/plain; charset=utf-8", len(content))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
"""What every answer says: it is for pages of this address alone, and its own address, with the token, for nobody."""
