"""Both sides of an evaluation: the frames of an asset, the views of a capture whose truth is known, and its lights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.errors import InvalidOptionError, MissingFileError
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import MATERIAL_CHANNELS, WORLD_AXES, GaussianCloud, GaussianSequence


@dataclass(frozen=True, eq=False)
class ComparedAsset:
    """An asset beside the capture that it is compared with, read frame by frame.

    Attributes:
        sequence: The asset.
        capture: The capture.
        matched: By the capture's number of a frame, the asset's; see `beam_warp.capture.matching.match_frames`.
        split: Which records of the capture.
    """

    sequence: GaussianSequence
    capture: Capture
    matched: Mapping[int, int]
    split: str

    def records(self, frame: int) -> list[CaptureRecord]:
        """Return the views of a frame whose truth is known."""
        selected = self.capture.select(split=self.split, frames={frame})
        return [record for record in selected if record.truth_path is not None]

    def cloud(self, frame: int) -> GaussianCloud:
        """Read the frame of the asset that shows one of the capture's, in the world's axes.

        Raises:
            InvalidOptionError: It is not relightable.
        """
        cloud = self.sequence[self.matched[frame]]
        missing = [name for name in MATERIAL_CHANNELS if getattr(cloud, name) is None]
        if missing:
            raise InvalidOptionError(
                f"asset must be relightable, got one without {', '.join(missing)} in frame {self.matched[frame]}. "
                "Estimate its materials with beam run."
            )
        return change_axes(cloud, WORLD_AXES)

    def lights(self, frames: Sequence[int]) -> dict[str, EnvironmentMap]:
        """Read every light under which a view of some frames is known, by name.

        Raises:
            MissingFileError: A light is not there.
        """
        names = dict.fromkeys(name for frame in frames for record in self.records(frame) for name in record.relit_paths)
        paths = {name: self.capture.folder / "truth" / f"{name}.exr" for name in names}
        for name, path in paths.items():
            if not path.is_file():
                raise MissingFileError(
                    f"light must be a file, got none at {path}, though {name!r} is among the capture's relit images. "
                    "Put it there."
                )
        return {name: EnvironmentMap.read(path) for name, path in paths.items()}
