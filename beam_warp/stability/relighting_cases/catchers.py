"""Shadow catchers."""

from __future__ import annotations

import numpy as np

from beam_warp.stability.relighting_cases.cases import Demand, RelightStress, shadow_demands
from beam_warp.stability.relighting_cases.measures import wall_seen, wall_shadow
from beam_warp.stability.relighting_cases.scenes import (
    GRAZING,
    RADIUS,
    RelightStudio,
    relightable,
    square,
    sun_at,
    white,
)
from beam_warp.stability.suite import stability_case
from beam_warp.world.camera import Camera
from beam_warp.world.shapes import tile
from beam_warp.world.shot import Shot


@stability_case(
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
                mesh=square(60.0, (0.0, 0.0, -RADIUS), catches=True),
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


@stability_case(
    "shadow catcher under grazing light",
    "the catcher shadows itself, or loses the shadow's foot",
    "the wall's shadow, sharp",
)
def grazing_catcher(studio: RelightStudio) -> RelightStress:
    """The wall on a catcher, a sun of 10 degrees and nothing else."""
    camera = studio.from_above()
    expected, judged = wall_shadow(studio, camera, wall_seen(studio))
    wall = relightable(tile(studio.wall()), 0.8)
    return RelightStress(
        shots=(Shot(cloud=wall, camera=camera, lights=(sun_at(GRAZING),), mesh=square(5.0, catches=True)),),
        demands=shadow_demands(lambda drawn: drawn.images[0].alpha > 0.5, expected, judged),
    )
