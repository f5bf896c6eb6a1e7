"""Corrections of cut-outs' masks: how far they are off, where that is kept, and the capture that they make.

Reconstruction finds them (`beam_warp.reconstruction.masks`) and writes them beside its result, so that whatever goes
back to the photographs later sees the subject that the Gaussians were fitted to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.findings import Finding
from beam_warp.capture.images import offset_finding
from beam_warp.capture.inspect import SPLIT
from beam_warp.capture.mattes import MaskOffset
from beam_warp.capture.records import read_json
from beam_warp.checks import require_number
from beam_warp.errors import AssetFormatError, BeamError

FILE_NAME = "masks.json"

MOST_BYTES = 2**24
"""Most bytes of a file of corrections; a camera has some 100."""


@dataclass(frozen=True)
class MaskCorrections:
    """Corrections of the masks of a rig's cameras, the same in all frames.

    Attributes:
        offsets: How far the masks of each camera reach beyond the subject; cameras whose masks stay are not there.
    """

    offsets: Mapping[str, MaskOffset] = field(default_factory=dict)

    def corrected(self, records: Sequence[CaptureRecord]) -> tuple[CaptureRecord, ...]:
        """Return records whose masks are moved as they are read; those of other splits than training stay."""
        return tuple(
            replace(record, mask_excess=self.offsets[record.camera_name].pixels)
            if record.split == SPLIT and record.camera_name in self.offsets
            else record
            for record in records
        )

    def capture(self, capture: Capture) -> Capture:
        """Return the capture with its training masks corrected; itself if there is nothing to correct."""
        return Capture(**{**vars(capture), "records": self.corrected(capture.records)}) if self.offsets else capture

    def findings(self) -> list[Finding]:
        """Return what a user should know about the masks."""
        return [offset_finding(self.offsets)] if self.offsets else []

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record, which `from_dict` reads."""
        return {"cameras": {name: asdict(offset) for name, offset in self.offsets.items()}}

    @classmethod
    def from_dict(cls, content: Any, where: Path) -> MaskCorrections:
        """Read what `as_dict` returned.

        Raises:
            AssetFormatError: A field is missing or out of range.
        """
        try:
            offsets = {
                str(name): MaskOffset(
                    require_number("pixels", offset["pixels"], -1e3, 1e3), require_number("error", offset["error"], 0.0)
                )
                for name, offset in content["cameras"].items()
            }
        except (BeamError, KeyError, TypeError, AttributeError) as error:
            reason = " ".join(str(error).split())
            raise AssetFormatError(
                f"corrections of masks must be as beam reconstruct wrote them, got {reason} at {where}. Delete the "
                "file to find them again."
            ) from error
        return cls(offsets)


def read_mask_corrections(folder: Path) -> MaskCorrections | None:
    """Read the corrections beside a reconstruction.

    Args:
        folder: Folder of the reconstruction.

    Returns:
        The corrections; None if there are none.

    Raises:
        AssetFormatError: The file is damaged.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    return MaskCorrections.from_dict(read_json(path, "corrections of masks", MOST_BYTES), path)
