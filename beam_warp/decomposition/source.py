"""First step of the main job: read the sequence, and the images of its capture, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from beam_warp.capture.digests import CaptureDigests
from beam_warp.decomposition.capture_images import CaptureImages
from beam_warp.decomposition.options import RunOptions
from beam_warp.decomposition.seen import SeenFrame
from beam_warp.digests import array_digest
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.jobs.progress import JobLog
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import WORLD_AXES, GaussianSequence


@dataclass(frozen=True, eq=False, kw_only=True)
class Source:
    """Input of a job, read one frame at a time.

    Attributes:
        sequence: Frames with captured radiance, in any axes.
        images: Images of the capture; None to do without.
        options: How frames are measured.
        digests: Digests of image files.
        device: Warp device.
        log: Told how far and how long steps take.
    """

    sequence: GaussianSequence
    images: CaptureImages | None
    options: RunOptions
    digests: CaptureDigests
    device: str
    log: JobLog

    @cached_property
    def first(self) -> SeenFrame:
        """Frame 0, which the light is judged by; see `frame`."""
        return self._read(0)

    def frame(self, number: int) -> SeenFrame:
        """Read a frame and bring it to the world's axes.

        Raises:
            InvalidArrayError: There is no Gaussian, or they have no captured radiance.
        """
        return self.first if number == 0 else self._read(number)

    def _read(self, number: int) -> SeenFrame:
        original = self.sequence[number]
        if len(original) == 0:
            raise InvalidArrayError(
                f"a frame must hold at least one Gaussian, got none at frame {number}. Leave empty frames out."
            )
        if original.radiance is None:
            raise InvalidArrayError(
                f"radiance must be given to decompose materials, got none at frame {number}. "
                "Import Gaussians with captured colour."
            )
        cloud = change_axes(original, WORLD_AXES)
        return SeenFrame(number, original, cloud, self.images, self.options.gathering, self.device, self.log)

    def is_display_referred(self) -> bool:
        """Return whether the captured colour has no scale: that of the first frame's images, if there are any."""
        if self.images is not None:
            return self.images.is_display_referred(0)
        return self.first.cloud.radiance_color_space == DISPLAY_SRGB

    @property
    def has_light(self) -> bool:
        """Whether the light was measured with the capture, so that its scale and its turn are nearly right."""
        return self.images is not None and self.images.has_light

    def image_digest(self, number: int) -> str:
        """Return the digest of a frame's images; empty without a capture."""
        return "" if self.images is None else self.images.digest(number, self.digests)

    def digest(self, frame: SeenFrame) -> str:
        """Return the digest of a frame: its Gaussians and its images."""
        cloud = frame.cloud
        text = f"{frame.number} {cloud.radiance_color_space} {self.image_digest(frame.number)}"
        return array_digest(*cloud.arrays().values(), text=text)
