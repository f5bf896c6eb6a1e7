"""Finished frames of the main job on disk, from which its result is read."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.jobs.store import is_stored_frame, read_frame, write_frame
from beam_warp.materials.base_color import BaseColor
from beam_warp.materials.direct import ColorEvidence
from beam_warp.materials.roughness_profile import RoughnessProfile
from beam_warp.world.gaussians import ATTRIBUTES, WORLD_AXES, GaussianCloud

_STORED = re.compile(r"(?:frame|solution|profile)_(\d{6,})\.h5")

EVIDENCE = "evidence_"
"""Prefix of the stored arrays of evidence."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredFrame:
    """Measurements of one frame.

    Attributes:
        number: Number of the frame in the sequence.
        cloud: The Gaussians with normals, roughness and ambient occlusion; on the image path with base colour.
        evidence: Evidence on base colour; None on the image path, which leaves nothing to solve.
        from_shape: Where the normal is the Gaussian's own shortest axis, ``(N,)`` bool.
        report: Gaussians that were traced, dropped as transparent, and given a larger scale, ``(3,)``.
    """

    number: int
    cloud: GaussianCloud
    evidence: ColorEvidence | None
    from_shape: NDArray[np.bool_]
    report: NDArray[np.int64]


class FrameArchive:
    """A folder of finished frames and their solutions.

    Attributes:
        folder: Where the files are; what is found once for all frames lies beside them.
    """

    def __init__(self, folder: Path, radiance_color_space: str | None) -> None:
        """Open an existing folder; the colour space is that of the Gaussians' captured radiance."""
        self.folder = folder
        self._color_space = radiance_color_space

    def read(self, number: int) -> MeasuredFrame:
        """Return a frame that was kept."""
        arrays = read_frame(self.frame_path(number))
        told = {name: arrays[EVIDENCE + name] for name in ColorEvidence.ARRAYS if EVIDENCE + name in arrays}
        return MeasuredFrame(
            number=number,
            cloud=GaussianCloud(
                **{name: array for name, array in arrays.items() if name in ATTRIBUTES},
                axes=WORLD_AXES,
                radiance_color_space=self._color_space,
            ),
            evidence=ColorEvidence.from_arrays(told) if told else None,
            from_shape=arrays["from_shape"],
            report=arrays["report"],
        )

    def evidence(self, number: int) -> ColorEvidence:
        """Return the evidence of a frame that was kept: a quarter of it."""
        arrays = read_frame(self.frame_path(number), tuple(EVIDENCE + name for name in ColorEvidence.ARRAYS))
        return ColorEvidence.from_arrays({name.removeprefix(EVIDENCE): array for name, array in arrays.items()})

    def keep(self, frame: MeasuredFrame) -> None:
        """Store a frame.

        Raises:
            OutputError: The file cannot be written; nothing is left behind.
        """
        arrays = {**frame.cloud.arrays(), "from_shape": frame.from_shape, "report": frame.report}
        if frame.evidence is not None:
            arrays |= {EVIDENCE + name: getattr(frame.evidence, name) for name in ColorEvidence.ARRAYS}
        write_frame(self.frame_path(frame.number), arrays)

    def keep_solution(self, number: int, solved: BaseColor) -> None:
        """Store the base colour of a frame.

        Raises:
            OutputError: The file cannot be written; nothing is left behind.
        """
        write_frame(self.solution_path(number), solved.arrays())

    def solution(self, number: int) -> dict[str, NDArray[Any]]:
        """Return base colour, its standard error and observability of a frame, as arrays of a cloud."""
        return read_frame(self.solution_path(number))

    def solved(self, number: int) -> GaussianCloud:
        """Return a frame with base colour of its own."""
        return self.read(number).cloud.with_arrays(**self.solution(number))

    def remove_beyond(self, count: int) -> list[str]:
        """Remove the frames that an earlier, longer sequence left, and say so in a note, if there were any."""
        numbered = ((_STORED.fullmatch(path.name), path) for path in self.folder.iterdir())
        stale = [path for match, path in numbered if match and int(match[1]) >= count and is_stored_frame(path)]
        for path in stale:
            path.unlink(missing_ok=True)
        files = f"file{'s'[: len(stale) > 1]}"
        return [f"removed {len(stale)} stored {files} of an earlier sequence of more frames"] if stale else []

    def frame_path(self, number: int) -> Path:
        """Return the file of a frame's measurements."""
        return self.folder / f"frame_{number:06d}.h5"

    def keep_profile(self, number: int, profile: RoughnessProfile | None) -> None:
        """Store what views of a frame say of roughness; None where they say nothing.

        Raises:
            OutputError: The file cannot be written; nothing is left behind.
        """
        told = {} if profile is None else {"misfit": profile.misfit, "views": profile.views, "scatter": profile.scatter}
        write_frame(self.profile_path(number), {name: np.asarray(array) for name, array in told.items()})

    def profile(self, number: int) -> RoughnessProfile | None:
        """Return what was kept of a frame's roughness."""
        arrays = read_frame(self.profile_path(number))
        return RoughnessProfile(arrays["misfit"], arrays["views"], scatter=arrays["scatter"]) if arrays else None

    def profile_path(self, number: int) -> Path:
        """Return the file of what views of a frame say of roughness."""
        return self.folder / f"profile_{number:06d}.h5"

    def solution_path(self, number: int) -> Path:
        """Return the file of a frame's base colour."""
        return self.folder / f"solution_{number:06d}.h5"
