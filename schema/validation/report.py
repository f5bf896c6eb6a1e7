"""Result of a validation as plain data: each broken rule by prim and attribute, and where it was first broken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class BrokenRule:
    """A rule that an asset breaks, at one prim and attribute.

    Attributes:
        rule: Stable id of the rule, ``BEAM-<AREA>-<nnn>``, or ``USD-<name>`` for OpenUSD's own validators.
        severity: ``error`` if a reader may fail or show something else, else ``warning``.
        message: The contract, what was found instead, and what to do.
        prim: Path of the prim, or ``/``.
        attribute: Name of the attribute, or empty.
        time: First time code at which the rule is broken; None if it does not depend on time.
        frames: Number of frames in which it is broken; 0 if it does not depend on time.
    """

    rule: str
    severity: Severity
    message: str
    prim: str = "/"
    attribute: str = ""
    time: float | None = None
    frames: int = 0

    def __str__(self) -> str:
        """Return one readable line."""
        place = self.prim + (f".{self.attribute}" if self.attribute else "")
        when = "" if self.time is None else f" at time {self.time:g}"
        more = f" ({self.frames} frames)" if self.frames > 1 else ""
        return f"{self.severity:7} {self.rule}  {place}{when}{more}: {self.message}"


@dataclass(frozen=True)
class Report:
    """All broken rules of one asset.

    Attributes:
        path: Path of the asset.
        findings: Broken rules, errors first, then by rule, prim, and attribute.
        frames: Number of frames that were checked.
        gaussians: Number of Gaussians in the first frame, all prims together.
        mended: Broken rules that `beam_warp.schema.validation.mending.mend` has mended; ``findings`` has what is left.
    """

    path: str
    findings: tuple[BrokenRule, ...]
    frames: int = 0
    gaussians: int = 0
    mended: tuple[BrokenRule, ...] = ()

    @property
    def is_valid(self) -> bool:
        """True if no finding is an error."""
        return not any(finding.severity == "error" for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON-able data."""
        lists = {name: [asdict(found) for found in getattr(self, name)] for name in ("findings", "mended")}
        return {**asdict(self), **lists, "valid": self.is_valid}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Report:
        """Rebuild a report from `as_dict`."""
        findings, mended = (tuple(BrokenRule(**found) for found in data[name]) for name in ("findings", "mended"))
        return cls(data["path"], findings, data["frames"], data["gaussians"], mended)
