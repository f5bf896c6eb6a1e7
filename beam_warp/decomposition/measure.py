"""Fourth step of the main job: measure every frame under the light of the capture, or find it finished."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.decomposition.archive import MeasuredFrame
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.roughness_finder import RoughnessFinder
from beam_warp.decomposition.seen import SeenFrame
from beam_warp.digests import array_digest
from beam_warp.materials.direct import ColorEvidence, measure_materials
from beam_warp.materials.images import ImagePathOptions, decompose_by_images
from beam_warp.world.gaussians import Observability

UNMEASURED = Observability.UNSEEN | Observability.FILLED


class FrameMeasurement:
    """Measures frames one after the other, and keeps each in an archive.

    Attributes:
        resumed: Frames that were found finished.
        ray_count: Rays of light and occlusion that were traced for the others.
        notes: What a reader of the result should know.
    """

    def __init__(self, plan: JobPlan, roughness: RoughnessFinder) -> None:
        """Start with no frame; ``roughness`` finds that of each."""
        self.resumed = 0
        self.ray_count = 0
        self.notes: list[str] = []
        self._plan, self._roughness = plan, roughness

    def __iter__(self) -> Iterator[MeasuredFrame]:
        """Measure the frames in their order; each is stored before it is given out."""
        plan = self._plan
        total = len(plan.source.sequence)
        previous: MeasuredFrame | None = None
        for number in range(total):
            frame = plan.source.frame(number)
            key = plan.source.key(plan.key, frame)
            if previous is not None:  # what is found then depends on what was found before
                key = array_digest(text=f"{key} {previous.key}")
            measured = plan.archive.find(number, key)
            if measured is None:
                measured = self._measure(frame, key, previous)
                with plan.source.log.timer("store"):
                    plan.archive.keep(measured)
                frame.forget()
            else:
                self.resumed += 1
            plan.source.log.report("decompose", number + 1, total)
            previous = measured if plan.persistent and plan.source.options.images is not None else None
            yield measured

    def _measure(self, frame: SeenFrame, key: str, previous: MeasuredFrame | None) -> MeasuredFrame:
        """Measure one frame."""
        images, evidence = self._plan.source.options.images, None
        if images is not None:
            arrays = self._by_images(frame, images, previous)
        else:
            arrays, evidence = self._by_rays(frame)
        surface, report = frame.surface, frame.scene.report
        return MeasuredFrame(
            number=frame.number,
            key=key,
            cloud=frame.cloud.with_arrays(normals=surface.normals, normal_confidence=surface.confidence, **arrays),
            evidence=evidence,
            from_shape=surface.from_shape,
            report=np.array([report.traced, report.dropped, report.raised_scales]),
        )

    def _by_rays(self, frame: SeenFrame) -> tuple[dict[str, NDArray[Any]], ColorEvidence]:
        """Measure a frame by rays from its Gaussians: occlusion, and evidence on base colour."""
        scene, points, views = frame.scene, frame.points, frame.views
        roughness = self._roughness.arrays(frame)
        with frame.log.timer("materials"):
            measured = measure_materials(
                frame.cloud,
                scene,
                points,
                roughness["roughness"],
                self._plan.light.prepared,
                options=self._plan.source.options.gathering,
                views=views,
                frame=frame.number,
                progress=frame.log.within("materials", frame.number),
            )
        self.ray_count += measured.ray_count
        with frame.log.timer("fill"):
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
        with frame.log.timer("materials"):
            found = decompose_by_images(
                frame.cloud,
                scene,
                views,
                roughness["roughness"],
                self._plan.light.prepared,
                options,
                raster_options=frame.capture.raster,
                previous=None if previous is None else previous.cloud.base_color,
                frame=frame.number,
                progress=frame.log.within("materials", frame.number),
            )
        self.ray_count += found.ray_count
        self.notes += [note for note in found.notes if note not in self.notes]
        return {
            "ambient_occlusion": found.ambient_occlusion,
            **roughness,
            "base_color": found.base_color,
            "observability": np.where(found.filled.any(axis=1), np.uint8(UNMEASURED), np.uint8(0)),
        }
