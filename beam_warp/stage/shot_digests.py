"""Digests of shots: two shots with the same digest render to the same image."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from beam_warp.digests import array_digest, described, fields_of
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.shot import Shot


class ShotDigests:
    """Digests of the shots of one job."""

    def __init__(self, *decisive: Any) -> None:
        """Take what decides every image besides its shot: options, versions; plain data and records of it."""
        self._decisive = _plain(decisive)
        self._environment: tuple[EnvironmentMap, str] | None = None

    def of(self, shot: Shot) -> str:
        """Return the digest of a shot, in hexadecimal."""
        content = {
            name: self._light(value) if isinstance(value, EnvironmentMap) else _plain(value)
            for name, value in fields_of(shot)
        }
        text = json.dumps([self._decisive, content], sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def _light(self, environment: EnvironmentMap) -> str:
        """Return the digest of an environment, which most shots of a job share: it is large."""
        if self._environment is None or self._environment[0] is not environment:
            self._environment = (environment, array_digest(environment.radiance))
        return self._environment[1]


def _plain(value: Any) -> Any:
    """Return a value as JSON-able data, with arrays as their digests."""
    return described(value, str, array_digest)
