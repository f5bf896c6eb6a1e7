"""What one frame brings to decomposition: its Gaussians, what views show of them, and where their light is gathered."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.digests import CaptureDigests
from beam_warp.capture.findings import Finding
from beam_warp.capture.inspect import SPLIT
from beam_warp.capture.views import CapturedView
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import DISPLAY_SRGB, LINEAR_REC709
from beam_warp.image.files import SCENE_REFERRED_SUFFIXES
from beam_warp.materials.agreement import (
    judge_clipping,
    judge_environment,
    largest_value,
    match_silhouettes,
    matched_frames,
    require_match,
)
from beam_warp.materials.base_color import fill_from_neighbors
from beam_warp.materials.evidence import ViewEvidence, view_evidence
from beam_warp.materials.light import check_light
from beam_warp.materials.normals import SurfaceNormals, SurfacePoints, estimate_normals
from beam_warp.materials.roughness_source import constant_roughness, textured_roughness
from beam_warp.raster.records import RasterOptions
from beam_warp.trace.scene import Scene
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.metadata import stated_capture_frames

LOADING_THREADS = 8
"""Images decoded at a time."""

NOTHING_IN_COMMON = 0.05
"""Overlap of silhouettes below which a sequence cannot be of a capture, whatever it says."""

SILHOUETTES = 6
"""Views, evenly chosen, in which silhouettes are compared."""

Timer = Callable[[str], AbstractContextManager[None]]
"""Charges what is done in its context to a stage."""

Progress = Callable[[str, int, int], None]
"""Called with (stage, done, total) of a frame."""


@dataclass(frozen=True)
class RoughnessTexture:
    """A roughness texture and the mesh whose texture coordinates it follows, in the axes and units of the input."""

    texture: Path
    mesh: Path


class CaptureImages:
    """The images that a sequence was reconstructed from, frame by frame."""

    def __init__(self, capture: Capture, sequence: GaussianSequence) -> None:
        """Find every frame's images.

        Raises:
            InvalidOptionError: The capture lacks a frame of the sequence.
        """
        self.raster = RasterOptions.from_metadata(sequence.metadata)
        self.is_stated = stated_capture_frames(sequence.metadata, len(sequence)) is not None
        self._records = {
            index: list(capture.select(split=SPLIT, frames={frame}))
            for index, frame in enumerate(matched_frames(sequence, capture, SPLIT))
        }

    def views(self, index: int) -> list[CapturedView]:
        """Read the images of a frame of the sequence."""
        with ThreadPoolExecutor(LOADING_THREADS) as pool:
            return list(pool.map(lambda record: record.view(), self._records[index]))

    def is_display_referred(self, index: int) -> bool:
        """Return whether images of a frame have a scale of their own, and an upper end, rather than that of light."""
        return any(_color_space(record) == DISPLAY_SRGB for record in self._records[index])

    def ceiling(self, index: int, views: Sequence[CapturedView]) -> float:
        """Return the largest value that the images of a frame can hold."""
        spaces = [_color_space(record) for record in self._records[index]]
        return min(
            largest_value([view for view, of in zip(views, spaces, strict=True) if of == space], space)
            for space in set(spaces)
        )

    def digest(self, index: int, digests: CaptureDigests) -> str:
        """Return what the images of a frame are, cameras included, as one word."""
        with ThreadPoolExecutor(LOADING_THREADS) as pool:
            return digests.of(index, self._records[index], pool)


class FrameInputs:
    """One frame on its way through: each step is done when it is first asked for, and once."""

    def __init__(
        self,
        number: int,
        original: GaussianCloud,
        images: CaptureImages | None,
        *,
        device: str,
        offset: float | Literal["auto"],
        seed: int,
        timer: Timer,
        progress: Progress,
    ) -> None:
        """Bring a frame to the world's axes.

        Args:
            number: Of the frame in the sequence.
            original: Its Gaussians, in any axes.
            images: Of the capture; None to do without.
            device: Warp device.
            offset: Lift of ray origins.
            seed: Same seed, same device, same bits.
            timer: Told how long steps take.
            progress: Told how far they are.

        Raises:
            InvalidArrayError: There is no Gaussian, or they have no captured radiance.
        """
        self.number = number
        self.original = original
        self.cloud = change_axes(original, WORLD_AXES)
        self._images = images
        self._device, self._seed = device, seed
        self._offset: float | Literal["auto"] = offset
        self._timer, self._progress = timer, progress
        if len(self.cloud) == 0:
            raise InvalidArrayError(
                f"a frame must hold at least one Gaussian, got none at frame {number}. Leave empty frames out."
            )
        if self.cloud.radiance is None:
            raise InvalidArrayError(
                f"radiance must be given to decompose materials, got none at frame {number}. "
                "Import Gaussians with captured colour."
            )

    def forget(self) -> None:
        """Let go of what was worked out: it lies on the device, and comes again when it is asked for."""
        for name in ("scene", "views", "points", "surface"):
            self.__dict__.pop(name, None)

    @cached_property
    def scene(self) -> Scene:
        """The Gaussians as occluders."""
        with self._timer("upload and build"):
            return Scene.from_gaussians(self.cloud, self._device)

    @property
    def images(self) -> list[CapturedView]:
        """What the cameras saw, read anew each time."""
        if self._images is None:
            return []
        with self._timer("read images"):
            return self._images.views(self.number)

    def check(self, environment: EnvironmentMap) -> list[Finding]:
        """Find what is wrong with the light and the images, before anything is measured.

        Raises:
            InvalidOptionError: The light is black, or the images show something else than the Gaussians.
        """
        findings = judge_environment(environment)
        if self._images is None or self.views is None:
            return findings
        images = self.images
        some = images[:: max(1, len(images) // SILHOUETTES)]
        match = match_silhouettes(self.cloud, some, options=self._images.raster, device=self._device)
        # Gaussians that say which frames they were made from may be poorly fitted, but hardly lie elsewhere.
        if not self._images.is_stated or not match.overlap > NOTHING_IN_COMMON:
            require_match(match)
        findings += [match.finding] if match.finding is not None else []
        findings += judge_clipping(images, self._images.ceiling(self.number, images))
        return findings + list(check_light(self.scene, self.points, self.views, environment).findings)

    @cached_property
    def views(self) -> ViewEvidence | None:
        """What the capture's images show; None without a capture."""
        if self._images is None:
            return None
        images = self.images
        with self._timer("views"):
            return view_evidence(
                self.cloud,
                [image.camera for image in images],
                images,
                options=self._images.raster,
                ceiling=self._images.ceiling(self.number, images),
                device=self._device,
                progress=lambda done, total: self._progress("views", done, total),
            )

    @cached_property
    def points(self) -> SurfacePoints:
        """Where light is gathered: where views show the surface, or the Gaussians' own centres."""
        views = self.views
        if views is None:
            surface = self.surface
            return SurfacePoints.at_centers(self.cloud, self.scene, surface, self._offset)
        scene = self.scene
        with self._timer("surface"):
            return SurfacePoints.seen_by(self.cloud, views, scene, self._offset)

    @cached_property
    def surface(self) -> SurfaceNormals:
        """Normals of all Gaussians: as views show them, those of neighbours where none does; or estimated."""
        if self.views is None:
            scene = self.scene
            with self._timer("normals"):
                return estimate_normals(
                    self.cloud,
                    scene,
                    seed=self._seed,
                    progress=lambda done, total: self._progress("normals", done, total),
                )
        points = self.points
        normals = points.normals.numpy()
        filled, _ = fill_from_neighbors(self.cloud.positions, normals, np.zeros_like(normals), ~points.seen)
        length = np.linalg.norm(filled, axis=1, keepdims=True)
        upright = np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), filled.shape)
        unit = np.where(length > 1e-6, filled / np.maximum(length, 1e-6), upright).astype(np.float32)
        return SurfaceNormals(unit, points.confidence, np.zeros(len(unit), bool))

    def roughness(self, source: float | RoughnessTexture) -> NDArray[np.float32]:
        """Return the roughness that a constant or a texture states, ``(N,)``."""
        if isinstance(source, RoughnessTexture):
            return textured_roughness(self.original, source.texture, source.mesh)
        return constant_roughness(self.cloud, source)


def filled_occlusion(
    inputs: FrameInputs, visibility: NDArray[np.float32], error: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Give Gaussians that no view shows the ambient occlusion of their neighbours."""
    missing = ~inputs.points.seen
    mean, spread = fill_from_neighbors(inputs.cloud.positions, visibility[:, None], error[:, None], missing)
    return mean[:, 0].astype(np.float32), spread[:, 0].astype(np.float32)


def _color_space(record: CaptureRecord) -> str:
    """Return the colour space of a record's image: as stated, or by the custom of its format."""
    if record.color_space is not None:
        return record.color_space
    return LINEAR_REC709 if record.image_path.suffix.lower() in SCENE_REFERRED_SUFFIXES else DISPLAY_SRGB
