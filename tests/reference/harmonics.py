"""Colour of spherical harmonics in float64, as viewers show it."""

import numpy as np

from beam_warp.world.harmonics import sh_basis


def sh_color(radiance, directions):
    """Colour clamped at 0, ``(N, 3)``, in the colour space of coefficients ``(N, K, 3)``.

    Directions are unit vectors from the camera to each Gaussian, ``(N, 3)``, or one ``(3,)`` for all.
    """
    coefficients = np.asarray(radiance, dtype=np.float64)
    basis = sh_basis(directions, round(np.sqrt(coefficients.shape[1])) - 1)
    return np.maximum(0.5 + np.einsum("...k,nkc->nc" if basis.ndim == 1 else "nk,nkc->nc", basis, coefficients), 0.0)
