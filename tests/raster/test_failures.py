"""What breaks rasterisers: every hazard is finite, and exact for inputs that differ from those given by roundings."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from reference.raster_differences import gradients, random_upstream
from reference.rasterizing import RasterImage, decide, replay
from reference.single_precision import ROUNDING, rounded
from support.drawn_hazards import APPROXIMATIONS, STABILITY, Drawn, remoteness
from support.raster_hazards import HAZARDS, ahead, make

from beam_warp.device.arrays import upload
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.directions import even_directions
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.quaternions import turns_from_z

OUTPUTS = ("alpha", "depth", "median_depth", "channels", "normals")

INVISIBLE = ("behind_the_camera", "far_outside_the_image", "a_tiny_world", "nothing")


@pytest.mark.parametrize(("antialiased", "depth_mode"), [(False, "plane"), (True, "exact")])
@pytest.mark.parametrize("name", HAZARDS)
def test_every_hazard_is_stable(device, rng, name, antialiased, depth_mode):
    """Images and gradients."""
    scene = replace(HAZARDS[name](rng), antialiased=antialiased, depth_mode=depth_mode)
    decisions = decide(scene)
    clear = ~decisions.near_jump
    assert clear.mean() > 0.9
    upstream = random_upstream(rng, scene, decisions)
    truth, wanted = replay(scene, decisions), gradients(scene, upstream, decisions)
    wanted |= {name: getattr(truth, name)[clear] for name in OUTPUTS}
    spread = dict.fromkeys(wanted, 0.0)
    for _ in range(3):
        other = rounded(rng, scene)
        image, found = replay(other, decisions), gradients(other, upstream, decisions)
        found |= {name: getattr(image, name)[clear] for name in OUTPUTS}
        spread = {key: max(spread[key], np.linalg.norm(found[key] - wanted[key])) for key in wanted}
    drawn = Drawn(scene, device)
    image, got = drawn.image(), drawn.gradients(upstream)
    got |= {name: getattr(image, name)[clear] for name in OUTPUTS}
    factor = STABILITY * remoteness(scene, decisions)
    rounding = ROUNDING * (APPROXIMATIONS if wp.get_device(device).is_cuda else 1.0)
    for key, array in wanted.items():
        assert np.isfinite(got[key]).all(), key
        limit = factor * (spread[key] + rounding * np.linalg.norm(array))
        assert np.linalg.norm(got[key] - array) <= limit, key
    np.testing.assert_array_equal(image.last[clear], truth.last[clear])


@pytest.mark.parametrize("name", INVISIBLE)
def test_what_is_nowhere_leaves_no_trace(device, rng, name):
    scene = HAZARDS[name](rng)
    drawn = Drawn(scene, device)
    image = drawn.image()
    for output in OUTPUTS:
        assert not getattr(image, output).any()
    assert (image.last == -1).all()
    ones = RasterImage(*(np.ones_like(getattr(image, output)) for output in OUTPUTS))
    for array in drawn.gradients(ones).values():
        assert not array.any()


@pytest.mark.parametrize("name", ["needles", "around_the_camera", "at_one_depth", "many_layers"])
def test_hazards_have_the_same_bits_again(device, rng, name, monkeypatch):
    scene = HAZARDS[name](rng)
    upstream = random_upstream(rng, scene, decide(scene))
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("BEAM_WARP_THREADS", threads)
        drawn = Drawn(scene, device)
        image = drawn.image()
        found.append({**drawn.gradients(upstream), **{output: getattr(image, output) for output in OUTPUTS}})
    for key, array in found[0].items():
        np.testing.assert_array_equal(array, found[1][key])


def test_capped_splats_pass_nothing_to_their_opacity(device, rng):
    """A wall of them on one pixel: its alpha does not change with anything."""
    scene = make(rng, [[0.0, 0.0, 2.0], [0.0, 0.0, 3.0]], [9.0, 10.0, 11.0], opacities=1.0, camera=ahead(1, 1))
    drawn = Drawn(scene, device)
    one = np.ones((1, 1))
    found = drawn.gradients(RasterImage(one, 0 * one, 0 * one, np.ones((1, 1, 3)), np.zeros((1, 1, 3))))
    for name in ("positions", "orientations", "scales", "opacities"):
        assert not found[name].any()
    np.testing.assert_allclose(found["values"], [[0.99] * 3, [0.0099] * 3], rtol=100 * 4 * ROUNDING)  # 1 - 0.99


def test_a_hundred_thousand_splats_on_one_tile(device, rng):
    """Each wider than the tile and barely above the cut: the pixel stops after the first 2,345 of them."""
    count = 100_000
    depth = np.sort(rng.uniform(1.0, 3.0, count))
    positions = np.stack([0 * depth, 0 * depth, depth], axis=-1)[rng.permutation(count)]
    scene = make(rng, positions, 1e3, opacities=1.0 / 254.9, camera=ahead(8, 8))
    drawn = Drawn(scene, device)
    image = drawn.image()
    passed = 1.0 - float(scene.opacities[0])
    seen = int(np.ceil(np.log(1e-4) / np.log(passed)))
    weights = (1.0 - passed) * passed ** np.arange(seen)
    order = np.argsort(positions.astype(np.float32)[:, 2], kind="stable")
    front = order[:seen]
    # The product of 2,345 factors, each rounded by half a unit, and as many sums.
    tolerance = 2 * seen * ROUNDING
    np.testing.assert_allclose(image.alpha, weights.sum(), rtol=tolerance)
    depths = weights @ scene.positions[front, 2] / weights.sum()
    np.testing.assert_allclose(image.depth, depths, rtol=tolerance)
    values = np.broadcast_to(weights @ scene.values[front], (8, 8, 3))
    np.testing.assert_allclose(image.channels, values, rtol=tolerance)
    assert (image.last == front[-1]).all()
    found = drawn.gradients(RasterImage(*(np.ones_like(getattr(image, output)) for output in OUTPUTS)))
    np.testing.assert_allclose(found["values"][front], np.tile(64 * weights[:, None], (1, 3)), rtol=tolerance)
    for array in found.values():
        assert np.isfinite(array).all()
        assert not array[order[seen:]].any()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 70), (16, 8), (17, 16), (65, 3)])
def test_images_of_every_shape(device, rng, width, height):
    """Splats around every pixel, edge and corner."""
    x, y = (rng.uniform(-4.0, side + 4.0, 80) for side in (width, height))
    z = rng.uniform(1.0, 3.0, 80)
    camera = ahead(width, height)
    positions = np.stack([(x - 0.5 * width) / 30.0 * z, (y - 0.5 * height) / 30.0 * z, z], axis=-1)
    scene = make(rng, positions, np.exp(rng.normal(-2.5, 0.5, (80, 3))), camera=camera)
    decisions = decide(scene)
    clear = ~decisions.near_jump
    got, want = Drawn(scene, device).image(), replay(scene, decisions)
    for output in ("alpha", "channels"):
        # A pixel coordinate below 80 is rounded by 4e-6 twice, and a response changes by at most 1.1 per pixel.
        np.testing.assert_allclose(getattr(got, output)[clear], getattr(want, output)[clear], atol=1e-5)
    np.testing.assert_array_equal(got.last[clear], want.last[clear])


def test_every_camera_of_a_batch_sees_what_it_sees_alone(device, rng):
    """Four sizes and lenses: every output, bit for bit, and gradients are the sum."""
    scene = HAZARDS["balls"](rng)
    cameras = [ahead(13, 9), ahead(1, 1), ahead(40, 17, 55.0), ahead(8, 8, 20.0)]
    arrays = [scene.arrays()[name].astype(np.float32) for name in ("positions", "orientations", "scales", "opacities")]
    gaussians = GaussianArrays(
        *(upload(a, kind, device) for a, kind in zip(arrays, (wp.vec3, wp.quat, wp.vec3, float), strict=True)),
        upload(scene.values.astype(np.float32), float, device),
    )
    edges = np.cumsum([0, *(camera.width * camera.height for camera in cameras)])
    to_alpha, to_channels = (rng.normal(size=(edges[-1], k)).astype(np.float32) for k in (1, 16))

    def seen(cameras, part):
        """Images, and gradients of the part of the loss that is theirs."""
        drawer = Rasterizer(len(arrays[0]), cameras, value_count=3, normals=True, device=device)
        images, adjoints = drawer.draw(gaussians), drawer.adjoints()
        adjoints.alpha.assign(to_alpha[part, 0])
        adjoints.channels[0].assign(np.ascontiguousarray(to_channels[part, : images.channels[0].shape[1]]))
        shown = (images.alpha, images.depth, images.median_depth, images.channels[0], drawer.gaussian_ids)
        found = drawer.backward()
        gradients = {name: getattr(found, name).numpy().astype(np.float64) for name in scene.arrays()}
        return [array.numpy() for array in shown], gradients

    together, total = seen(cameras, slice(None))
    size = dict.fromkeys(total, 0.0)
    for camera, part in zip(cameras, map(slice, edges[:-1], edges[1:]), strict=True):
        alone, found = seen([camera], part)
        for image, one in zip(together, alone, strict=True):
            np.testing.assert_array_equal(image[part], one)
        for name, array in found.items():
            total[name] -= array
            size[name] += np.abs(array).max()
    for name, rest in total.items():
        assert np.abs(rest).max() <= 8 * ROUNDING * size[name], name  # four sums


@pytest.mark.parametrize("length", [1e-3, 1e3])
def test_the_length_of_a_quaternion_does_not_matter(device, rng, length):
    """Images are the same, and the gradient falls as the length grows."""
    scene = HAZARDS["discs_without_thickness"](rng)
    other = replace(scene, orientations=(length * scene.orientations).astype(np.float32))
    decisions = decide(scene)
    upstream = random_upstream(rng, scene, decisions)
    first, second = Drawn(scene, device), Drawn(other, device)
    clear = ~decisions.near_jump
    np.testing.assert_allclose(second.image().alpha[clear], first.image().alpha[clear], atol=1e-5)
    one, two = first.gradients(upstream)["orientations"], second.gradients(upstream)["orientations"]
    assert np.linalg.norm(length * two - one) <= 1e-5 * np.linalg.norm(one)
    assert np.abs((two * other.orientations).sum(axis=1)).max() <= 1e-5 * np.linalg.norm(one)


def test_broken_rows_leave_the_others_alone(device, rng):
    """NaN, infinity and zero quaternions, in arrays that nobody checks: those rows are as good as absent."""
    scene = HAZARDS["balls"](rng)
    broken = {name: array.astype(np.float32) for name, array in scene.arrays().items()}
    broken["positions"][0] = np.nan
    broken["positions"][1, 0] = np.inf
    broken["orientations"][2, 1] = np.nan
    broken["orientations"][5] = 0.0
    broken["scales"][3, 1] = np.nan
    broken["opacities"][4] = np.nan
    rows = np.arange(6)
    absent = scene.opacities.copy()
    absent[rows] = 0.0
    upstream = random_upstream(rng, scene, decide(scene))
    bad, good = Drawn(replace(scene, **broken), device), Drawn(replace(scene, opacities=absent), device)
    for output in OUTPUTS:
        np.testing.assert_array_equal(getattr(bad.image(), output), getattr(good.image(), output))
    found, wanted = bad.gradients(upstream), good.gradients(upstream)
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name][6:], array[6:])


def outline_of_discs(device, thickness):
    """How far outside a sphere of 15 cm discs that lie on it draw its outline, and its middle [m]."""
    outward, radius, away, side = even_directions(5000), 0.15, 3.0, 160
    spread = 0.7 * radius * np.sqrt(4.0 * np.pi / len(outward))
    ball = GaussianCloud(
        positions=radius * outward,
        orientations=turns_from_z(outward),
        scales=np.tile([spread, spread, thickness], (len(outward), 1)),
        opacities=np.full(len(outward), 0.8),
        axes="rfu",
    )
    camera = Camera.look_at((0.0, -away, 0.0), (0, 0, 0), width=side, height=side, vertical_fov=8.0)
    options = RasterOptions(antialiased=True, low_pass=0.1)
    image = rasterize(ball, camera, channels=(), options=options, device=str(device))
    tangent = np.sqrt(image.alpha.sum() / np.pi) / camera.focal_x  # of half the angle that the ball covers
    middle = image.median_depth[side // 2 - 1 : side // 2 + 1, side // 2 - 1 : side // 2 + 1]
    return away * np.sin(np.arctan(tangent)) - radius, away - middle.mean() - radius


def test_an_outline_of_soft_discs_lies_outside_their_planes(device):
    """A ray at an outline passes many discs edge-on, and their tails add up; from the front, the first disc covers.

    So a fit that meets outlines sinks discs below the surface by as much. More than half of it is their thickness.
    """
    (thick, front), (thin, _) = outline_of_discs(device, 1e-3), outline_of_discs(device, 1e-4)
    assert abs(front) < 2e-4
    assert 1e-3 < thick < 4e-3
    assert 0.0 < thin < 0.5 * thick
