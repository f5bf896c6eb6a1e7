"""What is said about a capture: findings, and the words for counts and names in them."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any, Literal

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or worth knowing.

    Attributes:
        severity: ``error``: reconstruction is impossible or would be of nonsense; ``warning``: it goes on, by the
            fallback that ``what`` states; ``note``: an assumption that was made.
        code: Names the kind, for programs.
        what: One sentence without its full stop.
        where: Records, cameras or frames, in words; empty for the capture as a whole.
        remedy: What to do, a sentence or two.
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


def count_of(number: int, noun: str) -> str:
    """Return a number and what is counted."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def are(things: Collection[Any]) -> str:
    """Return the verb for so many things."""
    return "is" if len(things) == 1 else "are"


def names_of(names: Iterable[Any], most: int = 6) -> str:
    """List names, shortened."""
    found = [str(name) for name in dict.fromkeys(names)]
    return ", ".join(found[:most]) + (f" and {len(found) - most} more" if len(found) > most else "")
