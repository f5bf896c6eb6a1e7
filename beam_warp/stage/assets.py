"""Gaussians on a stage: where they stand, and which moment of theirs is seen at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.checks import require_array, require_choice, require_finite, require_number
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.schema.placement import Placement
from beam_warp.stage.camera_paths import outline
from beam_warp.stage.time_sampling import Blend, Moment, TimeSampler
from beam_warp.world.axes import axes_matrix, change_axes
from beam_warp.world.framing import bulk_of
from beam_warp.world.gaussians import MATERIAL_CHANNELS, WORLD_AXES, GaussianCloud, GaussianSequence

BOUNDING_FRAMES = 3
"""What bounds a moving subject is taken from this many of its frames: first, last and between."""

_SHARED = (
    "positions",
    "orientations",
    "scales",
    "opacities",
    *MATERIAL_CHANNELS,
    "normal_confidence",
    "ambient_occlusion_error",
    "base_color_error",
    "roughness_error",
    "observability",
)
"""Arrays that several assets can have in common; ids of different assets would mean nothing together."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class StageAsset:
    """A sequence on a stage: world = scale · R · point + translate.

    Attributes:
        sequence: Relightable Gaussians, in axes of their own.
        name: Name of the asset in messages.
        translate: Shift in the world [m].
        rotate: About z, counter-clockwise from above; or about x, then y, then z, each a fixed axis of the world
            [degree].
        scale: The same in all directions.
        on_ground: Put its lowest point (of its `bulk`) at height 0 before it is translated.
        centered: Put the middle of its bulk over the origin before it is translated.
        start: Time at which the first frame is seen [s].
        speed: How fast it plays; 2 is twice as fast.
        loop: Start again after the last frame, and play before ``start`` as well; else the end frames are held.
        blend: Which frames are blended at times between them; see `TimeSampler`.
        files: Files that the sequence is read from, if any: one tuple for each frame, or one for all frames.

    Raises:
        InvalidArrayError: The translation or rotation is not 3 finite numbers.
        InvalidOptionError: A number is out of range, or the first frame is not relightable.
    """

    sequence: GaussianSequence
    name: str = "asset"
    translate: Vector = (0.0, 0.0, 0.0)
    rotate: float | Vector = 0.0
    scale: float = 1.0
    on_ground: bool = False
    centered: bool = False
    start: float = 0.0
    speed: float = 1.0
    loop: bool = False
    blend: Blend = "identified"
    files: tuple[tuple[Path, ...], ...] = ()

    def __post_init__(self) -> None:
        """Check every field, and that there is something to light."""
        object.__setattr__(self, "translate", require_vector("translate", self.translate))
        object.__setattr__(self, "rotate", require_rotation("rotate", self.rotate))
        require_number("scale", self.scale, 1e-6, 1e6)
        require_number("start", self.start, -1e9, 1e9)
        require_number("speed", self.speed, 1e-3, 1e3)
        require_choice("blend", self.blend, ("identified", "rows", "nearest"))
        self._sampler.at(0.0)

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions of the asset's reader, and frames that could not be blended so far."""
        said = [line for line in self.sequence.metadata.get("notes", "").splitlines() if line]
        return tuple(f"{self.name}: {note}" for note in (*said, *self._sampler.notes))

    @property
    def end(self) -> float:
        """Time at which the last frame has been seen once [s]."""
        return self.start + len(self.sequence) / (self.sequence.frames_per_second * self.speed)

    def moment(self, time: float) -> Moment:
        """Return which of its frames are seen at a time of the stage [s]."""
        return self._sampler.moment((time - self.start) * self.speed * self.sequence.frames_per_second)

    def cloud_at(self, time: float) -> GaussianCloud:
        """Return the Gaussians of a time of the stage [s], in the world, without captured radiance.

        The same moment gives the same object, as long as no other was asked for in between.

        Raises:
            InvalidOptionError: A frame is not relightable.
            BeamError: A frame cannot be read.
        """
        return self._held_cloud(self.moment(time))

    def files_of(self, frame: int) -> tuple[Path, ...]:
        """Return the files that a frame is read from; none if it is in memory."""
        return self.files[min(frame, len(self.files) - 1)] if self.files else ()

    @cached_property
    def subject(self) -> NDArray[np.float64]:
        """Points that bound the asset's bulk in the world [m], ``(N, 3)``; none if the frames looked at are empty."""
        return outline(bulk_of([self._sampler.at(frame) for frame in self._bounding_frames]))

    @cached_property
    def placement(self) -> Placement:
        """Placement of the asset in the world."""
        placement = placement_of(self.translate, self.rotate, self.scale)
        shift = placement.translation
        if self.on_ground or self.centered:
            turned = replace(placement, translation=np.zeros(3))
            points = bulk_of([placed(self._bare(frame), turned) for frame in self._bounding_frames])
            if len(points):
                low, high = points.min(axis=0), points.max(axis=0)
                middle = -0.5 * (low + high)
                aside = middle[:2] if self.centered else np.zeros(2)
                shift = shift + np.array([*aside, -low[2] if self.on_ground else 0.0])
        return replace(placement, translation=shift)

    @property
    def _bounding_frames(self) -> list[int]:
        return sorted({round(frame) for frame in np.linspace(0, len(self.sequence) - 1, BOUNDING_FRAMES)})

    @cached_property
    def _sampler(self) -> TimeSampler:
        """Frames are placed as they are read: blending commutes with a similarity."""
        placing = replace(self.sequence, read_frame=lambda frame: placed(self._bare(frame), self.placement))
        return TimeSampler(placing, ends="loop" if self.loop else "hold", blend=self.blend)

    @cached_property
    def _held_cloud(self) -> Callable[[Moment], GaussianCloud]:
        """Reader of moments that keeps the latest one."""
        return lru_cache(1)(self._sampler.at_moment)

    def _bare(self, frame: int) -> GaussianCloud:
        """Read a frame and drop its captured radiance, which light does not look at."""
        cloud = self.sequence[frame]
        missing = [name for name in MATERIAL_CHANNELS if getattr(cloud, name) is None]
        if missing and len(cloud):
            raise InvalidOptionError(
                f"asset must be relightable, got one without {', '.join(missing)} in frame {frame} of {self.name}. "
                "Estimate its materials with beam run."
            )
        return cloud if cloud.radiance is None else cloud.with_arrays(radiance=None, radiance_color_space=None)


def placement_of(translate: object = (0.0, 0.0, 0.0), rotate: object = 0.0, scale: float = 1.0) -> Placement:
    """Return the placement that a `StageAsset` with these attributes has, after checking them.

    Raises:
        InvalidArrayError: The translation or rotation is not 3 finite numbers.
        InvalidOptionError: A number is out of range.
    """
    angles = require_rotation("rotate", rotate)
    turn = Rotation.from_euler("xyz", (0.0, 0.0, angles) if isinstance(angles, float) else angles, degrees=True)
    shift = np.array(require_vector("translate", translate))
    return Placement(require_number("scale", scale, 1e-6, 1e6), turn.as_matrix(), shift)


def placed(cloud: GaussianCloud, placement: Placement) -> GaussianCloud:
    """Return a cloud in the world's axes, at a place."""
    if placement.is_identity:
        return change_axes(cloud, WORLD_AXES)
    turn = placement.orthogonal @ axes_matrix(cloud.axes, WORLD_AXES)
    arrays: dict[str, Any] = dict(replace(placement, orthogonal=turn).apply(cloud.arrays()))
    return GaussianCloud(**arrays, axes=WORLD_AXES)


def joined(clouds: Sequence[GaussianCloud]) -> GaussianCloud:
    """Return the Gaussians of several clouds in the world as one, in their order; those that are empty do not count.

    Arrays that relighting does not need are kept where all have them.
    """
    kept = [cloud for cloud in clouds if len(cloud)]
    if len(kept) == 1:
        return kept[0]
    if not kept:
        return clouds[0] if clouds else empty_cloud()
    names = [name for name in _SHARED if all(getattr(cloud, name) is not None for cloud in kept)]
    arrays: dict[str, Any] = {name: np.concatenate([getattr(cloud, name) for cloud in kept]) for name in names}
    return GaussianCloud(**arrays)


def empty_cloud() -> GaussianCloud:
    """Return no Gaussians, relightable ones."""
    wide, flat = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    return GaussianCloud(
        positions=wide,
        orientations=np.zeros((0, 4), np.float32),
        scales=wide,
        opacities=flat,
        base_color=wide,
        roughness=flat,
        ambient_occlusion=flat,
        normals=wide,
    )


def require_vector(name: str, value: object) -> Vector:
    """Return three finite numbers."""
    vector = require_array(name, value, (3,), np.float64)  # type: ignore[arg-type]
    require_finite(name, vector)
    return tuple(vector.tolist())  # type: ignore[return-value]


def require_rotation(name: str, value: object) -> float | Vector:
    """Return an angle about z, or three about x, y and z [degree]."""
    if np.ndim(value) == 0:  # type: ignore[arg-type]
        return require_number(name, value, -1e6, 1e6)  # type: ignore[arg-type]
    try:
        return require_vector(name, value)
    except InvalidArrayError as error:
        raise InvalidArrayError(
            f"{name} must be an angle about z, or three angles about x, y and z, got {value!r}. Write 90 or [0, 0, 90]."
        ) from error
