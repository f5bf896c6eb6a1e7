"""The specular lobe in float64: GGX with height-correlated Smith masking, its directional albedo as a table.

Perceptual roughness r maps to alpha = r². With F = F0 + (1 - F0)(1 - v·h)^5 the directional albedo (the share of
uniform light that is reflected specularly) splits into E(n·v, r) = F0 A + B. The table is integrated, not fitted: the
usual analytic fits are off by up to a factor of four at grazing angles on rough surfaces.

Sources: Walter et al. 2007 (GGX); Heitz 2014 (height-correlated Smith); Dupuy and Benyoub 2023 (spherical-cap
sampling of visible normals); Karis 2013 (the split into A and B).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beam_warp.kernels.light.brdf import DIELECTRIC_F0

TABLE_SIZE = 64
"""Nodes along each axis of `specular_albedo_table`."""

SAMPLES_AROUND, SAMPLES_ACROSS = 32, 64
"""Midpoint grid over the visible normals: half a turn (the lobe is symmetric) and the cap's height."""

TAIL_POWER = 3
"""Nodes crowd towards the cap's rim as (1 - u)^3: there are the lobe's long tail and the jump at the horizon."""


def smith_lambda(cosine: ArrayLike, alpha: ArrayLike) -> NDArray[np.float64]:
    """Return Smith's Λ of GGX for the cosine of a direction with the normal, above 0."""
    c = np.asarray(cosine, np.float64)
    return 0.5 * (np.sqrt(1.0 + np.square(alpha) * (1.0 / np.square(c) - 1.0)) - 1.0)


def ggx_distribution(cosine: ArrayLike, alpha: ArrayLike) -> NDArray[np.float64]:
    """Return GGX's density D of normals [1/sr] for the cosine n·h; its integral of D (n·h) is 1."""
    c2, a2 = np.square(np.asarray(cosine, np.float64)), np.square(np.asarray(alpha, np.float64))
    return a2 / (np.pi * np.square(c2 * (a2 - 1.0) + 1.0))


def schlick_weight(cosine: ArrayLike) -> NDArray[np.float64]:
    """Return (1 - v·h)^5, the part of Schlick's Fresnel term that rises to 1 at grazing."""
    return (1.0 - np.asarray(cosine, np.float64)) ** 5


def specular_albedo_terms(n_dot_v: ArrayLike, roughness: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return A and B of E = F0 A + B by a midpoint rule over the visible normals.

    E is the mean of F G2 / G1 over visible normals: bounded by 1 and smooth, even at grazing and for a mirror.

    Args:
        n_dot_v: Cosines in (0, 1], any shape.
        roughness: Perceptual roughness in [0, 1], same shape.

    Returns:
        A and B, each of that shape.
    """
    cosine = np.asarray(n_dot_v, np.float64)[..., None, None]
    alpha = np.square(np.asarray(roughness, np.float64))[..., None, None]
    sine = np.sqrt(1.0 - cosine * cosine)
    azimuth = (np.arange(SAMPLES_AROUND) + 0.5) * (np.pi / SAMPLES_AROUND)
    remaining = 1.0 - ((np.arange(SAMPLES_ACROSS) + 0.5) / SAMPLES_ACROSS)[:, None]
    share = 1.0 - remaining**TAIL_POWER
    weight = TAIL_POWER * remaining ** (TAIL_POWER - 1)
    weight = weight / weight.mean()
    # The view direction, stretched to where the lobe is a hemisphere; a cap about it is uniform in height.
    length = np.hypot(alpha * sine, cosine)
    x, z = alpha * sine / length, cosine / length
    height = (1.0 - share) * (1.0 + z) - z
    ring = np.sqrt(np.maximum(1.0 - height * height, 0.0))
    h = np.stack(np.broadcast_arrays(alpha * (ring * np.cos(azimuth) + x), alpha * ring * np.sin(azimuth), height + z))
    h /= np.linalg.norm(h, axis=0)
    v_dot_h = sine * h[0] + cosine * h[2]
    n_dot_l = 2.0 * v_dot_h * h[2] - cosine
    above = n_dot_l > 0.0
    view = 1.0 + smith_lambda(cosine, alpha)
    masking = weight * np.where(above, view / (view + smith_lambda(np.where(above, n_dot_l, 1.0), alpha)), 0.0)
    rising = schlick_weight(v_dot_h)
    return (masking * (1.0 - rising)).mean(axis=(-2, -1)), (masking * rising).mean(axis=(-2, -1))


@cache
def specular_albedo_table() -> NDArray[np.float32]:
    """Return A and B at the nodes, ``(TABLE_SIZE, TABLE_SIZE, 2)`` float32, read-only; computed once in a process.

    Rows: roughness, evenly from 0 to 1. Columns: the square root of n·v, evenly from 0 to 1, which is finer where
    grazing angles need it; the first column holds the limit.
    """
    nodes = np.linspace(0.0, 1.0, TABLE_SIZE)
    cosines = np.maximum(nodes * nodes, 1e-6)
    with ThreadPoolExecutor() as pool:
        rows = pool.map(lambda r: np.stack(specular_albedo_terms(cosines, np.full_like(cosines, r)), axis=-1), nodes)
        table = np.stack(list(rows)).astype(np.float32)
    table.flags.writeable = False
    return table


def specular_albedo(n_dot_v: ArrayLike, roughness: ArrayLike, f0: float = DIELECTRIC_F0) -> NDArray[np.float64]:
    """Return E(n·v, r) = F0 A + B from the table, bilinear, as the kernels do; for cosines and roughness in [0, 1]."""
    table = specular_albedo_table().astype(np.float64)
    x = np.sqrt(np.asarray(n_dot_v, np.float64)) * (TABLE_SIZE - 1)
    y = np.asarray(roughness, np.float64) * (TABLE_SIZE - 1)
    column, row = (np.minimum(np.floor(p).astype(np.int64), TABLE_SIZE - 2) for p in (x, y))
    fx, fy = (x - column)[..., None], (y - row)[..., None]
    top = table[row, column] * (1 - fx) + table[row, column + 1] * fx
    bottom = table[row + 1, column] * (1 - fx) + table[row + 1, column + 1] * fx
    a, b = np.moveaxis(top * (1 - fy) + bottom * fy, -1, 0)
    return f0 * a + b
