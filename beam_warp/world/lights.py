"""Lights at a place or from a direction, in physical units, and the JSON that lists them.

A new type of light takes one entry in each of these places:

- here, a record and its name in `LIGHT_TYPES`: shots take it, and JSON is read and written;
- ``kernels/light/lights.py``, a kind and a case of `light_disc`: the direction, distance, irradiance and angle of the
  light at a point, from which sampling, densities and shading of both renderers follow;
- `beam_warp.light.uploaded.ROWS`: its layout for that kernel;
- `beam_warp.render.shadow_maps.VIEWS`: where its shadow maps look from;
- ``engines/web/lamps.js``: how it is placed by hand on a player page;
- ``beam_warp/world/__init__.pyi`` and the root's: its public name.

``tests/light/test_uploaded.py`` fails for a type without its entries.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_array, require_finite, require_number, require_path, require_range
from beam_warp.errors import AssetFormatError, BeamError, InvalidArrayError, InvalidOptionError, MissingFileError

MOST_POWER = 1e12
"""Largest number that states a light's power, of any unit."""

SUN_DIAMETER = 0.53
"""Angular diameter of the sun [degree]."""

Vector: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class DirectionalLight:
    """Light from one direction, like the sun's.

    Attributes:
        direction: World direction in which the light travels, of any length but 0.
        irradiance: Irradiance on a plane that faces the light [W/m^2], scene-linear Rec.709, in the unit of the
            environment's radiance times steradian.
        angular_diameter: Angle that the disc of the light takes up [degree], 0 to 90; shadows of 0 are sharp.
        casts_shadows: Whether what is in the way casts a shadow.

    Raises:
        InvalidArrayError: A vector is not finite, has no length, or power is negative.
        InvalidOptionError: The diameter is out of range.
    """

    direction: Vector
    irradiance: Vector
    angular_diameter: float = SUN_DIAMETER
    casts_shadows: bool = True

    def __post_init__(self) -> None:
        """Check every field once."""
        _set_direction(self)
        _set_power(self, "irradiance")
        require_number("angular_diameter", self.angular_diameter, 0.0, 90.0)

    def scaled(self, factor: float) -> DirectionalLight:
        """Return the light times a factor of at least 0."""
        red, green, blue = self.irradiance
        return replace(self, irradiance=(red * factor, green * factor, blue * factor))

    def turned(self, degrees: float) -> DirectionalLight:
        """Return the light turned about z, counter-clockwise from above."""
        x, y, z = self.direction
        cosine, sine = float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))
        return replace(self, direction=(cosine * x - sine * y, sine * x + cosine * y, z))


@dataclass(frozen=True, kw_only=True)
class PointLight:
    """Light from a small sphere, the same in all directions.

    Attributes:
        position: World position [m].
        intensity: Radiant intensity [W/sr], scene-linear Rec.709: irradiance is intensity over the distance squared.
        radius: Radius of the sphere [m], at least 0; shadows of 0 are sharp. A point inside of it gets no light.
        casts_shadows: Whether what is in the way casts a shadow.

    Raises:
        InvalidArrayError: A vector is not finite, or power is negative.
        InvalidOptionError: The radius is out of range.
    """

    position: Vector
    intensity: Vector
    radius: float = 0.0
    casts_shadows: bool = True

    def __post_init__(self) -> None:
        """Check every field once."""
        _set_vector(self, "position")
        _set_power(self, "intensity")
        require_number("radius", self.radius, 0.0, 1e6)


@dataclass(frozen=True, kw_only=True)
class SpotLight:
    """A point light within a cone.

    Attributes:
        position: World position [m].
        direction: World direction of the cone's axis, away from the light, of any length but 0.
        intensity: Radiant intensity on the axis [W/sr], scene-linear Rec.709.
        inner_angle: Angle between the axis and where light begins to fade [degree].
        outer_angle: Angle between the axis and where light ends [degree], above ``inner_angle`` and at most 89.
        radius: Radius of the sphere that shines [m], at least 0.
        casts_shadows: Whether what is in the way casts a shadow.

    Raises:
        InvalidArrayError: A vector is not finite, has no length, or power is negative.
        InvalidOptionError: An angle or the radius is out of range.
    """

    position: Vector
    direction: Vector
    intensity: Vector
    inner_angle: float = 20.0
    outer_angle: float = 30.0
    radius: float = 0.0
    casts_shadows: bool = True

    def __post_init__(self) -> None:
        """Check every field once."""
        _set_vector(self, "position")
        _set_direction(self)
        _set_power(self, "intensity")
        require_number("outer_angle", self.outer_angle, 0.1, 89.0)
        require_number("inner_angle", self.inner_angle, 0.0, self.outer_angle - 0.05)
        require_number("radius", self.radius, 0.0, 1e6)


Light: TypeAlias = DirectionalLight | PointLight | SpotLight

LIGHT_TYPES: Mapping[str, type[Light]] = {"directional": DirectionalLight, "point": PointLight, "spot": SpotLight}
"""Every type of light, by the name that JSON gives it."""

Entry = TypeVar("Entry")


def light_entry(table: Mapping[type[Light], Entry], light: Any) -> Entry:
    """Return a table's entry for the type of a light.

    Raises:
        InvalidOptionError: ``light`` is of no type that lights have.
    """
    if type(light) not in table:
        raise unknown_light(type(light).__name__)
    return table[type(light)]


def unknown_light(got: str) -> InvalidOptionError:
    """Return the error that refuses what is no light."""
    known = ", ".join(kind.__name__ for kind in LIGHT_TYPES.values())
    return InvalidOptionError(f"lights must be of {known}, got {got}. Choose one of these types.")


def lights_from_json(records: Any, where: str = "lights") -> tuple[Light, ...]:
    """Return the lights of a list of JSON objects: ``type`` and the attributes of that type.

    Args:
        records: ``[{"type": "point", "position": [1, -2, 2], "intensity": [4, 4, 4], "radius": 0.1}, …]``.
        where: What to call the list in errors.

    Raises:
        AssetFormatError: The records are no list of such objects; the error names the first wrong one and its fault.
    """
    if not isinstance(records, Sequence) or isinstance(records, str | bytes):
        raise AssetFormatError(f"{where} must be a list of lights, got {type(records).__name__}. Put them in [ ].")
    return tuple(_light(record, f"{where}[{i}]") for i, record in enumerate(records))


def lights_to_json(lights: Sequence[Light]) -> list[dict[str, Any]]:
    """Return what `lights_from_json` reads."""
    names = {kind: name for name, kind in LIGHT_TYPES.items()}
    return [{"type": light_entry(names, light), **asdict(light)} for light in lights]


def read_lights(path: str | Path) -> tuple[Light, ...]:
    """Read a JSON file that holds a list of lights, or an object with such a list as ``lights``.

    Raises:
        MissingFileError: The file cannot be read.
        AssetFormatError: The file is not JSON, or its list is wrong: see `lights_from_json`.
    """
    path = require_path("path", path)
    if not path.is_file():
        raise MissingFileError(f"lights must be a file, got {path} (no such file). Check its name.")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise MissingFileError(f"lights must be a file, got {path} ({error.strerror}). Check its name.") from error
    except (ValueError, RecursionError) as error:
        raise AssetFormatError(f"lights must be JSON, got {path} ({error}). Correct it.") from error
    if isinstance(content, dict) and "lights" in content:
        content = content["lights"]
    return lights_from_json(content, f"{path.name}: lights")


def _light(record: Any, where: str) -> Light:
    """Return one light."""
    kinds = ", ".join(LIGHT_TYPES)
    if not isinstance(record, Mapping):
        raise AssetFormatError(f"{where} must be an object, got {type(record).__name__}. Give type and attributes.")
    kind = LIGHT_TYPES.get(str(record.get("type")))
    if kind is None:
        raise AssetFormatError(f"{where}.type must be one of {kinds}, got {record.get('type')!r}. Choose one.")
    known = {field.name: field for field in fields(kind)}
    for name in record:
        if name != "type" and name not in known:
            raise AssetFormatError(f"{where} must have attributes of {', '.join(known)}, got {name!r}. Leave it out.")
    if not isinstance(record.get("casts_shadows", True), bool):
        raise AssetFormatError(f"{where}.casts_shadows must be true or false, got another. Write it without quotes.")
    try:
        return kind(**{name: value for name, value in record.items() if name != "type"})
    except BeamError as error:
        raise AssetFormatError(f"{where}: {error}") from error
    except TypeError as error:
        raise AssetFormatError(f"{where} must have numbers for its attributes, got another ({error}).") from error


def _set_vector(light: Any, name: str) -> NDArray[np.float64]:
    """Check a vector, and keep it as plain numbers."""
    vector = require_array(name, getattr(light, name), (3,), np.float64)
    require_finite(name, vector)
    object.__setattr__(light, name, tuple(vector.tolist()))
    return vector


def _set_direction(light: Any) -> None:
    """Check a direction, and make its length 1."""
    vector = _set_vector(light, "direction")
    length = float(np.linalg.norm(vector))
    if not length > 1e-12:
        raise InvalidArrayError(f"direction must have a length, got {vector.tolist()}. Say where the light goes.")
    object.__setattr__(light, "direction", tuple((vector / length).tolist()))


def _set_power(light: Any, name: str) -> None:
    """Check a power: finite, not negative."""
    require_range(name, _set_vector(light, name), 0.0, MOST_POWER, "Light is not negative.")
