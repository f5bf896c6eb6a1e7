"""Command lines, read into records; help in two pages: ``--help`` for most uses, ``--help-all`` for all options."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import FlagCreatePairsOff

FIRST, ALL = ("-h", "--help"), "--help-all"
"""Words that ask for the first page, and for all options."""

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
    is_first = not set(words).isdisjoint(FIRST)
    shown: Any = _noted(record, first_page(record)) if is_first and ALL not in words else record
    given = [FIRST[-1] if word == ALL else word for word in words]
    return tyro.cli(shown, prog=prog, args=given, config=(FlagCreatePairsOff,))


def first_page(record: type) -> type:
    """Return a record that lacks the options of the second page, for the help alone."""
    hints = get_type_hints(record, include_extras=True)
    fields, is_whole = [], True
    for entry in dataclasses.fields(record):
        hint = hints[entry.name]
        if SECOND_PAGE in getattr(hint, "__metadata__", ()):
            is_whole = False
            continue
        shown = _first_page_of(hint)
        default = dataclasses.field(default=entry.default)
        if entry.default_factory is not dataclasses.MISSING:
            default = dataclasses.field(default_factory=get_args(shown)[0])
        fields.append((entry.name, shown, default))
        is_whole = is_whole and shown is hint
    if is_whole:
        return record
    page = dataclasses.make_dataclass(record.__name__, fields, kw_only=True, frozen=True)
    page.__doc__ = record.__doc__
    return page


def _noted(record: type, page: type) -> type:
    """Say on a page that there is another one, where it lacks something."""
    if page is not record:
        page.__doc__ = f"{record.__doc__}\n\n{MORE}"
    return page


def _first_page_of(hint: Any) -> Any:
    """Return a type with every record in it replaced by its first page; the same object where nothing changes."""
    if get_origin(hint) is Annotated:
        inner, *marks = get_args(hint)
        shown = _first_page_of(inner)
        return hint if shown is inner else Annotated[(shown, *marks)]  # type: ignore[return-value]
    if get_origin(hint) in (Union, types.UnionType):
        pairs = [(kind, _first_page_of(kind)) for kind in get_args(hint)]
        changed = [pair for pair in pairs if pair[0] is not pair[1]]
        for kind, shown in changed:  # each is a command of its own
            _noted(get_args(kind)[0], get_args(shown)[0])
        return hint if not changed else Union[tuple(shown for _, shown in pairs)]  # noqa: UP007
    return first_page(hint) if dataclasses.is_dataclass(hint) and isinstance(hint, type) else hint
