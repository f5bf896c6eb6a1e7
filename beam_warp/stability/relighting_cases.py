"""Subjects and lights on which relighting fails: small shots, and what must hold of their images.

What must hold is a closed form, many samples of a path tracer, or a bound; each with the reason for how far an image
may be off, derived and not fitted to what renderers give.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.kernels.light.brdf import ALPHA_FLOOR
from beam_warp.light.ggx import DIELECTRIC_F0, ggx_distribution, schlick_weight, smith_lambda, specular_albedo
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap, texel_directions
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import SUN_DIAMETER, DirectionalLight, PointLight
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.shapes import TiledSurface, rectangle, sphere_zone, tile
from beam_warp.world.shot import RenderedImage, Shot, ShotMesh

DEFERRED, PATH = "deferred", "path"
RENDERERS = (DEFERRED, PATH)

FURNACE = 0.01
"""Part by which a white surface under even light may be off what it reflects: the plan's."""

ROUNDING = 1e-4
"""Relative: a thousand roundings of float32."""

RADIUS = 0.5
"""Of the ball [m]."""

FIREFLY = 5e4
"""Radiance of the one hot texel; others have `FIREFLY_SKY`."""

FIREFLY_SKY = 0.1

GRAZING = 10.0
ACNE = 3.0
"""Elevation of the sun over a floor with a wall, and over a bare one [degree]."""

WALL = (-0.5, 0.15, 0.4)
"""Where the wall stands along x, its height, and half its width [m]."""

FIELD = 1.8
"""Width of the floor that is seen from above [m]."""

THICKNESS = 0.02
"""Of the wall [m]."""

WRONG_PART = 0.01
"""Part of the lit, or shadowed, pixels that may be wrong: of 1024 pixels ten, few enough to be seen one by one."""

EDGE = 1
"""Pixels around the edge of a shadow that are not judged: the nearest pixel is as near as an image tells."""

LARGEST_OF_PIXELS = 6.0
"""Standard deviations by which no pixel of a small image lies above the mean."""

Images = Sequence[RenderedImage]


@dataclass(frozen=True, eq=False)
class Drawn:
    """What a renderer made of the shots of a case.

    Attributes:
        images: One a shot, drawn one after the other by one renderer.
        draw_alone: Draws one a shot, each by a renderer that drew nothing before.
        draw_reference: Draws one a shot by path tracing, with many samples of another seed.
    """

    images: Images
    draw_alone: Callable[[], Images]
    draw_reference: Callable[[], Images]

    @cached_property
    def alone(self) -> Images:
        """Images by a renderer each."""
        return self.draw_alone()

    @cached_property
    def reference(self) -> Images:
        """Images by many samples."""
        return self.draw_reference()


@dataclass(frozen=True, eq=False, kw_only=True)
class Demand:
    """A number that images have, and where it must lie.

    Attributes:
        what: It is, in words.
        measure: Takes it of the images.
        low: It must not be below.
        high: It must not be above.
        because: Where the bounds come from.
        of: Renderers that are asked.
    """

    what: str
    measure: Callable[[Drawn], float]
    low: float = 0.0
    high: float
    because: str
    of: tuple[str, ...] = RENDERERS


@dataclass(frozen=True, eq=False, kw_only=True)
class RelightStress:
    """Shots, and what must hold of them; that images are finite, with alpha in [0, 1], is asked of all.

    Attributes:
        shots: Drawn in this order by one renderer.
        demands: What must hold.
        noisy: Whether what is asked has noise; if it has none, one seed tells.
        done: What happened to the input before, in words.
    """

    shots: tuple[Shot, ...]
    demands: tuple[Demand, ...]
    noisy: bool = True
    done: str = "nothing"


@dataclass(frozen=True, eq=False)
class RelightStudio:
    """Makes the subjects.

    Attributes:
        size: Side of images [pixel]; of those of planes, which look everywhere alike, a quarter.
        spacing: Of the Gaussians on the floor and the ball [m].
        samples: Of a pixel that the path tracer takes: bounds of its noise depend on it.
    """

    size: int = 32
    spacing: float = 0.08
    samples: int = 64

    def plane(self, *, base_color: float = 1.0, roughness: float = 1.0, opacity: float = 0.99) -> GaussianCloud:
        """Return z = 0: one Gaussian, so wide that nothing of its rim is seen."""
        return _relightable(_sheet((0.0, 0.0, 0.0), 3.0, opacity), base_color, roughness)

    def ball(self, *, base_color: float = 1.0, roughness: float = 1.0, spacing: float | None = None) -> GaussianCloud:
        """Return a ball at the origin, tiled with flat Gaussians."""
        surface = sphere_zone(np.zeros(3), RADIUS, -1.0, 1.0, spacing or self.spacing)
        return _relightable(tile((surface,)), base_color, roughness)

    def floor(self, wall: tuple[TiledSurface, ...] = ()) -> GaussianCloud:
        """Return a floor of 2 m, tiled with flat Gaussians, and a wall on it if one is given."""
        x, y, _ = np.eye(3)
        return _relightable(tile((rectangle(np.zeros(3), x, y, self.spacing), *wall)), 0.8)

    def wall(self) -> tuple[TiledSurface, TiledSurface]:
        """Return both sides of the wall, the first towards the sun."""
        _, y, z = np.eye(3)
        place, height, half = WALL
        front = np.array([place - THICKNESS, 0.0, 0.5 * height])
        back = np.array([place, 0.0, 0.5 * height])
        spacing = 0.5 * self.spacing
        return (
            rectangle(front, half * -y, 0.5 * height * z, spacing),
            rectangle(back, half * y, 0.5 * height * z, spacing),
        )

    def at_plane(self, degrees: float = 45.0, *, fov: float = 2.0) -> Camera:
        """Return a camera that sees a spot of the plane, so many degrees from its normal."""
        side = max(self.size // 4, 4)
        angle = np.radians(degrees)
        eye = 2.0 * np.array([0.0, -np.sin(angle), np.cos(angle)])
        return Camera.look_at(eye, (0.0, 0.0, 0.0), width=side, height=side, vertical_fov=fov)

    def at_ball(self) -> Camera:
        """Return a camera that sees the ball from a little above."""
        return Camera.look_at((0.0, -2.6, 0.6), (0.0, 0.0, 0.0), width=self.size, height=self.size, vertical_fov=24.0)

    def from_above(self) -> Camera:
        """Return a camera that sees `FIELD` of the floor from 3 m above."""
        field = 2.0 * np.degrees(np.arctan(0.5 * FIELD / 3.0))
        side = self.size
        return Camera.look_at(
            (0.0, 0.0, 3.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), width=side, height=side, vertical_fov=field
        )


@dataclass(frozen=True)
class RelightingCase:
    """A registered case.

    Attributes:
        name: In words.
        fails: How a renderer without precautions fails.
        must: What is asked.
        build: Makes it.
        large: Whether it is run on request only.
    """

    name: str
    fails: str
    must: str
    build: Callable[[RelightStudio], RelightStress]
    large: bool = False


RELIGHTING_CASES: list[RelightingCase] = []

Build = Callable[[RelightStudio], RelightStress]


def relighting_case(name: str, fails: str, must: str, *, large: bool = False) -> Callable[[Build], Build]:
    """Register what follows."""

    def register(build: Build) -> Build:
        RELIGHTING_CASES.append(RelightingCase(name, fails, must, build, large))
        return build

    return register


# ---- closed forms and measures --------------------------------------------------------------------------------------


def scattered(normal: ArrayLike, view: ArrayLike, lights: ArrayLike, roughness: float) -> NDArray[np.float64]:
    """Return the dielectric GGX lobe times n·l in float64, for unit directions ``(..., 3)`` of light; 0 from below."""
    n, v, d = (np.asarray(a, np.float64) for a in (normal, view, lights))
    half = v + d
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    alpha, above = max(roughness**2, float(ALPHA_FLOOR)), np.maximum(d @ n, 1e-12)
    shadowing = 1.0 / (1.0 + smith_lambda(above, alpha) + smith_lambda(n @ v, alpha))
    fresnel = DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * schlick_weight(half @ v)
    lobe = ggx_distribution(half @ n, alpha) * shadowing * fresnel / (4.0 * (n @ v))
    return np.where(d @ n > 0.0, lobe, 0.0)


def diffuse(view: ArrayLike, base_color: float, roughness: float) -> float:
    """Return the Lambert lobe of a plane z = 0 [1/sr], seen from a unit direction."""
    return float(base_color * (1.0 - specular_albedo(np.asarray(view, np.float64)[2], roughness)) / np.pi)


def disc_directions(middle: ArrayLike, degrees: float, count: int = 20_000) -> NDArray[np.float64]:
    """Return directions spread evenly over the solid angle of a disc of so many degrees around a unit direction."""
    axis = np.asarray(middle, np.float64)
    k = np.arange(count) + 0.5
    z = 1.0 - (1.0 - np.cos(np.radians(degrees / 2.0))) * k / count
    around = np.pi * (3.0 - np.sqrt(5.0)) * k
    side = np.cross(axis, (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side), axis])
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(around), ring * np.sin(around), z], axis=-1) @ frame


def brightness(image: RenderedImage) -> float:
    """Return the mean radiance of what is covered."""
    return float(image.rgb.mean(dtype=np.float64) / max(float(image.alpha.mean(dtype=np.float64)), 1e-12))


def largest_difference(one: RenderedImage, other: RenderedImage) -> float:
    """Return by how much two images differ at most, of the largest value of the other; alpha in its own unit."""
    scale = max(float(other.rgb.max(initial=0.0)), 1e-12)
    color = np.abs(one.rgb - other.rgb).max(initial=0.0) / scale
    return float(max(color, np.abs(one.alpha - other.alpha).max(initial=0.0)))


def wrong_parts(dark: NDArray[np.bool_], expected: NDArray[np.bool_], judged: NDArray[np.bool_]) -> tuple[float, float]:
    """Return which part of the lit pixels is shadowed, and of the shadowed ones lit; `EDGE` pixels apart from edges."""
    height, width = expected.shape
    padded = np.pad(expected, EDGE, mode="edge")
    steps = range(2 * EDGE + 1)
    around = np.stack([padded[i : i + height, j : j + width] for i in steps for j in steps])
    lit, shadowed = judged & ~around.any(axis=0), judged & around.all(axis=0)
    return float(dark[lit].mean()) if lit.any() else 0.0, float((~dark)[shadowed].mean()) if shadowed.any() else 0.0


def arriving_part(shaded: RenderedImage, free: RenderedImage) -> NDArray[np.float64]:
    """Return what a shadow leaves of the light of every pixel."""
    rgb, full = (image.rgb.sum(axis=-1, dtype=np.float64) for image in (shaded, free))
    return np.divide(rgb, full, out=np.ones_like(rgb), where=full > 0.0)


def sun_at(degrees: float, irradiance: float = 3.0, *, diameter: float = SUN_DIAMETER) -> DirectionalLight:
    """Return a sun at -x, so many degrees above the floor."""
    angle = np.radians(degrees)
    return DirectionalLight(
        direction=(float(np.cos(angle)), 0.0, -float(np.sin(angle))),
        irradiance=(irradiance, irradiance, irradiance),
        angular_diameter=diameter,
    )


def in_wall_shadow(points: NDArray[np.float64], degrees: float) -> NDArray[np.bool_]:
    """Tell which points of the floor the wall hides from the middle of the sun."""
    place, height, half = WALL
    x, y = points[..., 0], points[..., 1]
    return (x > place) & (x < place + height / np.tan(np.radians(degrees))) & (np.abs(y) < half)


def floor_points(camera: Camera) -> NDArray[np.float64]:
    """Return where the middles of pixels see z = 0, ``(H, W, 3)``."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack(
        [
            (column - camera.center_x) / camera.focal_x,
            (row - camera.center_y) / camera.focal_y,
            np.ones_like(row),
        ],
        axis=-1,
    )
    directions = local @ camera.camera_to_world[:3, :3].T
    return camera.position - directions * (camera.position[2] / directions[..., 2:])


def _sheet(middle: ArrayLike, size: float, opacity: float, *, up: bool = True) -> GaussianCloud:
    """Return one flat Gaussian that faces up or down."""
    return GaussianCloud(
        positions=np.asarray(middle, np.float32)[None],
        orientations=np.array([[0.0, 0.0, 0.0, 1.0]]),
        scales=np.array([[size, size, 1e-3 * size]]),
        opacities=np.array([opacity]),
        normals=np.array([[0.0, 0.0, 1.0 if up else -1.0]]),
    )


def _relightable(cloud: GaussianCloud, base_color: float = 1.0, roughness: float = 1.0) -> GaussianCloud:
    """Return the cloud with one material."""
    count = len(cloud)
    return cloud.with_arrays(
        base_color=np.full((count, 3), base_color, np.float32),
        roughness=np.full(count, roughness, np.float32),
        ambient_occlusion=np.ones(count, np.float32),
    )


def _together(*clouds: GaussianCloud) -> GaussianCloud:
    """Return all Gaussians as one cloud."""
    names = clouds[0].arrays()
    arrays: dict[str, Any] = {name: np.concatenate([cloud.arrays()[name] for cloud in clouds]) for name in names}
    return GaussianCloud(**arrays)


def _nothing(studio: RelightStudio) -> GaussianCloud:
    """Return no Gaussians."""
    return studio.plane().select(np.zeros(0, np.int64))


def _square(half: float, middle: ArrayLike = (0.0, 0.0, 0.0), *, catches: bool = False) -> ShotMesh:
    """Return a level square of two triangles, white."""
    corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    surface = MaterialMesh(
        vertices=(corners + np.asarray(middle, np.float64)).astype(np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        normals=np.tile(np.array([0.0, 0.0, 1.0], np.float32), (4, 1)),
        base_color=np.ones((4, 3), np.float32),
        roughness=np.ones(4, np.float32),
    )
    return ShotMesh(surface=surface, catches_shadows=np.full(2, catches))


def white(radiance: float = 1.0) -> EnvironmentMap:
    """Return even light."""
    return EnvironmentMap.constant((radiance, radiance, radiance))


def firefly() -> EnvironmentMap:
    """Return a dim sky with one texel of `FIREFLY`, 51 degrees from the zenith."""
    radiance = np.full((16, 32, 3), FIREFLY_SKY, np.float32)
    radiance[4, 9] = FIREFLY
    return EnvironmentMap(radiance)


def sky_closed_form(light: EnvironmentMap, view: ArrayLike, roughness: float) -> tuple[float, float]:
    """Return what a white plane z = 0 sends to a viewer under an open sky: diffusely, and specularly."""
    fine = 16
    height, width = light.radiance.shape[:2]
    radiance = light.radiance[..., 0].astype(np.float64).repeat(fine, 0).repeat(fine, 1)
    directions = texel_directions(fine * height, fine * width)
    edges = np.cos(np.arange(fine * height + 1) * (np.pi / (fine * height)))
    solid = (edges[:-1] - edges[1:])[:, None] * (2.0 * np.pi / (fine * width)) * radiance
    up = np.array([0.0, 0.0, 1.0])
    cosine = np.maximum(directions[..., 2], 0.0)
    return (
        float(diffuse(view, 1.0, roughness) * (cosine * solid).sum()),
        float((scattered(up, view, directions, roughness) * solid).sum()),
    )


# ---- the cases ------------------------------------------------------------------------------------------------------


@relighting_case(
    "light inside the subject", "a shell that leaks glows from within", "the outside dark, whatever the lamp's size"
)
def light_inside(studio: RelightStudio) -> RelightStress:
    """A lamp in the middle of a closed ball."""
    cloud = studio.ball(base_color=0.8)
    lamps = [PointLight(position=(0.0, 0.0, 0.0), intensity=(1.0, 1.0, 1.0), radius=r) for r in (0.0, 0.2)]
    inner = 0.8 / np.pi / RADIUS**2
    return RelightStress(
        shots=tuple(Shot(cloud=cloud, camera=studio.at_ball(), lights=(lamp,)) for lamp in lamps),
        demands=tuple(
            Demand(
                what=f"outside, of the lit inner wall ({name})",
                measure=lambda drawn, k=k: brightness(drawn.images[k]) / inner,
                high=0.01,
                because="all of the outside faces away from the lamp: 0, or what is not seen beside the inner wall",
            )
            for k, name in enumerate(("a point", "a sphere"))
        ),
    )


@relighting_case(
    "a lamp on the surface", "1 / 0 at its place, shadows of the surface on itself", "finite; the closed form near it"
)
def lamp_on_surface(studio: RelightStudio) -> RelightStress:
    """A lamp in the middle of a Gaussian, and one 5 cm above."""
    cloud = studio.plane()
    near = 0.05
    lamps = [PointLight(position=(0.0, 0.0, height), intensity=(1.0, 1.0, 1.0)) for height in (0.0, near)]
    camera = replace(studio, size=32).from_above()  # pixels of 6 cm, whatever is asked
    points = floor_points(camera)
    squared = (points[..., :2] ** 2).sum(axis=-1)
    ring = (squared > 0.2**2) & (squared < 0.6**2)
    arriving = near / (squared + near**2) ** 1.5
    to_eye = camera.position - points
    to_eye /= np.linalg.norm(to_eye, axis=-1, keepdims=True)
    to_lamp = np.array([0.0, 0.0, near]) - points
    to_lamp /= np.linalg.norm(to_lamp, axis=-1, keepdims=True)
    up = np.array([0.0, 0.0, 1.0])
    expected = np.array(
        [
            diffuse(v, 1.0, 1.0) * e + float(scattered(up, v, d, 1.0)) * e / d[2]
            for v, d, e in zip(to_eye[ring], to_lamp[ring], arriving[ring], strict=True)
        ]
    ).sum()

    def seen(drawn: Drawn, k: int) -> float:
        image = drawn.images[k]
        radiance = image.rgb[..., 1].astype(np.float64) / np.maximum(image.alpha, 1e-12)
        return float(radiance[ring].sum() / expected)

    return RelightStress(
        shots=tuple(Shot(cloud=cloud, camera=camera, lights=(lamp,)) for lamp in lamps),
        demands=(
            Demand(
                what="light of the lamp 5 cm above, of the closed form",
                measure=lambda drawn: seen(drawn, 1),
                low=0.95,
                high=1.05,
                because="h / (h² + x²)^(3/2); beyond 20 cm pixels of 6 cm bend it by under 4 %",
            ),
            Demand(
                what="light of the lamp on it, of that",
                measure=lambda drawn: seen(drawn, 0),
                high=0.13,
                because="0 for a lamp in the plane; as if it were 2 standard deviations of the layer (6 mm) above",
            ),
        ),
    )


def _wrong_by_reference(drawn: Drawn, lit: bool) -> float:
    """Return the part of pixels that are falsely lit, or shadowed, as the reference sees them."""
    part = arriving_part(*drawn.images)
    expected = arriving_part(*drawn.reference)
    judged = (np.abs(expected - 0.5) > 0.25) & (drawn.reference[1].alpha > 0.5)
    return wrong_parts(part < 0.5, expected < 0.5, judged)[int(lit)]


def _wall_shadow(studio: RelightStudio, camera: Camera, around: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where the floor is in the wall's shadow, and where that is known.

    It is not where tiles end softly, and not so far around the wall that it is the wall that is seen there.
    """
    place, height, half = WALL
    points = floor_points(camera)
    slope = 1.0 / np.tan(np.radians(GRAZING))
    reach = 0.5 * studio.spacing  # of the wall's own tiles, which are half as wide as the floor's, beyond its edges
    x, y = points[..., 0], points[..., 1]
    soft = np.abs(x - (place + height * slope)) < reach * slope
    soft |= (np.abs(np.abs(y) - half) < reach) & (x > place)
    soft |= (np.abs(x - place) < around) & (np.abs(y) < half + around)
    return in_wall_shadow(points, GRAZING), ~soft & (np.abs(points[..., :2]) < 0.8).all(axis=-1)


@relighting_case(
    "sun at grazing incidence, bare floor", "acne: Gaussians shadow themselves", "no pixel of it in shadow"
)
def acne(studio: RelightStudio) -> RelightStress:
    """A sun of 3 degrees over a floor of many Gaussians: nothing is in its way."""
    cloud, camera, sun = studio.floor(), studio.from_above(), sun_at(ACNE)
    inside = (np.abs(floor_points(camera)[..., :2]) < 0.8).all(axis=-1)

    def dark(drawn: Drawn) -> float:
        return float((arriving_part(*drawn.images)[inside] < 0.5).mean())

    return RelightStress(
        shots=tuple(
            Shot(cloud=cloud, camera=camera, lights=(replace(sun, casts_shadows=shadows),)) for shadows in (True, False)
        ),
        demands=(
            Demand(
                what="falsely shadowed",
                measure=dark,
                high=0.0,
                because="a level floor is open: closed form",
            ),
            Demand(
                what="light that arrives, of all",
                measure=lambda drawn: float(arriving_part(*drawn.images)[inside].mean()),
                low=0.98,
                high=1.0 + ROUNDING,
                because="1; Gaussians whose edges rise above the mean height may take 2 %",
            ),
        ),
    )


def _wall_seen(studio: RelightStudio) -> float:
    """Return how far beside the wall it is itself that is seen from above [m].

    Splats are widened by 0.3 px², which makes two pixels of opaque wall of a stack of them.
    """
    return studio.spacing + 2.0 * FIELD / studio.size


def _behind(studio: RelightStudio, wall: tuple[TiledSurface, ...]) -> RelightStress:
    """Return a sun of 10 degrees, and a wall of 15 cm on the floor: its shadow is 85 cm long."""
    cloud, camera, sun = studio.floor(wall), studio.from_above(), sun_at(GRAZING)
    expected, judged = _wall_shadow(studio, camera, studio.spacing)
    names = ("falsely shadowed", "falsely lit")
    by_form = tuple(
        Demand(
            what=what,
            measure=lambda drawn, lit=lit: wrong_parts(arriving_part(*drawn.images) < 0.5, expected, judged)[lit],
            high=WRONG_PART,
            because="height / tan 10° long: closed form, 1 px and half a Gaussian from edges",
        )
        for lit, what in enumerate(names)
    )
    by_paths = tuple(
        Demand(
            what=f"{what}, by paths",
            measure=lambda drawn, lit=lit: _wrong_by_reference(drawn, bool(lit)),
            high=WRONG_PART,
            because="of pixels that the reference has lit or shadowed by 3/4, 1 px from edges",
            of=(DEFERRED,),
        )
        for lit, what in enumerate(names)
    )
    place, height, half = WALL
    points = floor_points(camera)
    behind = points[..., 0] - place
    middle = (behind > _wall_seen(studio)) & (behind < 0.5 * height / np.tan(np.radians(GRAZING)))
    shadowed = expected & judged & middle & (np.abs(points[..., 1]) < 0.5 * half)
    dark = Demand(
        what="light in the middle of the shadow",
        measure=lambda drawn: float(arriving_part(*drawn.images)[shadowed].mean()),
        high=0.1,
        because="tiles let up to 0.05 through, and no more than that comes back from the lit floor by way of the wall",
    )
    return RelightStress(
        shots=tuple(
            Shot(cloud=cloud, camera=camera, lights=(replace(sun, casts_shadows=shadows),)) for shadows in (True, False)
        ),
        demands=(*by_form, *by_paths, dark),
    )


@relighting_case(
    "sun at grazing incidence, a wall",
    "a bias that hides acne takes the shadow off the wall's foot (peter-panning)",
    "shadows where they are, to a pixel",
)
def peter_panning(studio: RelightStudio) -> RelightStress:
    """A wall of two sides."""
    return _behind(studio, studio.wall())


@relighting_case(
    "sun at grazing incidence, a sheet",
    "a layer that faces the sun is lit from its front when it is seen from behind, and lights what is in its shadow",
    "shadows where they are, to a pixel",
)
def single_layer(studio: RelightStudio) -> RelightStress:
    """The wall's shadow, of a single layer of Gaussians whose normals face the sun."""
    front, _ = studio.wall()
    return _behind(studio, (replace(front, points=front.points + np.array([THICKNESS, 0.0, 0.0])),))


def _furnace(studio: RelightStudio, roughness: float) -> tuple[tuple[Shot, ...], tuple[Demand, ...]]:
    """Return a white plane under even light from three angles, and that it must not be told from it."""
    angles = (5.0, 45.0, 80.0)
    cloud = studio.plane(roughness=roughness)
    shots = tuple(Shot(cloud=cloud, camera=studio.at_plane(a, fov=1.0), environment=white()) for a in angles)
    demands = tuple(
        Demand(
            what=f"white furnace from {angle:g}°",
            measure=lambda drawn, k=k: brightness(drawn.images[k]),
            low=1.0 - FURNACE,
            high=1.0 + FURNACE,
            because="1, within the 1 % that is asked at every roughness",
        )
        for k, angle in enumerate(angles)
    )
    return shots, demands


def _highlight(studio: RelightStudio, roughness: float, first: int) -> tuple[tuple[Shot, ...], tuple[Demand, ...]]:
    """Return a black plane with a sun, and one without size, in the mirror direction; closed forms of both."""
    cloud = studio.plane(base_color=0.0, roughness=roughness)
    camera = studio.at_plane(45.0, fov=0.01)
    view = np.array([0.0, -1.0, 1.0]) / np.sqrt(2.0)
    mirror = view * (1.0, -1.0, 1.0)
    suns = [
        DirectionalLight(direction=tuple(-mirror), irradiance=(3.0, 3.0, 3.0), angular_diameter=d, casts_shadows=False)
        for d in (0.0, SUN_DIAMETER)
    ]
    up = np.array([0.0, 0.0, 1.0])
    disc = disc_directions(mirror, SUN_DIAMETER)
    share = scattered(up, view, disc, roughness).sum() / (disc @ mirror).sum()
    expected = [3.0 * float(scattered(up, view, mirror, roughness)), 3.0 * float(share)]
    demands = tuple(
        Demand(
            what=f"highlight of {name}, of the closed form",
            measure=lambda drawn, k=k: brightness(drawn.images[first + k]) / expected[k],
            low=0.97,
            high=1.03,
            because="D G F / 4 over the disc; pixels are 3 % of the lobe wide, and a widened lobe may err by as much",
        )
        for k, name in enumerate(("a light without size", "the sun"))
    )
    return tuple(Shot(cloud=cloud, camera=camera, lights=(sun,)) for sun in suns), demands


@relighting_case("roughness 0.03", "D overflows, lobes miss the sun: fireflies or nothing", "energy, and highlights")
def nearly_mirror(studio: RelightStudio) -> RelightStress:
    """A plane that is almost a mirror."""
    shots, demands = _furnace(studio, 0.03)
    more, others = _highlight(studio, 0.03, len(shots))
    return RelightStress(shots=shots + more, demands=demands + others)


@relighting_case("roughness 1", "the widest lobe loses energy at grazing", "energy, and highlights")
def fully_rough(studio: RelightStudio) -> RelightStress:
    """A plane that is as rough as can be."""
    shots, demands = _furnace(studio, 1.0)
    more, others = _highlight(studio, 1.0, len(shots))
    return RelightStress(shots=shots + more, demands=demands + others)


@relighting_case(
    "firefly environment",
    "few samples find the texel: black images with white dots",
    "the mean right, and little noise",
)
def hot_texel(studio: RelightStudio) -> RelightStress:
    """One texel of 5e4 in a dim sky, over a white plane."""
    camera = studio.at_plane(40.0)
    view = camera.position / np.linalg.norm(camera.position)
    matt, gloss = sky_closed_form(firefly(), view, 1.0)
    whole = matt + gloss
    count = studio.samples

    def radiance(drawn: Drawn) -> NDArray[np.float64]:
        image = drawn.images[0]
        return image.rgb[..., 1].astype(np.float64) / np.maximum(image.alpha, 1e-12) / whole

    return RelightStress(
        shots=(Shot(cloud=studio.plane(), camera=camera, environment=firefly()),),
        demands=(
            Demand(
                what="mean, of the closed form",
                measure=lambda drawn: float(radiance(drawn).mean()),
                low=0.99,
                high=1.01,
                because="a quadrature over 256 parts of every texel; 1 % as for the furnace",
                of=(PATH,),
            ),
            Demand(
                what="mean, of the closed form",
                measure=lambda drawn: float(radiance(drawn).mean()),
                low=(matt * (1.0 - FURNACE)) / whole,
                high=(matt * (1.0 + FURNACE) + 2.0 * gloss) / whole,
                because="the split sum may misplace all of the gloss, and none of the diffuse part",
                of=(DEFERRED,),
            ),
            Demand(
                what="spread over pixels, of the mean",
                measure=lambda drawn: float(radiance(drawn).std() / radiance(drawn).mean()),
                high=1.0 / np.sqrt(count),
                because=f"drawn by radiance times cosine, one sample has no more than its mean: 1/√{count}",
            ),
            Demand(
                what="brightest pixel, of the closed form",
                measure=lambda drawn: float(radiance(drawn).max()),
                high=1.0 + LARGEST_OF_PIXELS / np.sqrt(count),
                because=f"{LARGEST_OF_PIXELS:g} of those spreads above the mean",
            ),
        ),
    )


@relighting_case(
    "black and missing environment", "0 / 0 in tables of where light comes from", "black, coverage as ever"
)
def no_light(studio: RelightStudio) -> RelightStress:
    """Even light, a black map, and none."""
    cloud, camera = studio.ball(), studio.at_ball()
    return RelightStress(
        shots=tuple(Shot(cloud=cloud, camera=camera, environment=light) for light in (white(), white(0.0), None)),
        noisy=False,
        demands=(
            Demand(
                what="brightest value without light",
                measure=lambda drawn: float(max(image.rgb.max() for image in drawn.images[1:])),
                high=0.0,
                because="no light, none reflected: closed form",
            ),
            Demand(
                what="difference of coverage",
                measure=lambda drawn: float(
                    max(np.abs(image.alpha - drawn.images[0].alpha).max() for image in drawn.images[1:])
                ),
                high=0.0,
                because="what is seen does not depend on light",
            ),
        ),
    )


@relighting_case("empty frame", "arrays of no length, a tree over nothing", "nothing; the floor that is there as ever")
def empty_frame(studio: RelightStudio) -> RelightStress:
    """No Gaussians: alone, and over a floor of triangles."""
    cloud, camera = _nothing(studio), studio.at_plane(45.0)
    light: dict[str, Any] = {"environment": white(), "lights": (sun_at(45.0, 0.0),)}
    return RelightStress(
        shots=tuple(Shot(cloud=cloud, camera=camera, mesh=mesh, **light) for mesh in (None, _square(3.0))),
        demands=(
            Demand(
                what="coverage of nothing",
                measure=lambda drawn: float(max(drawn.images[0].alpha.max(), drawn.images[0].rgb.max())),
                high=0.0,
                because="closed form",
            ),
            Demand(
                what="the white floor under even light",
                measure=lambda drawn: brightness(drawn.images[1]),
                low=1.0 - FURNACE,
                high=1.0 + FURNACE,
                because="1, as for the furnace",
            ),
        ),
    )


@relighting_case(
    "camera inside Gaussians", "splats of infinite size, rays that start in what they hit", "finite, no light made"
)
def camera_inside(studio: RelightStudio) -> RelightStress:
    """A camera in the middle of a ball, within a round Gaussian, under even light."""
    round_one = _sheet((0.0, 0.0, 0.0), 0.15, 0.5).with_arrays(scales=np.full((1, 3), 0.15, np.float32))
    cloud = _together(studio.ball(), _relightable(round_one))
    camera = Camera.look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.2), width=studio.size, height=studio.size, vertical_fov=80.0)
    return RelightStress(
        shots=(Shot(cloud=cloud, camera=camera, environment=white()),),
        demands=(
            Demand(
                what="mean radiance, of the light around",
                measure=lambda drawn: float(drawn.images[0].rgb.mean()),
                high=1.0 + FURNACE,
                because="nothing is brighter than the furnace",
            ),
            Demand(
                what="coverage",
                measure=lambda drawn: float(drawn.images[0].alpha.mean()),
                low=0.95,
                high=1.0,
                because="even amid four tiles, where most is let through, a layer stops 0.95",
            ),
        ),
    )


@relighting_case(
    "frames of different counts",
    "what was kept of the frame before: wrong sizes, old shadows",
    "as drawn alone, same bits",
)
def different_counts(studio: RelightStudio) -> RelightStress:
    """One renderer draws many Gaussians, few, none, and the first again."""
    many, few = studio.ball(base_color=0.7), studio.ball(base_color=0.4, spacing=2.0 * studio.spacing)
    light: dict[str, Any] = {"environment": firefly(), "lights": (sun_at(40.0),)}
    shots = tuple(Shot(cloud=cloud, camera=studio.at_ball(), **light) for cloud in (many, few, _nothing(studio), many))
    return RelightStress(
        shots=shots,
        noisy=False,
        demands=(
            Demand(
                what="largest difference from drawn alone",
                measure=lambda drawn: max(map(largest_difference, drawn.images, drawn.alone)),
                high=0.0,
                because="same input, same bits",
            ),
        ),
    )


@relighting_case("10⁶ Gaussians", "memory, indices of 16 bits, minutes", "the furnace of a ball", large=True)
def million(studio: RelightStudio) -> RelightStress:
    """A ball of a million Gaussians under even light."""
    cloud = studio.ball(spacing=float(np.sqrt(4.0 * np.pi * RADIUS**2 / 1e6)))
    return RelightStress(
        shots=(Shot(cloud=cloud, camera=studio.at_ball(), environment=white()),),
        demands=(
            Demand(
                what="white ball under even light",
                measure=lambda drawn: brightness(drawn.images[0]),
                low=0.95,
                high=1.0 + FURNACE,
                because="1 for a convex body; between tiles, light that goes to neighbours and is not followed: 5 %",
            ),
        ),
    )


@relighting_case(
    "normals that all face away",
    "negative cosines: black, negative or infinite",
    "finite, no light made, coverage as ever",
)
def turned_normals(studio: RelightStudio) -> RelightStress:
    """The ball as it is, and with every normal turned inwards, under even light."""
    cloud = studio.ball()
    assert cloud.normals is not None
    inside_out = cloud.with_arrays(normals=-cloud.normals)
    return RelightStress(
        shots=tuple(Shot(cloud=c, camera=studio.at_ball(), environment=white()) for c in (cloud, inside_out)),
        demands=(
            Demand(
                what="brightness, of the light around",
                measure=lambda drawn: brightness(drawn.images[1]),
                high=1.0 + FURNACE,
                because="between black and the furnace",
            ),
            Demand(
                what="difference of coverage",
                measure=lambda drawn: float(np.abs(drawn.images[0].alpha - drawn.images[1].alpha).max()),
                high=ROUNDING,
                because="what covers does not depend on normals",
            ),
        ),
    )


@relighting_case(
    "a leaking front before a dark inside", "the inside shines through: surfaces look dirty", "the front's own colour"
)
def leaking_front(studio: RelightStudio) -> RelightStress:
    """A layer of opacity 0.5 of colour 0.8, and five of its sizes behind it one of 0.1 that faces away."""
    front = _relightable(_sheet((0.0, 0.0, 0.5), 0.1, 0.5), 0.8)
    back = _relightable(_sheet((0.0, 0.0, 0.0), 3.0, 0.99, up=False), 0.1)
    sun = DirectionalLight(direction=(0.0, 0.0, -1.0), irradiance=(3.0, 3.0, 3.0), angular_diameter=0.0)
    side = max(studio.size // 4, 4)
    camera = Camera.look_at((0.01, 0.0, 2.5), (0.0, 0.0, 0.5), width=side, height=side, vertical_fov=0.5)
    up = np.array([0.0, 0.0, 1.0])
    expected = 3.0 * (diffuse(up, 0.8, 1.0) + float(scattered(up, up, up, 1.0)))
    return RelightStress(
        shots=(Shot(cloud=_together(front, back), camera=camera, lights=(sun,)),),
        demands=(
            Demand(
                what="radiance, of the front's own",
                measure=lambda drawn: brightness(drawn.images[0]) / expected,
                low=0.98,
                high=1.02,
                because="E (ρ (1 - E_spec) / π + f): closed form; of alpha 0.995, 1 % may be the inside's",
            ),
        ),
    )


@relighting_case(
    "shadow catcher far from everything", "0 / 0 where no light is missing: grey ground", "nothing seen of it"
)
def far_catcher(studio: RelightStudio) -> RelightStress:
    """A catcher 30 m from a ball, under a sky and a sun."""
    middle = np.array([30.0, 0.0, -RADIUS])
    side = max(studio.size // 4, 4)
    camera = Camera.look_at(middle + np.array([0.0, -2.0, 1.0]), middle, width=side, height=side, vertical_fov=20.0)
    return RelightStress(
        shots=(
            Shot(
                cloud=studio.ball(),
                camera=camera,
                environment=white(0.5),
                lights=(sun_at(60.0),),
                mesh=_square(60.0, (0.0, 0.0, -RADIUS), catches=True),
            ),
        ),
        demands=(
            Demand(
                what="alpha of the shadow",
                measure=lambda drawn: float(drawn.images[0].alpha.max()),
                high=0.01,
                because="the ball hides (r/d)² of the sky and nothing of the sun: 3e-4, less times its height",
            ),
            Demand(
                what="radiance of the catcher",
                measure=lambda drawn: float(drawn.images[0].rgb.max()),
                high=0.0,
                because="it is not seen",
            ),
        ),
    )


@relighting_case(
    "shadow catcher under grazing light",
    "the catcher shadows itself, or loses the shadow's foot",
    "the wall's shadow, sharp",
)
def grazing_catcher(studio: RelightStudio) -> RelightStress:
    """The wall on a catcher, a sun of 10 degrees and nothing else."""
    camera = studio.from_above()
    expected, judged = _wall_shadow(studio, camera, _wall_seen(studio))
    wall = _relightable(tile(studio.wall()), 0.8)
    return RelightStress(
        shots=(Shot(cloud=wall, camera=camera, lights=(sun_at(GRAZING),), mesh=_square(5.0, catches=True)),),
        demands=tuple(
            Demand(
                what=what,
                measure=lambda drawn, lit=lit: wrong_parts(drawn.images[0].alpha > 0.5, expected, judged)[lit],
                high=WRONG_PART,
                because="height / tan 10° long: closed form, 1 px and half a Gaussian from edges",
            )
            for lit, what in enumerate(("falsely shadowed", "falsely lit"))
        ),
    )


@relighting_case(
    "a frame with rows of NaN", "one NaN makes every bound, and so the image, NaN", "as without them, same bits"
)
def broken_rows(studio: RelightStudio) -> RelightStress:
    """The ball with 10 rows of NaN among its own, left out as reading does."""
    cloud, camera = studio.ball(base_color=0.6), studio.at_ball()
    arrays = cloud.arrays()
    rows = np.linspace(0, len(cloud) - 1, 10).astype(np.int64)
    broken = {name: np.insert(array, rows, array[rows], axis=0) for name, array in arrays.items()}
    broken["positions"][rows + np.arange(10)] = np.nan
    kept, left_out = GaussianCloud.leaving_out_invalid(**broken)
    light: dict[str, Any] = {"environment": white(), "lights": (sun_at(40.0),)}
    return RelightStress(
        shots=tuple(Shot(cloud=c, camera=camera, **light) for c in (cloud, kept)),
        noisy=False,
        demands=(
            Demand(
                what="largest difference",
                measure=lambda drawn: largest_difference(drawn.images[1], drawn.images[0]),
                high=0.0,
                because="the same rows, the same bits",
            ),
        ),
        done=f"{left_out.not_finite} rows left out",
    )


@relighting_case("environment turned by 360°", "a jump in a turntable's last frame", "as not turned at all")
def full_turn(studio: RelightStudio) -> RelightStress:
    """A sky with one hot texel, as it is and turned once around."""
    cloud, camera = studio.ball(base_color=0.6, roughness=0.3), studio.at_ball()
    return RelightStress(
        shots=tuple(
            Shot(cloud=cloud, camera=camera, environment=firefly(), environment_rotation=turn) for turn in (0.0, 360.0)
        ),
        noisy=False,
        demands=(
            Demand(
                what="largest difference",
                measure=lambda drawn: largest_difference(drawn.images[1], drawn.images[0]),
                high=0.0,
                because="the sine of 360° is below float32's resolution of 1: same bits",
                of=(PATH,),
            ),
            Demand(
                what="largest difference",
                measure=lambda drawn: largest_difference(drawn.images[1], drawn.images[0]),
                high=ROUNDING,
                because="a thousand roundings",
                of=(DEFERRED,),
            ),
        ),
    )
