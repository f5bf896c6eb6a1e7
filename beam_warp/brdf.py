"""Integrals of the BRDF that do not depend on the light: the two terms of the split sum, as tables.

With F = F0 + (1 - F0) (1 - v.h)^5 the specular lobe's directional albedo is F0 scale + bias, where scale and bias
depend on n.v and roughness alone (Karis 2013). Tabulated by quadrature, because the published fits are off by up to a
factor of four at grazing angles.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

DIELECTRIC_F0 = 0.04
"""Reflectance at normal incidence of a dielectric of index 1.5; equals the device's constant (tested)."""

TABLE_SIZE = 64
SMALLEST_COSINE = 1e-3
"""The row of n.v = 0 is evaluated here: at 0 exactly the lobe is degenerate."""


@lru_cache(maxsize=4)
def split_sum_table(size: int = TABLE_SIZE, quadrature: int = 64) -> NDArray[np.float64]:
    """Tabulate scale and bias.

    Args:
        size: Nodes along each axis, from 0 to 1 inclusive.
        quadrature: Points along each axis of the half-vector's unit square.

    Returns:
        ``(size, size, 2)`` float64: n.v, roughness, (scale, bias). Read-only.

    Source: GGX and height-correlated Smith (Heitz 2014); half vectors by the visible normals (Dupuy and Benyoub 2023),
    whose weight G2/G1 is smooth and at most 1, so that midpoint quadrature converges fast.
    """
    table = np.zeros((size, size, 2))
    u = (np.arange(quadrature) + 0.5) / quadrature
    uu, vv = np.meshgrid(u, u, indexing="ij")
    phi = 2.0 * np.pi * uu.ravel()
    v = vv.ravel()
    for row, n_dot_v in enumerate(np.maximum(np.linspace(0.0, 1.0, size), SMALLEST_COSINE)):
        view = np.array([np.sqrt(1.0 - n_dot_v**2), 0.0, n_dot_v])
        for column, roughness in enumerate(np.linspace(0.0, 1.0, size)):
            alpha = max(roughness * roughness, 1e-3)
            stretched = view * (alpha, alpha, 1.0)
            stretched /= np.linalg.norm(stretched)
            z = (1.0 - v) * (1.0 + stretched[2]) - stretched[2]
            radius = np.sqrt(np.maximum(1.0 - z * z, 0.0))
            half = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1) + stretched
            half *= (alpha, alpha, 1.0)
            half /= np.linalg.norm(half, axis=-1, keepdims=True)
            v_dot_h = np.maximum(half @ view, 0.0)
            n_dot_l = 2.0 * v_dot_h * half[:, 2] - view[2]
            a2 = alpha * alpha
            g1 = 2.0 * n_dot_v / (n_dot_v + np.sqrt(n_dot_v**2 * (1.0 - a2) + a2))
            light = np.maximum(n_dot_l, 0.0)
            g2 = (
                2.0
                * light
                * n_dot_v
                / np.maximum(
                    light * np.sqrt(n_dot_v**2 * (1.0 - a2) + a2) + n_dot_v * np.sqrt(light**2 * (1.0 - a2) + a2),
                    1e-30,
                )
            )
            weight = g2 / g1
            fresnel = (1.0 - v_dot_h) ** 5
            table[row, column] = np.mean(weight * (1.0 - fresnel)), np.mean(weight * fresnel)
    table.flags.writeable = False
    return table


def specular_albedo_table(size: int = TABLE_SIZE) -> NDArray[np.float32]:
    """Tabulate the specular lobe's directional albedo for a dielectric, ``(size, size)`` float32: n.v, roughness."""
    table = split_sum_table(size)
    return (DIELECTRIC_F0 * table[..., 0] + table[..., 1]).astype(np.float32)
