"""Random Gaussians with captured radiance, and with materials on request, for tests of what keeps every channel."""

import numpy as np
from support.shapes import unit

from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.world.gaussians import GaussianCloud


def radiant_cloud(count=50, degree=3, *, materials=False, seed=1, **changes):
    """A random cloud; unit vectors are unit to float32 rounding."""
    rng = np.random.default_rng(seed)
    fields = {
        "positions": rng.normal(size=(count, 3)),
        "orientations": unit(rng.normal(size=(count, 4))),
        "scales": np.exp(rng.uniform(-8.0, 0.0, (count, 3))),
        "opacities": rng.uniform(0.01, 0.99, count),
        "radiance": rng.normal(size=(count, (degree + 1) ** 2, 3)),
        "radiance_color_space": DISPLAY_SRGB,
        "axes": "rfu",
    }
    if materials:
        fields |= {
            "base_color": rng.uniform(size=(count, 3)),
            "roughness": rng.uniform(size=count),
            "ambient_occlusion": rng.uniform(size=count),
            "normals": unit(rng.normal(size=(count, 3))),
        }
    return GaussianCloud(**fields | changes)
