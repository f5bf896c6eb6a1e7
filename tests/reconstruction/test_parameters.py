"""Gaussians as they are moved: there and back, rows without one, gradients, what an optimiser moves, refusals."""

import numpy as np
import pytest
import warp as wp
from support.float32 import EPSILON
from support.moving_ball import ball_cloud

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.image.color import DISPLAY_SRGB
from beam_warp.raster.records import GaussianGradients
from beam_warp.reconstruction.parameters import DEAD_LOGIT, GaussianParameters

NAMES = ("positions", "orientations", "radiance", "log_scales", "logits")


def parameters_of(cloud, device, **options):
    return GaussianParameters(cloud, wp.get_device(device), **options)


def random_gradients(rng, parameters):
    """Random gradients as a rasteriser writes them."""
    count, bands = parameters.radiance.shape
    kinds = (("positions", wp.vec3, (3,)), ("orientations", wp.quat, (4,)), ("scales", wp.vec3, (3,)))
    arrays = {
        name: wp.array(rng.normal(size=(count, *tail)), dtype=kind, device=parameters.device)
        for name, kind, tail in (*kinds, ("opacities", float, ()), ("radiance", wp.vec3, (bands, 3)))
    }
    return GaussianGradients(**arrays, values=None)


class TestThereAndBack:
    def test_a_cloud_comes_back(self, device):
        """Through a logarithm and a logit: an exponential of up to 10, whose argument is rounded, on each way."""
        given = ball_cloud(33)
        found = parameters_of(given, device).cloud()
        np.testing.assert_array_equal(found.positions, given.positions)
        np.testing.assert_allclose(found.orientations, given.orientations, atol=4 * EPSILON)
        np.testing.assert_allclose(found.scales, given.scales, rtol=16 * EPSILON)
        np.testing.assert_allclose(found.opacities, given.opacities, rtol=16 * EPSILON)
        np.testing.assert_array_equal(found.radiance[:, :1], given.radiance)
        assert not found.radiance[:, 1:].any()
        assert found.radiance_color_space == given.radiance_color_space
        assert found.ids.tolist() == list(range(33))

    @pytest.mark.parametrize(("degree", "bands"), [(0, 1), (1, 4), (3, 16)])
    def test_harmonics_are_cut_or_filled_up(self, device, rng, degree, bands):
        given = ball_cloud(5).with_arrays(radiance=rng.normal(size=(5, 9, 3)))
        found = parameters_of(given, device, sh_degree=degree).cloud().radiance
        assert found.shape == (5, bands, 3)
        kept = min(bands, 9)
        np.testing.assert_array_equal(found[:, :kept], given.radiance[:, :kept])
        assert not found[:, kept:].any()

    def test_ends_of_the_ranges(self, device):
        """Opacities of 0 and 1 and scales of 0 have no logit and no logarithm; what is moved is finite, and near."""
        given = ball_cloud(3).with_arrays(opacities=[0.0, 1.0, 0.5], scales=[[0.1, 0.1, 0.0], [0.0] * 3, [1.0] * 3])
        parameters = parameters_of(given, device)
        assert all(np.isfinite(array).all() for array in parameters.rows().values())
        assert parameters.alive().all()
        found = parameters.cloud()
        np.testing.assert_allclose(found.opacities, given.opacities, atol=1.3e-4)  # sigmoid(-9)
        np.testing.assert_allclose(found.scales, given.scales, atol=1.01e-7)

    def test_orientations_of_any_length_are_those_of_unit_length(self, device):
        parameters = parameters_of(ball_cloud(9), device)
        parameters.set_rows({"orientations": 7.0 * parameters.rows()["orientations"]})
        np.testing.assert_allclose(parameters.cloud().orientations, ball_cloud(9).orientations, atol=4 * EPSILON)

    def test_rows_set_stay_where_captured_steps_look_for_them(self, device):
        parameters = parameters_of(ball_cloud(9), device)
        places = [getattr(parameters, name).ptr for name in NAMES]
        parameters.set_rows({name: 0.5 * array for name, array in parameters.rows().items()})
        assert [getattr(parameters, name).ptr for name in NAMES] == places
        np.testing.assert_array_equal(parameters.positions.numpy(), 0.5 * ball_cloud(9).positions)


class TestRowsWithoutAGaussian:
    def test_they_do_not_appear(self, device):
        parameters = parameters_of(ball_cloud(5), device, row_count=12)
        assert len(parameters) == 12
        assert parameters.alive().tolist() == [True] * 5 + [False] * 7
        assert len(parameters.cloud()) == 5
        assert (parameters.logits.numpy()[5:] == np.float32(DEAD_LOGIT)).all()

    def test_all_of_them(self, device):
        parameters = parameters_of(ball_cloud(3), device)
        parameters.set_rows({"logits": np.full(3, DEAD_LOGIT, np.float32)})
        assert len(parameters.cloud()) == 0

    def test_sums_begin_anew_and_go_on(self, device, rng):
        parameters = parameters_of(ball_cloud(9), device)
        one, other = random_gradients(rng, parameters), random_gradients(rng, parameters)
        parameters.add_gradients(one)
        parameters.zero_gradients()
        assert not any(parameters.gradient(name).numpy().any() for name in NAMES)
        parameters.add_gradients(one)
        parameters.add_gradients(other)
        for name in NAMES[:3]:
            expected = getattr(one, name).numpy() + getattr(other, name).numpy()
            np.testing.assert_array_equal(parameters.gradient(name).numpy(), expected)


class TestDropout:
    """Out of 4,000 Gaussians, a quarter is left out: 1,000, with a standard deviation of 27."""

    COUNT, PART = 4_000, 0.25

    def parameters(self, device, opacities):
        return parameters_of(ball_cloud(self.COUNT).with_arrays(opacities=opacities), device)

    def drawn(self, parameters, seed=0):
        parameters.activate()
        parameters.drop_out(self.PART, seed)
        return parameters.drawn.opacities.numpy().copy()

    def test_light_that_passes_stays_the_same_in_the_mean(self, device, rng):
        opacities = rng.uniform(0.05, 0.7, self.COUNT)
        found = self.drawn(self.parameters(device, opacities))
        kept = found > 0.0
        assert abs((~kept).sum() - self.PART * self.COUNT) < 4.0 * 27.0
        np.testing.assert_allclose(found[kept], opacities[kept] / (1.0 - self.PART), rtol=1e-5)

    def test_opaque_ones_stay_below_the_rasteriser_s_limit_and_never_fade(self, device):
        opacities = np.resize([0.9, 0.9985], self.COUNT)
        found = self.drawn(self.parameters(device, opacities))
        limits = np.resize([0.99, 0.9985], self.COUNT)
        np.testing.assert_allclose(found[found > 0.0], limits[found > 0.0], rtol=1e-5)

    def test_others_each_time_and_the_same_again(self, device):
        """Two draws share a sixteenth: 250, with a deviation of 15; so do draws of two seeds."""
        one, again = (self.parameters(device, np.full(self.COUNT, 0.5)) for _ in range(2))
        first, second = self.drawn(one), self.drawn(one)
        np.testing.assert_array_equal(self.drawn(again), first)
        np.testing.assert_array_equal(self.drawn(again), second)
        other = self.drawn(self.parameters(device, np.full(self.COUNT, 0.5)), seed=1)
        for draw in (second, other):
            assert abs(((first == 0.0) & (draw == 0.0)).sum() - 250) < 4.0 * 15.0

    def test_activation_brings_all_back(self, device):
        parameters = self.parameters(device, np.full(self.COUNT, 0.5))
        self.drawn(parameters)
        parameters.activate()
        np.testing.assert_allclose(parameters.drawn.opacities.numpy(), 0.5, rtol=1e-5)


class TestOptimizer:
    def test_each_group_has_its_rate_and_those_left_out_stay(self, device, rng):
        """A first step is the rate, whatever the gradient: band 0 by its own, the others by theirs."""
        parameters = parameters_of(ball_cloud(9), device, sh_degree=1)
        before = {name: array.copy() for name, array in parameters.rows().items()}
        adam = parameters.optimizer({"positions": 0.5, "color": 0.25, "bands": 0.125})
        parameters.add_gradients(random_gradients(rng, parameters))
        adam.step()
        found = {name: np.abs(array - before[name]) for name, array in parameters.rows().items()}
        np.testing.assert_allclose(found["positions"], 0.5, rtol=1e-5)
        np.testing.assert_allclose(found["radiance"][:, :1], 0.25, rtol=1e-5)
        np.testing.assert_allclose(found["radiance"][:, 1:], 0.125, rtol=1e-5)
        assert not any(found[name].any() for name in ("orientations", "log_scales", "logits"))

    def test_without_bands(self, device):
        adam = parameters_of(ball_cloud(9), device, sh_degree=0).optimizer({"color": 0.1, "bands": 0.1})
        assert set(adam.parameters) == {"color"}


class TestRefusals:
    def test_radiance_must_be_scene_linear(self, device):
        """Colours of another space would be fitted from as if they were light: they are refused, not converted."""
        with pytest.raises(InvalidArrayError, match="start must have radiance in lin_rec709_scene, got none"):
            parameters_of(ball_cloud(3).with_arrays(radiance=None, radiance_color_space=None), device)
        with pytest.raises(InvalidArrayError, match=f"must have radiance in lin_rec709_scene, got {DISPLAY_SRGB}"):
            parameters_of(ball_cloud(3).with_arrays(radiance_color_space=DISPLAY_SRGB), device)

    def test_counts(self, device):
        with pytest.raises(InvalidOptionError, match="row_count must be an integer in"):
            parameters_of(ball_cloud(3), device, row_count=2)
        with pytest.raises(InvalidOptionError, match="sh_degree must be an integer in"):
            parameters_of(ball_cloud(3), device, sh_degree=5)
