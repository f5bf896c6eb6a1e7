"""The player page: an HTML file with a take, environments and the modules that draw them, from ``engines/web``."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from beam_warp.errors import InvalidOptionError
from beam_warp.image.hdr import radiance_hdr
from beam_warp.outputs import replacing
from beam_warp.world.environment import EnvironmentMap

MODULES = "beam-relight"
"""Name under which the page's modules import each other: an import map says where each is."""

MAX_EMBEDDED = 2**28
"""Largest take that a page holds [byte]: browsers bound a text by 2^29 characters, and base64 takes 4 for 3 bytes."""

ENVIRONMENT_ROWS = 128
"""Most rows of an environment in a page: 1.4 degrees, finer than what but the glossiest surfaces show."""

SERVED = ("live", "stills")
"""Modules of pages that a server stands behind, which packs the take and draws stills."""

_IMPORT = re.compile(r"""((?:from|import)\s*\(?\s*["'])\./([\w-]+\.js)(?=["'])""")
_CHUNK = 3 * 2**18
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' data: blob:; style-src 'unsafe-inline'; img-src data: blob:; "
    "connect-src 'self' data: blob:; worker-src data: blob:"
)
_OLD = "This page needs JavaScript, and a browser of 2024 or later."


def write_player(
    path: Path,
    take: Path,
    environments: Mapping[str, EnvironmentMap],
    *,
    title: str,
    view: Mapping[str, Any] | None = None,
    is_beside: bool = False,
) -> list[Path]:
    """Write a page that plays a take; readers see the old page or the complete new one.

    Args:
        path: The page, ``.html``.
        take: The take, ``.b4d``.
        environments: Lights to choose from, by name; the first one is shown.
        title: What the page is called.
        view: What is shown first: ``state``, ``lights``, ``cameras`` as ``engines/web/player.js`` reads them.
        is_beside: Put the take beside the page, which a server then has to offer. Otherwise the page holds it.

    Returns:
        The files written.

    Raises:
        InvalidOptionError: The take is too large to be held by a page.
        OutputError: A file cannot be written.
    """
    size = take.stat().st_size
    if size > MAX_EMBEDDED and not is_beside:
        raise InvalidOptionError(
            f"take must have at most {MAX_EMBEDDED:,} bytes to be held by a page, got {size:,}. Write it with --beside."
        )
    beside = path.with_suffix(".b4d")
    lights = [{"name": name, "hdr": _encoded(hdr_bytes(light))} for name, light in environments.items()]
    settings = {
        "title": title,
        "take": {"url": beside.name} if is_beside else {"element": "take"},
        "environments": lights,
        "view": dict(view or {}),
    }
    if is_beside and not (beside.exists() and beside.samefile(take)):
        with replacing(beside) as temporary, temporary.open("wb") as file:
            file.writelines(_chunks(take))
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        file.write(_head(title, settings))
        if not is_beside:
            file.write('<script type="text/plain" id="take">')
            file.writelines(map(_encoded, _chunks(take)))
            file.write("</script>\n")
        file.write(_script())
    return [beside, path] if is_beside else [path]


def page_text(title: str, settings: Mapping[str, Any]) -> str:
    """Return the page of a server: what it shows is at the addresses that the settings name.

    Args:
        title: What the page is called.
        settings: What ``engines/web/player.js`` reads.
    """
    return _head(title, settings, SERVED) + _script(SERVED)


def modules(more: Iterable[str] = ()) -> dict[str, str]:
    """Return the texts of the player, of more modules, and of all that they import, by file name.

    Imports name `MODULES`.
    """
    found: dict[str, str] = {}
    wanted = ["player.js", *(f"{name}.js" for name in more)]
    while wanted:
        name = wanted.pop()
        if name not in found:
            text = _source(name)
            wanted += [match[2] for match in _IMPORT.finditer(text)]
            found[name] = _IMPORT.sub(rf"\g<1>{MODULES}/\g<2>", text)
    return found


def _source(name: str) -> str:
    return files("beam_warp.web").joinpath(name).read_text(encoding="utf-8")


def _head(title: str, settings: Mapping[str, Any], more: Iterable[str] = ()) -> str:
    """Return a page up to its take."""
    addresses = {
        f"{MODULES}/{name}": f"data:text/javascript;base64,{_encoded(text.encode())}"
        for name, text in modules(more).items()
    }
    # "<" is escaped, so that no text in the data can end the element that holds it
    data = json.dumps(settings, allow_nan=False).replace("<", "\\u003c")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{html.escape(title)}</title>\n<style>\n{_source('player.css')}</style>\n"
        f'<script type="importmap">{json.dumps({"imports": addresses})}</script>\n</head>\n<body>\n'
        f'<main id="player"><p class="message fatal">{_OLD}</p></main>\n'
        f'<script type="application/json" id="settings">{data}</script>\n'
    )


def _script(more: Iterable[str] = ()) -> str:
    """Return the end of a page: it starts the player, and hands it more modules by name."""
    imports = [f'import * as {name} from "{MODULES}/{name}.js";\n' for name in more]
    return f"""<script type="module">
import {{start}} from "{MODULES}/player.js";
{"".join(imports)}const settings = JSON.parse(document.getElementById("settings").textContent);
start(document.getElementById("player"), settings, {{{", ".join(more)}}});
</script>
</body>
</html>
"""


def hdr_bytes(light: EnvironmentMap) -> bytes:
    """Return a light as a Radiance picture of at most `ENVIRONMENT_ROWS`."""
    rows = min(light.height, ENVIRONMENT_ROWS)
    return radiance_hdr((light if rows == light.height else light.resized(rows, 2 * rows)).radiance)


def _chunks(path: Path) -> Iterator[bytes]:
    """Yield the bytes of a file in parts whose base64 can be joined."""
    with path.open("rb") as file:
        while part := file.read(_CHUNK):
            yield part


def _encoded(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
