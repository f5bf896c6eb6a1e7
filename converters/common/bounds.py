"""How far arrays may be from their originals where a take is to be small: in containers, and between keys of assets."""

from __future__ import annotations

import numpy as np

from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0


def bounds_of(cloud: GaussianCloud, factor: float = 1.0) -> dict[str, float]:
    """Return how far each array may be from its original.

    Positions, normals and occlusion, which take most of the space, change relit images about equally by their bounds.
    Positions have the finest: where they move by the thickness of Gaussians, others come to lie in front. A standard
    error has the bound of what it is the error of. Radiance that was not captured stands in for what occlusion shades:
    a white surface may look as much brighter as occlusion may be off.

    Positions are in metres: a part of the width of the median Gaussian. Scales are relative, rotations and normals are
    angles [rad], and all others are differences.

    Args:
        cloud: A frame of the take.
        factor: Multiplies all bounds.
    """
    width = float(np.median(np.sort(cloud.scales, axis=1)[:, 1])) if len(cloud) else 0.0
    bounds = {
        "positions": 0.05 * max(width, 1e-6),
        "orientations": 0.02,
        "scales": 0.02,
        "opacities": 0.01,
        "base_color": 0.005,
        "roughness": 0.02,
        "ambient_occlusion": 0.03,
        "normals": 0.06,
        "radiance": 0.01,
    }
    errors = {f"{name}_error": bounds[name] for name in ("base_color", "roughness", "ambient_occlusion")}
    bounds |= {**errors, "normal_confidence": bounds["ambient_occlusion"]}
    if cloud.radiance is None:
        bounds["radiance"] = bounds["ambient_occlusion"] / SH_C0
    return {name: factor * bound for name, bound in bounds.items()}
