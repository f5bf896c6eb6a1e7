"""Axis codes, which state where x, y and z point, and the conversion of clouds between them.

An axis code names, in turn, where x, y and z point: ``r``/``l`` right or left, ``u``/``d`` up or down, ``f``/``b``
forward or back. Thus ``rdf`` is COLMAP and the usual 3DGS PLY, ``rub`` USD and glTF with y up, ``rfu`` our own world
and USD with z up, ``ruf`` Unity (left-handed) and ``fru`` Unreal (left-handed).
"""

from __future__ import annotations

from itertools import permutations
from itertools import product as cartesian
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_number
from beam_warp.errors import InvalidOptionError
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import sh_transform
from beam_warp.world.quaternions import product, quaternion_of

_DIRECTIONS = {
    "r": (1.0, 0.0, 0.0),
    "l": (-1.0, 0.0, 0.0),
    "u": (0.0, 1.0, 0.0),
    "d": (0.0, -1.0, 0.0),
    "f": (0.0, 0.0, 1.0),
    "b": (0.0, 0.0, -1.0),
}
"""Each letter's direction in the reference frame (right, up, forward), which is itself left-handed."""

AXIS_CODES = tuple("".join(code) for pairs in permutations(("rl", "ud", "fb")) for code in cartesian(*pairs))
"""All 48 codes."""


def require_axes(name: str, code: str) -> str:
    """Return an axis code after checking it.

    Raises:
        InvalidOptionError: The code is not one letter of each pair r/l, u/d, f/b.
    """
    if code not in AXIS_CODES:
        raise InvalidOptionError(
            f"{name} must be three letters, one each of r/l, u/d and f/b, got {code!r}. "
            "Say where x, y and z point, e.g. rdf (right, down, forward) for a usual 3DGS PLY."
        )
    return code


def _frame(code: str) -> NDArray[np.float64]:
    """Return the axes of a code as columns in the reference frame."""
    return np.array([_DIRECTIONS[letter] for letter in require_axes("axes", code)]).T


def axes_matrix(source: str, target: str) -> NDArray[np.float64]:
    """Return the signed permutation M with ``v_target = M @ v_source``, ``(3, 3)`` float64.

    Raises:
        InvalidOptionError: A code is no axis code.
    """
    return _frame(target).T @ _frame(source)


def handedness(code: str) -> Literal["left", "right"]:
    """Return which hand the axes follow."""
    return "left" if np.linalg.det(_frame(code)) > 0.0 else "right"


def _flip_and_rotation(matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Factor M = F P: a flip F of at most one axis (its diagonal) after a proper rotation P.

    Any axis would do, for an ellipsoid equals its mirror image in its own planes. The one that leaves the smallest
    rotation is taken, so that a pure mirror map turns nothing.
    """
    if np.linalg.det(matrix) > 0.0:
        return np.ones(3), matrix
    flips = 1.0 - 2.0 * np.eye(3)
    flip = max(flips, key=lambda diagonal: float(diagonal @ np.diag(matrix)))
    return flip, flip[:, None] * matrix


def change_axes(cloud: GaussianCloud, target: str, *, scale: float = 1.0) -> GaussianCloud:
    """Express a cloud in other axes, and in other units if a consumer wants them.

    M maps the cloud's axes to the target's and is factored into a rotation P and a flip F of at most one axis,
    M = F P. Positions become ``scale`` M p, normals M n. An orientation becomes q_P q and is then flipped,
    (w, v) -> (w, det(F) F v): its matrix F (P R) F is again a proper rotation, and with unpermuted scales S it has
    the covariance M (R S^2 R^T) M^T, because F commutes with the diagonal S. Spherical harmonics are carried by
    `sh_transform`, so a Gaussian shows the same colour from the corresponding direction.

    Args:
        cloud: Gaussians in ``cloud.axes``.
        target: Axis code to express them in.
        scale: Target units per metre: 100 for centimetres. In memory a cloud is in metres; only a writer asks for
            another unit, for the file that it is about to write.

    Returns:
        A new cloud whose ``axes`` is ``target``; the cloud itself if there is nothing to do.

    Raises:
        InvalidOptionError: An axis code or ``scale`` is not one.
    """
    require_number("scale", scale, 1e-6, 1e6)
    matrix = axes_matrix(require_axes("cloud.axes", cloud.axes), require_axes("target", target))
    if target == cloud.axes and scale == 1.0:
        return cloud
    changes = {
        "positions": (cloud.positions @ matrix.T * scale).astype(np.float32),
        "scales": (cloud.scales.astype(np.float64) * scale).astype(np.float32),
        "axes": target,
    }
    if target != cloud.axes:
        flip, rotation = _flip_and_rotation(matrix)
        orientations = product(quaternion_of(rotation), cloud.orientations.astype(np.float64))
        orientations[:, :3] *= np.prod(flip) * flip
        changes["orientations"] = orientations.astype(np.float32)
        if cloud.normals is not None:
            changes["normals"] = (cloud.normals @ matrix.T).astype(np.float32)
        if cloud.radiance is not None and cloud.sh_degree:
            # Rounding removes the solver's 1e-16 beside the exact 0 and ±1 of a flip, so that flips stay bit-exact.
            transform = np.round(sh_transform(matrix, cloud.sh_degree), 14)
            changes["radiance"] = np.einsum("jk,nkc->njc", transform, cloud.radiance, optimize=True)
    return cloud.with_arrays(**changes)
