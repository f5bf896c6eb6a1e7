"""What breaks rasterisers: every hazard is finite, and exact for inputs that differ from those given by roundings."""

from dataclasses import replace

import numpy as np
import pytest
from raster_hazards import HAZARDS, ahead, make
from reference.rasterizing import decide, replay
from reference.single_precision import ROUNDING, rounded

from beam_warp.assets import GaussianCloud
from beam_warp.rasterizing import rasterize_values

STABILITY = 10.0
"""How many times the spread under one rounding of the inputs: a few dozen roundings in a chain, as their root sum."""

INVISIBLE = ("behind_the_camera", "far_outside_the_image", "a_tiny_world", "nothing")


def cloud_of(scene):
    return GaussianCloud(
        positions=scene.positions, orientations=scene.orientations, scales=scene.scales, opacities=scene.opacities
    )


def draw(scene, device):
    """Alpha, and the sums of depth and values."""
    return rasterize_values(cloud_of(scene), scene.camera, scene.values, device=device, antialiased=scene.antialiased)


def exact(scene, decisions):
    image = replay(scene, decisions)
    return image.alpha, image.alpha * image.depth, image.channels


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", HAZARDS)
def test_every_hazard_is_stable(device, rng, name, antialiased):
    scene = replace(HAZARDS[name](rng), antialiased=antialiased)
    decisions = decide(scene)
    clear = ~decisions.near_jump
    assert clear.mean() > 0.9
    wanted = exact(scene, decisions)
    spread = [0.0, 0.0, 0.0]
    for _ in range(4):
        others = exact(rounded(rng, scene), decisions)
        spread = [max(s, np.linalg.norm((o - w)[clear])) for s, o, w in zip(spread, others, wanted, strict=True)]
    for got, want, noise in zip(draw(scene, device), wanted, spread, strict=True):
        assert np.isfinite(got).all()
        limit = STABILITY * (noise + ROUNDING * np.linalg.norm(want[clear]))
        assert np.linalg.norm((got - want)[clear]) <= limit


@pytest.mark.parametrize("name", INVISIBLE)
def test_what_is_nowhere_leaves_no_trace(device, rng, name):
    for array in draw(HAZARDS[name](rng), device):
        assert not array.any()


@pytest.mark.parametrize("name", ["at_one_depth", "copies"])
def test_one_depth_is_drawn_in_the_order_of_rows(device, rng, name):
    scene = HAZARDS[name](rng)
    order = rng.permutation(len(scene.positions))
    other = replace(scene, **{key: array[order] for key, array in scene.arrays().items()})
    first, second = draw(scene, device), draw(other, device)
    assert np.abs(first[2] - second[2]).max() > 0.01
    decisions = decide(other)
    clear = ~decisions.near_jump
    # A weight of at most one, of values of at most one, rounded at each of forty splats.
    np.testing.assert_allclose(second[2][clear], exact(other, decisions)[2][clear], atol=40 * 2 * ROUNDING)


@pytest.mark.parametrize("name", HAZARDS)
def test_every_hazard_has_the_same_bits_again(device, rng, name, monkeypatch):
    scene = HAZARDS[name](rng)
    first = draw(scene, device)
    monkeypatch.setenv("BEAM_WARP_THREADS", "3")
    for a, b in zip(first, draw(scene, device), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_hundred_thousand_splats_on_one_tile(device, rng):
    """Each wider than the tile and barely above the cut: the pixel stops after the first 2,345 of them."""
    count = 100_000
    depth = np.sort(rng.uniform(1.0, 3.0, count))
    positions = np.stack([0 * depth, 0 * depth, depth], axis=-1)[rng.permutation(count)]
    scene = make(rng, positions, 1e3, opacities=1.0 / 254.9, camera=ahead(8, 8))
    alpha, depths, values = draw(scene, device)
    passed = 1.0 - float(scene.opacities[0])
    drawn = int(np.ceil(np.log(1e-4) / np.log(passed)))
    weights = (1.0 - passed) * passed ** np.arange(drawn)
    front = np.argsort(positions.astype(np.float32)[:, 2], kind="stable")[:drawn]
    # The product of 2,345 factors, each rounded by half a unit, and as many sums.
    tolerance = 2 * drawn * ROUNDING
    np.testing.assert_allclose(alpha, weights.sum(), rtol=tolerance)
    np.testing.assert_allclose(depths, weights @ scene.positions[front, 2], rtol=tolerance)
    np.testing.assert_allclose(values, np.broadcast_to(weights @ scene.values[front], (8, 8, 3)), rtol=tolerance)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 70), (70, 1), (7, 9), (16, 8), (17, 16), (65, 3)])
def test_images_of_every_shape(device, rng, width, height):
    """Splats around every pixel, edge and corner."""
    x, y = (rng.uniform(-4.0, side + 4.0, 80) for side in (width, height))
    z = rng.uniform(1.0, 3.0, 80)
    camera = ahead(width, height)
    positions = np.stack([(x - 0.5 * width) / 30.0 * z, (y - 0.5 * height) / 30.0 * z, z], axis=-1)
    scene = make(rng, positions, np.exp(rng.normal(-2.5, 0.5, (80, 3))), camera=camera)
    decisions = decide(scene)
    clear = ~decisions.near_jump
    for got, want in zip(draw(scene, device), exact(scene, decisions), strict=True):
        assert got.shape == want.shape
        # A pixel coordinate below 80 is rounded by 4e-6 twice; ln(alpha) has a slope of at most 6 where it is cut.
        np.testing.assert_allclose(got[clear], want[clear], atol=3.0 * 5e-5 / 6)
