"""Images of a capture, as the frames of a sequence need them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.digests import CaptureDigests
from beam_warp.capture.exposures import scale_errors
from beam_warp.capture.findings import count_of, names_of
from beam_warp.capture.inspect import SPLIT
from beam_warp.capture.views import CapturedView
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.image.files import SCENE_REFERRED_SUFFIXES
from beam_warp.materials.agreement import largest_value, matched_frames
from beam_warp.raster.records import RasterOptions
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import stated_capture_frames

LOADING_THREADS = 8
"""Images decoded at a time."""


class CaptureImages:
    """The images that a sequence was reconstructed from, frame by frame.

    Attributes:
        raster: How the Gaussians were drawn when they were fitted.
        is_stated: Whether the sequence states which frames of the capture it shows.
        has_light: Whether the capture comes with its light, in the units of its images.
        notes: Images that are missing and were left out, in words.
    """

    def __init__(self, capture: Capture, sequence: GaussianSequence) -> None:
        """Find every frame's images; those without a file are left out, as reconstruction does, if others are there.

        Raises:
            InvalidOptionError: The capture lacks a frame of the sequence.
        """
        self.raster = RasterOptions.from_metadata(sequence.metadata)
        self.is_stated = stated_capture_frames(sequence.metadata, len(sequence)) is not None
        self.has_light = capture.environment_path is not None
        self._records: dict[int, list[CaptureRecord]] = {}
        missing: list[str] = []
        for index, frame in enumerate(matched_frames(sequence, capture, SPLIT)):
            records = capture.select(split=SPLIT, frames={frame})
            there = [record for record in records if record.image_path.is_file()]
            self._records[index] = there or list(records)  # of a frame without images the reader names the first
            missing += [record.name for record in records if there and record not in there]
        self.notes = [f"{count_of(len(missing), 'image')} missing, left out: {names_of(missing)}"] if missing else []

    def views(self, index: int) -> list[CapturedView]:
        """Read the images of a frame of the sequence."""
        with ThreadPoolExecutor(LOADING_THREADS) as pool:
            return list(pool.map(lambda record: record.view(), self._records[index]))

    def is_display_referred(self, index: int) -> bool:
        """Return whether images of a frame have a scale and an upper end of their own, rather than those of light."""
        return any(_color_space(record) == DISPLAY_SRGB for record in self._records[index])

    def ceiling(self, index: int, views: Sequence[CapturedView]) -> float:
        """Return the largest value that the images of a frame can hold."""
        spaces = [_color_space(record) for record in self._records[index]]
        return min(
            largest_value([view for view, of in zip(views, spaces, strict=True) if of == space], space)
            for space in set(spaces)
        )

    def scale_errors(self) -> tuple[float, float, float]:
        """Return by how much the light may differ in brightness from the first frame's images; see `scale_errors`."""
        return scale_errors([record.gains for record in self._records[0]])

    def digest(self, index: int, digests: CaptureDigests) -> str:
        """Return the digest of a frame's images and cameras."""
        with ThreadPoolExecutor(LOADING_THREADS) as pool:
            return digests.of(index, self._records[index], pool)


def _color_space(record: CaptureRecord) -> str:
    """Return the colour space of a record's image: as stated, or by the custom of its format."""
    if record.color_space is not None:
        return record.color_space
    return LINEAR_REC709 if record.image_path.suffix.lower() in SCENE_REFERRED_SUFFIXES else DISPLAY_SRGB
