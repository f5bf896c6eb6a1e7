"""Fourth step of the main job: measure every frame under the light of the capture, or find it finished."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.digests import array_digest
from beam_warp.jobs.progress import JobLog
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.archive import FrameArchive, MeasuredFrame
from beam_warp.materials.direct import ColorEvidence, MaterialOptions, measure_materials
from beam_warp.materials.images import ImagePathOptions, decompose_by_images
from beam_warp.materials.roughness_finder import RoughnessFinder
from beam_warp.materials.seen import SeenFrame
from beam_warp.materials.source import Source
from beam_warp.world.gaussians import Observability

UNMEASURED = Observability.UNSEEN | Observability.FILLED


class FrameMeasurement:
    """Measures frames one after the other, and keeps each in an archive.

    Attributes:
        resumed: Frames that were found finished.
        notes: What a reader of the result should know.
    """

    def __init__(
        self,
        source: Source,
        light: PreparedEnvironment,
        roughness: RoughnessFinder,
        archive: FrameArchive,
        *,
        options: MaterialOptions | ImagePathOptions,
        persistent: bool,
        key: str,
        log: JobLog,
    ) -> None:
        """Take what frames are measured with.

        Args:
            source: The frames.
            light: The light of the capture.
            roughness: Finds their roughness.
            archive: Where finished frames are.
            options: Of the direct path, or of the image path.
            persistent: Whether row i is the same Gaussian in every frame.
            key: Key of the job.
            log: Told how far and how long steps take.
        """
        self.resumed = 0
        self.notes: list[str] = []
        self._source, self._light, self._roughness, self._archive = source, light, roughness, archive
        self._options, self._persistent, self._key, self._log = options, persistent, key, log

    def __iter__(self) -> Iterator[MeasuredFrame]:
        """Measure the frames in their order; each is stored before it is given out."""
        total = len(self._source.sequence)
        previous: MeasuredFrame | None = None
        for number in range(total):
            frame = self._source.frame(number)
            key = self._source.key(self._key, frame)
            if previous is not None:  # what is found then depends on what was found before
                key = array_digest(text=f"{key} {previous.key}")
            measured = self._archive.find(number, key)
            if measured is None:
                measured = self._measure(frame, key, previous)
                with self._log.timer("store"):
                    self._archive.keep(measured)
                frame.forget()
            else:
                self.resumed += 1
            self._log.report("decompose", number + 1, total)
            follows = self._persistent and isinstance(self._options, ImagePathOptions)
            previous = measured if follows else None
            yield measured

    def _measure(self, frame: SeenFrame, key: str, previous: MeasuredFrame | None) -> MeasuredFrame:
        """Measure one frame."""
        options, evidence = self._options, None
        if isinstance(options, ImagePathOptions):
            arrays = self._by_images(frame, options, previous)
        else:
            arrays, evidence = self._by_rays(frame, options)
        surface, report = frame.surface, frame.scene.report
        return MeasuredFrame(
            number=frame.number,
            key=key,
            cloud=frame.cloud.with_arrays(normals=surface.normals, normal_confidence=surface.confidence, **arrays),
            evidence=evidence,
            from_shape=surface.from_shape,
            report=np.array([report.traced, report.dropped, report.raised_scales]),
        )

    def _by_rays(self, frame: SeenFrame, options: MaterialOptions) -> tuple[dict[str, NDArray[Any]], ColorEvidence]:
        """Measure a frame by rays from its Gaussians: occlusion, and evidence on base colour."""
        scene, points, views = frame.scene, frame.points, frame.views
        roughness = self._roughness.arrays(frame)
        with self._log.timer("materials"):
            measured = measure_materials(
                frame.cloud,
                scene,
                points,
                roughness["roughness"],
                self._light,
                options=options,
                views=views,
                frame=frame.number,
                progress=self._log.within("materials", frame.number),
            )
        with self._log.timer("fill"):
            occlusion, error = frame.filled_occlusion(measured.ambient_occlusion, measured.ambient_occlusion_error)
        arrays = {"ambient_occlusion": occlusion, "ambient_occlusion_error": error, **roughness}
        return arrays, measured.evidence

    def _by_images(
        self, frame: SeenFrame, options: ImagePathOptions, previous: MeasuredFrame | None
    ) -> dict[str, NDArray[Any]]:
        """Measure a frame by rays from the pixels of its views, baked into its Gaussians: all materials at once."""
        assert frame.capture is not None
        scene, roughness = frame.scene, self._roughness.arrays(frame)
        views = frame.images()
        with self._log.timer("materials"):
            found = decompose_by_images(
                frame.cloud,
                scene,
                views,
                roughness["roughness"],
                self._light,
                options,
                raster_options=frame.capture.raster,
                previous=None if previous is None else previous.cloud.base_color,
                frame=frame.number,
                progress=self._log.within("materials", frame.number),
            )
        self.notes += [note for note in found.notes if note not in self.notes]
        return {
            "ambient_occlusion": found.ambient_occlusion,
            **roughness,
            "base_color": found.base_color,
            "observability": np.where(found.filled.any(axis=1), np.uint8(UNMEASURED), np.uint8(0)),
        }
