"""What a reconstruction found wrong with a capture: a file beside its result, and the records that it puts right.

Whatever goes back to the photographs later so sees them as the Gaussians were fitted to them. Only training records
change.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict
from operator import is_
from pathlib import Path
from typing import Any, ClassVar, Self

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.findings import Finding
from beam_warp.capture.inspect import SPLIT
from beam_warp.capture.records import read_json
from beam_warp.errors import AssetFormatError, BeamError

MOST_BYTES = 2**26
"""Most bytes of a file; a camera has 100 to 500."""


class SideFile(ABC):
    """Something that was found wrong with a capture; its subclasses are dataclasses.

    Attributes:
        FILE: Name of the file.
        SUBJECT: What errors call its content.
    """

    FILE: ClassVar[str]
    SUBJECT: ClassVar[str]

    @abstractmethod
    def put_right(self, record: CaptureRecord) -> CaptureRecord | None:
        """Return a training record put right, itself if nothing is wrong with it, or None to leave it out."""

    @abstractmethod
    def findings(self) -> list[Finding]:
        """Return what a user should know."""

    @classmethod
    @abstractmethod
    def from_dict(cls, content: Any) -> Self:
        """Take what `as_dict` returned; whatever else raises KeyError, TypeError, ValueError or BeamError."""

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record, which `from_dict` takes."""
        return asdict(self)  # type: ignore[call-overload]

    def corrected(self, records: Sequence[CaptureRecord]) -> tuple[CaptureRecord, ...]:
        """Return records put right; those of other splits than training stay."""
        rows = (self.put_right(record) if record.split == SPLIT else record for record in records)
        return tuple(record for record in rows if record is not None)

    def capture(self, capture: Capture) -> Capture:
        """Return the capture with its records put right; itself if all of them stay."""
        records = self.corrected(capture.records)
        if len(records) == len(capture.records) and all(map(is_, records, capture.records)):
            return capture
        return Capture(**{**vars(capture), "records": records})

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """Read what was found from the folder of a reconstruction; None if there is no such file.

        Raises:
            AssetFormatError: The file is damaged: a field is missing or out of range.
        """
        path = folder / cls.FILE
        if not path.is_file():
            return None
        content = read_json(path, cls.SUBJECT, MOST_BYTES)
        try:
            return cls.from_dict(content)
        except (BeamError, AttributeError, KeyError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise AssetFormatError(
                f"{cls.SUBJECT} must be as beam reconstruct wrote them, got {reason} at {path}. Delete the file to "
                "find them again."
            ) from error
