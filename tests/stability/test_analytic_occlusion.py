"""Ambient occlusion of shapes with closed forms: noise against its own standard error, discretisation apart."""

import numpy as np
import pytest
from support.shapes import random_cloud

from beam_warp.stability import analytic_occlusion
from beam_warp.stability.analytic_occlusion import (
    SHAPES,
    build_bowl,
    build_disc,
    build_resting_sphere,
    build_wall,
    measure_occlusion,
    occlusion_quadrature,
    quadrature_directions,
)
from beam_warp.trace.occlusion import AmbientOcclusion

pytestmark = pytest.mark.slow  # a stability suite


def sees_past_disc(o, d):
    at = o + d * (0.4 / d[..., 2:])
    return (at[..., 0] ** 2 + at[..., 1] ** 2) > 0.5**2


def sees_past_wall(o, d):
    at = o - d * (o[..., :1] / np.minimum(d[..., :1], -1e-12))
    return (d[..., 0] >= 0.0) | (np.abs(at[..., 1]) > 1.6) | (at[..., 2] > 0.4)


def sees_past_sphere(o, d):
    p = o - np.array([0.0, 0.0, 0.5])
    b = (p * d).sum(-1)
    return (b >= 0.0) | ((p * p).sum(-1) - b**2 > 0.5**2)


def sees_out_of_bowl(o, d):
    return (o - 2.0 * (o * d).sum(-1, keepdims=True) * d)[..., 2] > 0.0


class TestClosedForms:
    @pytest.mark.parametrize(
        ("build", "visible"),
        [
            (build_disc, sees_past_disc),
            (build_wall, sees_past_wall),
            (build_resting_sphere, sees_past_sphere),
            (build_bowl, sees_out_of_bowl),
        ],
    )
    def test_agree_with_rays_against_the_smooth_shape(self, build, visible):
        tiled = build(0.1, 9)
        o, n = tiled.points.astype(np.float64), tiled.normals.astype(np.float64)
        runs = [
            visible(o[:, None, :], quadrature_directions(n, 8192, shift)).mean(axis=1) for shift in np.arange(8) / 8.0
        ]
        # 65,536 lattice points: the spread of eight shifts is the quadrature's own error
        error = np.std(runs, axis=0, ddof=1) / np.sqrt(8)
        assert np.abs(np.mean(runs, axis=0) - tiled.visibility).max() <= 5.0 * error.max()
        assert error.max() < 5e-4

    def test_on_the_axis_of_a_disc(self):
        assert build_disc(0.1, 5).visibility[0] == pytest.approx(0.4**2 / (0.5**2 + 0.4**2), abs=1e-12)

    def test_a_wall_of_eight_heights_is_long(self):
        tiled = build_wall(0.1, 9)
        x = tiled.points[:, 0].astype(np.float64)
        endless = 0.5 * (1.0 + x / np.sqrt(x**2 + 0.4**2))
        # what both ends hide of an endless wall: less than (H / L)^2 for x up to 1.5 H
        assert (endless < tiled.visibility).all()
        assert (tiled.visibility - endless).max() < (0.4 / 3.2) ** 2


class TestQuadrature:
    def test_directions_are_cosine_distributed(self, rng):
        n = rng.normal(size=(4, 3))
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        d = quadrature_directions(n, 4096, 0.3)
        assert np.linalg.norm(d, axis=2) == pytest.approx(np.ones((4, 4096)), abs=1e-12)
        cosine = np.einsum("pkc,pc->pk", d, n)
        # the lattice is even in u = sin^2 of the angle: its mean error is below one step
        assert cosine.mean(axis=1) == pytest.approx(np.full(4, 2.0 / 3.0), abs=1.0 / 4096)
        assert (1.0 - cosine**2).mean(axis=1) == pytest.approx(np.full(4, 0.5), abs=1.0 / 4096)

    def test_nothing_hides_nothing(self, rng):
        cloud = random_cloud(rng, 3).select(np.arange(0))
        value, error = occlusion_quadrature(cloud, np.zeros((2, 3)), [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], 64)
        assert value.tolist() == [1.0, 1.0]
        assert error.tolist() == [0.0, 0.0]


@pytest.fixture(scope="module")
def rare():
    """What Student's t of 7 degrees exceeds as rarely as 3 standard errors: a mean of 12, and of their squares."""
    t = np.random.default_rng(0).standard_t(7, (200_000, 12))
    return np.quantile(np.abs(t.mean(axis=1)), 0.9973), np.quantile(np.square(t).mean(axis=1), 0.9973)


class TestEstimator:
    @pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.name)
    def test_is_within_its_standard_error_of_the_tiles(self, device, shape, rare):
        """One estimate by its stated error; and the mean of 16 frames by their spread, which a bias would exceed.

        The latter follows Student's t with at least 7 degrees of freedom, those of the quadrature's eight shifts.
        """
        outcome = measure_occlusion(shape, device)
        assert outcome.points == 12
        assert outcome.largest_z <= 3.0
        assert outcome.passed
        assert abs(outcome.mean_z) <= rare[0]
        assert outcome.chi_square <= rare[1]

    def test_a_bias_is_noticed(self, monkeypatch):
        """A bias of 0.02 is half a stated standard error of a single estimate."""
        real = analytic_occlusion.ambient_occlusion

        def biased(*args, **options):
            result = real(*args, **options)
            return AmbientOcclusion(result.visibility + np.float32(0.02), result.standard_error)

        monkeypatch.setattr(analytic_occlusion, "ambient_occlusion", biased)
        disc = next(shape for shape in SHAPES if shape.name == "coaxial disc")
        outcome = measure_occlusion(disc, "cpu")
        assert outcome.mean_z > 2.0
        assert outcome.chi_square > 5.0


class TestDiscretisation:
    @pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.name)
    def test_shrinks_with_the_tiles(self, shape):
        """Soft edges and lifted origins are a number of spacings: a quarter of the spacing, a quarter of the error.

        Half is allowed, for edges grow and lifted origins open up, against each other and not at the same rate.
        """
        few = {"point_count": 6, "sample_count": 4, "frame_count": 4, "quadrature_count": 512}
        spacings = [shape.spacing * refinement for refinement in (1.0, 0.5, 0.25)]
        errors = [measure_occlusion(shape, "cpu", spacing=each, **few).discretisation for each in spacings]
        if shape.name == "plane":
            assert max(errors) < 1e-9  # nothing on a plane lies above it
        else:
            assert errors[0] > errors[1] > errors[2]
            assert errors[2] < errors[0] / 2.0
