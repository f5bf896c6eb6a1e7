"""The 3DGS basis: orthonormal, of the stated signs, and carried along by any rotation or mirror."""

import numpy as np
import pytest
from reference.harmonics import sh_color
from scipy.spatial.transform import Rotation

from beam_warp.world.harmonics import SH_C0, sh_basis, sh_transform


def quadrature():
    """Gauss–Legendre in z, uniform in azimuth: exact for products of two bands up to 4."""
    z, weight = np.polynomial.legendre.leggauss(12)
    phi = np.arange(24) * (2.0 * np.pi / 24)
    zz, pp = np.meshgrid(z, phi, indexing="ij")
    radius = np.sqrt(1.0 - zz**2)
    directions = np.stack([radius * np.cos(pp), radius * np.sin(pp), zz], axis=-1).reshape(-1, 3)
    return directions, np.repeat(weight, 24) * (2.0 * np.pi / 24)


def test_orthonormal():
    directions, weight = quadrature()
    basis = sh_basis(directions, 4)
    assert np.abs(basis.T @ (basis * weight[:, None]) - np.eye(25)).max() < 1e-13


def test_signs_of_the_reference_implementation():
    x, y, z = np.eye(3)
    c1 = 0.4886025119029199
    assert sh_basis(z, 0) == pytest.approx([SH_C0])
    assert sh_basis(x, 1)[1:] == pytest.approx([0.0, 0.0, -c1])
    assert sh_basis(y, 1)[1:] == pytest.approx([-c1, 0.0, 0.0])
    assert sh_basis(z, 1)[1:] == pytest.approx([0.0, c1, 0.0])
    xy = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    assert sh_basis(xy, 2)[4] == pytest.approx(1.0925484305920792 / 2.0)
    assert sh_basis(z, 3)[12] == pytest.approx(0.3731763325901154 * 2.0)


@pytest.mark.parametrize("degree", range(5))
def test_coefficients_follow_rotations_and_mirrors(rng, degree):
    coefficients = rng.normal(size=(degree + 1) ** 2)
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = sh_basis(directions, degree) @ coefficients
    mirrors = np.diag([1.0, -1.0, 1.0]), np.diag([-1.0, 1.0, 1.0])
    for linear in (*Rotation.random(5, random_state=3).as_matrix(), *mirrors):
        moved = sh_transform(linear, degree) @ coefficients
        assert np.abs(sh_basis(directions @ linear.T, degree) @ moved - expected).max() < 1e-12


def test_mirrors_only_change_signs():
    for axis in range(3):
        flip = np.ones(3)
        flip[axis] = -1.0
        assert np.abs(np.abs(sh_transform(np.diag(flip), 3)) - np.eye(16)).max() < 1e-12


def test_colour_is_half_plus_the_sum_and_never_negative():
    radiance = np.zeros((2, 1, 3))
    radiance[0] = 0.25 / SH_C0
    radiance[1] = -4.0
    color = sh_color(radiance, np.array([0.0, 0.0, 1.0]))
    assert color[0] == pytest.approx([0.75] * 3)
    assert (color[1] == 0.0).all()
