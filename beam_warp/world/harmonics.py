"""Real spherical harmonics in the basis and sign convention of 3DGS: evaluate, and rotate.

3DGS stores, for band l, the orders m = -l … l in turn, with the signs of the reference implementation of
Kerbl et al. 2023 (Condon–Shortley phase kept in the polynomials below). Plain NumPy float64 inside.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.world.directions import even_directions

SH_C0 = 0.28209479177387814
"""Y_0 = 1 / (2 sqrt(pi)); a DC coefficient c shows the colour 0.5 + SH_C0 c."""


def sh_basis(directions: ArrayLike, degree: int) -> NDArray[np.float64]:
    """Evaluate the basis.

    Args:
        directions: Unit vectors, ``(..., 3)``.
        degree: 0 to 4.

    Returns:
        ``(..., (degree + 1)^2)`` float64.
    """
    d = np.asarray(directions, dtype=np.float64)
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    xx, yy, zz = x * x, y * y, z * z
    terms = [np.full_like(x, SH_C0)]
    if degree >= 1:
        c1 = np.sqrt(3.0 / (4.0 * np.pi))
        terms += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        c = np.sqrt(15.0 / (4.0 * np.pi))
        terms += [
            c * x * y,
            -c * y * z,
            np.sqrt(5.0 / (16.0 * np.pi)) * (2.0 * zz - xx - yy),
            -c * x * z,
            0.5 * c * (xx - yy),
        ]
    if degree >= 3:
        c35, c105, c21 = np.sqrt(35.0 / (32.0 * np.pi)), np.sqrt(105.0 / (4.0 * np.pi)), np.sqrt(21.0 / (32.0 * np.pi))
        terms += [
            -c35 * y * (3.0 * xx - yy),
            c105 * x * y * z,
            -c21 * y * (4.0 * zz - xx - yy),
            np.sqrt(7.0 / (16.0 * np.pi)) * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -c21 * x * (4.0 * zz - xx - yy),
            0.5 * c105 * z * (xx - yy),
            -c35 * x * (xx - 3.0 * yy),
        ]
    if degree >= 4:
        terms += [
            0.75 * np.sqrt(35.0 / np.pi) * x * y * (xx - yy),
            -0.75 * np.sqrt(35.0 / (2.0 * np.pi)) * y * z * (3.0 * xx - yy),
            0.75 * np.sqrt(5.0 / np.pi) * x * y * (7.0 * zz - 1.0),
            -0.75 * np.sqrt(5.0 / (2.0 * np.pi)) * y * z * (7.0 * zz - 3.0),
            0.1875 / np.sqrt(np.pi) * (35.0 * zz * zz - 30.0 * zz + 3.0),
            -0.75 * np.sqrt(5.0 / (2.0 * np.pi)) * x * z * (7.0 * zz - 3.0),
            0.375 * np.sqrt(5.0 / np.pi) * (xx - yy) * (7.0 * zz - 1.0),
            -0.75 * np.sqrt(35.0 / (2.0 * np.pi)) * x * z * (xx - 3.0 * yy),
            0.1875 * np.sqrt(35.0 / np.pi) * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)),
        ]
    return np.stack(terms, axis=-1)


def sh_transform(linear: ArrayLike, degree: int) -> NDArray[np.float64]:
    """Return the matrix that carries coefficients along when the scene is turned or mirrored.

    If g(d) = f(M^T d) for an orthogonal M, then ``coefficients(g) = sh_transform(M, degree) @ coefficients(f)``.
    The basis is evaluated in more directions than it has terms, and the consistent, well-conditioned linear system is
    solved. This is exact to rounding for every orthogonal M, flips included, and needs no Wigner recursion.

    Args:
        linear: Orthogonal ``(3, 3)``.
        degree: 0 to 4.

    Returns:
        ``((degree + 1)^2, (degree + 1)^2)`` float64, block diagonal by band.
    """
    matrix = np.asarray(linear, dtype=np.float64)
    directions = even_directions(64)  # even, so the system is well conditioned
    count = (degree + 1) ** 2
    transform = np.zeros((count, count))
    here, there = sh_basis(directions, degree), sh_basis(directions @ matrix, degree)  # row d M = (M^T d)^T
    for band in range(degree + 1):
        block = slice(band * band, (band + 1) ** 2)
        transform[block, block] = np.linalg.lstsq(here[:, block], there[:, block], rcond=None)[0]
    return transform
