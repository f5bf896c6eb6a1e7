"""Sharpness, noise and compression of images: blurs, noise and steps that are known, and copies of the walker."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from PIL import Image as PillowImage
from scipy.ndimage import gaussian_filter
from support.discs import SIDE, WALL, before, disc

from beam_warp.capture.capture import Capture
from beam_warp.capture.inspect import inspect_capture
from beam_warp.capture.quality import FEWEST, _deviations, blotted, edge_blur, photon_noise
from beam_warp.image.files import quantization_error
from beam_warp.stability.flaws.optics import defocused, motion_blurred
from beam_warp.stability.flaws.write import write_flawed

RNG = np.random.default_rng(0)


def layers(alpha):
    return np.pad(alpha, 8)[..., None].astype(np.float64)


def blur_of(image):
    return edge_blur(image.astype(np.float32), image[..., -1].astype(np.float32))


def test_an_outline_that_is_sharp_has_no_blur():
    assert max(blur_of(layers(disc()))) < 0.1
    assert max(edge_blur(before(WALL, disc()), disc())) < 0.1


@pytest.mark.parametrize("diameter", [1.4, 2.0, 2.6, 4.0])
def test_the_blur_of_a_disc_is_a_quarter_of_its_diameter(diameter):
    least, largest = blur_of(defocused(layers(disc()), diameter))
    assert 0.7 < least / (diameter / 4.0) < 1.05  # a lower bound: the quartile of edges, followed for three pixels
    assert largest == pytest.approx(least, abs=0.05)


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.3, 2.5])
def test_the_blur_of_motion_is_in_one_direction(angle):
    least, largest = blur_of(motion_blurred(layers(disc()), 2.2 * np.array([np.cos(angle), np.sin(angle)])))
    assert least < 0.2
    assert largest == pytest.approx(2.2 / np.sqrt(12.0), abs=0.12)


def test_a_photograph_shows_its_blur_by_its_colors():
    photograph = gaussian_filter(before(WALL, disc()), (0.7, 0.7, 0.0), mode="nearest")
    least, largest = edge_blur(photograph, disc())
    assert 0.7 * 0.7 < least <= largest < 1.05 * 0.7


def test_directions_without_edges_are_not_blurred():
    """The covariance that fits edges within 45 degrees of one direction may be large across it, by chance."""
    quartiles, angles = np.array([-0.17, -0.03, -0.06, -0.10]), (np.array([0.0, 1.0, 6.0, 7.0]) + 0.5) * np.pi / 8.0
    normals = np.stack([np.sin(angles), np.cos(angles)], axis=1).repeat(FEWEST, axis=0)
    assert _deviations(quartiles.repeat(FEWEST), normals) == (0.0, 0.0)


@pytest.mark.parametrize("noise", [0.0, 4e-4])
def test_holes_and_islands_of_a_mask_are_told_from_the_subject_s_own(noise):
    """A disc, one with a hole, and one with another beside it: each as the subject, and as its mask."""
    shapes = {"disc": disc(), "ring": disc() - disc(radius=6.0), "pair": disc() + disc(radius=5.0, center=(8.0, 10.0))}
    hole, island = (int(((shapes[name] > 0.5) != (shapes["disc"] > 0.5)).sum()) for name in ("ring", "pair"))
    wrong = {("disc", "ring"): hole, ("disc", "pair"): island, ("ring", "pair"): island, ("pair", "ring"): hole}
    for (subject, true), (name, mask) in product(shapes.items(), shapes.items()):
        photograph = gaussian_filter(before(WALL, true), (0.7, 0.7, 0.0), mode="nearest")
        if noise:
            photograph = (RNG.poisson(photograph / noise) * noise).astype(np.float32)
        assert blotted(photograph, mask) == wrong.get((subject, name), 0)
    clutter = (WALL * RNG.uniform(0.2, 2.0, WALL.shape)).astype(np.float32)
    assert blotted(before(clutter, shapes["disc"]), shapes["pair"]) == 0


def test_nothing_tells_without_an_outline():
    assert np.isnan(edge_blur(WALL, np.ones((SIDE, SIDE), np.float32))).all()
    assert np.isnan(photon_noise(WALL, np.zeros((SIDE, SIDE), bool)))


@pytest.mark.parametrize("noise", [1e-4, 4e-4, 2e-3])
def test_noise_is_told_from_texture(noise):
    texture = gaussian_filter(RNG.normal(size=(SIDE, SIDE)), 0.7)[..., None] * np.array([0.1, 0.1, 0.1])
    surface = 0.5 * WALL * (1.0 + texture)
    solid = disc() == 1.0
    assert photon_noise(surface.astype(np.float32), solid) < 1e-6
    noisy = RNG.poisson(surface / noise) * noise
    assert np.sqrt(photon_noise(noisy.astype(np.float32), solid) / noise) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("quality", [75, 90, 95])
def test_steps_of_a_jpeg_say_how_far_its_luminance_is_off(tmp_path, quality):
    grey = RNG.integers(0, 256, (128, 128)).astype(np.uint8)
    PillowImage.fromarray(grey).save(tmp_path / "a.jpg", quality=quality)
    error = np.asarray(PillowImage.open(tmp_path / "a.jpg"), float) - grey
    assert quantization_error(tmp_path / "a.jpg") == pytest.approx(np.sqrt(np.square(error).mean()), rel=0.05)
    PillowImage.fromarray(grey).save(tmp_path / "a.png")
    assert quantization_error(tmp_path / "a.png") == 0.0


@pytest.mark.parametrize(
    ("flaws", "size", "said"),
    [
        ((), 1.0, set()),
        (("plate",), 1.0, set()),
        (("defocus",), 1.0, {"soft-images"}),
        (("defocus", "plate"), 2.0, {"soft-images"}),
        (("motion-blur",), 2.0, {"motion-blur"}),
        (("noise",), 2.0, {"noisy-images"}),
        (("jpeg",), 1.0, {"jpeg-loss"}),
        (("blots",), 1.0, {"mask-blots"}),
    ],
)
def test_flaws_of_images_are_named(data_dir, tmp_path, flaws, size, said):
    clean = Capture.read(data_dir / "captures" / "walker")
    few = replace(clean, records=clean.select(split="train", frames={0})[::3])
    found = inspect_capture(write_flawed(few, tmp_path / "flawed", flaws, size=size).capture).findings
    named = {"soft-images", "motion-blur", "noisy-images", "jpeg-loss", "mask-blots"}
    assert {finding.code for finding in found} & named == said
