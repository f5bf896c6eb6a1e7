"""Total variation of radiance: how much of it noise asks for, and who is a neighbour. What a fit gains: `test_fit`."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from support.moving_ball import ball_cloud

from beam_warp.reconstruction.parameters import GaussianParameters
from beam_warp.reconstruction.total_variation import NEIGHBORS, ROUNDING, RadianceVariation, chosen_variation


def test_as_much_as_noise_asks_for():
    """The variance, in the median of what is known; none below .0003, and .003 at most."""
    assert chosen_variation("auto", np.array([0.04, 0.02, 0.05])) == pytest.approx(0.0016)
    assert chosen_variation("auto", np.array([0.04, np.nan])) == pytest.approx(0.0016)
    assert chosen_variation("auto", np.array([0.3])) == 0.003
    assert chosen_variation("auto", np.array([0.017])) == 0.0
    assert chosen_variation("auto", np.array([np.nan])) == 0.0
    assert chosen_variation(0.5, np.array([0.04])) == 0.5


def added(parameters, variation):
    """The gradient of radiance for a weight of 1."""
    parameters.zero_gradients()
    variation.add_gradients(1.0)
    return parameters.gradient("radiance").numpy()


@pytest.mark.parametrize("count", [1, 2, 60])
def test_neighbors_are_the_nearest_that_are_there(device, rng, count):
    """All distances in double precision tell them: rows without a Gaussian are nobody's, and what moved has others."""
    cloud = ball_cloud(60).select(np.arange(count))
    parameters = GaussianParameters(cloud, device, row_count=count + 3)
    variation = RadianceVariation(parameters)
    radiance = parameters.radiance.numpy().astype(np.float64)[:count]
    for _ in range(2):
        places = parameters.positions.numpy().astype(np.float64)[:count]
        near = np.argsort(cdist(places, places), axis=1)[:, 1 : NEIGHBORS + 1]
        away = radiance[:, None] - radiance[near]
        lengths = np.sqrt((away**2).sum(axis=(2, 3), keepdims=True) + ROUNDING**2)
        found = added(parameters, variation)
        np.testing.assert_allclose(found[:count], (away / lengths).sum(axis=1), atol=1e-5)
        assert (found[count:] == 0.0).all()
        rows = parameters.rows()
        rows["positions"][:count] = rows["positions"][rng.permutation(count)]
        parameters.set_rows(rows)
        variation.find_neighbors()
