"""Reader of Gaussian-splat assets, ours or others', as lazy sequences in metres."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Tf, Usd, UsdGeom, Vt

from beam_warp.checks import UNIT_TOLERANCE
from beam_warp.errors import AssetFormatError, InvalidArrayError, SchemaVersionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.schema import MATERIAL_API, SCHEMA_VERSION
from beam_warp.schema.files import said_by_usd
from beam_warp.schema.layout import CHANNELS, SH_DEGREE, Channel, from_vt
from beam_warp.schema.placement import placement_of
from beam_warp.schema.stage_queries import (
    ancestors,
    applied_schemas,
    array_attribute,
    authored,
    frame_times,
    has_material_api,
    most_frames,
    open_asset,
    radiance_color_space,
    sequence_prim,
    splat_prims,
    stage_axes,
    stage_meters,
)
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence, Topology
from beam_warp.world.metadata import UNSTATED_RASTER, capture_frames_metadata, raster_metadata

RATE_RANGE = (1e-3, 1e6)
"""Range of playback rates [1/s]."""

_MOVED = frozenset({"positions", "orientations", "scales", "normals", "radiance"})
"""Arrays that a moving transform changes."""

_ABSENT = {"orientations": (0.0, 0.0, 0.0, 1.0), "scales": (1.0, 1.0, 1.0), "opacities": 1.0}
"""Values of arrays that are not authored, by OpenUSD's schema."""

_TOKENS = {
    "radiance_meaning": "beam:radianceMeaning",
    "normal_source": "beam:normalSource",
    "roughness_source": "beam:roughnessSource",
}

_SEQUENCE_TOKENS = {
    "source_axes": "beam:sequence:sourceAxes",
    "source_units": "beam:sequence:sourceUnits",
    "generator": "beam:sequence:generator",
}


def read_asset(path: str | Path, *, prim_path: str | None = None, trusted: bool = False) -> GaussianSequence:
    """Open an asset; frames are read when they are asked for, from any thread.

    Any ``ParticleField3DGaussianSplat`` is read, wherever it is on the stage; without our schema it is not
    relightable. The transforms above the prim are applied (spherical harmonics included), units become metres, and
    the up axis becomes the axes code: y up is ``rub``, z up is ``rfu``. Frames are the time samples of the prim; of an
    asset with keys, every time code of its range, interpolated by OpenUSD.

    Args:
        path: A ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` file.
        prim_path: Path of the prim to read, if there are several.
        trusted: True skips the child process that opens the file first (about 0.4 s); a corrupt file may then end
            this process.

    Returns:
        The sequence. ``metadata`` has what the asset states about itself, and assumptions in ``metadata["notes"]``, one
        line each.

    Raises:
        MissingFileError: There is no such file.
        AssetFormatError: The file is broken, holds no or several Gaussian-splat prims, arrays of wrong length, or a
            transform that is no similarity. Faults inside a frame appear when that frame is read.
        SchemaVersionError: The asset has a major version that this package does not read.
    """
    source, stage = open_asset(path, trusted=trusted)
    prim = _find(stage, source, prim_path)
    notes: list[str] = []
    metadata = _metadata(prim, source, notes)
    frames, rate, topology = _timing(stage, prim, source, notes)
    meters_per_unit = stage_meters(stage, source)
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        notes.append(f"one unit is taken as {meters_per_unit:g} m, USD's default; the asset states none")
    space, word = radiance_color_space(prim)
    if array_attribute(prim, CHANNELS["radiance"]) is not None and space is None:
        stated = repr(word) if word else "nothing"
        notes.append(f"the colour space of the radiance is taken as {DISPLAY_SRGB}; the asset says {stated}")
    reader = _FrameReader(
        stage=stage,
        prim=prim,
        source=source,
        times=frames,
        meters_per_unit=meters_per_unit,
        axes=stage_axes(stage, source),
        color_space=space or DISPLAY_SRGB,
        captured=metadata.get("radiance_meaning") != "baseColorOnly",
    )
    return GaussianSequence(
        frame_count=len(frames),
        read_frame=reader.read,
        frames_per_second=rate,
        constant=reader.constant() if len(frames) > 1 else frozenset(reader.read(0).arrays()),
        topology=topology,
        metadata={**metadata, **({"notes": "\n".join(notes)} if notes else {})},
    )


@dataclass(frozen=True)
class _FrameReader:
    """Reads one prim at the time of a frame."""

    stage: Usd.Stage = field(repr=False)  # a prim does not keep its stage alive
    prim: Usd.Prim = field(repr=False)
    source: Path
    times: list[float]
    meters_per_unit: float
    axes: str
    color_space: str
    captured: bool
    kept: dict[str, NDArray[Any]] = field(default_factory=dict, repr=False)  # converted arrays that do not vary

    def read(self, frame: int) -> GaussianCloud:
        """Read one frame; an error names file, prim and time."""
        time = self.times[frame]
        where = f"{self.source}: {self.prim.GetPath()} at time {time:g}"
        try:
            arrays = self._arrays(time, where)
            cache = UsdGeom.XformCache(time)  # per call: a cache is not safe to share between threads
            matrix = np.array(cache.GetLocalToWorldTransform(self.prim))
            place = placement_of(matrix, self.meters_per_unit, where)
            return GaussianCloud(
                **(arrays if place.is_identity else place.apply(arrays)),
                axes=self.axes,
                radiance_color_space=self.color_space if "radiance" in arrays else None,
            )
        except InvalidArrayError as error:
            raise AssetFormatError(f"{where}: {error}") from error
        except Tf.ErrorException as error:
            said = said_by_usd(error)
            raise AssetFormatError(f"{where} must be readable, got {said}. Export the file again.") from error

    def constant(self) -> frozenset[str]:
        """Return the names of the arrays that do not vary."""
        names = set()
        for name, channel in CHANNELS.items():
            attribute = array_attribute(self.prim, channel)
            if attribute is not None and name != "metallic" and not attribute.ValueMightBeTimeVarying():
                names.add(name)
        if not self.captured:
            names.discard("radiance")
        xforms = (UsdGeom.Xformable(prim) for prim in ancestors(self.prim) if prim.IsA(UsdGeom.Xformable))
        return frozenset(names - _MOVED if any(xform.TransformMightBeTimeVarying() for xform in xforms) else names)

    def _arrays(self, time: float, where: str) -> dict[str, NDArray[Any]]:
        positions = self._array(CHANNELS["positions"], time, where)
        if positions is None:
            raise AssetFormatError(f"{where} must have positions, got none. Export it again.")
        count = len(positions)
        arrays: dict[str, NDArray[Any]] = {"positions": positions}
        for name, channel in CHANNELS.items():
            if name in ("positions", "metallic") or (name == "radiance" and not self.captured):
                continue
            array = self._array(channel, time, where)
            if array is None:
                if name in _ABSENT:
                    arrays[name] = np.broadcast_to(np.float32(_ABSENT[name]), (count, *np.shape(_ABSENT[name]))).copy()
                continue
            terms = self._sh_terms(where) if name == "radiance" else 1
            if len(array) < count * terms:
                raise AssetFormatError(
                    f"{where}: {channel.usd_name} must have {count * terms} elements, got {len(array)}. "
                    "USD would ignore the array; export it again."
                )
            array = array[: count * terms]  # USD's rule for arrays that are too long
            arrays[name] = array.reshape(count, terms, 3) if name == "radiance" else array
        for name in ("orientations", "normals"):
            if name in arrays:
                arrays[name] = _unit(name, arrays[name], where)
        return arrays

    def _array(self, channel: Channel, time: float, where: str) -> NDArray[Any] | None:
        attribute = array_attribute(self.prim, channel)
        if attribute is None or channel.name in self.kept:
            return self.kept.get(channel.name)
        value = attribute.Get(time)
        try:
            if value is None:
                raise ValueError("no value")
            array = from_vt(channel, value)
            with np.errstate(over="ignore"):  # the cloud refuses infinity, in words
                array = array.astype(np.float32) if array.dtype.kind == "f" else array
        except (TypeError, ValueError) as error:
            raise AssetFormatError(
                f"{where}: {attribute.GetName()} must be {channel.type_name}, got {type(value).__name__} "
                f"({error}). Export it again."
            ) from error
        if not attribute.ValueMightBeTimeVarying():
            array.flags.writeable = False  # shared between frames
            self.kept[channel.name] = array
        return array

    def _sh_terms(self, where: str) -> int:
        degree = self.prim.GetAttribute(SH_DEGREE).Get()
        if not isinstance(degree, int) or not 0 <= degree <= 4:
            raise AssetFormatError(f"{where}: {SH_DEGREE} must be 0 to 4, got {degree!r}. Drop the higher bands.")
        return (degree + 1) ** 2


def _find(stage: Usd.Stage, source: Path, prim_path: str | None) -> Usd.Prim:
    """Return the only splat prim, or the one at ``prim_path``."""
    prims = splat_prims(stage)
    paths = [str(prim.GetPath()) for prim in prims]
    if prim_path is not None and prim_path in paths:
        return prims[paths.index(prim_path)]
    if prim_path is None and len(prims) == 1:
        return prims[0]
    if not prims:
        raise AssetFormatError(
            f"{source} must hold a ParticleField3DGaussianSplat, got none. Convert the splats with beam-convert."
        )
    wanted = "one Gaussian-splat prim" if prim_path is None else f"a Gaussian-splat prim {prim_path}"
    raise AssetFormatError(f"{source} must hold {wanted}, got {', '.join(paths)}. Pass one of them as prim_path.")


def _metadata(prim: Usd.Prim, source: Path, notes: list[str]) -> dict[str, str]:
    """Return what the asset states about itself, after checking that its version can be read."""
    said: dict[str, str] = {}
    newer = [name for name in applied_schemas(prim) if name.startswith(f"{MATERIAL_API}_")]
    if newer:
        raise SchemaVersionError(
            f"{source} must have schema major version {SCHEMA_VERSION.partition('.')[0]}, got the schema {newer[0]} "
            f"at {prim.GetPath()}. Upgrade beam-warp."
        )
    playing = sequence_prim(prim)
    if playing is not None:
        stored = playing.GetCustomDataByKey("beam")
        said.update({str(key): str(value) for key, value in (stored if isinstance(stored, Mapping) else {}).items()})
        for key, name in _SEQUENCE_TOKENS.items():
            word = authored(playing, name)
            if word:
                said[key] = str(word)
        frames = authored(playing, "beam:sequence:captureFrames", Vt.IntArray)
        if frames is not None:
            said.update(capture_frames_metadata(frames))
    if not has_material_api(prim):
        return said
    version = str(authored(prim, "beam:schemaVersion") or "")
    major, _, minor = version.partition(".")
    if major != SCHEMA_VERSION.partition(".")[0] or not re.fullmatch("[0-9]{1,6}", minor):
        raise SchemaVersionError(
            f"{source} must have schema version {SCHEMA_VERSION}, got {version[:40] or 'none'!r} at {prim.GetPath()}. "
            "Upgrade beam-warp, or export the asset again."
        )
    said["schema_version"] = version
    if int(minor) > int(SCHEMA_VERSION.partition(".")[2]):
        notes.append(f"schema version {version} is newer than {SCHEMA_VERSION}: what it added is not read")
        warnings.warn(f"{source}: {notes[-1]}. Upgrade beam-warp to read all of it.", UserWarning, stacklevel=3)
    for key, name in _TOKENS.items():
        word = authored(prim, name)
        if word is not None:
            said[key] = str(word)
    raster = [authored(prim, "beam:rasterAntialiased", bool), authored(prim, "beam:rasterLowPass", float)]
    if raster != [None, None]:
        antialiased, low_pass = (UNSTATED_RASTER[i] if value is None else value for i, value in enumerate(raster))
        said.update(raster_metadata(bool(antialiased), low_pass))
    if array_attribute(prim, CHANNELS["metallic"]) is not None:
        notes.append("the asset has a metallic channel, which is not read")
    return said


def _timing(stage: Usd.Stage, prim: Usd.Prim, source: Path, notes: list[str]) -> tuple[list[float], float, Topology]:
    """Return the time of each frame, the playback rate, and the topology."""
    times = frame_times(prim)
    rate = stage.GetTimeCodesPerSecond()
    playing = sequence_prim(prim)
    topology = str(authored(playing, "beam:sequence:topology") or "perFrame") if playing is not None else "perFrame"
    count = authored(playing, "beam:sequence:frameCount", int) if playing is not None else None
    if count is not None and len(times) != count:
        most = most_frames(len(times))
        if not 1 <= count <= most:
            raise AssetFormatError(
                f"{source}: beam:sequence:frameCount must be in [1, {most}] for {len(times)} time samples, "
                f"got {count}. Mend it."
            )
        start = stage.GetStartTimeCode() if stage.HasAuthoredTimeCodeRange() else 0.0
        times = [start + frame for frame in range(count)]
    elif len(times) > 1:
        steps = np.diff(times)
        rate /= float(np.median(steps))
        if not np.allclose(steps, steps[0], rtol=1e-6):
            notes.append("time samples are unevenly spaced; the rate is that of the median step")
    times = times or [stage.GetStartTimeCode()]
    if not (np.isfinite(times).all() and RATE_RANGE[0] <= rate <= RATE_RANGE[1]):
        raise AssetFormatError(
            f"{source} must have finite time codes and {RATE_RANGE[0]:g} to {RATE_RANGE[1]:g} frames per second, got "
            f"{rate:g} from time {times[0]:g}. Set startTimeCode and timeCodesPerSecond."
        )
    return times, rate, "constant" if topology == "constant" or len(times) == 1 else "perFrame"


def _unit(name: str, vectors: NDArray[np.float32], where: str) -> NDArray[np.float32]:
    """Normalise rows that differ noticeably from unit length, as renderers do; rows of length 0 are refused."""
    length = np.linalg.norm(vectors.astype(np.float64), axis=1, keepdims=True)
    if not (length > 1e-12).all():
        row = int(np.flatnonzero(~(length[:, 0] > 1e-12))[0])
        raise AssetFormatError(f"{where}: {name} must have unit length, got {length[row, 0]:g} at row {row}. Mend it.")
    off = np.abs(length - 1.0) > 0.5 * UNIT_TOLERANCE
    return np.where(off, vectors / length, vectors).astype(np.float32) if off.any() else vectors
