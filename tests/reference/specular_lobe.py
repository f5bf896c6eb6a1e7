"""The specular lobe by quadrature over half vectors, with no sampling of normals in common with the product."""

from functools import cache

import numpy as np

from beam_warp.light.ggx import ggx_distribution, schlick_weight, smith_lambda


@cache
def unit_nodes(count):
    """Nodes and weights of Gauss and Legendre on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1), 0.5 * weights


def half_angles(alpha, count):
    """Angles θ of half vectors, spread evenly over the lobe by s in tan θ = α s / (1 - s), and their sin θ dθ."""
    s, weights = unit_nodes(count)
    theta = np.arctan(alpha * s / (1 - s))
    jacobian = alpha / ((1 - s) ** 2 * (1 + np.tan(theta) ** 2))
    return theta, np.sin(theta) * jacobian * weights


def reflected_lobe(n_dot_v, roughness, f0, count=600):
    """Directions of light for normal +z, ``(3, count, count)``, and their shares of ∫ D G F / (4 n·v) dω, the albedo.

    Half a turn of azimuths stands for both, whose sidewards parts cancel.
    """
    alpha = roughness**2
    theta, polar = (each[:, None] for each in half_angles(alpha, count))
    phi = ((np.arange(count) + 0.5) * (np.pi / count))[None]
    h = np.stack(np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)))
    v = np.array([np.sqrt(1 - n_dot_v**2), 0.0, n_dot_v])
    v_dot_h = np.tensordot(v, h, 1)
    light = 2 * v_dot_h * h - v[:, None, None]
    light[1] = 0.0
    lit = (light[2] > 0) & (v_dot_h > 0)
    masking = 1 / (1 + smith_lambda(n_dot_v, alpha) + smith_lambda(np.where(lit, light[2], 1.0), alpha))
    fresnel = f0 + (1 - f0) * schlick_weight(v_dot_h)
    # dω_l = 4 v·h dω_h, and n·l cancels: f_s n·l = D G F / (4 n·v)
    value = np.where(lit, ggx_distribution(h[2], alpha) * masking * fresnel * v_dot_h / n_dot_v, 0.0)
    return light, value * polar * (2 * np.pi / count)
