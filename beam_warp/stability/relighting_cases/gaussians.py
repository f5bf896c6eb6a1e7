"""Gaussians that few expect: none, around the camera, of another number, a million, turned, and leaking."""

from __future__ import annotations

from typing import Any

import numpy as np

from beam_warp.stability.relighting_cases.cases import Demand, RelightStress
from beam_warp.stability.relighting_cases.measures import (
    FURNACE,
    ROUNDING,
    brightness,
    diffuse,
    largest_difference,
    scattered,
)
from beam_warp.stability.relighting_cases.scenes import (
    RADIUS,
    RelightStudio,
    firefly,
    nothing,
    relightable,
    sheet,
    square,
    sun_at,
    white,
)
from beam_warp.stability.suite import stability_case, together
from beam_warp.world.camera import Camera
from beam_warp.world.lights import DirectionalLight
from beam_warp.world.shot import Shot


@stability_case("empty frame", "arrays of no length, a tree over nothing", "nothing; the floor that is there as ever")
def empty_frame(studio: RelightStudio) -> RelightStress:
    """No Gaussians: alone, and over a floor of triangles."""
    cloud, camera = nothing(studio), studio.at_plane(45.0)
    light: dict[str, Any] = {"environment": white(), "lights": (sun_at(45.0, 0.0),)}
    return RelightStress(
        shots=tuple(Shot(cloud=cloud, camera=camera, mesh=mesh, **light) for mesh in (None, square(3.0))),
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


@stability_case(
    "camera inside Gaussians", "splats of infinite size, rays that start in what they hit", "finite, no light made"
)
def camera_inside(studio: RelightStudio) -> RelightStress:
    """A camera in the middle of a ball, within a round Gaussian, under even light."""
    round_one = sheet((0.0, 0.0, 0.0), 0.15, 0.5).with_arrays(scales=np.full((1, 3), 0.15, np.float32))
    cloud = together(studio.ball(), relightable(round_one))
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


@stability_case(
    "frames of different counts",
    "what was kept of the frame before: wrong sizes, old shadows",
    "as drawn alone, same bits",
)
def different_counts(studio: RelightStudio) -> RelightStress:
    """One renderer draws many Gaussians, few, none, and the first again."""
    many, few = studio.ball(base_color=0.7), studio.ball(base_color=0.4, spacing=2.0 * studio.spacing)
    light: dict[str, Any] = {"environment": firefly(), "lights": (sun_at(40.0),)}
    shots = tuple(Shot(cloud=cloud, camera=studio.at_ball(), **light) for cloud in (many, few, nothing(studio), many))
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


@stability_case("10⁶ Gaussians", "memory, indices of 16 bits, minutes", "the furnace of a ball", large=True)
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


@stability_case(
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


@stability_case(
    "a leaking front before a dark inside", "the inside shines through: surfaces look dirty", "the front's own colour"
)
def leaking_front(studio: RelightStudio) -> RelightStress:
    """A layer of opacity 0.5 of colour 0.8, and five of its sizes behind it one of 0.1 that faces away."""
    front = relightable(sheet((0.0, 0.0, 0.5), 0.1, 0.5), 0.8)
    back = relightable(sheet((0.0, 0.0, 0.0), 3.0, 0.99, up=False), 0.1)
    sun = DirectionalLight(direction=(0.0, 0.0, -1.0), irradiance=(3.0, 3.0, 3.0), angular_diameter=0.0)
    side = max(studio.size // 4, 4)
    camera = Camera.look_at((0.01, 0.0, 2.5), (0.0, 0.0, 0.5), width=side, height=side, vertical_fov=0.5)
    up = np.array([0.0, 0.0, 1.0])
    expected = 3.0 * (diffuse(up, 0.8, 1.0) + float(scattered(up, up, up, 1.0)))
    return RelightStress(
        shots=(Shot(cloud=together(front, back), camera=camera, lights=(sun,)),),
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
