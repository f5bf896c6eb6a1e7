"""The specular albedo: limits in closed form, an independent quadrature, and the table's interpolation."""

import numpy as np
import pytest

from beam_warp.light.ggx import (
    DIELECTRIC_F0,
    ggx_distribution,
    schlick_weight,
    smith_lambda,
    specular_albedo,
    specular_albedo_table,
    specular_albedo_terms,
)


def albedo_by_light_directions(n_dot_v, roughness, f0, count=600):
    """∫ D G F / (4 n·v) dω over light directions, with no sampling of normals in common with the module.

    Gauss-Legendre over the half vector's azimuth and over s in tan θ = α s / (1 - s), which spreads the lobe evenly.
    """
    alpha = roughness**2
    s, ws = np.polynomial.legendre.leggauss(count)
    s, ws = 0.5 * (s + 1)[:, None], 0.5 * ws[:, None]
    theta = np.arctan(alpha * s / (1 - s))
    jacobian = alpha / ((1 - s) ** 2 * (1 + np.tan(theta) ** 2))
    phi, wp = np.polynomial.legendre.leggauss(count)
    phi, wp = 0.5 * np.pi * (phi + 1)[None], np.pi * wp[None]  # half a turn, counted twice
    v_dot_h = np.sqrt(1 - n_dot_v**2) * np.sin(theta) * np.cos(phi) + n_dot_v * np.cos(theta)
    n_dot_l = 2 * v_dot_h * np.cos(theta) - n_dot_v
    lit = (n_dot_l > 0) & (v_dot_h > 0)
    safe = np.where(lit, n_dot_l, 1.0)
    masking = 1 / (1 + smith_lambda(n_dot_v, alpha) + smith_lambda(safe, alpha))
    fresnel = f0 + (1 - f0) * schlick_weight(v_dot_h)
    # dω_l = 4 v·h dω_h, and n·l cancels: f_s n·l = D G F / (4 n·v)
    value = np.where(lit, ggx_distribution(np.cos(theta), alpha) * masking * fresnel * v_dot_h / n_dot_v, 0.0)
    return (value * np.sin(theta) * jacobian * ws * wp).sum()


@pytest.mark.parametrize("alpha", [0.01, 0.3, 1.0])
def test_distribution_is_normalised(alpha):
    s, weights = np.polynomial.legendre.leggauss(400)
    s, weights = 0.5 * (s + 1), 0.5 * weights
    theta = np.arctan(alpha * s / (1 - s))
    jacobian = alpha / ((1 - s) ** 2 * (1 + np.tan(theta) ** 2))
    value = ggx_distribution(np.cos(theta), alpha) * np.cos(theta) * 2 * np.pi * np.sin(theta) * jacobian
    assert (value * weights).sum() == pytest.approx(1.0, rel=1e-9)


def test_a_mirror_is_schlick():
    cosine = np.linspace(0.01, 1, 50)
    a, b = specular_albedo_terms(cosine, np.zeros(50))
    np.testing.assert_allclose(a + b, 1.0, rtol=1e-12)
    np.testing.assert_allclose(b, (1 - cosine) ** 5, atol=1e-12)


@pytest.mark.parametrize(
    ("n_dot_v", "roughness"), [(0.05, 0.9), (0.05, 0.3), (0.3, 0.6), (0.9, 1.0), (1.0, 0.25), (0.2, 0.2), (0.02, 0.7)]
)
def test_terms_against_quadrature_over_light(n_dot_v, roughness):
    expected = albedo_by_light_directions(n_dot_v, roughness, DIELECTRIC_F0)
    a, b = specular_albedo_terms(n_dot_v, roughness)
    # The jump at the horizon holds either rule to first order: 1 / 600 nodes of the oracle's, times the jump.
    assert DIELECTRIC_F0 * a + b == pytest.approx(expected, rel=2e-3)
    # F0 = 1 measures single scattering without Fresnel.
    assert a + b == pytest.approx(albedo_by_light_directions(n_dot_v, roughness, 1.0), rel=2e-3)


def test_known_values_at_grazing():
    # Measured with an independent program; the usual analytic fit gives 0.020 and 0.378.
    assert specular_albedo(0.05, 0.9) == pytest.approx(0.075, abs=5e-4)
    assert specular_albedo(0.05, 0.3) == pytest.approx(0.390, abs=1e-3)


def test_table_interpolates(rng):
    n_dot_v, roughness = rng.uniform(0.02, 1, 2000), rng.uniform(0.05, 1, 2000)
    a, b = specular_albedo_terms(n_dot_v, roughness)
    np.testing.assert_allclose(specular_albedo(n_dot_v, roughness), DIELECTRIC_F0 * a + b, atol=2e-3)


def test_table_is_bounded_and_shared():
    table = specular_albedo_table()
    assert table is specular_albedo_table()
    assert not table.flags.writeable
    assert (table >= 0).all()
    assert (table.sum(axis=-1) <= 1 + 1e-6).all()
