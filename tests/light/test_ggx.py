"""The specular albedo: limits in closed form, an independent quadrature, and the table's interpolation."""

import numpy as np
import pytest
from reference.specular_lobe import half_angles, reflected_lobe

from beam_warp.light.ggx import (
    DIELECTRIC_F0,
    ggx_distribution,
    specular_albedo,
    specular_albedo_table,
    specular_albedo_terms,
)


@pytest.mark.parametrize("alpha", [0.01, 0.3, 1.0])
def test_distribution_is_normalised(alpha):
    theta, polar = half_angles(alpha, 400)
    value = ggx_distribution(np.cos(theta), alpha) * np.cos(theta) * 2 * np.pi
    assert (value * polar).sum() == pytest.approx(1.0, rel=1e-9)


def test_a_mirror_is_schlick():
    cosine = np.linspace(0.01, 1, 50)
    a, b = specular_albedo_terms(cosine, np.zeros(50))
    np.testing.assert_allclose(a + b, 1.0, rtol=1e-12)
    np.testing.assert_allclose(b, (1 - cosine) ** 5, atol=1e-12)


@pytest.mark.parametrize(
    ("n_dot_v", "roughness"), [(0.05, 0.9), (0.05, 0.3), (0.3, 0.6), (0.9, 1.0), (1.0, 0.25), (0.2, 0.2), (0.02, 0.7)]
)
def test_terms_against_quadrature_over_light(n_dot_v, roughness):
    a, b = specular_albedo_terms(n_dot_v, roughness)
    _, shares = reflected_lobe(n_dot_v, roughness, DIELECTRIC_F0)
    # The jump at the horizon holds either rule to first order: 1 / 600 nodes of the oracle's, times the jump.
    assert DIELECTRIC_F0 * a + b == pytest.approx(shares.sum(), rel=2e-3)
    # F0 = 1 measures single scattering without Fresnel.
    _, shares = reflected_lobe(n_dot_v, roughness, 1.0)
    assert a + b == pytest.approx(shares.sum(), rel=2e-3)


def test_known_values_at_grazing():
    # Measured with an independent program; the usual analytic fit gives 0.020 and 0.378.
    assert specular_albedo(0.05, 0.9) == pytest.approx(0.075, abs=5e-4)
    assert specular_albedo(0.05, 0.3) == pytest.approx(0.390, abs=1e-3)


def test_table_interpolates(rng):
    n_dot_v, roughness = rng.uniform(0.02, 1, 600), rng.uniform(0.05, 1, 600)
    a, b = specular_albedo_terms(n_dot_v, roughness)
    np.testing.assert_allclose(specular_albedo(n_dot_v, roughness), DIELECTRIC_F0 * a + b, atol=2e-3)


def test_table_is_bounded_and_shared():
    table = specular_albedo_table()
    assert table is specular_albedo_table()
    assert not table.flags.writeable
    assert (table >= 0).all()
    assert (table.sum(axis=-1) <= 1 + 1e-6).all()
