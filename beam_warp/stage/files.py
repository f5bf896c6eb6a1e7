"""Stages as JSON; ``docs/stages.md`` lists every field."""

from __future__ import annotations

from dataclasses import fields as fields_of
from pathlib import Path
from typing import Any

from beam_warp import converters
from beam_warp.checks import require_number
from beam_warp.converters.formats import format_of
from beam_warp.converters.numbering import files_at
from beam_warp.errors import AssetFormatError, SchemaVersionError
from beam_warp.stage.assets import StageAsset, placement_of
from beam_warp.stage.camera_paths import (
    POSE_FIELDS,
    USD_SUFFIXES,
    CameraPath,
    FixedCamera,
    KeyframePath,
    OrbitPath,
    keyframe_of,
    keyframe_path,
    read_camera_path,
)
from beam_warp.stage.environments import StageEnvironment
from beam_warp.stage.fields import Fields, placed, read_json, shown
from beam_warp.stage.meshes import Ground, read_stage_mesh
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
    *("path", "name", "source_axes", "meters_per_unit", "drop_invalid", *_PLACE),
    *("on_ground", "centered", "start", "speed", "loop", "blend"),
)

MESH_FIELDS = ("path", *_PLACE, "base_color", "roughness", "catches_shadows", "smooth")

GROUND_FIELDS = ("ground", *(field.name for field in fields_of(Ground)))

ENVIRONMENT_FIELDS = ("path", "radiance", "rotate", "degrees_per_second", "exposure")

FIXED_FIELDS = ("type", *POSE_FIELDS)

ORBIT_FIELDS = ("type", *(field.name for field in fields_of(OrbitPath) if field.name != "subject"))

FILE_FIELDS = ("type", "path", "prim")


def read_stage_file(path: Path) -> dict[str, Any]:
    """Return what a JSON file puts on a stage, by the names of `beam_warp.stage.stage.Stage`.

    Raises:
        AssetFormatError: A field is malformed or unknown; says which one and what to do.
        SchemaVersionError: The version is none that is read.
        MissingFileError: The file, or one that it names, is not there.
    """
    document, folder, where = read_json(path, "stage"), path.parent, f"{path.name}:"
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
    path: Path,
    *,
    source_axes: str | None = None,
    meters_per_unit: float | None = None,
    drop_invalid: bool = False,
    name: str | None = None,
    **place: Any,
) -> StageAsset:
    """Read an asset and put it on a stage.

    Args:
        path: A file or folder of Gaussians, as `beam_warp.converters.read` takes it.
        source_axes: Axes of the file; None takes its word.
        meters_per_unit: Length of the file's unit [m]; None takes its word.
        drop_invalid: Leave out rows that are no Gaussians.
        name: Name of the asset in messages; the file's name if None.
        place: Further attributes of a `StageAsset`.

    Raises:
        BeamError: It cannot be read, or is not relightable.
    """
    sequence = converters.read(
        path, source_axes=source_axes, meters_per_unit=meters_per_unit, drop_invalid=drop_invalid
    )
    return StageAsset(sequence=sequence, name=name or path.name, files=source_files(path), **place)


def source_files(path: Path) -> tuple[tuple[Path, ...], ...]:
    """Return the files that decide each frame of an asset: numbered ones, or once the layers of a USD stage."""
    files = files_at(path)
    if len(files) == 1 and files[0].suffix.lower() in USD_SUFFIXES:
        from beam_warp.schema.stage_queries import layer_files  # brings OpenUSD along

        return (tuple(layer_files(files[0])),)
    if format_of(files[0]).is_index:
        return (tuple(sorted(file for file in files[0].parent.rglob("*") if file.is_file())),)
    return tuple((file,) for file in files)


def _asset(record: Any, where: str, folder: Path) -> StageAsset:
    """Return one asset of JSON; a text alone is its path."""
    fields = Fields({"path": record} if isinstance(record, str) else record, where, ASSET_FIELDS)
    path = fields.path("path", folder, folders=True)
    options = fields.given(
        **dict.fromkeys(("start", "speed", "meters_per_unit"), "number"),
        **dict.fromkeys(("on_ground", "centered", "loop", "drop_invalid"), "flag"),
        **dict.fromkeys(("name", "blend", "source_axes"), "text"),
    )
    place = _placing(fields)
    with fields.placed():
        return read_stage_asset(path, **place, **options)


def _placing(fields: Fields) -> dict[str, Any]:
    """Return where something stands, as far as it is said."""
    return fields.given(translate=3, rotate=3 if isinstance(fields.value("rotate"), list) else "number", scale="number")


def _mesh(record: Any, where: str, folder: Path) -> tuple[ShotMesh | Ground, tuple[str, ...]]:
    """Return one mesh of JSON, or the ground; a text alone is its path."""
    if isinstance(record, dict) and "ground" in record:
        return _ground(record, where), ()
    fields = Fields({"path": record} if isinstance(record, str) else record, where, MESH_FIELDS)
    path = fields.path("path", folder)
    options = fields.given(base_color=3, roughness="number", catches_shadows="flag", smooth="flag")
    place = _placing(fields)
    with fields.placed():
        return read_stage_mesh(path, placement=placement_of(**place), **options)


def _ground(record: dict[str, Any], where: str) -> Ground:
    """Return the ground of JSON."""
    fields = Fields(record, where, GROUND_FIELDS)
    if fields.flag("ground") is not True:
        raise fields.error("ground", "true", "Leave the whole object out for no ground.")
    kinds = {"base_color": 3, "size": "number", "roughness": "number", "catches_shadows": "flag"}
    kinds |= {name: kind for name, kind in (("center", 2), ("height", "number")) if fields.value(name) != "auto"}
    given = fields.given(**kinds)
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
    rates = fields.given(rotate="number", degrees_per_second="number")
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
        prim = fields.given(prim="text").get("prim")
        path = fields.path("path", folder)
        with fields.placed():
            return read_camera_path(path, prim_path=prim)
    if kind == "orbit":
        fields = Fields(record, where, ORBIT_FIELDS)
        given = fields.given(**dict.fromkeys(ORBIT_FIELDS[1:], "number") | {"center": 3})
        with fields.placed():
            return OrbitPath(**given)
    fields = Fields(record, where, FIXED_FIELDS)
    return FixedCamera(KeyframePath((keyframe_of(fields, 0.0),)).camera_at(0.0, 2, 2))
