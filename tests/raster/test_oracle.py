"""The float64 rasteriser is what others are measured by: closed forms, brute force, and gradients by other means."""

from dataclasses import replace

import numpy as np
import pytest
from reference.raster_differences import gradients, random_upstream
from reference.raster_splats import RasterScene, harmonics, rotations
from reference.rasterizing import RasterImage, decide, draw, pixel_centers, replay
from support.raster_clouds import around
from support.raster_hazards import HAZARDS, ahead

from beam_warp.world.camera import Camera
from beam_warp.world.harmonics import sh_basis

OUTPUTS = ("alpha", "depth", "median_depth", "channels", "normals")

ROUNDING = 1e-13
"""Some hundred operations of 1e-16 on numbers of order 1."""

STEPS = {
    "positions": lambda scene: 1e-7 * scene.scales.max(axis=1, keepdims=True),
    "orientations": lambda scene: 1e-7 * np.maximum(thinness(scene), 1e-3),
    "scales": lambda scene: 1e-7 * scene.scales,
    "opacities": lambda scene: 1e-7 * scene.opacities,
    "values": lambda scene: 1e-7,
}
"""Moves that change no decision but close ones: a disc seen edge on swings its plane by its turn over its thinness."""

UP = [0.0, 0.0, 0.0, 1.0]


SMALL = ahead(16, 12, 20.0)


def thinness(scene):
    """Least over largest scale, (N, 1); 1 for a point."""
    largest = scene.scales.max(axis=1, keepdims=True)
    least = scene.scales.min(axis=1, keepdims=True)
    return np.divide(least, largest, out=np.ones_like(least), where=largest > 0.0)


def make_scene(rng, count, size, **changes):
    fields = {
        "positions": rng.uniform(-1, 1, (count, 3)),
        "orientations": rng.normal(size=(count, 4)),
        "scales": np.exp(rng.normal(-2.5, 0.7, (count, 3))),
        "opacities": rng.uniform(0.05, 1.0, count),
        "camera": around(size, size),
        "values": rng.uniform(size=(count, 2)),
        "radiance": rng.normal(0.0, 0.3, (count, 16, 3)),
    }
    return RasterScene(**{**fields, **changes})


def loss(image, upstream):
    return sum((getattr(upstream, name) * getattr(image, name)).sum() for name in OUTPUTS)


def offsets(camera):
    """Pixel centres from the principal point, over the focal length, (H, W, 2)."""
    pixels = pixel_centers(camera) - (camera.center_x, camera.center_y)
    return (pixels / (camera.focal_x, camera.focal_y)).reshape(camera.height, camera.width, 2)


@pytest.mark.parametrize("depth_mode", ["plane", "exact"])
def test_a_ball_on_the_axis_is_its_closed_form(depth_mode):
    camera, z, scale, opacity = SMALL, 2.0, 0.3, 0.7
    scene = RasterScene([[0, 0, z]], [UP], [[scale] * 3], [opacity], camera, values=[[3.0]], depth_mode=depth_mode)
    image = draw(scene)
    square = (offsets(camera) ** 2).sum(-1)
    variance = (20.0 * scale / z) ** 2 + 0.3
    alpha = opacity * np.exp(-0.5 * 400.0 * square / variance)
    assert alpha.min() > 1 / 255
    np.testing.assert_allclose(image.alpha, alpha, rtol=ROUNDING)
    np.testing.assert_allclose(image.channels[..., 0], 3.0 * alpha, rtol=ROUNDING)
    np.testing.assert_allclose(image.normals, alpha[..., None] * [0.0, 0.0, -1.0], atol=ROUNDING)
    # The plane is perpendicular to the axis; the point of a ray closest to the centre is the foot of its perpendicular.
    depth = np.full_like(alpha, z) if depth_mode == "plane" else z / (1.0 + square)
    np.testing.assert_allclose(image.depth, depth, rtol=ROUNDING)
    np.testing.assert_allclose(image.median_depth, depth, rtol=ROUNDING)
    assert (image.last == 0).all()


def test_antialiasing_keeps_the_total():
    camera = SMALL
    scene = RasterScene([[0, 0, 2.0]], [UP], [[0.02] * 3], [0.9], camera, antialiased=True)
    sharp = (20.0 * 0.02 / 2.0) ** 2
    alpha = 0.9 * sharp / (sharp + 0.3) * np.exp(-200.0 * (offsets(camera) ** 2).sum(-1) / (sharp + 0.3))
    np.testing.assert_allclose(draw(scene).alpha, np.where(alpha < 1 / 255, 0.0, alpha), atol=ROUNDING)


def test_layers_are_composited_capped_and_stopped():
    # Balls as wide as the world: on the one pixel each has its opacity.
    camera = ahead(1, 1)
    opacities = [0.3, 0.003, 0.4, 1.0, 1.0, 0.9]
    depths = np.array([2.0, 2.5, 3.0, 4.0, 5.0, 6.0])
    order = [3, 0, 5, 1, 4, 2]
    positions = np.stack([0 * depths, 0 * depths, depths], axis=-1)[order]
    scene = RasterScene(
        positions, [UP] * 6, [[50.0] * 3] * 6, np.array(opacities)[order], camera, values=np.eye(6)[order]
    )
    image = draw(scene)
    # The second is below 1/255; after the fifth less than 1e-4 is left, so the last is never reached.
    weights = np.array([0.3, 0.0, 0.7 * 0.4, 0.42 * 0.99, 0.0042 * 0.99, 0.0])
    np.testing.assert_allclose(image.channels[0, 0], weights, atol=ROUNDING)
    np.testing.assert_allclose(image.alpha, weights.sum(), rtol=ROUNDING)
    np.testing.assert_allclose(image.depth, weights @ depths / weights.sum(), rtol=ROUNDING)
    assert image.median_depth[0, 0] == pytest.approx(3.0, rel=ROUNDING)  # 0.7 before it, 0.42 after
    assert image.last[0, 0] == order.index(4)


@pytest.mark.parametrize(("first", "median"), [(0.49, 3.0), (0.51, 2.0)])
def test_the_median_is_the_last_with_more_than_half_before_it(first, median):
    camera = ahead(1, 1)
    scene = RasterScene([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]], [UP] * 3, [[50.0] * 3] * 3, [first, 0.3, 0.9], camera)
    assert draw(scene).median_depth[0, 0] == pytest.approx(median, rel=ROUNDING)


def test_what_is_not_seen():
    camera = SMALL
    image = draw(
        RasterScene(
            [[0, 0, -1.0], [0, 0, 0.009]], [UP] * 2, [[0.1] * 3] * 2, [1.0, 1.0], camera, values=np.ones((2, 1))
        )
    )
    for name in OUTPUTS:
        assert not getattr(image, name).any()
    assert (image.last == -1).all()
    assert draw(RasterScene(*(np.zeros((0, *s)) for s in ((3,), (4,), (3,), ())), camera)).channels.shape == (12, 16, 0)


@pytest.mark.parametrize("tilt", [0.0, 1.2])
def test_a_disc_is_its_plane_and_has_its_normal(tilt):
    """Both modes, in a turned camera: the normal comes in world axes."""
    camera = Camera.orbit((0, 0, 0), 2.0, 30.0, 10.0, width=24, height=24, vertical_fov=50.0)
    to_world = camera.camera_to_world[:3, :3]
    turn = rotations(np.array([[np.sin(0.5 * tilt), 0.0, 0.0, np.cos(0.5 * tilt)]]))[0]
    # A quaternion whose rotation carries the disc's axis z to the tilted normal.
    world = to_world @ turn
    w = 0.5 * np.sqrt(1.0 + np.trace(world))
    quaternion = [
        *(np.array([world[2, 1] - world[1, 2], world[0, 2] - world[2, 0], world[1, 0] - world[0, 1]]) / (4 * w)),
        w,
    ]
    # A thin disc is its plane up to the square of its thickness over its width.
    scene = RasterScene([[0.02, 0.05, -0.01]], [quaternion], [[0.2, 0.15, 1e-9]], [0.9], camera)
    normal = -world[:, 2] if (scene.positions[0] - camera.position) @ world[:, 2] > 0 else world[:, 2]
    rays = camera.directions()
    distance = ((scene.positions[0] - camera.position) @ normal) / (rays @ normal)
    center_depth = (scene.positions[0] - camera.position) @ camera.forward
    depth = distance * (rays @ camera.forward)
    for mode in ("plane", "exact"):
        image = draw(replace(scene, depth_mode=mode))
        inside = (image.alpha > 0) & (np.abs(depth - center_depth) < 3 * 0.2)
        assert inside.sum() > 50
        np.testing.assert_allclose(image.depth[inside], depth[inside], rtol=1e-12)
        np.testing.assert_allclose(image.normals, image.alpha[..., None] * normal, atol=1e-12)


def random_gaussian(rng):
    """One Gaussian before the camera, up to a hundred times as long as wide."""
    z = rng.uniform(1.0, 3.0)
    position = np.array([[*rng.uniform(-0.3, 0.3, 2) * z, z]])
    return position, rng.normal(size=(1, 4)), np.exp(rng.uniform(np.log(0.003), np.log(0.3), (1, 3)))


def test_exact_depth_is_where_the_response_is_largest(rng):
    """Against bisection on the response itself, a parabola on the ray: its rise across t is zero at its top."""
    camera, worst, compared = SMALL, 0.0, 0
    for _ in range(60):
        position, orientation, scales = random_gaussian(rng)
        scene = RasterScene(position, orientation, scales, [0.9], camera, depth_mode="exact")
        decisions = decide(scene)
        image = draw(scene)
        axes = rotations(scene.orientations)[0]
        inverse = np.linalg.inv(axes @ np.diag(scales[0] ** 2) @ axes.T)
        at = decisions.pixel[(decisions.depth_side == 0) & ~decisions.behind]
        rays = np.concatenate([offsets(camera).reshape(-1, 2)[at], np.ones((len(at), 1))], axis=1)

        def exponent(t, rays=rays, inverse=inverse, position=position):
            offset = t[:, None] * rays - position
            return -0.5 * np.einsum("pi,ij,pj->p", offset, inverse, offset)

        step = scales.max()
        low, high = np.full(len(at), position[0, 2] - 4 * step), np.full(len(at), position[0, 2] + 4 * step)
        for _ in range(60):
            middle = 0.5 * (low + high)
            rising = exponent(middle + step) > exponent(middle - step)
            low, high = np.where(rising, middle, low), np.where(rising, high, middle)
        worst = max(worst, np.abs(image.depth.ravel()[at] / low - 1.0).max(initial=0.0))
        compared += len(at)
    assert compared > 1000
    assert worst < 1e-12  # the exponent is rounded by 1e-16 of up to 1e4, the squared ratio of the scales


def test_harmonics_are_those_of_the_package(rng):
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for degree in range(5):
        np.testing.assert_allclose(harmonics(directions, degree), sh_basis(directions, degree), atol=1e-14)


def test_radiance_is_seen_from_the_camera_and_clamped():
    radiance = np.zeros((1, 4, 3))
    radiance[0, 0] = [1.0, 0.0, -3.0]
    radiance[0, 2] = 0.5  # grows along z
    scene = RasterScene([[0, 0, 2.0]], [UP], [[0.3] * 3], [0.8], SMALL, values=[[7.0]], radiance=radiance)
    image = draw(scene)
    first, along_z = np.sqrt(0.25 / np.pi), np.sqrt(0.75 / np.pi)
    expected = [7.0, 0.5 + first + 0.5 * along_z, 0.5 + 0.5 * along_z, 0.0]
    np.testing.assert_allclose(image.channels, image.alpha[..., None] * expected, atol=ROUNDING)


def test_gradients_of_a_ball_by_hand():
    """Every derivative of alpha, expected depth, median, one value and the normals of one ball on the axis."""
    rng = np.random.default_rng(5)
    camera, f, z, s, o, v = SMALL, 20.0, 2.0, 0.3, 0.7, 3.0
    scene = RasterScene([[0, 0, z]], [2 * np.array(UP)], [[s] * 3], [o], camera, values=[[v]])
    upstream = random_upstream(rng, scene, decide(scene))
    got = gradients(scene, upstream)
    d = f * offsets(camera)
    square = (d**2).sum(-1)
    variance = (f * s / z) ** 2 + 0.3
    response = np.exp(-0.5 * square / variance)
    # L as a function of alpha alone: depths do not depend on it where there is one splat.
    to_alpha = upstream.alpha + v * upstream.channels[..., 0] - upstream.normals[..., 2]
    np.testing.assert_allclose(got["opacities"], [(to_alpha * response).sum()], rtol=1e-12)
    np.testing.assert_allclose(got["values"], [[(upstream.channels[..., 0] * o * response).sum()]], rtol=1e-12)
    # Along each axis the variance grows with that scale only; the third widens nothing on the axis.
    by_variance = (to_alpha * o * response)[..., None] * d**2 / (2 * variance**2)
    np.testing.assert_allclose(got["scales"][0, :2], by_variance.sum((0, 1)) * 2 * s * (f / z) ** 2, rtol=1e-12)
    # The normal is -A p / |A p|, the plane's slope is that of A p: moved by s, it stays on the axis.
    np.testing.assert_allclose(got["scales"][0, 2], 0.0, atol=1e-12)
    # Sideways: the centre moves by f/z, the normal by -1/z, and the plane stays perpendicular to the centre's ray:
    # its inverse depth is (1 + u x) / (z (1 + u^2)) with x the pixel's slope, so depth falls by z x du, du = 1/z.
    to_depth = upstream.depth + upstream.median_depth
    sideways = (to_alpha * o * response)[..., None] * d / variance * f / z
    sideways -= (o * response)[..., None] * upstream.normals[..., :2] / z
    sideways -= to_depth[..., None] * offsets(camera)
    np.testing.assert_allclose(got["positions"][0, :2], sideways.sum((0, 1)), rtol=1e-12)
    # Away: the variance falls, depth grows one to one.
    away = (by_variance.sum(-1) * -2 * (f * s) ** 2 / z**3 + to_depth).sum()
    np.testing.assert_allclose(got["positions"][0, 2], away, rtol=1e-12)
    np.testing.assert_allclose(got["orientations"], 0.0, atol=1e-11)  # a ball does not turn


@pytest.mark.parametrize(("depth_mode", "antialiased"), [("plane", True), ("exact", False)])
def test_gradients_of_all_splats_at_once_are_those_of_each_entry(rng, depth_mode, antialiased):
    """Against the whole image, replayed for one moved entry at a time."""
    scene = make_scene(rng, 40, 20, depth_mode=depth_mode, antialiased=antialiased)
    upstream, decisions = random_upstream(rng, scene, decide(scene)), decide(scene)
    got = gradients(scene, upstream, decisions)
    assert list(got) == list(scene.arrays())
    for name, array in scene.arrays().items():
        expected = []
        entries = [tuple(int(rng.integers(side)) for side in array.shape) for _ in range(12)]
        for entry in entries:
            moved = array.astype(complex)
            moved[entry] += 1e-20j
            expected.append(loss(replay(replace(scene, **{name: moved}), decisions), upstream).imag / 1e-20)
        difference = np.array([got[name][entry] for entry in entries]) - expected
        assert np.any(expected)
        assert np.linalg.norm(difference) < 1e-10 * np.linalg.norm(expected), name


def test_gradients_know_what_cannot_move(rng):
    scene = make_scene(rng, 40, 20)
    scene.positions[0] = scene.camera.position - scene.camera.forward  # behind the camera
    got = gradients(scene, random_upstream(rng, scene, decide(scene)))
    for name in scene.arrays():
        assert not got[name][0].any()
    turning = (got["orientations"] * scene.orientations).sum(axis=1)
    size = np.linalg.norm(got["orientations"], axis=1) * np.linalg.norm(scene.orientations, axis=1)
    assert np.all(np.abs(turning) <= 1e-10 * size.max())  # a quaternion's length is no parameter
    capped = RasterScene([[0, 0, 2.0]], [UP], [[50.0] * 3], [1.0], ahead(1, 1), values=[[1.0]])
    assert not gradients(capped, random_upstream(rng, capped, decide(capped)))["opacities"].any()


@pytest.mark.parametrize("end", [-1, 1])
def test_depth_clamped_at_an_end_moves_with_the_splat(rng, end):
    """Depth is z + 3 s or z - 3 s there, s the largest scale."""
    half = 0.5 * np.radians(86.0)
    scene = RasterScene(
        positions=[[0, 0, 2.0]],
        orientations=[[0, np.sin(half), 0, np.cos(half)]],
        scales=[[0.05, 0.2, 1e-4]],
        opacities=[0.9],
        camera=ahead(33, 1, 40.0),
        low_pass=40.0,
    )
    decisions = decide(scene)
    clamped = decisions.pixel[decisions.depth_side == end]
    count = len(clamped)
    assert count > 3
    np.testing.assert_allclose(draw(scene).depth[0, clamped], 2.0 - end * 0.6, rtol=ROUNDING)
    upstream = np.zeros((1, 33))
    upstream[0, clamped] = 1.0
    nothing = np.zeros((1, 33))
    got = gradients(scene, RasterImage(nothing, upstream, nothing, np.zeros((1, 33, 0)), np.zeros((1, 33, 3))))
    np.testing.assert_allclose(got["scales"][0], [0.0, -3.0 * end * count, 0.0], atol=1e-12 * count)
    np.testing.assert_allclose(got["positions"][0], [0.0, 0.0, count], atol=1e-12 * count)


@pytest.mark.parametrize(
    ("name", "opacity", "layers"), [("near_jump", 1 / 255, 1), ("near_bend", 0.99, 1), ("near_jump", 0.5, 2)]
)
def test_near_ties_are_known(name, opacity, layers):
    """A splat at the cut, one at the cap, and one that leaves exactly half."""
    positions = [[0, 0, 2.0 + i] for i in range(layers)]
    for factor, tied in ((1.0 + 1e-6, True), (1.0 - 1e-6, True), (0.995, False)):
        opacities = [opacity * factor] + [0.3] * (layers - 1)
        scene = RasterScene(positions, [UP] * layers, [[1e3, 900, 800]] * layers, opacities, ahead(1, 1))
        assert getattr(decide(scene), name)[0, 0] == tied


def test_depths_too_close_to_sort_are_known():
    for gap, tied in ((0.0, False), (1e-7, True), (1e-4, False)):
        scene = RasterScene([[0, 0, 2.0], [0, 0, 2.0 + gap]], [UP] * 2, [[1.0, 0.9, 0.8]] * 2, [0.3, 0.2], ahead(1, 1))
        assert decide(scene).near_jump[0, 0] == tied


@pytest.mark.slow
@pytest.mark.parametrize("depth_mode", ["plane", "exact"])
@pytest.mark.parametrize("name", HAZARDS)
def test_gradients_are_plain_differences_in_hazards(rng, name, depth_mode):
    """The image is drawn anew, decisions and all; where one is close, nothing is asked."""
    scene = replace(HAZARDS[name](rng), depth_mode=depth_mode)
    decisions = decide(scene)
    upstream = random_upstream(rng, scene, decisions)
    got = gradients(scene, upstream, decisions)
    image = draw(scene)
    for output in OUTPUTS:
        assert np.isfinite(getattr(image, output)).all()
    for array in got.values():
        assert np.isfinite(array).all()
    size = sum(np.abs(getattr(upstream, output) * getattr(image, output)).sum() for output in OUTPUTS)
    # Rounding: a few bits of the sum, and what a few bits of every input make of it.
    size += sum(np.abs(got[key] * array).sum() for key, array in scene.arrays().items())
    # All entries of an array move at once, by so little that what would be decided otherwise was close.
    for key, array in scene.arrays().items():
        way = rng.normal(size=array.shape) * STEPS[key](scene)
        if key == "positions" and name in ("at_one_depth", "copies"):
            way[:, 2] = 0.0  # their order would change
        sides = [loss(draw(replace(scene, **{key: array + sign * way})), upstream) for sign in (1.0, -1.0)]
        terms = got[key] * way
        # Truncation: a step is at most 1e-4 of what a thousandfold thinness makes of it, and leaves out its square, of
        # terms that cancel.
        tolerance = 1e-5 * np.abs(terms).sum() + 1e-15 * size
        assert abs(0.5 * (sides[0] - sides[1]) - terms.sum()) <= tolerance, key
