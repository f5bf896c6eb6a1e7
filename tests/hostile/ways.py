"""Ways to spoil a sound file: cuts, turned bits, other bytes, numbers of a header, fields of JSON, what is packed."""

import copy
import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Case:
    """One spoiled file.

    Attributes:
        name: How it was spoiled.
        content: Bytes of the file.
        is_fatal: True if no reader may accept it.
    """

    name: str
    content: bytes
    is_fatal: bool = True


@dataclass(frozen=True, kw_only=True)
class Ways:
    """How to spoil bytes, beside turning some of their bits.

    Attributes:
        swaps: Name → bytes of the sound file and what replaces them; none of the results may be accepted.
        numbers: Name → offset and `struct` code of a number that is set to the ends of its type, to NaN and infinity.
        is_json: True if fields are spoiled one by one, too.
        free: Numbers and JSON fields that may hold anything, and names of cases that happen to be sound.
        cuts: Parts of the length after which the file ends.
        others: Makes further cases of the sound file.
    """

    swaps: Mapping[str, tuple[bytes, bytes]] = field(default_factory=dict)
    numbers: Mapping[str, tuple[int, str]] = field(default_factory=dict)
    is_json: bool = False
    free: frozenset[str] = frozenset()
    cuts: tuple[float, ...] = (0.0, 0.01, 0.1, 0.3, 0.6, 0.9)
    others: Callable[[bytes], Iterator[Case]] | None = None


@dataclass(frozen=True)
class Inside:
    """A part of a file that is packed in it, and is spoiled as well.

    Attributes:
        take: Returns the part of a sound file.
        put: Returns the sound file with another part.
        ways: How to spoil the part.
    """

    take: Callable[[bytes], bytes]
    put: Callable[[bytes, bytes], bytes]
    ways: Ways


@dataclass(frozen=True)
class Reader(Ways):
    """A reader, and what to spoil for it.

    Attributes:
        make: Writes sound files into a folder, and returns the one that is spoiled.
        read: Reads all that there is, from the path of that file.
        family: Fuzz target that reads it, too: ``splats``, ``captures`` or ``images``.
        inside: What it packs.
        is_slow: True if a child process opens each file first.
    """

    make: Callable[[Path], Path]
    read: Callable[[Path], object]
    family: str = ""
    inside: Inside | None = None
    is_slow: bool = False


def cases(reader: Reader, sound: bytes) -> Iterator[Case]:
    """Yield every spoiled form of a sound file."""
    yield from _spoiled(reader, sound)
    if reader.inside is not None:
        for case in _spoiled(reader.inside.ways, reader.inside.take(sound)):
            yield Case(f"inside, {case.name}", reader.inside.put(sound, case.content), case.is_fatal)


def _spoiled(ways: Ways, sound: bytes) -> Iterator[Case]:
    for case in _all(ways, sound):
        yield replace(case, is_fatal=case.is_fatal and case.name not in ways.free)


def _all(ways: Ways, sound: bytes) -> Iterator[Case]:
    for part in ways.cuts:
        yield Case(f"cut at {part:.0%}", sound[: int(part * len(sound))])
    yield Case("zeros", bytes(len(sound)))
    yield Case("ones", b"\xff" * len(sound))
    yield Case("a page", b"<!DOCTYPE html><html><body>404</body></html>")
    yield Case("a script", b"#!/bin/sh\nrm -rf \x1b[31m\n")
    yield Case("in UTF-16", sound.decode("latin-1").encode("utf-16"))
    rng = np.random.default_rng(len(sound))
    for index in range(6):
        damaged = bytearray(sound)
        place = int(rng.integers(len(sound)))
        damaged[place] ^= 1 << int(rng.integers(8))
        yield Case(f"bit {index} turned at {place}", bytes(damaged), is_fatal=False)
    yield Case("twice", sound + sound, is_fatal=False)
    yield Case("zeros after", sound + bytes(64), is_fatal=False)
    for name, (old, new) in ways.swaps.items():
        assert old in sound, (name, old)
        yield Case(name, sound.replace(old, new, 1))
    for name, (place, code) in ways.numbers.items():
        for value in _ends(code):
            new = struct.pack(code, value)
            content = sound[:place] + new + sound[place + len(new) :]
            yield Case(f"{name} is {value}", content, is_fatal=name not in ways.free)
    if ways.is_json:
        yield from _json_cases(json.loads(sound), ways.free)
    if ways.others is not None:
        yield from ways.others(sound)


def _ends(code: str) -> tuple[float, ...]:
    if code[-1] in "ef":
        return float("nan"), float("inf"), float("-inf")
    bits = 8 * struct.calcsize(code)
    return 2**bits - 1, 2 ** (bits - 1), 2 ** (bits // 2)


BOMB_BYTES = 1 << 29
"""Zeros in `bomb` once it is unpacked, more than may be taken for a small file."""


def bomb() -> bytes:
    """Return a raw deflate stream of `BOMB_BYTES` zeros, made without them."""
    packer = zlib.compressobj(9, wbits=-15)
    block = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return (BOMB_BYTES >> 20) * block + packer.flush()


SPOILED: dict[str, Any] = {
    "an object": {"\x1b[31m": []},
    "not a number": float("nan"),
    "beyond floats": 10**400,
    "half a pair": "\ud800\n\x07",
    "nested": [[[[[[[[[[]]]]]]]]]],
}


def _json_cases(document: Any, free: frozenset[str]) -> Iterator[Case]:
    """Spoil each field once, wherever it first occurs."""
    yield Case("lists without end", b"[" * 100_000)
    yield Case("a long number", b'{"w": ' + b"9" * 5000 + b"}")
    for name in ("an object", "nested"):
        yield Case(f"all is {name}", json.dumps(SPOILED[name]).encode())
    seen = set()
    for place in _places(document):
        label = ".".join(name for name in place if isinstance(name, str))
        if label in seen:
            continue
        seen.add(label)
        for name, value in SPOILED.items():
            changed = copy.deepcopy(document)
            holder = changed
            for step in place[:-1]:
                holder = holder[step]
            holder[place[-1]] = value
            yield Case(f"{label} is {name}", json.dumps(changed).encode(), is_fatal=place[-1] not in free)


def _places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, item in inner:
        yield (*place, name)
        yield from _places(item, (*place, name))
