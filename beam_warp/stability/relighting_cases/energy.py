"""Light that must be neither lost nor made: materials at their ends, a hot texel, and no light at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from beam_warp.stability.relighting_cases.cases import DEFERRED, PATH, Demand, Drawn, RelightStress
from beam_warp.stability.relighting_cases.measures import (
    FURNACE,
    brightness,
    disc_directions,
    scattered,
    sky_closed_form,
)
from beam_warp.stability.relighting_cases.scenes import RelightStudio, firefly, white
from beam_warp.stability.suite import stability_case
from beam_warp.world.lights import SUN_DIAMETER, DirectionalLight
from beam_warp.world.shot import Shot

LARGEST_OF_PIXELS = 6.0
"""Standard deviations by which no pixel of a small image lies above the mean."""


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


@stability_case("roughness 0.03", "D overflows, lobes miss the sun: fireflies or nothing", "energy, and highlights")
def nearly_mirror(studio: RelightStudio) -> RelightStress:
    """A plane that is almost a mirror."""
    shots, demands = _furnace(studio, 0.03)
    more, others = _highlight(studio, 0.03, len(shots))
    return RelightStress(shots=shots + more, demands=demands + others)


@stability_case("roughness 1", "the widest lobe loses energy at grazing", "energy, and highlights")
def fully_rough(studio: RelightStudio) -> RelightStress:
    """A plane that is as rough as can be."""
    shots, demands = _furnace(studio, 1.0)
    more, others = _highlight(studio, 1.0, len(shots))
    return RelightStress(shots=shots + more, demands=demands + others)


@stability_case(
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


@stability_case("black and missing environment", "0 / 0 in tables of where light comes from", "black, coverage as ever")
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
