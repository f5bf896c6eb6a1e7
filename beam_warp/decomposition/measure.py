"""Fourth step of the main job: measure a frame under the light of the capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.decomposition.archive import MeasuredFrame
from beam_warp.decomposition.plan import JobPlan
from beam_warp.decomposition.seen import SeenFrame
from beam_warp.materials.direct import ColorEvidence, measure_materials
from beam_warp.world.gaussians import Observability

if TYPE_CHECKING:
    from beam_warp.materials.images import ImagePathOptions

UNMEASURED = Observability.UNSEEN | Observability.FILLED


@dataclass(eq=False)
class FrameMeasurement:
    """Measures one frame.

    Attributes:
        plan: Light and options.
        roughness: ``roughness`` of the frame's Gaussians, ``(N,)``, and ``roughness_error`` where it is estimated.
        ray_count: Rays of light and occlusion that were traced.
        economy: What fewer rays for some Gaussians have left out; see `beam_warp.materials.pilot.economy`.
        notes: What a reader of the result should know.
    """

    plan: JobPlan
    roughness: Mapping[str, NDArray[np.float32]]
    ray_count: int = 0
    economy: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def measure(self, frame: SeenFrame, previous: MeasuredFrame | None) -> MeasuredFrame:
        """Measure a frame; on the image path, colours follow those of the frame before, if it has the same rows."""
        images, evidence = self.plan.source.options.images, None
        if images is not None:
            arrays = self._by_images(frame, images, previous)
        else:
            arrays, evidence = self._by_rays(frame)
        surface, report = frame.surface, frame.scene.report
        return MeasuredFrame(
            number=frame.number,
            cloud=frame.cloud.with_arrays(normals=surface.normals, normal_confidence=surface.confidence, **arrays),
            evidence=evidence,
            from_shape=surface.from_shape,
            report=np.array([report.traced, report.dropped, report.raised_scales]),
        )

    def _by_rays(self, frame: SeenFrame) -> tuple[dict[str, NDArray[Any]], ColorEvidence]:
        """Measure a frame by rays from its Gaussians: occlusion, and evidence on base colour."""
        scene, points, views, roughness = frame.scene, frame.points, frame.views, self.roughness
        with frame.log.timer("materials"):
            measured = measure_materials(
                frame.cloud,
                scene,
                points,
                roughness["roughness"],
                self.plan.light.prepared,
                options=self.plan.source.options.gathering,
                views=views,
                frame=frame.number,
                progress=frame.log.within("materials", frame.number),
            )
        self.ray_count += measured.ray_count
        self.economy = measured.economy
        with frame.log.timer("fill"):
            occlusion, error = frame.filled_occlusion(measured.ambient_occlusion, measured.ambient_occlusion_error)
        arrays = {"ambient_occlusion": occlusion, "ambient_occlusion_error": error, **roughness}
        return arrays, measured.evidence

    def _by_images(
        self, frame: SeenFrame, options: ImagePathOptions, previous: MeasuredFrame | None
    ) -> dict[str, NDArray[Any]]:
        """Measure a frame by rays from the pixels of its views, baked into its Gaussians: all materials at once."""
        from beam_warp.materials.images import decompose_by_images  # with kernels that the direct path does not need

        assert frame.capture is not None
        scene, roughness = frame.scene, self.roughness
        views = frame.images()
        with frame.log.timer("materials"):
            found = decompose_by_images(
                frame.cloud,
                scene,
                views,
                roughness["roughness"],
                self.plan.light.prepared,
                options,
                raster_options=frame.capture.raster,
                previous=None if previous is None else previous.cloud.base_color,
                frame=frame.number,
                progress=frame.log.within("materials", frame.number),
            )
        self.ray_count += found.ray_count
        self.notes += found.notes
        return {
            "ambient_occlusion": found.ambient_occlusion,
            **roughness,
            "base_color": found.base_color,
            "observability": np.where(found.filled.any(axis=1), np.uint8(UNMEASURED), np.uint8(0)),
        }
