"""Gaussians, meshes, lights and a camera over time, and the shot of any moment."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_number, require_path
from beam_warp.digests import array_digest, content_digest, described
from beam_warp.stage.assets import StageAsset, joined
from beam_warp.stage.camera_paths import CameraPath, OrbitPath
from beam_warp.stage.environments import StageEnvironment
from beam_warp.stage.files import DURATIONS, RATES, read_stage_asset, read_stage_file
from beam_warp.stage.meshes import Ground, joined_meshes
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import Light, lights_to_json
from beam_warp.world.metadata import RASTER_ANTIALIASED, RASTER_LOW_PASS
from beam_warp.world.shot import Shot, ShotMesh

DEFAULT_RATE = 30.0
"""Images a second where no asset has a rate [1/s]."""

TURNTABLE_SECONDS = 5.0
"""Duration of turns around what does not move itself, where none is stated."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Stage:
    """Everything that images show over time; their size and renderer are chosen apart.

    Attributes:
        assets: Gaussians; none is fine.
        meshes: Triangles among them, in the world, and grounds.
        lights: Lights at places and from directions.
        environment: Distant light.
        camera: Camera path; if None, a camera that frames the assets from the front.
        fps: Images a second; if None, the rate of the first asset that moves.
        duration: Length [s]; if None, until the last moving asset has ended, else the camera has arrived, else the
            environment has turned once; a single image if nothing moves.
        given_notes: Assumptions made while the parts were read.

    Raises:
        InvalidOptionError: The rate or the duration is out of range.
        BeamError: A frame that is needed to frame the assets cannot be read.
    """

    assets: tuple[StageAsset, ...] = ()
    meshes: tuple[ShotMesh | Ground, ...] = ()
    lights: tuple[Light, ...] = ()
    environment: StageEnvironment | None = None
    camera: CameraPath | None = None
    fps: float | None = None
    duration: float | None = None
    given_notes: tuple[str, ...] = ()
    _known_files: dict[str, list[Any]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        """Settle duration and rate, and give the camera the points that it is to frame."""
        for name in ("assets", "meshes", "lights", "given_notes"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        moving = [asset for asset in self.assets if len(asset.sequence) > 1]
        rate = moving[0].sequence.frames_per_second if moving else DEFAULT_RATE
        object.__setattr__(self, "fps", require_number("fps", rate if self.fps is None else self.fps, *RATES))
        length = self._natural_duration(moving) if self.duration is None else self.duration
        object.__setattr__(self, "duration", require_number("duration", length, *DURATIONS))
        camera = OrbitPath() if self.camera is None else self.camera
        if isinstance(camera, OrbitPath):
            camera = camera.lasting(self.seconds)
            if camera.frames_subject and camera.subject is None:
                camera = replace(camera, subject=self.subject)
        object.__setattr__(self, "camera", camera)

    @classmethod
    def read(cls, path: str | Path) -> Stage:
        """Read a stage from JSON; see ``docs/stages.md``.

        Raises:
            MissingFileError: The file, or one that it names, is not there.
            AssetFormatError: It is malformed; says which field and what to do.
        """
        return cls(**read_stage_file(require_path("path", path)))

    @classmethod
    def of(
        cls,
        paths: Sequence[str | Path],
        *,
        spacing: float | None = None,
        centered: bool = False,
        source_axes: str | None = None,
        meters_per_unit: float | None = None,
        drop_invalid: bool = False,
        on_ground: bool = False,
        loop: bool = False,
        **contents: Any,
    ) -> Stage:
        """Put assets on a stage without a file.

        Args:
            paths: Files or folders of Gaussians, as `beam_warp.converters.read` takes them.
            spacing: Put the assets in a row along x, this far apart [m], each centred.
            centered: Put the middle of every asset over the origin.
            source_axes: Axes of the files; None takes their word.
            meters_per_unit: Length of the files' unit [m]; None takes their word.
            drop_invalid: Leave out rows that are no Gaussians.
            on_ground: Put the lowest point of every asset at height 0.
            loop: Whether assets start again after their last frame.
            contents: Further attributes of the stage.

        Raises:
            BeamError: Something cannot be read, or an option is out of range.
        """
        if spacing is not None:
            require_number("spacing", spacing, 0.0, 1e6)
        assets = [
            read_stage_asset(
                require_path("path", path),
                source_axes=source_axes,
                meters_per_unit=meters_per_unit,
                drop_invalid=drop_invalid,
                on_ground=on_ground,
                centered=centered or spacing is not None,
                translate=(0.0 if spacing is None else (index - 0.5 * (len(paths) - 1)) * spacing, 0.0, 0.0),
                loop=loop,
            )
            for index, path in enumerate(paths)
        ]
        return cls(assets=tuple(assets), **contents)

    @property
    def seconds(self) -> float:
        """Duration of the stage [s]."""
        assert self.duration is not None
        return self.duration

    @property
    def rate(self) -> float:
        """Images a second."""
        assert self.fps is not None
        return self.fps

    @property
    def frame_count(self) -> int:
        """Number of images at the stage's rate, at least 1."""
        return max(1, round(self.seconds * self.rate))

    def time_of(self, frame: int) -> float:
        """Return the time of an image, counted from 0 [s]."""
        return frame / self.rate

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed and what could not be done so far, each once; more may come as frames are read."""
        said = [
            *self.given_notes,
            *getattr(self.camera, "notes", ()),
            *(note for asset in self.assets for note in asset.notes),
        ]
        stated = {json.dumps(_raster(asset), sort_keys=True): asset.name for asset in self.assets}
        if len(stated) > 1:
            said.append(
                f"assets were fitted to be drawn in different ways: all are drawn as "
                f"{self._drawn_as.name if self._drawn_as else 'is usual'}"
            )
        return tuple(dict.fromkeys(said))

    @property
    def raster_metadata(self) -> Mapping[str, str]:
        """Metadata for `RasterOptions.from_metadata`: those of the first asset that states how it is drawn."""
        return {} if self._drawn_as is None else _raster(self._drawn_as)

    @cached_property
    def subject(self) -> NDArray[np.float64]:
        """Points that bound the assets [m], or the meshes if the assets show nothing, ``(N, 3)``."""
        points = [asset.subject for asset in self.assets if len(asset.subject)]
        if not points:
            points = [mesh.surface.vertices for mesh in self.meshes if isinstance(mesh, ShotMesh)]
        return np.concatenate(points).astype(np.float64) if points else np.zeros((0, 3))

    @cached_property
    def mesh(self) -> ShotMesh | None:
        """All triangles as one mesh; None if there are none."""
        return joined_meshes([mesh.mesh(self.subject) if isinstance(mesh, Ground) else mesh for mesh in self.meshes])

    def cloud_at(self, time: float) -> GaussianCloud:
        """Return the Gaussians of all assets at a time [s], in the world; the same object as long as none moves.

        Raises:
            BeamError: A frame cannot be read.
        """
        parts = tuple(asset.cloud_at(time) for asset in self.assets)
        held: tuple[tuple[GaussianCloud, ...], GaussianCloud] | None = self.__dict__.get("_held")
        if held is not None and all(one is other for one, other in zip(held[0], parts, strict=True)):
            return held[1]
        cloud = joined(parts)
        self.__dict__["_held"] = (parts, cloud)
        return cloud

    def shot(self, time: float, width: int, height: int) -> Shot:
        """Return what is rendered at a time.

        Args:
            time: Time from the start [s]; also before it or after the end.
            width: Width of the image [pixel].
            height: Height of the image [pixel].

        Raises:
            InvalidOptionError: The time is not finite, a size is out of range, or there is nothing to frame.
            BeamError: A frame cannot be read.
        """
        require_number("time", time, -1e9, 1e9)
        assert self.camera is not None
        light = self.environment
        return Shot(
            cloud=self.cloud_at(time),
            camera=self.camera.camera_at(time, width, height),
            environment=None if light is None else light.map,
            environment_rotation=0.0 if light is None else light.rotation_at(time),
            lights=self.lights,
            mesh=self.mesh,
        )

    def digest(self, time: float | None = None) -> str:
        """Return a digest of all that decides what is seen, at one time [s] or at any.

        It is the same for the same content wherever files lie, and another one if a file, a number or a part changes.
        Of a folder of numbered files, only those of a time's frames count for that time.

        Raises:
            MissingFileError: A file is not there any more.
        """
        content = [self._fixed_description, time, [self._frames_digest(asset, time) for asset in self.assets]]
        return hashlib.blake2b(json.dumps(content, sort_keys=True).encode(), digest_size=16).hexdigest()

    def _natural_duration(self, moving: Sequence[StageAsset]) -> float:
        """Return how long it takes until everything has been seen."""
        if moving:
            return max(asset.end for asset in moving)
        if self.camera is not None and self.camera.duration is not None:
            return self.camera.duration
        if isinstance(self.camera, OrbitPath) and self.camera.turns:
            return TURNTABLE_SECONDS
        if self.environment is not None and self.environment.degrees_per_second:
            return abs(360.0 / self.environment.degrees_per_second)
        assert self.fps is not None
        return 1.0 / self.fps

    @property
    def _drawn_as(self) -> StageAsset | None:
        """First asset that states how it is drawn: all are drawn so."""
        return next((asset for asset in self.assets if _raster(asset)), None)

    @cached_property
    def _fixed_description(self) -> Any:
        """All but the frames, as plain data."""
        mesh = self.mesh
        light = self.environment
        surfaces = [] if mesh is None else [getattr(mesh.surface, name) for name in _SURFACE]
        return {
            "assets": [
                {
                    **{name: getattr(asset, name) for name in _PLACES},
                    "fps": asset.sequence.frames_per_second,
                    "frames": len(asset.sequence),
                    "topology": asset.sequence.topology,
                    "raster": _raster(asset),
                    "read": [asset.sequence.metadata.get(key) for key in ("source_axes", "source_units", "notes")],
                    "placement": described(asset.placement, self._file_digest),
                }
                for asset in self.assets
            ],
            "mesh": None if mesh is None else array_digest(*surfaces, mesh.catches_shadows),
            "lights": lights_to_json(self.lights),
            "environment": None
            if light is None
            else [array_digest(light.map.radiance), light.rotate, light.degrees_per_second],
            "camera": [type(self.camera).__name__, described(self.camera, self._file_digest)],
        }

    def _frames_digest(self, asset: StageAsset, time: float | None) -> list[str]:
        """Return the digests of what an asset's frames at a time, or all of them, are made of."""
        moment = None if time is None else asset.moment(time)
        frames = range(len(asset.sequence)) if moment is None else sorted({moment.frame, moment.following})
        if not asset.files:
            return [
                array_digest(*(array for _, array in sorted(cloud.arrays().items())))
                for cloud in (asset.sequence[frame] for frame in frames)
            ]
        files = dict.fromkeys(file for frame in frames for file in asset.files_of(frame))
        return [self._file_digest(file) for file in files]

    def _file_digest(self, path: Path) -> str:
        """Return the digest of a file's content."""
        stamp, digest = content_digest(path, self._known_files)
        if stamp is not None:
            self._known_files[str(path)] = [*stamp, digest]
        return digest


_SURFACE = ("vertices", "faces", "normals", "base_color", "roughness")

_PLACES = ("start", "speed", "loop", "blend")


def _raster(asset: StageAsset) -> dict[str, str]:
    """Return the metadata of an asset that state how it is drawn."""
    metadata = asset.sequence.metadata
    return {key: metadata[key] for key in (RASTER_ANTIALIASED, RASTER_LOW_PASS) if key in metadata}
