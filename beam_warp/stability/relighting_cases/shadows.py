"""Lamps in and on the subject, and a sun at grazing incidence: shadows that leak, or fall on what casts them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from beam_warp.stability.relighting_cases.cases import DEFERRED, Demand, Drawn, RelightStress, shadow_demands
from beam_warp.stability.relighting_cases.measures import (
    ROUNDING,
    WRONG_PART,
    arriving_part,
    brightness,
    diffuse,
    floor_points,
    scattered,
    wall_seen,
    wall_shadow,
    wrong_parts,
)
from beam_warp.stability.relighting_cases.scenes import ACNE, GRAZING, RADIUS, THICKNESS, WALL, RelightStudio, sun_at
from beam_warp.stability.suite import stability_case
from beam_warp.world.lights import PointLight
from beam_warp.world.shapes import TiledSurface
from beam_warp.world.shot import Shot


@stability_case(
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


@stability_case(
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


@stability_case("sun at grazing incidence, bare floor", "acne: Gaussians shadow themselves", "no pixel of it in shadow")
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
            Demand(what="falsely shadowed", measure=dark, high=0.0, because="a level floor is open: closed form"),
            Demand(
                what="light that arrives, of all",
                measure=lambda drawn: float(arriving_part(*drawn.images)[inside].mean()),
                low=0.98,
                high=1.0 + ROUNDING,
                because="1; Gaussians whose edges rise above the mean height may take 2 %",
            ),
        ),
    )


def _behind(studio: RelightStudio, wall: tuple[TiledSurface, ...]) -> RelightStress:
    """Return a sun of 10 degrees, and a wall of 15 cm on the floor: its shadow is 85 cm long."""
    cloud, camera, sun = studio.floor(wall), studio.from_above(), sun_at(GRAZING)
    expected, judged = wall_shadow(studio, camera, studio.spacing)
    by_form = shadow_demands(lambda drawn: arriving_part(*drawn.images) < 0.5, expected, judged)
    by_paths = tuple(
        Demand(
            what=f"{demand.what}, by paths",
            measure=lambda drawn, lit=lit: _wrong_by_reference(drawn, bool(lit)),
            high=WRONG_PART,
            because="of pixels that the reference has lit or shadowed by 3/4, 1 px from edges",
            of=(DEFERRED,),
        )
        for lit, demand in enumerate(by_form)
    )
    place, height, half = WALL
    points = floor_points(camera)
    behind = points[..., 0] - place
    middle = (behind > wall_seen(studio)) & (behind < 0.5 * height / np.tan(np.radians(GRAZING)))
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


@stability_case(
    "sun at grazing incidence, a wall",
    "a bias that hides acne takes the shadow off the wall's foot (peter-panning)",
    "shadows where they are, to a pixel",
)
def peter_panning(studio: RelightStudio) -> RelightStress:
    """A wall of two sides."""
    return _behind(studio, studio.wall())


@stability_case(
    "sun at grazing incidence, a sheet",
    "a layer that faces the sun is lit from its front when it is seen from behind, and lights what is in its shadow",
    "shadows where they are, to a pixel",
)
def single_layer(studio: RelightStudio) -> RelightStress:
    """The wall's shadow, of a single layer of Gaussians whose normals face the sun."""
    front, _ = studio.wall()
    return _behind(studio, (replace(front, points=front.points + np.array([THICKNESS, 0.0, 0.0])),))
