"""Back-projection: what pixels hold, carried to the Gaussians with the weights of drawing, and summed over views."""

import numpy as np
import pytest
import warp as wp
from reference.raster_splats import RasterScene, see
from reference.rasterizing import decide, pair_terms
from support.float32 import EPSILON
from support.raster_clouds import around, cloud, drawn

from beam_warp import Camera, GaussianCloud
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.raster.bin_tiles import TILE
from beam_warp.raster import forward
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import upload_gaussians

TWIN_ERROR = 1e-5
"""Relative L2 against float64: coordinates below 64 pixels are rounded by 4e-6 twice, and the slope of alpha is at most
exp(-1/2) / sqrt(0.3) = 1.1 per pixel, so that weights are off by at most 9e-6."""

COUNT = 200


VIEWS = [around(), around(17, 33, 110.0), around(1, 1, 200.0), around(64, 3, 290.0)]


def back_projected(drawer, pixels):
    """What every view says of every Gaussian, ``(V, N, K)``; the output is not what it was before."""
    pixels = wp.array(pixels.astype(np.float32), dtype=float, device=drawer.device)
    views = len(drawer.cameras)
    shape = (views * drawer._count, pixels.shape[1])
    out = wp.array(np.full(shape, np.nan, np.float32), dtype=float, device=drawer.device)
    drawer.back_project(pixels, out)
    return out.numpy().reshape(views, drawer._count, pixels.shape[1])


def summed(drawer, rows):
    """Rows of all views, summed on the device."""
    rows = wp.array(rows.reshape(-1, rows.shape[-1]), dtype=float, device=drawer.device)
    out = wp.full((drawer._count, rows.shape[1]), np.nan, dtype=float, device=drawer.device)
    drawer.sum_views(rows, out)
    return out.numpy()


def roundings(cameras):
    """Most roundings in a sum over a Gaussian's pixels: two products, a tile's pixels, tiles, views."""
    tiles = sum(-(-camera.width // TILE) * -(-camera.height // TILE) for camera in cameras)
    return 2 + TILE * TILE + tiles + len(cameras)


@pytest.mark.parametrize("opacity", [0.3, 0.999])
def test_weights_are_those_of_drawing_to_the_last_bit(device, rng, opacity):
    """Drawing a Gaussian that holds 1 gives its weights; so does back-projecting a pixel that holds 1."""
    made = cloud(rng, 16)
    made = made.with_arrays(
        positions=0.3 * made.positions, scales=3.0 * made.scales, opacities=np.full(16, opacity, np.float32)
    )
    drawer, _ = drawn(made, [around(20, 20)], device, np.eye(16, dtype=np.float32))
    weights = drawer.images.channels[0].numpy()
    assert (weights > 0).any(axis=1).mean() > 0.5
    for start in range(0, 400, 16):
        pixels = np.zeros((400, 16))
        pixels[start : start + 16] = np.eye(16)
        np.testing.assert_array_equal(back_projected(drawer, pixels)[0].T, weights[start : start + 16])


@pytest.mark.parametrize(("length", "antialiased"), [(4, False), (8, False), (12, False), (16, True)])
def test_against_float64(device, rng, length, antialiased):
    """Every weight anew in double precision, pixel by pixel; views of several sizes at once."""
    made, options = cloud(rng), RasterOptions(antialiased=antialiased)
    arrays = (made.positions, made.orientations, made.scales, made.opacities)
    held, wanted = [], []
    for camera in VIEWS:
        scene = RasterScene(*arrays, camera, values=np.zeros((COUNT, 1)), antialiased=antialiased)
        decisions = decide(scene)
        pixels = rng.normal(size=(camera.width * camera.height, length)).astype(np.float32)
        pixels[decisions.near_jump.ravel()] = 0.0  # where single precision may decide otherwise
        alphas, _ = pair_terms(scene, see(scene, decisions.splats), decisions)
        weights, passing = np.zeros((COUNT, len(pixels))), np.ones(len(pixels))
        for splat, pixel, alpha in zip(decisions.splat, decisions.pixel, alphas, strict=True):  # front to back
            weights[splat, pixel] = alpha * passing[pixel]
            passing[pixel] *= 1.0 - alpha
        held.append(pixels)
        wanted.append(weights @ pixels)
    found = back_projected(drawn(made, VIEWS, device, options=options)[0], np.concatenate(held))
    for got, want in zip(found, wanted, strict=True):
        assert np.linalg.norm(got - want) <= TWIN_ERROR * np.linalg.norm(want)
        np.testing.assert_array_equal(got[~want.any(axis=1)], 0.0)
    assert min(np.abs(want).max() for want in wanted) > 0.0


@pytest.mark.parametrize("depth", ["plane", "exact"])
def test_it_is_the_gradient_of_values(device, rng, depth):
    """`backward` finds what passes before a splat by a division for each of those behind it."""
    made, count = cloud(rng), 7
    drawer, _ = drawn(made, VIEWS, device, np.zeros((COUNT, count), np.float32), options=RasterOptions(depth=depth))
    pixels = rng.normal(size=(len(drawer.images.alpha), 8)).astype(np.float32)
    drawer.adjoints().channels[0].assign(pixels)
    want = drawer.backward().values.numpy().copy()
    got = summed(drawer, back_projected(drawer, pixels))[:, :count]
    weighed = summed(drawer, back_projected(drawer, np.abs(pixels)))[:, :count]
    assert np.abs(want).max() > 1.0
    # A product and a quotient, of up to two roundings, for each of at most all splats; two sums.
    assert (np.abs(got - want) <= (3 * COUNT + 2 * roundings(VIEWS)) * EPSILON * weighed).all()
    np.testing.assert_array_equal(drawer.backward().values.numpy(), want)  # nothing that it needs was changed


def test_bands_change_roundings_only(device, rng, monkeypatch):
    """A Gaussian's pairs are summed band by band."""
    made, found = cloud(rng), []
    pixels = rng.normal(size=(sum(camera.width * camera.height for camera in VIEWS), 4)).astype(np.float32)
    for limit in (2**24, 300):
        monkeypatch.setattr(forward, "MAX_BAND_PAIRS", limit)
        drawer, _ = drawn(made, VIEWS, device)
        assert (len(drawer._bands) > 2) == (limit == 300)
        found.append(back_projected(drawer, pixels))
        np.testing.assert_array_equal(back_projected(drawer, pixels), found[-1])
        weighed = back_projected(drawer, np.abs(pixels))
    assert (np.abs(found[0] - found[1]) <= 2 * roundings(VIEWS) * EPSILON * weighed).all()


def test_many_splats_on_a_tile(device, rng):
    """More than a warp looks at at once, and pixels that stop before the end of their lists."""
    count, camera = 333, around(16, 16)
    made = cloud(rng, count).with_arrays(
        positions=rng.uniform(-0.1, 0.1, (count, 3)), scales=np.full((count, 3), 1.0), opacities=np.full(count, 0.2)
    )
    drawer, _ = drawn(made, [camera], device, np.ones((count, 1), np.float32))
    assert drawer.pair_count() == count
    assert drawer.images.alpha.numpy().max() > 1.0 - 1e-3
    found = back_projected(drawer, np.ones((256, 4)))[0]
    assert 32 < (found[:, 0] > 0.0).sum() < count  # what is behind the last stop gets nothing
    alpha = drawer.images.alpha.numpy().sum(dtype=float)
    np.testing.assert_allclose(found.sum(axis=0, dtype=float), alpha, rtol=(count + roundings([camera])) * EPSILON)


def test_what_no_view_sees_gets_nothing(device):
    """Behind the camera, beside the image, transparent; and no Gaussian at all."""
    camera = Camera(20, 12, 20.0, 20.0, 10.0, 6.0, np.eye(4))
    made = GaussianCloud(
        positions=[[0, 0, -2.0], [0, 0, 2.0], [9.0, 0, 2.0]],
        orientations=[[0, 0, 0, 1]] * 3,
        scales=[[0.1] * 3] * 3,
        opacities=[0.5] * 3,
    )
    pixels = np.ones((240, 4))
    found = back_projected(drawn(made, [camera], device)[0], pixels)
    np.testing.assert_array_equal(found[0, [0, 2]], 0.0)
    assert (found[0, 1] > 0.1).all()
    unseen = made.with_arrays(positions=made.positions * np.float32([1, 1, -1]), opacities=np.zeros(3, np.float32))
    drawer, _ = drawn(unseen, [camera, camera], device)
    assert drawer.pair_capacity == 0
    np.testing.assert_array_equal(back_projected(drawer, np.ones((480, 4))), np.zeros((2, 3, 4)))
    nothing, _ = drawn(cloud(np.random.default_rng(1), 0), [camera, camera], device)
    assert back_projected(nothing, np.ones((480, 4))).shape == (2, 0, 4)
    assert summed(nothing, np.zeros((0, 4), np.float32)).shape == (0, 4)


def test_any_number_of_threads_gives_the_same_bits(rng, monkeypatch):
    made = cloud(rng, 600)
    found = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("BEAM_WARP_THREADS", threads)
        drawer, _ = drawn(made, [around(150, 140), around(31, 90, 80.0)], "cpu")
        pixels = np.random.default_rng(1).normal(size=(len(drawer.images.alpha), 8))
        rows = back_projected(drawer, pixels)
        found.append((rows, summed(drawer, rows)))
    assert np.abs(found[0][1]).max() > 0.0
    for rows, sums in found[1:]:
        np.testing.assert_array_equal(rows, found[0][0])
        np.testing.assert_array_equal(sums, found[0][1])


def test_sums_are_of_one_view_after_the_other(device, rng):
    drawer = Rasterizer(1023, [around(3, 2)] * 5, device=device)
    rows = rng.normal(size=(5, 1023, 7)).astype(np.float32)
    wanted = np.zeros((1023, 7), np.float32)
    for view in rows:
        wanted += view
    np.testing.assert_array_equal(summed(drawer, rows), wanted)


def test_it_follows_redraw_and_other_rooms(device, rng):
    """Moved Gaussians, other cameras, more pairs than there is room for: the rows are those of what was drawn last."""
    made = cloud(rng)
    drawer, arrays = drawn(made.with_arrays(scales=0.02 * made.scales), [around(50, 40)], device)
    pixels = rng.normal(size=(2000, 4))
    assert np.abs(back_projected(drawer, pixels)).max() > 0.0
    arrays.scales.assign(made.scales)
    drawer.redraw()
    assert drawer.pair_count() > drawer.pair_capacity
    assert np.isfinite(back_projected(drawer, pixels)).all()
    drawer.draw(arrays)
    fresh, _ = drawn(made, [around(50, 40)], device)
    np.testing.assert_array_equal(back_projected(drawer, pixels), back_projected(fresh, pixels))
    drawer.set_cameras([around(50, 40, 140.0)])
    drawer.redraw()
    fresh, _ = drawn(made, [around(50, 40, 140.0)], device)
    np.testing.assert_array_equal(back_projected(drawer, pixels), back_projected(fresh, pixels))


def test_a_frame_and_its_back_projection_are_one_graph(rng):
    if not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
    drawer, _ = drawn(cloud(rng), VIEWS, "cuda:0")
    pixels = wp.array(rng.normal(size=(len(drawer.images.alpha), 8)), dtype=float, device="cuda:0")
    out, sums = (wp.zeros((count, 8), dtype=float, device="cuda:0") for count in (len(VIEWS) * COUNT, COUNT))
    drawer.back_project(pixels, out)
    wanted = out.numpy()
    with wp.ScopedCapture(drawer.device) as capture:
        drawer.redraw()
        drawer.back_project(pixels, out)
        drawer.sum_views(out, sums)
    out.zero_()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(out.numpy(), wanted)
    np.testing.assert_allclose(sums.numpy(), wanted.reshape(len(VIEWS), COUNT, 8).sum(axis=0), rtol=1e-6, atol=1e-6)


def test_wrong_arrays_are_refused(rng):
    drawer = Rasterizer(COUNT, [around(8, 4), around(2, 3)], device="cpu")

    def zeros(*shape, dtype=float):
        return wp.zeros(shape, dtype=dtype, device="cpu")

    pixels, out = zeros(38, 4), zeros(2 * COUNT, 4)
    with pytest.raises(InvalidOptionError, match="back_project must follow draw, got no draw before it"):
        drawer.back_project(pixels, out)
    drawer.draw(upload_gaussians(cloud(rng), drawer.device))
    drawer.back_project(pixels, out)
    wanted = "pixels must be a compact warp array of float32, 38 x 4 or 8 or 12 or 16, on cpu, got "
    for wrong, got in (
        (zeros(37, 4), r"float32 \(37, 4\) on cpu"),
        (zeros(38, 3), r"float32 \(38, 3\) on cpu"),
        (zeros(38, 20), r"float32 \(38, 20\) on cpu"),
        (zeros(38 * 4), r"float32 \(152,\) on cpu"),
        (zeros(38, dtype=wp.vec4), r"vec4f \(38,\) on cpu"),
        (zeros(38, 4, dtype=wp.float64), r"float64 \(38, 4\) on cpu"),
        (zeros(38, 8)[:, :4], r"float32 \(38, 4\) on cpu, a part of another array"),
        (np.zeros((38, 4), np.float32), "ndarray"),
    ):
        with pytest.raises(InvalidArrayError, match=wanted + got):
            drawer.back_project(wrong, out)
    for wrong in (zeros(2 * COUNT, 8), zeros(COUNT, 4), zeros(4, 2 * COUNT).transpose()):
        with pytest.raises(InvalidArrayError, match="out must be a compact warp array of float32, 400 x 4, on cpu"):
            drawer.back_project(pixels, wrong)
    with pytest.raises(InvalidArrayError, match="rows must be a compact warp array of float32, 400 x K, on cpu"):
        drawer.sum_views(zeros(COUNT, 4), zeros(COUNT, 4))
    with pytest.raises(InvalidArrayError, match="out must be a compact warp array of float32, 200 x 4, on cpu"):
        drawer.sum_views(out, zeros(COUNT, 3))


def test_arrays_of_another_device_are_refused(rng):
    if not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
    drawer, _ = drawn(cloud(rng), [around(8, 4)], "cuda:0")
    with pytest.raises(InvalidArrayError, match=r"on cuda:0, got float32 .* on cpu"):
        drawer.back_project(wp.zeros((32, 4), dtype=float, device="cpu"), wp.zeros((COUNT, 4), device="cuda:0"))
