"""What a photograph says about its camera: the flow of pixels, numbers found again, errors that hold."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from beam_warp.capture.corrections import moved_camera
from beam_warp.capture.lenses import Lens
from beam_warp.reconstruction import alignment
from beam_warp.reconstruction.alignment import Evidence, evidence, flow, flow_of, strength
from beam_warp.world.camera import Camera

CAMERA = Camera.orbit((0.1, 0.2, 0.3), 2.5, 40.0, 10.0, width=96, height=72, vertical_fov=40.0)


@pytest.mark.parametrize("number", range(9))
def test_flow_is_the_derivative_of_projection(rng, number):
    points = rng.uniform(-0.4, 0.4, (50, 3))
    step = np.zeros(9)
    step[number] = 1e-6
    moved = (moved_camera(CAMERA, step).project(points) - CAMERA.project(points))[:, :2].T / 1e-6
    np.testing.assert_allclose(flow_of(CAMERA, points)[number], moved, atol=1e-6 * 2 * CAMERA.focal_x)  # second order


@pytest.mark.parametrize("number", [9, 10])
def test_flow_of_radial_terms_is_that_of_a_lens(rng, number):
    pixels = rng.uniform(0.0, 70.0, (2, 40))
    tangents = ((pixels.T - (CAMERA.center_x, CAMERA.center_y)) / CAMERA.focal_x).astype(np.float64)
    lens = Lens((1e-3 * (number == 9), 1e-3 * (number == 10), 0.0, 0.0, 0.0, 0.0))
    moved = (lens.distort(tangents) - tangents).T * CAMERA.focal_x / 1e-3
    np.testing.assert_allclose(flow(CAMERA, np.ones(40), pixels)[number], moved, atol=1e-9 * CAMERA.focal_x)


def picture(camera, points, colors):
    """Blurred dots, smooth enough for differences of pixels to be derivatives; the last channel is coverage."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    image = np.zeros((camera.height, camera.width, 4))
    for (x, y, _), color in zip(camera.project(points), colors, strict=True):
        image += np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18.0)[..., None] * color
    return image


@pytest.fixture
def dots(rng):
    """Points of a plane across the optical axis, and their colours."""
    across = rng.uniform(-0.6, 0.6, (60, 2))
    axes = CAMERA.camera_to_world[:3, :3]
    points = CAMERA.position + 2.5 * axes[:, 2] + across @ axes[:, :2].T
    return points, rng.uniform(0.1, 0.4, (60, 4))


def test_turns_are_found_again(dots):
    move = np.array([2e-3, -1e-3, 3e-3, *[0.0] * 6])
    drawn, photograph = picture(CAMERA, *dots), picture(moved_camera(CAMERA, move), *dots)
    found, _ = evidence(drawn, photograph, np.full((72, 96), 2.5), CAMERA).solved(["turn"])
    np.testing.assert_allclose(
        found[:3], move[:3], atol=0.1 * 3e-3
    )  # differences of pixels blur slopes by some per cent
    np.testing.assert_array_equal(found[3:], 0.0)


def test_errors_are_those_that_noise_makes(rng, monkeypatch):
    """The mean of |z| is 1 where photographs differ by noise alone, as far as 60 numbers tell."""
    monkeypatch.setattr(alignment, "MODEL_ERROR", 1.0)
    camera = CAMERA.supersampled(3)
    drawn = np.stack([5.0 + gaussian_filter(rng.normal(size=(216, 288)), 3.0) for _ in range(4)], axis=-1)
    photographs = [drawn + 0.05 * rng.normal(size=drawn.shape) for _ in range(20)]
    found = [evidence(drawn, photograph, np.full((216, 288), 2.5), camera) for photograph in photographs]
    sizes = strength(found, ["turn"], "turn")
    assert np.sqrt(np.mean(sizes**2)) == pytest.approx(1.0, abs=4.0 / np.sqrt(2 * 60))


def test_a_photograph_of_nothing_says_nothing():
    empty = np.zeros((72, 96, 4))
    found = evidence(empty, empty, np.zeros((72, 96)), CAMERA)
    numbers, covariance = found.solved(["turn", "shift"])
    assert not numbers.any()
    assert not covariance.any()
    assert not strength([found, Evidence(np.zeros((0, 11, 11)), np.zeros((0, 11)))], ["turn"], "turn").any()
