"""Activation: closed forms, the float64 twin, its complex steps, ties, the ends of the range of floats."""

import numpy as np
import pytest
import warp as wp
from reference.activation import activate, thin_axes
from support.float32 import EPSILON

from beam_warp.kernels.reconstruction.activation import Shapes, launch_activate, launch_add_shape_gradients

ROUNDINGS = 64
"""An exponential is within 2 ulp, 4 roundings; of an opacity there are three, two roots and nine other operations."""


def shapes_of(log_scales, logits, filters, device):
    shapes = Shapes()
    shapes.log_scales = wp.array(np.float32(log_scales), dtype=wp.vec3, device=device)
    shapes.logits = wp.array(np.float32(logits), dtype=float, device=device)
    shapes.filters = wp.array(np.float32(filters), dtype=float, device=device)
    return shapes


def activated(log_scales, logits, filters, device):
    shapes = shapes_of(log_scales, logits, filters, device)
    scales = wp.zeros(len(logits), dtype=wp.vec3, device=device)
    opacities = wp.zeros(len(logits), dtype=float, device=device)
    launch_activate(scales.size, shapes, scales, opacities, device)
    return scales.numpy(), opacities.numpy()


def pulled(log_scales, logits, filters, to_scales, to_opacities, device, found=0.0):
    """Gradients of log scales and logits, added to ``found``."""
    out_log_scales = wp.full(len(logits), wp.vec3(found), dtype=wp.vec3, device=device)
    out_logits = wp.full(len(logits), found, dtype=float, device=device)
    launch_add_shape_gradients(
        shapes_of(log_scales, logits, filters, device),
        wp.array(np.float32(to_scales), dtype=wp.vec3, device=device),
        wp.array(np.float32(to_opacities), dtype=float, device=device),
        out_log_scales,
        out_logits,
        device,
    )
    return out_log_scales.numpy(), out_logits.numpy()


def random_shapes(rng, count):
    """Discs and balls of 1 mm to 1 m, filters from nothing to ten times that."""
    log_scales = rng.uniform(np.log(1e-3), 0.0, (count, 3)).astype(np.float32)
    filters = np.where(rng.uniform(size=count) < 0.2, 0.0, np.exp(rng.uniform(-7.0, 2.0, count)))
    return log_scales, rng.uniform(-9.0, 9.0, count).astype(np.float32), filters.astype(np.float32)


class TestClosedForms:
    @pytest.mark.parametrize("thin", range(3))
    def test_three_four_five(self, device, thin):
        """A filter of 4 makes 3 to 5, and leaves 3/5 of the opacity for each; the smallest axis stays."""
        scales = np.full((1, 3), 3.0)
        scales[0, thin] = 0.01
        wide = np.full((1, 3), 5.0)
        wide[0, thin] = 0.01
        found, opacities = activated(np.log(scales), [np.log(3.0)], [4.0], device)
        np.testing.assert_allclose(found, wide, rtol=16 * EPSILON)
        np.testing.assert_allclose(opacities, [0.75 * 0.36], rtol=ROUNDINGS * EPSILON)

    @pytest.mark.parametrize(
        ("scales", "thin"),
        [((1, 1, 2), 1), ((1, 2, 1), 2), ((2, 1, 1), 2), ((1, 1, 1), 2), ((1, 2, 2), 0), ((2, 1, 2), 1)],
    )
    def test_of_equal_axes_exactly_one_stays(self, device, scales, thin):
        found, _ = activated(np.log([scales]), [0.0], [1.0], device)
        stays = np.isclose(found[0], scales)
        assert stays.tolist() == [axis == thin for axis in range(3)]
        to_log_scales, _ = pulled(np.log([scales]), [0.0], [1.0], np.ones((1, 3)), [0.0], device)
        own = to_log_scales[0, thin] / scales[thin]
        assert own == pytest.approx(1.0, rel=16 * EPSILON)  # ds/dlog s = s: the same axis on the way back


@pytest.mark.parametrize("count", [1, 1025])
class TestTwin:
    def test_forward(self, device, rng, count):
        log_scales, logits, filters = random_shapes(rng, count)
        scales, opacities = activated(log_scales, logits, filters, device)
        wide, kept = activate(log_scales.astype(np.float64), logits.astype(np.float64), filters, thin_axes(log_scales))
        np.testing.assert_allclose(scales, wide, rtol=ROUNDINGS * EPSILON)
        np.testing.assert_allclose(opacities, kept, rtol=ROUNDINGS * EPSILON)

    def test_gradients_are_complex_steps_of_it(self, device, rng, count):
        """Every sum has at most three terms, which may cancel: errors count against the largest of them."""
        log_scales, logits, filters = random_shapes(rng, count)
        to_scales, to_opacities = rng.normal(size=(count, 3)), rng.normal(size=count)
        thin, step = thin_axes(log_scales), 1e-20
        to_scales, to_opacities = np.float32(to_scales), np.float32(to_opacities)

        def loss(log_scales, logits):
            wide, kept = activate(log_scales, logits, filters, thin)
            return ((to_scales * wide).sum(axis=1) + to_opacities * kept).imag / step

        expected = np.stack(
            [loss(log_scales + 1j * step * np.eye(3)[axis], logits.astype(np.float64)) for axis in range(3)], axis=1
        )
        expected_logits = loss(log_scales.astype(np.float64), logits + 1j * step)
        found, found_logits = pulled(log_scales, logits, filters, to_scales, to_opacities, device)
        wide, kept = activate(log_scales.astype(np.float64), logits.astype(np.float64), filters, thin)
        bound = ROUNDINGS * EPSILON * (np.abs(to_scales) * wide + np.abs(to_opacities * kept)[:, None])
        assert (np.abs(found - expected) <= bound).all()
        # 1 - sigmoid loses the digits of a sigmoid near 1: an error of sigmoid's, not of the product's size
        assert (np.abs(found_logits - expected_logits) <= ROUNDINGS * EPSILON * np.abs(to_opacities) * kept).all()
        assert np.linalg.norm(found - expected) <= 1e-6 * np.linalg.norm(expected)
        assert np.linalg.norm(found_logits - expected_logits) <= 1e-6 * np.linalg.norm(expected_logits)

    def test_gradients_are_added(self, device, rng, count):
        log_scales, logits, filters = random_shapes(rng, count)
        upstream = rng.normal(size=(count, 3)), rng.normal(size=count)
        once = pulled(log_scales, logits, filters, *upstream, device)
        more = pulled(log_scales, logits, filters, *upstream, device, found=2.0)
        for a, b in zip(once, more, strict=True):
            np.testing.assert_allclose(b - 2.0, a, atol=4 * EPSILON * (2.0 + np.abs(a).max()))


class TestEndsOfTheRange:
    def test_a_row_that_is_no_gaussian_has_neither_opacity_nor_gradient(self, device):
        _, opacities = activated([[-10.0] * 3], [-30.0], [0.0], device)
        assert 0.0 < opacities[0] < 1e-12  # far below the 1/255 from which on it would be drawn
        to_log_scales, to_logits = pulled([[-10.0] * 3], [-30.0], [0.0], np.zeros((1, 3)), [0.0], device)
        assert not to_log_scales.any()
        assert not to_logits.any()

    @pytest.mark.parametrize("filter", [0.0, 0.01])
    @pytest.mark.parametrize("log_scales", [(-60.0, -61.0, -62.0), (-5.0, -6.0, -60.0), (-200.0, -200.0, -200.0)])
    def test_scales_whose_squares_are_no_floats(self, device, log_scales, filter):
        """Steps may shrink a scale without end: to 1e-26, to 0, but never to NaN, which would spread from there."""
        scales, opacities = activated([log_scales], [0.0], [filter], device)
        assert np.isfinite(scales).all()
        assert 0.0 <= opacities[0] <= 0.5
        for found in pulled([log_scales], [0.0], [filter], np.ones((1, 3)), [1.0], device):
            assert np.isfinite(found).all()

    def test_without_a_filter_opacity_is_the_sigmoid_however_small_a_scale(self, device):
        _, opacities = activated([[-60.0, -61.0, -62.0]], [0.0], [0.0], device)
        assert opacities[0] == pytest.approx(0.5, rel=8 * EPSILON)
