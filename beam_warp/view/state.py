"""State of a viewer: time, channel, light, tone, viewpoints; values that no mouse can break."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from beam_warp.errors import InvalidOptionError
from beam_warp.image.color import srgb_to_linear
from beam_warp.image.tone import TRANSFORMS, ViewTransform
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import DirectionalLight, Light, PointLight, SpotLight, unknown_light
from beam_warp.world.quaternions import matrix_of

LIT = "lit"
"""The channel that shows the asset under light."""

DEPTH, ALPHA = "depth", "alpha"
"""Channels that every cloud has, whatever arrays it holds."""

DEFERRED, TRACED = "deferred", "path traced"
"""How light is computed: at once, or by paths once nothing moves."""

NO_ENVIRONMENT = "none"

NO_GROUND, GREY_GROUND, SHADOW_GROUND = "none", "grey", "shadows"
"""What the subject stands on: nothing, a grey square, or what catches its shadow and is not seen itself."""

LIMITS = {"rotation": (-360.0, 360.0), "exposure": (-16.0, 16.0), "samples": (1, 1_000_000), "frame": (0, 2**31 - 1)}
"""Least and most of every number."""

CHOICES = {"mode": (DEFERRED, TRACED), "ground": (NO_GROUND, GREY_GROUND, SHADOW_GROUND), "transform": TRANSFORMS}
"""Names of what every viewer has; those of channels and environments depend on the asset and the command line."""

SPOT_CORE = 0.7
"""Part of a spot light's cone that gets all of its light."""

FARTHEST = 1e6
"""Largest coordinate of a light [m]."""

LARGEST_SIDE = 8192
"""Sides of a page beyond this are a mistake [pixel]."""

Color = tuple[int, int, int]
LightKind = Literal["point", "directional", "spot"]


@dataclass(frozen=True, kw_only=True)
class ViewState:
    """State that all pages share; each has a camera of its own.

    Attributes:
        frame: Which frame of the sequence.
        channel: `LIT`, `DEPTH`, `ALPHA` or a channel of the cloud.
        environment: Name of a light, or `NO_ENVIRONMENT`.
        rotation: Turn of the environment about z, counter-clockwise from above [degree].
        exposure: Stops.
        transform: Name of what turns scene-linear light into display colours.
        background: Display colour behind everything, 0 to 255.
        lights: Lamps and suns besides.
        ground: `NO_GROUND`, `GREY_GROUND` or `SHADOW_GROUND`.
        environment_shadows: Whether the environment casts shadows and light goes from surface to surface, in what is
            deferred; where there is no GPU, once nothing moves.
        mode: `DEFERRED` or `TRACED`.
        samples: Paths a pixel at which path tracing ends.
        choices: Names that a field may have, for every field that names something.
    """

    frame: int = 0
    channel: str = LIT
    environment: str = NO_ENVIRONMENT
    rotation: float = 0.0
    exposure: float = 0.0
    transform: ViewTransform = "standard"
    background: Color = (33, 33, 33)
    lights: tuple[Light, ...] = ()
    ground: str = NO_GROUND
    environment_shadows: bool = True
    mode: str = DEFERRED
    samples: int = 256
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: CHOICES, compare=False)

    def changed(self, **values: Any) -> ViewState:
        """Return the state with other values; what is no number or no choice is left as it was, numbers are cut."""
        known = {entry.name for entry in fields(self)} - {"choices"}
        kept: dict[str, Any] = {}
        for name, value in values.items():
            if name not in known:
                raise InvalidOptionError(f"state must have {', '.join(sorted(known))}, got {name!r}. Name one of them.")
            if name in LIMITS:
                number = number_within(value, getattr(self, name), *LIMITS[name])
                kept[name] = type(getattr(self, name))(number)
            elif name == "background":
                kept[name] = color_within(value, self.background)
            elif name in self.choices:
                kept[name] = value if value in self.choices[name] else getattr(self, name)
            else:
                kept[name] = value
        return replace(self, **kept)

    @property
    def lighting(self) -> object:
        """Values that light on the subject depends on, from wherever it is seen."""
        return self.frame, self.environment, self.rotation, self.lights, self.ground

    @property
    def is_traced(self) -> bool:
        """True if paths are traced where nothing moves: only what is lit is."""
        return self.mode == TRACED and self.channel == LIT


def number_within(value: Any, otherwise: float, low: float, high: float) -> float:
    """Return a number cut to its range; ``otherwise`` where it is not finite or none at all."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return otherwise
    return min(max(number, low), high) if math.isfinite(number) else otherwise


def color_within(value: Any, otherwise: Color) -> Color:
    """Return a colour of whole numbers from 0 to 255; ``otherwise`` where it is no colour."""
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 3:
        return otherwise
    red, green, blue = (round(number_within(v, o, 0, 255)) for v, o in zip(value, otherwise, strict=True))
    return red, green, blue


@dataclass(frozen=True)
class Viewpoint:
    """Where a page looks from, and how large it is.

    Attributes:
        wxyz: Rotation from camera to world, x right, y down, z forward; of any length but 0.
        position: Position in the world [m].
        fov: Angle between the upper and the lower edge [rad].
        width: Width of the page's canvas [pixel].
        height: Height of the page's canvas [pixel].
    """

    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov: float
    width: int
    height: int

    @property
    def is_usable(self) -> bool:
        """False while a page has no size, or its camera is nowhere: then nothing is drawn for it."""
        return (
            all(math.isfinite(number) for number in (*self.wxyz, *self.position, self.fov))
            and math.hypot(*self.wxyz) > 1e-9
            and 1e-3 < self.fov < 3.1
            and 1 <= self.width <= LARGEST_SIDE
            and 1 <= self.height <= LARGEST_SIDE
        )

    def size(self, scale: float, longest: int) -> tuple[int, int]:
        """Return width and height at a scale, in the page's proportions, neither side beyond ``longest`` nor none."""
        factor = min(scale, longest / max(self.width, self.height))
        return max(1, round(self.width * factor)), max(1, round(self.height * factor))

    def camera(self, scale: float, longest: int) -> Camera:
        """Return the camera of the page at a scale; both fields of view are the page's, whatever is rounded."""
        width, height = self.size(scale, longest)
        focal = 0.5 / math.tan(0.5 * self.fov)  # of an image of height 1
        pose = np.eye(4)
        pose[:3, :3] = rotation_of(self.wxyz)
        pose[:3, 3] = self.position
        focal_x = focal * width * self.height / self.width
        return Camera(width, height, focal_x, focal * height, 0.5 * width, 0.5 * height, pose)


def rotation_of(wxyz: Sequence[float]) -> NDArray[np.float64]:
    """Return the rotation matrix of a quaternion of any length but 0."""
    return matrix_of(np.roll(np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz), -1))


def turn_to(direction: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the shortest rotation, wxyz, that takes -z to a direction of any length but 0."""
    x, y, z = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    if z > 1.0 - 1e-12:  # straight up: half a turn about x
        return 0.0, 1.0, 0.0, 0.0
    # q = (1 + a·b, a × b) for a = (0, 0, -1), b = (x, y, z)
    quaternion = np.array([1.0 - z, y, -x, 0.0])
    w, i, j, k = (quaternion / np.linalg.norm(quaternion)).tolist()
    return w, i, j, k


@dataclass(frozen=True, kw_only=True)
class PlacedLight:
    """A light as it is set by hand: a place, a turn, a colour and numbers.

    Attributes:
        kind: ``"point"``, ``"directional"`` or ``"spot"``.
        position: Position in the world [m]; for a directional light, that of its handle.
        wxyz: Turn of its handle; it shines along the handle's -z.
        color: Display colour of the light, 0 to 255.
        power: Irradiance of a directional light [W/m^2], else radiant intensity [W/sr], of white.
        size: Radius [m]; for a directional light the angular diameter [degree].
        cone: Angle between a spot light's axis and the edge of its cone [degree].
        casts_shadows: Whether what is in the way casts a shadow.
    """

    kind: LightKind
    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    color: Color = (255, 255, 255)
    power: float = 3.0
    size: float = 0.0
    cone: float = 60.0
    casts_shadows: bool = True

    def changed(self, **values: Any) -> PlacedLight:
        """Return the light with other values; what is not finite is left as it was, what is out of range is cut."""
        kept = dict(values)
        widest = 90.0 if self.kind == "directional" else 100.0
        limits = {"power": (0.0, 1e6), "size": (0.0, widest), "cone": (1.0, 89.0)}
        for name, (low, high) in limits.items():
            if name in kept:
                kept[name] = number_within(kept[name], getattr(self, name), low, high)
        if "color" in kept:
            kept["color"] = color_within(kept["color"], self.color)
        for name in ("position", "wxyz"):
            if name in kept:
                before = getattr(self, name)
                numbers = tuple(number_within(number, math.nan, -FARTHEST, FARTHEST) for number in kept[name])
                sound = len(numbers) == len(before) and all(map(math.isfinite, numbers))
                kept[name] = numbers if sound and (name == "position" or math.hypot(*numbers) > 1e-9) else before
        return replace(self, **kept)

    def light(self) -> Light:
        """Return it as renderers take it."""
        linear = srgb_to_linear(np.asarray(self.color, np.float64) / 255.0).tolist()
        red, green, blue = (self.power * channel for channel in linear)
        power = (red, green, blue)
        ahead = -rotation_of(self.wxyz)[:, 2]
        direction = (float(ahead[0]), float(ahead[1]), float(ahead[2]))
        if self.kind == "directional":
            return DirectionalLight(
                direction=direction, irradiance=power, angular_diameter=self.size, casts_shadows=self.casts_shadows
            )
        if self.kind == "spot":
            return SpotLight(
                position=self.position,
                direction=direction,
                intensity=power,
                inner_angle=SPOT_CORE * self.cone,
                outer_angle=self.cone,
                radius=self.size,
                casts_shadows=self.casts_shadows,
            )
        if self.kind == "point":
            return PointLight(
                position=self.position, intensity=power, radius=self.size, casts_shadows=self.casts_shadows
            )
        raise unknown_light(self.kind)


@dataclass(frozen=True)
class SubjectBox:
    """The box that the sequence is in, as far as it is known: what cameras frame and lights are placed around.

    Attributes:
        low: Least coordinates [m], ``(3,)``.
        high: Largest coordinates [m], ``(3,)``.
    """

    low: NDArray[np.float64] = field(default_factory=lambda: np.full(3, -1.0))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(3, 1.0))

    @classmethod
    def of(cls, points: NDArray[np.float64]) -> SubjectBox:
        """Return the box of points; a metre around the origin where there are none."""
        return cls(points.min(axis=0), points.max(axis=0)) if len(points) else cls()

    @property
    def center(self) -> NDArray[np.float64]:
        """The middle of the box [m]."""
        return 0.5 * (self.low + self.high)

    @property
    def extent(self) -> float:
        """The diagonal of the box [m]; at least a millimetre."""
        return max(float(np.linalg.norm(self.high - self.low)), 1e-3)

    def new_light(self, kind: LightKind) -> PlacedLight:
        """Return a light to the subject's left front that shines on it, where a page that frames the subject sees it.

        Point and spot lights give white about the irradiance π: as much as an environment of radiance 1 from all sides.
        """
        offset = self.extent * np.array([-0.35, -0.3, 0.25])
        x, y, z = (self.center + offset).tolist()
        squared = float(offset @ offset)
        return PlacedLight(
            kind=kind,
            position=(x, y, z),
            wxyz=(1.0, 0.0, 0.0, 0.0) if kind == "point" else turn_to((-offset).tolist()),
            power=float(f"{math.pi * (1.0 if kind == 'directional' else squared):.2g}"),
            size=0.53 if kind == "directional" else float(f"{0.03 * self.extent:.1g}"),
        )


def channels_of(cloud: GaussianCloud) -> tuple[str, ...]:
    """Return the channels that a cloud can show: what is lit first, where it can be."""
    order = (
        *("radiance", "base_color", "roughness", "ambient_occlusion", "normals"),
        *("base_color_error", "roughness_error", "ambient_occlusion_error", "normal_confidence", "observability"),
    )
    own = [name for name in order if getattr(cloud, name) is not None]
    return (*([LIT] if cloud.is_relightable else []), *own, "surface_normals", DEPTH, ALPHA)


@dataclass(frozen=True)
class Playback:
    """A sequence that runs: which frame it shows at a time.

    Attributes:
        started: Time of the start, by any clock [s].
        first: The frame it was started at.
        frames_per_second: Rate of the playback.
        frame_count: Number of frames of the sequence.
        loops: Whether it starts over at its end.
    """

    started: float
    first: int
    frames_per_second: float
    frame_count: int
    loops: bool = True

    def frame_at(self, now: float) -> int:
        """Return the frame to show; the last one for good where it does not loop."""
        steps = self.first + math.floor(max(0.0, now - self.started) * self.frames_per_second)
        return steps % self.frame_count if self.loops else min(steps, self.frame_count - 1)

    def is_over(self, now: float) -> bool:
        """True if nothing changes any more."""
        return not self.loops and self.frame_at(now) == self.frame_count - 1
