"""Stages as JSON; ``docs/stages.md`` lists every field."""

from __future__ import annotations

from dataclasses import fields as fields_of
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from beam_warp import converters
from beam_warp.checks import require_number
from beam_warp.converters.numbering import numbered_files
from beam_warp.errors import AssetFormatError, SchemaVersionError
from beam_warp.schema.placement import Placement
from beam_warp.stage.assets import StageAsset, require_rotation, require_vector
from beam_warp.stage.camera_paths import (
    DEFAULT_FOV,
    USD_SUFFIXES,
    CameraPath,
    FixedCamera,
    OrbitPath,
    keyframe_path,
    read_camera_path,
)
from beam_warp.stage.environments import StageEnvironment
from beam_warp.stage.fields import Fields, placed, read_json, shown
from beam_warp.stage.meshes import Ground, read_stage_mesh
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.lights import Light, lights_from_json, read_lights
from beam_warp.world.shot import ShotMesh

KEY = "beam-stage"
"""The field that makes an object a stage; its value is the version of the format."""

VERSION = 1

RATES = (1e-3, 1e6)
"""Images a second that a stage may have."""

DURATIONS = (1e-6, 1e9)
"""Seconds that a stage may last."""

FIELDS = ("fps", "duration", "assets", "meshes", "lights", "environment", "camera")

_PLACE = ("translate", "rotate", "scale")

ASSET_FIELDS = (
    *("path", "name", "source_axes", "drop_invalid", *_PLACE),
    *("on_ground", "centered", "start", "speed", "loop", "blend"),
)

MESH_FIELDS = ("path", *_PLACE, "base_color", "roughness", "catches_shadows", "smooth")

GROUND_FIELDS = ("ground", *(field.name for field in fields_of(Ground)))

ENVIRONMENT_FIELDS = ("path", "radiance", "rotate", "degrees_per_second", "exposure")

FIXED_FIELDS = ("type", "position", "target", "camera_to_world", "fov")

ORBIT_FIELDS = ("type", *(field.name for field in fields_of(OrbitPath) if field.name != "subject"))

FILE_FIELDS = ("type", "path", "prim")


def read_stage_file(path: Path) -> dict[str, Any]:
    """Read a file; see `stage_contents`, and `fields.read_json` for further errors."""
    return stage_contents(read_json(path, "stage"), path.parent, path.name)


def stage_contents(document: Any, folder: Path, name: str = "stage") -> dict[str, Any]:
    """Return what a JSON object puts on a stage, by the names of `beam_warp.stage.stage.Stage`.

    Args:
        document: The object.
        folder: Folder where relative paths start.
        name: Name of the stage in messages.

    Raises:
        AssetFormatError: A field is malformed or unknown; says which one and what to do.
        SchemaVersionError: The version is none that is read.
        MissingFileError: A file is not there.
    """
    where = f"{name}:"
    if isinstance(document, dict):
        version = document.get(KEY)
        if isinstance(version, int) and not isinstance(version, bool) and version > VERSION:
            raise SchemaVersionError(f"{where} {KEY} must be {VERSION}, got {version}. Upgrade beam-warp.")
    fields = Fields(document, where, (KEY, *FIELDS))
    if document.get(KEY) != VERSION or isinstance(document.get(KEY), bool):
        raise fields.error(KEY, str(VERSION), "State the version of the format there.")
    contents: dict[str, Any] = {}
    with fields.placed():
        for name, (low, high) in (("fps", RATES), ("duration", DURATIONS)):
            contents[name] = require_number(name, fields.number(name), low, high) if name in fields else None
    contents |= {
        "lights": _lights(fields, folder),
        "camera": _camera(fields.value("camera"), f"{where} camera", folder),
        "environment": _environment(fields.value("environment"), f"{where} environment", folder),
    }
    meshes = [_mesh(entry, f"{where} meshes[{i}]", folder) for i, entry in enumerate(fields.items("meshes"))]
    contents["meshes"] = tuple(mesh for mesh, _ in meshes)
    contents["given_notes"] = tuple(note for _, notes in meshes for note in notes)
    listed = enumerate(fields.items("assets"))  # last, since they are what takes time
    return contents | {"assets": tuple(_asset(entry, f"{where} assets[{i}]", folder) for i, entry in listed)}


def read_stage_asset(
    path: Path, *, source_axes: str | None = None, drop_invalid: bool = False, name: str | None = None, **place: Any
) -> StageAsset:
    """Read an asset and put it on a stage.

    Args:
        path: A PLY or USD file, or a folder of numbered PLY files.
        source_axes: Axes of a PLY that does not state them.
        drop_invalid: Leave out rows that are no Gaussians.
        name: Name of the asset in messages; the file's name if None.
        place: Further attributes of a `StageAsset`.

    Raises:
        BeamError: It cannot be read, or is not relightable.
    """
    sequence = converters.read(path, source_axes=source_axes, drop_invalid=drop_invalid)
    return StageAsset(sequence=sequence, name=name or path.name, files=source_files(path), **place)


def source_files(path: Path) -> tuple[tuple[Path, ...], ...]:
    """Return the files that decide each frame of an asset: numbered ones, or once the layers of a USD stage."""
    if path.is_dir():
        return tuple((file,) for file in numbered_files(path))
    if path.suffix.lower() in USD_SUFFIXES:
        from beam_warp.schema.stage_queries import layer_files  # brings OpenUSD along

        return (tuple(layer_files(path)),)
    return ((path,),)


def _asset(record: Any, where: str, folder: Path) -> StageAsset:
    """Return one asset of JSON; a text alone is its path."""
    fields = Fields({"path": record} if isinstance(record, str) else record, where, ASSET_FIELDS)
    path = fields.path("path", folder, folders=True)
    options: dict[str, Any] = _placing(fields)
    for name in ("start", "speed"):
        if name in fields:
            options[name] = fields.number(name)
    for name in ("on_ground", "centered", "loop", "drop_invalid"):
        if name in fields:
            options[name] = fields.flag(name)
    for name in ("name", "blend", "source_axes"):
        if name in fields:
            options[name] = fields.text(name)
    with fields.placed():
        return read_stage_asset(path, **options)


def _placing(fields: Fields) -> dict[str, Any]:
    """Return where something stands, as far as it is said."""
    given: dict[str, Any] = {}
    if "translate" in fields:
        given["translate"] = fields.numbers("translate", 3)
    if "rotate" in fields:
        angles = fields.value("rotate")
        given["rotate"] = fields.numbers("rotate", 3) if isinstance(angles, list) else fields.number("rotate")
    if "scale" in fields:
        given["scale"] = fields.number("scale")
    return given


def _mesh(record: Any, where: str, folder: Path) -> tuple[ShotMesh | Ground, tuple[str, ...]]:
    """Return one mesh of JSON, or the ground; a text alone is its path."""
    if isinstance(record, dict) and "ground" in record:
        return _ground(record, where), ()
    fields = Fields({"path": record} if isinstance(record, str) else record, where, MESH_FIELDS)
    path = fields.path("path", folder)
    options: dict[str, Any] = {}
    if "base_color" in fields:
        options["base_color"] = fields.numbers("base_color", 3)
    if "roughness" in fields:
        options["roughness"] = fields.number("roughness")
    for name in ("catches_shadows", "smooth"):
        if name in fields:
            options[name] = fields.flag(name)
    place = _placing(fields)
    with fields.placed():
        angles = require_rotation("rotate", place.get("rotate", 0.0))
        turn = Rotation.from_euler("xyz", (0.0, 0.0, angles) if isinstance(angles, float) else angles, degrees=True)
        shift = np.array(require_vector("translate", place.get("translate", (0.0, 0.0, 0.0))))
        scale = require_number("scale", place.get("scale", 1.0), 1e-6, 1e6)
        return read_stage_mesh(path, placement=Placement(scale, turn.as_matrix(), shift), **options)


def _ground(record: dict[str, Any], where: str) -> Ground:
    """Return the ground of JSON."""
    fields = Fields(record, where, GROUND_FIELDS)
    if fields.flag("ground") is not True:
        raise fields.error("ground", "true", "Leave the whole object out for no ground.")
    given: dict[str, Any] = {}
    for name, count in (("base_color", 3), ("center", 2)):
        if name in fields and fields.value(name) != "auto":
            given[name] = fields.numbers(name, count)
    for name in ("size", "roughness", "height"):
        if name in fields and not (name == "height" and fields.value(name) == "auto"):
            given[name] = fields.number(name)
    if "catches_shadows" in fields:
        given["catches_shadows"] = fields.flag("catches_shadows")
    with fields.placed():
        return Ground(**given)


def _lights(fields: Fields, folder: Path) -> tuple[Light, ...]:
    """Return lights that are listed, or those of a file."""
    if "lights" not in fields:
        return ()
    if isinstance(fields.value("lights"), str):
        with placed(fields.place("lights"), ()):
            return read_lights(fields.path("lights", folder))
    return lights_from_json(fields.value("lights"), fields.place("lights"))


def _environment(record: Any, where: str, folder: Path) -> StageEnvironment | None:
    """Return distant light of JSON; a text alone is its path."""
    if record is None:
        return None
    fields = Fields({"path": record} if isinstance(record, str) else record, where, ENVIRONMENT_FIELDS)
    if ("path" in fields) == ("radiance" in fields):
        raise AssetFormatError(
            f"{where} must have a path or a radiance, got {'both' if 'path' in fields else 'neither'}. Give one."
        )
    rates = {name: fields.number(name) for name in ("rotate", "degrees_per_second") if name in fields}
    with fields.placed():
        if "path" in fields:
            light = EnvironmentMap.read(fields.path("path", folder))
        else:
            light = EnvironmentMap.constant(fields.numbers("radiance", 3))
        if "exposure" in fields:
            light = light.exposed(require_number("exposure", fields.number("exposure"), -64.0, 64.0))
        return StageEnvironment(map=light, **rates)


def _camera(record: Any, where: str, folder: Path) -> CameraPath | None:
    """Return a camera of JSON; a text alone is the path of a file."""
    if record is None:
        return None
    if isinstance(record, str):
        record = {"type": "file", "path": record}
    kinds = ("fixed", "orbit", "keyframes", "file")
    kind = record.get("type") if isinstance(record, dict) else None
    if isinstance(record, dict) and kind not in kinds:
        raise AssetFormatError(f"{where}.type must be one of {', '.join(kinds)}, got {shown(kind)}. Choose one.")
    if kind == "keyframes":
        return keyframe_path(record, where)
    if kind == "file":
        fields = Fields(record, where, FILE_FIELDS)
        prim = fields.text("prim") if "prim" in fields else None
        path = fields.path("path", folder)
        with fields.placed():
            return read_camera_path(path, prim_path=prim)
    if kind == "orbit":
        fields = Fields(record, where, ORBIT_FIELDS)
        given: dict[str, Any] = {"center": fields.numbers("center", 3)} if "center" in fields else {}
        given |= {
            name: fields.number(name) for name in ORBIT_FIELDS if name not in ("type", "center") and name in fields
        }
        with fields.placed():
            return OrbitPath(**given)
    fields = Fields(record, where, FIXED_FIELDS)
    keyframe = {name: fields.value(name) for name in ("position", "target", "camera_to_world") if name in fields}
    fov = fields.number("fov") if "fov" in fields else DEFAULT_FOV
    with fields.placed():
        if "camera_to_world" in keyframe:
            for name in ("position", "target"):
                if name in keyframe:
                    raise fields.error(name, "left out beside camera_to_world", "Leave one of them out.")
            pose = keyframe["camera_to_world"]
            aimed = Camera.look_at((0, 0, 0), (0, 1, 0), width=2, height=2, vertical_fov=fov)
            return FixedCamera(Camera(2, 2, aimed.focal_x, aimed.focal_y, 1.0, 1.0, pose))
        position, target = fields.numbers("position", 3), fields.numbers("target", 3)
        return FixedCamera(Camera.look_at(position, target, width=2, height=2, vertical_fov=fov))
