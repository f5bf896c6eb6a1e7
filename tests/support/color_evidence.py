"""Evidence on base colour from numbers."""

import numpy as np

from beam_warp.materials.direct import ColorEvidence

VECTORS = ("numerator", "denominator", "observed", "irradiance", "misfit")
MEASURED = {
    "irradiance": 1.0,
    "openness": 1.0,
    "noise": 0.0,
    "misfit": 0.0,
    "facing": 1.0,
    "saturated": 0.0,
    "unseen": 0.0,
}


def color_evidence(count, **given):
    """One frame of Gaussians, whose arrays may be changed; what is not given is lit, seen, faced and free of noise."""
    arrays = {name: np.asarray(value, np.float64) for name, value in (MEASURED | given).items()}
    shapes = {name: (count, 3) if name in VECTORS else (count,) for name in arrays}
    return ColorEvidence(**{name: np.broadcast_to(array, shapes[name]).copy() for name, array in arrays.items()})
