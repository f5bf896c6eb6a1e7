"""What a validation found, as plain data: one finding for each rule, prim and attribute, and where it was first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class Finding:
    """One broken rule.

    Attributes:
        rule: Stable id, ``BEAM-<AREA>-<nnn>``, or ``USD-<name>`` for OpenUSD's own validators.
        severity: ``error`` if a reader may fail or show something else, else ``warning``.
        message: What must hold, what was found, and what to do.
        prim: Path of the prim, or ``/``.
        attribute: Name of the attribute, or empty.
        time: Time code where it was first seen; None if it does not depend on time.
        frames: In how many frames it was seen; 0 if it does not depend on time.
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
    """All findings of one asset.

    Attributes:
        path: The asset.
        findings: Errors first, then by rule, prim, and attribute.
        frames: Number of frames that were looked at.
        gaussians: Number of Gaussians in the first frame, all prims together.
    """

    path: str
    findings: tuple[Finding, ...]
    frames: int = 0
    gaussians: int = 0

    @property
    def is_valid(self) -> bool:
        """True if no finding is an error."""
        return not any(finding.severity == "error" for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON-able data."""
        return {**asdict(self), "findings": [asdict(finding) for finding in self.findings], "valid": self.is_valid}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Report:
        """Rebuild a report from `as_dict`."""
        findings = tuple(Finding(**finding) for finding in data["findings"])
        return cls(data["path"], findings, data["frames"], data["gaussians"])
