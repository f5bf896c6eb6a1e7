"""Corrections of cut-outs' masks: how far they are off, where that is kept, and the capture that they make.

Reconstruction finds them (`beam_warp.reconstruction.masks`) and writes them beside its result, so that whatever goes
back to the photographs later sees the subject that the Gaussians were fitted to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from beam_warp.capture.capture import CaptureRecord
from beam_warp.capture.findings import Finding
from beam_warp.capture.images import offset_finding
from beam_warp.capture.mattes import MaskOffset
from beam_warp.capture.side_file import SideFile
from beam_warp.checks import require_number


@dataclass(frozen=True)
class MaskCorrections(SideFile):
    """Corrections of the masks of a rig's cameras, the same in all frames.

    Attributes:
        offsets: How far the masks of each camera reach beyond the subject; cameras whose masks stay are not there.
    """

    FILE = "masks.json"
    SUBJECT = "corrections of masks"

    offsets: Mapping[str, MaskOffset] = field(default_factory=dict)

    def put_right(self, record: CaptureRecord) -> CaptureRecord:
        """Return a record whose mask is moved as it is read."""
        offset = self.offsets.get(record.camera_name)
        return record if offset is None else replace(record, mask_excess=offset.pixels)

    def findings(self) -> list[Finding]:
        """Return what a user should know about the masks."""
        return [offset_finding(self.offsets)] if self.offsets else []

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record, which `from_dict` takes."""
        return {
            "cameras": {name: {"pixels": found.pixels, "error": found.error} for name, found in self.offsets.items()}
        }

    @classmethod
    def from_dict(cls, content: Any) -> MaskCorrections:
        """Take what `as_dict` returned."""
        return cls(
            {
                str(name): MaskOffset(
                    require_number("pixels", offset["pixels"], -1e3, 1e3), require_number("error", offset["error"], 0.0)
                )
                for name, offset in content["cameras"].items()
            }
        )
