"""Image losses: closed forms, float64 twins and their differences, skimage, masks, strides, threads, refusals."""

import math

import numpy as np
import pytest
import warp as wp
from reference import image_losses as twin
from skimage.metrics import structural_similarity
from support.float32 import EPSILON, relative_error
from support.kernel_runs import upload_floats as upload

from beam_warp.device.array_checks import pixel_channels
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.raster.losses import L1Loss, NormalLoss, SsimLoss

GRADIENT = 1e-5
"""Relative 2-norm of a gradient's error that training asks for; float32 needs some 20 roundings, 1e-6, of it."""


def zeros(shape, device):
    return wp.zeros(shape, dtype=float, device=device)


def value(loss):
    return float(loss.numpy()[0])


def images(rng, *shape):
    """A picture with edges and a smooth bright part, and a noisy one of it, in float64 as float32 holds them."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    target = 0.45 + 0.4 * np.tanh(np.sin(0.4 * x) + np.cos(0.3 * y))[..., None] * rng.uniform(0.5, 1.0, shape[2])
    image = np.clip(target + 0.05 * rng.standard_normal(shape), 0.0, 1.0)
    return image.astype(np.float32).astype(float), target.astype(np.float32).astype(float)


def unit(rng, *shape):
    vectors = rng.standard_normal((*shape, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


class TestL1:
    def test_twin(self, device, rng):
        image, target = images(rng, 37, 29, 3)
        mask = rng.uniform(size=(37, 29)).astype(np.float32)
        gradient = zeros(image.shape, device)
        loss = L1Loss(37, 29, device=device)(image, target, weight=0.8, mask=mask, gradient=gradient)
        assert value(loss) == pytest.approx(0.8 * twin.l1(image, target, mask), rel=8.0 * EPSILON)
        expected = 0.8 * mask[..., None] * np.sign(image - target) / image.size
        assert np.abs(gradient.numpy() - expected).max() <= 4.0 * EPSILON * np.abs(expected).max()

    def test_what_is_masked_away_is_not_read(self, device):
        image, mask, gradient = np.full((3, 3, 3), 0.5), np.ones((3, 3)), zeros((3, 3, 3), device)
        image[1, 1], mask[1, 1] = np.nan, 0.0
        assert value(L1Loss(3, 3, device=device)(image, np.zeros((3, 3, 3)), mask=mask, gradient=gradient)) == (
            pytest.approx(0.5 * 8.0 / 9.0, rel=4.0 * EPSILON)
        )
        assert (gradient.numpy()[1, 1] == 0.0).all()


class TestSsim:
    def test_skimage_inside(self, device, rng):
        image, target = images(rng, 40, 33, 3)
        _, similar = structural_similarity(
            image,
            target,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            channel_axis=-1,
            full=True,
        )
        inside = (slice(5, -5), slice(5, -5))
        assert np.abs(similar[inside] - twin.similarity(image, target)[inside]).max() < 1e-12
        mask = np.zeros((40, 33))
        mask[inside] = 1.0
        loss = SsimLoss(40, 33, device=device)(image, target, mask=mask)
        # moments: 22 roundings of squares below 1, over a variance and C2 of above 1e-3, averaged over 690 windows
        assert value(loss) == pytest.approx((1.0 - similar[inside]).sum() / image.size, abs=22.0 * EPSILON / 1e-3 / 26)

    @pytest.mark.parametrize("shape", [(1, 1, 1), (1, 9, 3), (15, 6, 1), (17, 11, 2)])
    def test_twin(self, device, rng, shape):
        image, target = images(rng, *shape)
        mask = rng.uniform(size=shape[:2]).astype(np.float32)
        gradient = zeros(shape, device)
        loss = SsimLoss(*shape, device=device)(image, target, weight=0.2, mask=mask, gradient=gradient)
        assert value(loss) == pytest.approx(0.2 * twin.ssim(image, target, mask), rel=GRADIENT)
        expected = 0.2 * twin.slope(lambda moved: twin.ssim(moved, target, mask), image)
        assert relative_error(gradient.numpy(), expected) <= GRADIENT

    def test_close_images_keep_their_digits(self, device, rng):
        """Bright, smooth, and within 1e-3 of the target: where 1 - S taken as such loses five digits."""
        target = np.full((20, 18, 1), 0.9, np.float32).astype(float)
        image = (target + 1e-3 * rng.standard_normal(target.shape)).astype(np.float32).astype(float)
        mask, gradient = np.ones((20, 18)), zeros(target.shape, device)
        loss = SsimLoss(20, 18, 1, device=device)(image, target, gradient=gradient)
        # float64 differences lose eleven digits of 1 - S = 1e-3 to a step of 1e-5: 1e-6 is left
        assert value(loss) == pytest.approx(twin.ssim(image, target, mask), rel=1e-6)
        expected = twin.slope(lambda moved: twin.ssim(moved, target, mask), image)
        assert relative_error(gradient.numpy(), expected) <= 2e-6


class TestNormal:
    def test_closed_form(self, device):
        angle = 0.3
        rendered = np.tile([0.0, 0.0, 0.4], (2, 3, 1))
        expected = np.tile([np.sin(angle), 0.0, np.cos(angle)], (2, 3, 1))
        to_rendered, to_expected = zeros((2, 3, 3), device), zeros((2, 3, 3), device)
        loss = NormalLoss(2, 3, device=device)(
            rendered, expected, weight=6.0, rendered_gradient=to_rendered, expected_gradient=to_expected
        )
        assert value(loss) == pytest.approx(6.0 * (1.0 - np.cos(angle)), abs=6.0 * 8.0 * EPSILON)
        # 6 over 6 pixels; turning a vector of length 0.4 towards the other by dx turns it by dx / 0.4
        assert to_rendered.numpy()[1, 2] == pytest.approx([-np.sin(angle) / 0.4, 0.0, 0.0], abs=16.0 * EPSILON)
        assert to_expected.numpy()[1, 2] == pytest.approx([0.0, 0.0, -1.0], abs=4.0 * EPSILON)

    @pytest.mark.parametrize("tolerance", [np.inf, 0.1])
    def test_twin(self, device, rng, tolerance):
        expected = unit(rng, 9, 8).astype(np.float32).astype(float)
        expected[2:4, 3] = 0.0
        rendered = (unit(rng, 9, 8) * rng.uniform(0.2, 1.0, (9, 8, 1))).astype(np.float32).astype(float)
        rendered[5, 5:7] = 0.0
        mask = rng.uniform(size=(9, 8)).astype(np.float32)
        to_rendered, to_expected = zeros((9, 8, 3), device), zeros((9, 8, 3), device)
        loss = NormalLoss(9, 8, device=device)(
            rendered,
            expected,
            weight=0.03,
            mask=mask,
            tolerance=tolerance,
            rendered_gradient=to_rendered,
            expected_gradient=to_expected,
        )
        assert value(loss) == pytest.approx(0.03 * twin.normal(rendered, expected, mask, tolerance), rel=16.0 * EPSILON)
        # where a normal is 0 it is left out, and a difference would step over that decision
        counted = (np.abs(rendered).max(-1) > 0.0) & (np.abs(expected).max(-1) > 0.0)
        frozen = mask * counted
        slope = 0.03 * twin.slope(lambda moved: twin.normal(moved, expected, frozen, tolerance), rendered)
        assert relative_error(to_rendered.numpy(), slope) <= 1e-6
        slope = 0.03 * twin.slope(lambda moved: twin.normal(rendered, moved, frozen, tolerance), expected)
        assert relative_error(to_expected.numpy(), slope) <= 1e-6
        assert (to_rendered.numpy()[~counted] == 0.0).all()
        assert (to_expected.numpy()[~counted] == 0.0).all()

    def test_what_differs_by_more_than_the_tolerance_counts_by_its_angle(self, device):
        rendered = np.tile([0.0, 0.0, 1.0], (1, 2, 1))
        found = []
        for angle in (1e-3, 1.0):
            expected = np.tile([np.sin(angle), 0.0, np.cos(angle)], (1, 2, 1))
            to_rendered = zeros((1, 2, 3), device)
            NormalLoss(1, 2, device=device)(rendered, expected, tolerance=0.1, rendered_gradient=to_rendered)
            found.append(-2.0 * to_rendered.numpy()[0, 0, 0])
        # of small angles the slope is the angle; of large ones the tolerance, times the cosine of half the angle
        assert found[0] == pytest.approx(1e-3, rel=1e-3)
        assert found[1] == pytest.approx(0.1 * np.cos(0.5), rel=0.01)

    @pytest.mark.parametrize("tolerance", [0.0, -1.0, np.nan])
    def test_tolerances_are_above_0(self, tolerance):
        with pytest.raises(InvalidOptionError, match="tolerance must be above 0, got"):
            NormalLoss(1, 1, device="cpu")(np.ones((1, 1, 3)), np.ones((1, 1, 3)), tolerance=tolerance)

    @pytest.mark.parametrize("broken", [0.0, 5e-4, np.nan])
    def test_pixels_without_a_direction(self, device, broken):
        rendered, expected = np.tile([0.0, 1.0, 0.0], (1, 3, 1)), np.tile([1.0, 0.0, 0.0], (1, 3, 1))
        rendered[0, 1] = broken, 0.0, 0.0
        to_rendered = zeros((1, 3, 3), device)
        loss = NormalLoss(1, 3, device=device)(rendered, expected, rendered_gradient=to_rendered)
        assert value(loss) == pytest.approx(2.0 / 3.0, rel=2.0 * EPSILON)
        assert (to_rendered.numpy()[0, 1] == 0.0).all()


class TestTerms:
    """What holds for every term."""

    @pytest.fixture(params=[L1Loss, SsimLoss])
    def kind(self, request):
        return request.param

    def test_equal_images(self, device, rng, kind):
        image, gradient = rng.uniform(size=(30, 20, 3)), zeros((30, 20, 3), device)
        assert value(kind(30, 20, device=device)(image, image, gradient=gradient)) == 0.0
        assert (gradient.numpy() == 0.0).all()

    def test_gradients_add_up(self, device, rng, kind):
        image, target = images(rng, 20, 30, 3)
        loss, gradient = kind(20, 30, device=device), upload(np.ones((20, 30, 3)), device)
        once = zeros((20, 30, 3), device)
        first = value(loss(image, target, weight=2.0, gradient=once))
        loss(image, target, weight=2.0, gradient=gradient)
        assert value(loss(image, target, weight=2.0)) == first  # the value alone
        assert np.abs(gradient.numpy() - (1.0 + once.numpy())).max() <= 2.0 * EPSILON

    def test_channels_of_wider_rows(self, device, rng, kind):
        image, target = images(rng, 19, 23, 3)
        rows = np.zeros((19 * 23, 8), np.float32)
        rows[:, 2:5] = image.reshape(-1, 3)
        channels = wp.types.vector(length=8, dtype=float)
        wide = wp.array(rows, dtype=channels, device=device)
        upstream = wp.zeros(19 * 23, dtype=channels, device=device)
        gradient, loss = zeros((19, 23, 3), device), kind(19, 23, device=device)
        apart = value(loss(image, target, gradient=gradient))
        together = loss(pixel_channels(wide, 19, 23, 2, 3), target, gradient=pixel_channels(upstream, 19, 23, 2, 3))
        assert value(together) == apart
        assert (upstream.numpy()[:, 2:5] == gradient.numpy().reshape(-1, 3)).all()
        assert (upstream.numpy()[:, [0, 1, 5, 6, 7]] == 0.0).all()

    def test_same_bits_for_every_number_of_threads(self, device, rng, kind, monkeypatch):
        image, target = images(rng, 70, 90, 3)
        found = []
        for threads in ("1", "3"):
            monkeypatch.setenv("BEAM_WARP_THREADS", threads)
            gradient = zeros(image.shape, device)
            found.append((value(kind(70, 90, device=device)(image, target, gradient=gradient)), gradient.numpy()))
        assert found[0][0] == found[1][0]
        assert (found[0][1] == found[1][1]).all()

    def test_capture_in_a_graph(self, device, rng, kind):
        if device == "cpu":
            pytest.skip("CUDA graphs are for CUDA")
        image, target = (upload(a, device) for a in images(rng, 20, 30, 3))
        loss, gradient, again = kind(20, 30, device=device), zeros(image.shape, device), zeros(image.shape, device)
        before = value(loss(image, target, gradient=again))
        with wp.ScopedCapture(device) as capture:
            result = loss(image, target, gradient=gradient)
        gradient.zero_()
        wp.capture_launch(capture.graph)
        assert value(result) == before
        assert (gradient.numpy() == again.numpy()).all()

    def test_many_pixels(self, device, rng):
        """More than the lanes of a sum, not a multiple of them."""
        image = rng.uniform(size=(211, 197, 1)).astype(np.float32)
        loss = value(L1Loss(211, 197, 1, device=device)(image, np.zeros_like(image)))
        assert loss == np.float32(math.fsum(image.ravel().tolist()) / image.size)

    def test_refusals(self, kind):
        loss, image = kind(4, 5, device="cpu"), np.zeros((4, 5, 3))
        with pytest.raises(InvalidArrayError, match=r"target must have shape \(4, 5, 3\), got \(5, 4, 3\)"):
            loss(image, np.zeros((5, 4, 3)))
        with pytest.raises(InvalidArrayError, match=r"mask must have shape \(4, 5\), got \(4, 5, 1\)"):
            loss(image, image, mask=np.zeros((4, 5, 1)))
        with pytest.raises(InvalidArrayError, match="gradient must be a warp array on cpu, got ndarray"):
            loss(image, image, gradient=np.zeros((4, 5, 3)))
        with pytest.raises(InvalidOptionError, match="weight must be a number in"):
            loss(image, image, weight=-1.0)
        with pytest.raises(InvalidOptionError, match="height must be an integer in"):
            kind(0, 5, device="cpu")


class TestChannels:
    def test_refusals(self):
        rows = wp.zeros(12, dtype=wp.vec4, device="cpu")
        with pytest.raises(InvalidArrayError, match="rows must be 3 x 4, contiguous, with channels 2 to 5, got"):
            pixel_channels(rows, 3, 4, 2, 3)
        with pytest.raises(InvalidArrayError, match="array must hold contiguous rows of float32, got dtype int32"):
            pixel_channels(wp.zeros(12, dtype=int, device="cpu"), 3, 4, 0, 1)
