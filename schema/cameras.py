"""Cameras of USD stages, over time, in the internal world.

USD cameras look along -z with y up. Aperture and focal length are in tenths of the stage's unit; only their ratio
matters. If the image's shape differs from that of the aperture, the image shows all of the aperture and more above and
below it, or at its sides (USD's aspect-ratio policy ``expandAperture``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from beam_warp.checks import require_number
from beam_warp.errors import AssetFormatError, BeamError, InvalidOptionError
from beam_warp.schema.placement import placement_of
from beam_warp.schema.stage_queries import layer_files, open_asset, stage_axes, stage_meters, transform_times
from beam_warp.world.axes import axes_matrix
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import WORLD_AXES

MAX_SAMPLES = 1_000_000
"""Most time samples of a camera; each of them is checked."""

_LENS = ("focalLength", "horizontalAperture", "verticalAperture")
_OFFSETS = ("horizontalApertureOffset", "verticalApertureOffset")

_TO_OPENCV = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class UsdCamera:
    """A camera of a USD stage; time 0 is the stage's start, or the camera's first sample if the stage states none.

    Attributes:
        files: Files of the stage's layers, its own first.
        prim_path: Path of the camera's prim.
        notes: Assumptions, a sentence each.
    """

    files: tuple[Path, ...]
    prim_path: str
    notes: tuple[str, ...] = field(init=False, default=())

    def __post_init__(self) -> None:
        """Open the stage and check the camera at each of its samples.

        Raises:
            AssetFormatError: The camera is not perspective, its lens is out of range, or its pose is not rigid; the
                message names the time.
        """
        stage = Usd.Stage.Open(str(self.files[0]), Usd.Stage.LoadAll)
        prim = stage.GetPrimAtPath(self.prim_path)
        times = _sample_times(prim)
        start = stage.GetStartTimeCode() if stage.HasAuthoredTimeCodeRange() else (times[0] if times else 0.0)
        rate = stage.GetTimeCodesPerSecond()
        if not rate > 0.0:
            raise AssetFormatError(f"{self.files[0]} must have a positive timeCodesPerSecond, got {rate:g}. Set it.")
        if len(times) > MAX_SAMPLES:
            raise AssetFormatError(
                f"{self._where} must have at most {MAX_SAMPLES} samples, got {len(times)}. Export fewer."
            )
        held = {"_stage": stage, "_prim": prim, "_start": start, "_rate": rate, "_last": times[-1] if times else start}
        held["_meters"] = stage_meters(stage, self.files[0])
        held["_axes"] = axes_matrix(stage_axes(stage, self.files[0]), WORLD_AXES)
        self.__dict__.update(held)
        if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
            note = f"{self.files[0].name}: one unit is taken as {self._meters:g} m, USD's default; it states none"
            object.__setattr__(self, "notes", (note,))
        projection = UsdGeom.Camera(prim).GetProjectionAttr().Get()
        if projection != UsdGeom.Tokens.perspective:
            raise AssetFormatError(f"{self._where} must be a perspective camera, got {projection!r}. Change it.")
        for time in times or [start]:
            self._lens(time)
            self._placement(time)

    @property
    def duration(self) -> float | None:
        """Time of the last sample [s]; None if it is not after time 0."""
        last = (self._last - self._start) / self._rate
        return last if last > 0.0 else None

    @property
    def aspect(self) -> float:
        """Width over height of its aperture at time 0."""
        lens = self._lens(self._start)
        return lens["horizontalAperture"] / lens["verticalAperture"]

    def camera_at(self, time: float, width: int, height: int) -> Camera:
        """Return the camera at a time [s], for images of a size [pixel].

        Between samples, USD interpolates; an interpolated matrix is replaced by the nearest rotation.

        Raises:
            InvalidOptionError: The time is not finite, or a size is out of range.
        """
        code = self._start + require_number("time", time, -1e9, 1e9) * self._rate
        lens = self._lens(code)
        focal_length, across, along = (lens[name] for name in _LENS)
        pixels = min(width / across, height / along)  # of one unit of the aperture
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self._between(code)
        return Camera(
            width,
            height,
            focal_length * pixels,
            focal_length * pixels,
            0.5 * width - lens["horizontalApertureOffset"] * pixels,
            0.5 * height + lens["verticalApertureOffset"] * pixels,
            pose,
        )

    @property
    def _where(self) -> str:
        return f"{self.files[0]}: {self.prim_path}"

    def _matrix(self, code: float) -> NDArray[np.float64]:
        """Return the local-to-world matrix of USD at a time; a cache is not safe to share between threads."""
        return np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(self._prim))

    def _placement(self, code: float) -> None:
        """Refuse a pose that is not rigid, apart from a uniform scale."""
        where = f"{self._where} at time {code:g}"
        matrix = self._matrix(code)
        if not np.isfinite(matrix).all():
            raise AssetFormatError(f"{where} must have a finite transform, got NaN or infinity. Export it again.")
        if not np.linalg.det(placement_of(matrix, 1.0, where).orthogonal) > 0.0:
            raise AssetFormatError(f"{where} must not be mirrored, got a negative scale. Take it out.")

    def _between(self, code: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the rotation, with columns right, down and forward, and the position in the world [m]."""
        matrix = self._matrix(code)
        left, _, right = np.linalg.svd(matrix[:3, :3].T)
        return self._axes @ left @ right @ _TO_OPENCV, self._axes @ matrix[3, :3] * self._meters

    def _lens(self, code: float) -> dict[str, float]:
        """Return focal length, apertures and their offsets, in one unit."""
        found: dict[str, float] = {}
        try:
            for name in _LENS:
                found[name] = require_number(name, self._prim.GetAttribute(name).Get(code), 1e-6, 1e9)
            for name in _OFFSETS:
                found[name] = require_number(name, self._prim.GetAttribute(name).Get(code), -1e9, 1e9)
            angle = 2.0 * np.degrees(np.arctan2(0.5 * found["verticalAperture"], found["focalLength"]))
            require_number("fov", float(angle), 0.01, 179.0)
        except BeamError as error:
            raise AssetFormatError(f"{self._where} at time {code:g}: {error}") from error
        return found


def read_usd_camera(path: Path, *, prim_path: str | None = None, trusted: bool = False) -> UsdCamera:
    """Read a camera from a USD stage.

    Args:
        path: A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file; its up axis and unit are honoured.
        prim_path: Path of the camera, if there are several.
        trusted: True skips the child process that opens the file first; a corrupt file may then end this process.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: The file is broken, has no camera or several, or the camera is not a pinhole.
    """
    source, stage = open_asset(path, trusted=trusted)
    every: Any = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    paths = [str(prim.GetPath()) for prim in every if prim.IsA(UsdGeom.Camera)]
    if not paths:
        raise AssetFormatError(f"{source} must hold a camera, got none. Export one with the stage.")
    if prim_path is None and len(paths) > 1:
        raise AssetFormatError(f"{source} must hold one camera, got {', '.join(paths)}. Name one of them as prim.")
    if prim_path is not None and prim_path not in paths:
        raise InvalidOptionError(
            f"prim must be a camera of {source}, got {prim_path!r} (it has {', '.join(paths)}). Name one of them."
        )
    return UsdCamera(tuple(layer_files(source)), prim_path or paths[0])


def _sample_times(prim: Usd.Prim) -> list[float]:
    """Return the times at which the lens or a transform above it has a sample, ascending."""
    times: set[float] = set()
    for name in (*_LENS, *_OFFSETS):
        times.update(prim.GetAttribute(name).GetTimeSamples())
    return sorted(times | transform_times(prim))
