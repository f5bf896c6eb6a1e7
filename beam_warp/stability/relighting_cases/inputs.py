"""Input that was mended or is the same in disguise: rows of NaN, and a full turn."""

from __future__ import annotations

from typing import Any

import numpy as np

from beam_warp.stability.relighting_cases.cases import DEFERRED, PATH, RENDERERS, Demand, RelightStress
from beam_warp.stability.relighting_cases.measures import ROUNDING, largest_difference
from beam_warp.stability.relighting_cases.scenes import RelightStudio, firefly, sun_at, white
from beam_warp.stability.suite import stability_case
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.shot import Shot


@stability_case(
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
        demands=(_same_images(0.0, "the same rows, the same bits"),),
        done=f"{left_out.not_finite} rows left out",
    )


@stability_case("environment turned by 360°", "a jump in a turntable's last frame", "as not turned at all")
def full_turn(studio: RelightStudio) -> RelightStress:
    """A sky with one hot texel, as it is and turned once around."""
    cloud, camera = studio.ball(base_color=0.6, roughness=0.3), studio.at_ball()
    return RelightStress(
        shots=tuple(
            Shot(cloud=cloud, camera=camera, environment=firefly(), environment_rotation=turn) for turn in (0.0, 360.0)
        ),
        noisy=False,
        demands=(
            _same_images(0.0, "the sine of 360° is below float32's resolution of 1: same bits", of=(PATH,)),
            _same_images(ROUNDING, "a thousand roundings", of=(DEFERRED,)),
        ),
    )


def _same_images(high: float, because: str, of: tuple[str, ...] = RENDERERS) -> Demand:
    """Demand that two shots give the same image."""
    return Demand(
        what="largest difference",
        measure=lambda drawn: largest_difference(drawn.images[1], drawn.images[0]),
        high=high,
        because=because,
        of=of,
    )
