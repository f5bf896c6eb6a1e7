"""Findings about a capture, and how counts and names in them are worded."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any, Literal

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One fault of a capture, or one thing worth knowing about it.

    Attributes:
        severity: ``error``: reconstruction is impossible or its result would be meaningless; ``warning``: it goes on
            with the fallback that ``what`` states; ``note``: an assumption that was made.
        code: Identifies the kind of finding, for programs.
        what: The fault in one sentence, without its full stop.
        where: Records, cameras or frames, in words; empty for the capture as a whole.
        remedy: Advice in a sentence or two; empty if there is none.
    """

    severity: Severity
    code: str
    what: str
    where: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        """Return one line."""
        place = f" ({self.where})" if self.where else ""
        return f"{self.severity}: {self.what}{place}.{' ' + self.remedy if self.remedy else ''}"


class Findings(list[Finding]):
    """Findings in the order in which they are made."""

    def add(self, severity: Severity, code: str, what: str, where: str | Iterable[Any] = (), remedy: str = "") -> None:
        """Append a finding; see `Finding`. ``where`` may be names, which are then listed by `names_of`."""
        self.append(Finding(severity, code, what, where if isinstance(where, str) else names_of(where), remedy))

    def warn(self, code: str, what: str, where: str | Iterable[Any] = (), remedy: str = "") -> None:
        """Append a warning; see `add`."""
        self.add("warning", code, what, where, remedy)


def count_of(number: int, noun: str) -> str:
    """Return a number with its noun: ``1 image``, ``3 images``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def are(things: Collection[Any]) -> str:
    """Return ``is`` for one thing and ``are`` for several."""
    return "is" if len(things) == 1 else "are"


def names_of(names: Iterable[Any], most: int = 6) -> str:
    """List names without repetition; beyond ``most``, say how many more there are."""
    found = [str(name) for name in dict.fromkeys(names)]
    return ", ".join(found[:most]) + (f" and {len(found) - most} more" if len(found) > most else "")
