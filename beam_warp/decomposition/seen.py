"""Second step of the main job: evidence of a frame's views on its Gaussians, and points where light is gathered."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.views import CapturedView
from beam_warp.decomposition.capture_images import CaptureImages
from beam_warp.jobs.progress import JobLog
from beam_warp.materials.base_color import Neighbors
from beam_warp.materials.evidence import ViewEvidence, view_evidence
from beam_warp.materials.light import light_evidence
from beam_warp.materials.light_fits import LightEvidence
from beam_warp.materials.light_rays import MaterialOptions
from beam_warp.materials.normals import SurfaceNormals, SurfacePoints, estimate_normals
from beam_warp.trace.scene import Scene
from beam_warp.world.gaussians import GaussianCloud


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """One frame and what its views show of it. Each part is worked out when it is first asked for, and once.

    Attributes:
        number: Number of the frame in the sequence.
        original: The Gaussians in the axes of the input.
        cloud: The Gaussians in the world's axes, with captured radiance.
        capture: Images of the capture; None without one.
        options: Offset of ray origins, and seed.
        device: Warp device.
        log: Told how far and how long steps take.
    """

    number: int
    original: GaussianCloud
    cloud: GaussianCloud
    capture: CaptureImages | None
    options: MaterialOptions
    device: str
    log: JobLog

    def forget(self) -> None:
        """Free what was worked out, which lies on the device; it is worked out again when it is asked for."""
        for name in ("scene", "views", "points", "neighbors", "surface", "light_evidence"):
            self.__dict__.pop(name, None)

    @cached_property
    def scene(self) -> Scene:
        """The Gaussians as occluders."""
        with self.log.timer("upload and build"):
            return Scene.from_gaussians(self.cloud, self.device)

    def images(self) -> list[CapturedView]:
        """Read what the cameras saw; nothing without a capture."""
        if self.capture is None:
            return []
        with self.log.timer("read images"):
            return self.capture.views(self.number)

    @cached_property
    def views(self) -> ViewEvidence | None:
        """Evidence of the capture's images on the Gaussians; None without a capture."""
        if self.capture is None:
            return None
        images = self.images()
        with self.log.timer("views"):
            return view_evidence(
                self.cloud,
                [image.camera for image in images],
                images,
                options=self.capture.raster,
                ceiling=self.capture.ceiling(self.number, images),
                device=self.device,
                progress=self.log.within("views", self.number),
            )

    @cached_property
    def points(self) -> SurfacePoints:
        """Points where light is gathered: where views show the surface, or the Gaussians' own centres."""
        views, offset = self.views, self.options.offset
        if views is None:
            return SurfacePoints.at_centers(self.cloud, self.scene, self.surface, offset)
        scene = self.scene
        with self.log.timer("surface"):
            return SurfacePoints.seen_by(self.cloud, views, scene, offset)

    @cached_property
    def neighbors(self) -> Neighbors:
        """What views show around Gaussians that none of them does."""
        return Neighbors.of(self.cloud.positions, ~self.points.seen)

    @cached_property
    def light_evidence(self) -> LightEvidence:
        """What well-seen Gaussians show of the light; only with a capture."""
        assert self.views is not None
        points, scene = self.points, self.scene
        with self.log.timer("check"):
            return light_evidence(scene, points, self.views)

    @cached_property
    def surface(self) -> SurfaceNormals:
        """Normals of all Gaussians: as views show them, those of neighbours where none does; or estimated."""
        if self.views is None:
            scene = self.scene
            with self.log.timer("normals"):
                return estimate_normals(
                    self.cloud, scene, seed=self.options.seed, progress=self.log.within("normals", self.number)
                )
        points = self.points
        normals = points.normals.numpy()
        filled = self.neighbors.fill(normals)
        length = np.linalg.norm(filled, axis=1, keepdims=True)
        upright = np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), filled.shape)
        unit = np.where(length > 1e-6, filled / np.maximum(length, 1e-6), upright).astype(np.float32)
        return SurfaceNormals(unit, points.confidence, np.zeros(len(unit), bool))

    def filled_occlusion(
        self, visibility: NDArray[np.float32], error: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Give Gaussians that no view shows the ambient occlusion of their neighbours, ``(N,)`` each."""
        seen = (visibility[:, None], error[:, None])
        mean, spread = self.neighbors.fill(seen[0]), self.neighbors.spread(self.cloud.positions, *seen)
        return mean[:, 0].astype(np.float32), spread[:, 0].astype(np.float32)
