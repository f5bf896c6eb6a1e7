"""Command lines, read into records; help in two pages: ``--help`` for most uses, ``--help-all`` for all options."""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Iterator, Sequence
from typing import Any, TypeGuard, TypeVar, get_args, get_type_hints

import tyro
from tyro.conf import FlagCreatePairsOff, Positional
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

FIRST, ALL = ("-h", "--help"), "--help-all"
"""Words that ask for the first page, and for all options."""

NARROWEST, WIDEST = 40, 400
"""Widths that help is set for [character]; narrower terminals break its lines. In one column, tyro takes minutes."""

MORE = "More options: the same command with --help-all."


class _SecondPage:
    """Marks an option that only ``--help-all`` shows."""


SECOND_PAGE = _SecondPage()
"""Mark for ``Annotated``: this option is on the second page of the help alone."""

Record = TypeVar("Record")


def parse(record: type[Record], words: Sequence[str], prog: str) -> Record:
    """Read a command line into a record; print a page of help and exit where one is asked for.

    Args:
        record: Dataclass of the options; fields that are records themselves are groups in the help.
        words: The command line without the command's own words.
        prog: The command's own words.

    Raises:
        SystemExit: Help was printed (0), or the words are no such command line (2).
    """
    registry, left_out = ConstructorRegistry(), list[str]()

    def first_page(info: StructTypeInfo) -> StructConstructorSpec | None:
        """Build a record from the options of its first page alone."""
        if not dataclasses.is_dataclass(info.type):
            return None
        hints = get_type_hints(info.type, include_extras=True)
        shown = []
        for entry in dataclasses.fields(info.type):
            if SECOND_PAGE in getattr(hints[entry.name], "__metadata__", ()):
                left_out.append(entry.name)
                continue
            default = tyro.MISSING if entry.default is dataclasses.MISSING else entry.default
            if entry.default_factory is not dataclasses.MISSING:
                default = entry.default_factory()
            shown.append(StructFieldSpec(entry.name, hints[entry.name], default))
        return StructConstructorSpec(info.type, tuple(shown))

    if ALL not in words and not set(words).isdisjoint(FIRST):
        registry.struct_rule(first_page)
    if not NARROWEST <= (columns := shutil.get_terminal_size().columns) <= WIDEST:
        os.environ["COLUMNS"] = str(min(max(columns, NARROWEST), WIDEST))
    given = [FIRST[-1] if word == ALL else word for word in words]
    try:
        with registry:
            return tyro.cli(record, prog=prog, args=given, config=(FlagCreatePairsOff,))
    except SystemExit as stopped:
        if left_out and not stopped.code:
            print(MORE)
        raise


def flags_of(record: type) -> dict[str, str]:
    """Return by the name of each field the option that sets it, also of the records in a record.

    Fields whose value stands on the command line without an option are left out.
    """
    flags: dict[str, str] = {}
    hints = get_type_hints(record, include_extras=True)
    for field in dataclasses.fields(record):
        marks = getattr(hints[field.name], "__metadata__", ())
        if inner := [kind for kind in _types_in(hints[field.name]) if _is_record(kind)]:
            flags |= {name: flag for kind in inner for name, flag in flags_of(kind).items()}
        elif not set(marks).intersection(_POSITIONAL):
            named = next((mark.name for mark in marks if getattr(mark, "name", None)), field.name)
            flags[field.name] = f"--{named.replace('_', '-')}"
    return flags


def _is_record(kind: Any) -> TypeGuard[type]:
    """Return True for a dataclass, not for an object of one."""
    return isinstance(kind, type) and dataclasses.is_dataclass(kind)


def _types_in(hint: Any) -> Iterator[Any]:
    """Yield the types of which a hint consists: members of a union, without their marks."""
    inner = get_args(hint)[:1] if hasattr(hint, "__metadata__") else get_args(hint)
    yield from (kind for part in inner for kind in _types_in(part)) if inner else [hint]


_POSITIONAL = getattr(Positional[int], "__metadata__", ())
"""Marks of a field that no option sets."""
