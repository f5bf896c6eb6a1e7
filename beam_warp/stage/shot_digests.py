"""Digests of shots: two shots with the same digest render to the same image."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.shot import Shot


class ShotDigests:
    """Digests of the shots of one job."""

    def __init__(self, *decisive: Any) -> None:
        """Take what decides every image besides its shot: options, versions; plain data and records of it."""
        self._start = hashlib.blake2b(digest_size=16)
        _feed(self._start, decisive)
        self._environment: tuple[EnvironmentMap, bytes] | None = None

    def of(self, shot: Shot) -> str:
        """Return the digest of a shot, in hexadecimal."""
        digest = self._start.copy()
        for field in fields(shot):
            value = getattr(shot, field.name)
            digest.update(field.name.encode())
            _feed(digest, self._light(value) if isinstance(value, EnvironmentMap) else value)
        return digest.hexdigest()

    def _light(self, environment: EnvironmentMap) -> bytes:
        """Return the digest of an environment, which most shots of a job share: it is large."""
        if self._environment is None or self._environment[0] is not environment:
            digest = hashlib.blake2b(digest_size=16)
            _feed(digest, environment.radiance)
            self._environment = (environment, digest.digest())
        return self._environment[1]


def _feed(digest: Any, value: Any) -> None:
    """Add a value, exactly and so that two different ones are told apart; a type that is not known is an error."""
    if isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype} {value.shape}:".encode())
        digest.update(np.ascontiguousarray(value).data)
    elif is_dataclass(value) and not isinstance(value, type):
        digest.update(f"{type(value).__name__}(".encode())
        for field in fields(value):
            digest.update(f"{field.name}=".encode())
            _feed(digest, getattr(value, field.name))
        digest.update(b")")
    elif isinstance(value, Mapping):
        _feed(digest, sorted(value.items()))
    elif isinstance(value, tuple | list):
        digest.update(f"{len(value)}[".encode())
        for item in value:
            _feed(digest, item)
        digest.update(b"]")
    elif isinstance(value, bytes):
        digest.update(b"bytes " + value + b",")
    elif value is None or isinstance(value, bool | int | float | str | np.generic):
        digest.update(f"{type(value).__name__} {value!r},".encode())
    else:
        raise TypeError(f"what decides an image must be plain data to be digested, got {type(value).__name__}")
