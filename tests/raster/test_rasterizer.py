"""The rasteriser on a device: every number of channels, its gradients, and what it keeps from frame to frame."""

import numpy as np
import pytest
import warp as wp
from raster_readable import ReadableRasterizer
from reference.harmonics import sh_color
from reference.raster_differences import gradients, random_upstream
from reference.raster_splats import RasterScene
from reference.rasterizing import decide, replay
from support.float32 import relative_error
from support.raster_clouds import around, cloud, drawn, set_upstream

from beam_warp import GaussianCloud, rasterize
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.raster import tile_lists_cuda
from beam_warp.kernels.raster.composite_cuda import STRIDE
from beam_warp.raster import buffers, forward, rasterizer
from beam_warp.raster.gbuffer import rasterize_backward
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import DrawnCloud, upload_gaussians

GRADIENT_ERROR = 1e-5
"""Relative L2 of every gradient against float64 frozen-decision differences."""

DEPTH_ERROR = 1e-4
"""Relative, against the largest response along the ray."""


@pytest.fixture
def made(rng):
    return cloud(rng)


@pytest.fixture
def values(rng):
    return rng.uniform(0, 1, (200, 3)).astype(np.float32)


def reference_scene(made, camera, **more):
    """The same in float64."""
    return RasterScene(made.positions, made.orientations, made.scales, made.opacities, camera, **more)


@pytest.mark.parametrize(
    ("held", "options"),
    [
        ({"values": (1,)}, RasterOptions()),
        ({"values": (5,)}, RasterOptions()),
        ({"values": (9,)}, RasterOptions(antialiased=True)),
        pytest.param({"values": (17,)}, RasterOptions(), marks=pytest.mark.slow),
        ({"values": (1,)}, RasterOptions(depth="exact")),
        pytest.param({"values": (35,)}, RasterOptions(depth="exact"), marks=pytest.mark.slow),
        ({"radiance": (1, 3)}, RasterOptions()),
        ({"radiance": (16, 3)}, RasterOptions()),
    ],
    ids=str,
)
def test_gradients_of_any_number_of_channels(device, rng, held, options):
    """Values or captured colour, whose gradients go to its coefficients, and to positions by the direction."""
    made, camera = cloud(rng, 60), around(33, 25)
    colors = {name: rng.normal(0.3, 0.4, (60, *shape)).astype(np.float32) for name, shape in held.items()}
    scene = reference_scene(made, camera, **colors, antialiased=options.antialiased, depth_mode=options.depth)
    decisions = decide(scene)
    upstream = random_upstream(rng, scene, decisions)
    wanted, image = gradients(scene, upstream, decisions), replay(scene, decisions)
    kind = {"value_count": held["values"][0]} if "values" in held else {"radiance": True}
    drawer = Rasterizer(60, [camera], **kind, normals=True, options=options, device=device)
    images = drawer.draw(upload_gaussians(made, drawer.device, **colors))
    assert sum(rows.shape[1] for rows in images.channels) >= image.channels.shape[-1] + 3
    clear = ~decisions.near_jump.ravel()
    assert clear.mean() > 0.95
    np.testing.assert_allclose(images.alpha.numpy()[clear], image.alpha.ravel()[clear], atol=1e-5)
    for name in ("depth", "median_depth"):
        got, want = getattr(images, name).numpy()[clear], getattr(image, name).ravel()[clear]
        np.testing.assert_allclose(got, want, rtol=DEPTH_ERROR)
    set_upstream(drawer, upstream)
    found = drawer.backward()
    assert (found.values is None) == ("radiance" in held)
    for name, array in wanted.items():
        assert relative_error(getattr(found, name).numpy(), array) <= GRADIENT_ERROR, name


def test_every_draw_may_have_another_number_of_coefficients(device, rng, made):
    """The way back makes room for what was drawn last, more or fewer."""
    drawer = Rasterizer(200, [around()], radiance=True, device=device)
    for coefficients in (4, 9, 1, 25, 4):
        fresh = Rasterizer(200, [around()], radiance=True, device=device)
        radiance = rng.normal(0, 0.5, (200, coefficients, 3)).astype(np.float32)
        found = []
        for one in (drawer, fresh):
            one.draw(upload_gaussians(made, one.device, radiance=radiance))
            filled(np.random.default_rng(1), one)
            gradients_found = one.backward()
            found.append([gradients_found.positions.numpy(), gradients_found.radiance.numpy()])
        assert found[0][1].shape == radiance.shape
        assert np.abs(found[0][1]).max() > 0
        for kept, new in zip(*found, strict=True):
            np.testing.assert_array_equal(kept, new)


@pytest.mark.parametrize("count", [0, 5])
def test_nothing_one_pixel_and_both_ways_twice(device, rng, count):
    """No Gaussian is no special case: arrays without rows, images without anything; the way back repeats its bits."""
    made = cloud(rng, count)
    cameras = [around(), around(1, 1, 90.0)]
    drawer = Rasterizer(count, cameras, value_count=2, radiance=True, normals=True, device=device)
    radiance, values = rng.normal(size=(count, 4, 3)).astype(np.float32), np.ones((count, 2), np.float32)
    filled(np.random.default_rng(1), drawer)  # before anything is drawn
    drawer.draw(upload_gaussians(made, drawer.device, values=values, radiance=radiance))
    assert drawer.first_pixels == (0, 40 * 36, 40 * 36 + 1)
    first = state(drawer)
    assert bool(drawer.images.alpha.numpy().any()) == bool(drawer.pair_count()) == (count > 0)
    drawer.redraw()
    assert_same(first, state(drawer))
    assert drawer.backward().radiance.shape == (count, 4)


def test_arrays_may_be_strided(device, rng, made):
    """Every second row, some columns: the same bits as of compact copies."""
    wide = rng.uniform(0, 1, (200, 8)).astype(np.float32)
    drawer = Rasterizer(200, [around()], value_count=3, device=device)
    compact = upload_gaussians(made, drawer.device, values=np.ascontiguousarray(wide[:, 2:5]))
    strided = compact._replace(
        positions=upload(np.repeat(made.positions, 2, axis=0), wp.vec3, drawer.device)[::2],
        values=upload(wide, float, drawer.device)[:, 2:5],
    )
    assert not strided.positions.is_contiguous
    assert not strided.values.is_contiguous
    filled(rng, drawer)
    found = []
    for arrays in (compact, strided):
        drawer.draw(arrays)
        found.append(state(drawer))
    assert_same(*found)


def test_a_frame_that_is_refused_cannot_be_drawn_again(made, monkeypatch):
    drawer, arrays = drawn(made, [around()], "cpu")
    with monkeypatch.context() as limits:
        limits.setattr(forward, "MAX_ROW_PAIRS", 1)
        limits.setattr(forward, "MAX_BAND_PAIRS", 1)
        with pytest.raises(InvalidArrayError, match="cover a row of tiles at most 1 times, got"):
            drawer.draw(arrays)
    for call in (drawer.redraw, drawer.redraw_values, drawer.backward):
        with pytest.raises(InvalidOptionError, match="must follow draw"):
            call()
    drawer.draw(arrays)
    drawer.redraw()


def images(drawer):
    """Copies of everything drawn, on the host."""
    found = drawer.images
    arrays = [*found.channels, found.alpha, found.depth, found.median_depth, drawer.gaussian_ids]
    return [array.numpy().copy() for array in arrays]


def state(drawer):
    """Copies of everything drawn and of every gradient of it, on the host."""
    found = drawer.backward()
    arrays = [found.positions, found.orientations, found.scales, found.opacities, found.values]
    return images(drawer) + [array.numpy().copy() for array in arrays]


def assert_same(some, others):
    for one, other in zip(some, others, strict=True):
        np.testing.assert_array_equal(one, other)


def assert_like_fresh(drawer, made, values, **options):
    """What was drawn and its gradients have the bits of a rasteriser made for it."""
    fresh, _ = drawn(made, drawer.cameras, drawer.device, values, **options)
    for one in (drawer, fresh):
        filled(np.random.default_rng(1), one)
    assert_same(state(drawer), state(fresh))


def filled(rng, drawer):
    """Set random derivatives."""
    adjoints = drawer.adjoints()
    for array in (*adjoints.channels, adjoints.alpha, adjoints.depth, adjoints.median_depth):
        array.assign(rng.normal(size=array.shape).astype(np.float32))


@pytest.mark.parametrize(("width", "height", "depth"), [(40, 36, "exact"), (17, 15, "plane"), (129, 3, "plane")])
def test_readable_and_fast_composites_give_the_same_bits(device, rng, width, height, depth):
    made = cloud(rng, 400)
    values = rng.uniform(0, 1, (400, 7)).astype(np.float32)
    found = []
    for kind in (ReadableRasterizer, Rasterizer):
        drawer = kind(400, [around(width, height)], value_count=7, options=RasterOptions(depth=depth), device=device)
        drawer.draw(upload_gaussians(made, drawer.device, values=values))
        found.append(images(drawer))
    assert_same(*found)


def test_bands_change_no_image_and_hardly_a_gradient(device, made, values, monkeypatch):
    """Sums over a splat's pairs are cut at the bands, so gradients differ by roundings of them."""
    cameras = [around(50, 70), around(20, 40, 80.0)]
    found = []
    for limit in (2**24, 300):
        monkeypatch.setattr(forward, "MAX_BAND_PAIRS", limit)
        drawer, _ = drawn(made, cameras, device, values)
        filled(np.random.default_rng(1), drawer)
        found.append(state(drawer))
        assert (len(drawer._bands) > 2) == (limit == 300)
    assert_same(found[0][:5], found[1][:5])
    for one, other in zip(found[0][5:], found[1][5:], strict=True):
        assert np.linalg.norm(one - other) <= 1e-6 * np.linalg.norm(one)


@pytest.mark.parametrize(("opacities", "depth"), [((0.004, 0.05), "exact"), ((0.05, 0.95), "plane")])
def test_checkpoints_change_no_image_and_hardly_a_gradient(device, rng, opacities, depth):
    """Lists have several strides: some pixels see all of them, others stop anywhere."""
    made = cloud(rng, 6_000).with_arrays(opacities=rng.uniform(*opacities, 6_000).astype(np.float32))
    values = rng.uniform(0, 1, (6_000, 19)).astype(np.float32)
    cameras, options = [around(33, 20), around(17, 30, 80.0)], RasterOptions(depth=depth)
    found = []
    for checkpoints in (False, True):
        drawer, _ = drawn(made, cameras, device, values, options=options, checkpoints=checkpoints)
        assert drawer.pair_count() > 4 * int(STRIDE) * 10  # tiles
        filled(np.random.default_rng(1), drawer)
        found.append(state(drawer))
        drawer.redraw()
        assert_same(found[-1], state(drawer))
    assert_same(found[0][:6], found[1][:6])
    for one, other in zip(found[0][6:], found[1][6:], strict=True):
        assert np.linalg.norm(one - other) <= 1e-5 * np.linalg.norm(one)


@pytest.mark.parametrize("depth", ["exact", "plane"])
def test_large_images_have_the_bits_of_small_ones(device, rng, monkeypatch, depth):
    """A lane has two pixels on CUDA where tiles are many, one where they are few. Images end within tiles."""
    made = cloud(rng, 6_000)
    values = rng.uniform(0, 1, (6_000, 19)).astype(np.float32)
    cameras, found = [around(33, 20), around(17, 30, 80.0)], []
    for held in (16, 0):
        monkeypatch.setattr(buffers, "BLOCKS_HELD", held)
        drawer, _ = drawn(made, cameras, device, values, options=RasterOptions(depth=depth))
        filled(np.random.default_rng(1), drawer)
        found.append(state(drawer))
    assert_same(*found)


@pytest.mark.parametrize("bits", [16, 4])
def test_splats_that_reach_very_many_tiles(device, made, values, monkeypatch, bits):
    """Also ranks of pairs beyond what an entry has bits for: gradients on CUDA are those on the CPU."""
    monkeypatch.setattr(tile_lists_cuda, "MOST_RANK_BITS", bits)
    scales = made.scales.copy()
    scales[::20] *= 30.0
    large, camera = made.with_arrays(scales=scales), around(230, 170)
    drawers = [drawn(large, [camera], target, values)[0] for target in ("cpu", device)]
    for drawer in drawers:
        filled(np.random.default_rng(1), drawer)
    one, other = (state(drawer) for drawer in drawers)
    assert drawers[0].pair_count() > 10 * 100
    assert drawers[0]._buffers.may_lack_ranks == (bits == 4)
    for i in range(5, len(one)):
        assert np.linalg.norm(one[i] - other[i]) <= 1e-5 * np.linalg.norm(one[i])


@pytest.mark.parametrize("limit", [2**24, 300])
def test_redraw_follows_contents_and_cameras(device, rng, made, values, monkeypatch, limit):
    """Also where there are bands."""
    monkeypatch.setattr(forward, "MAX_BAND_PAIRS", limit)
    moved = cloud(rng)
    drawer, arrays = drawn(made, [around()], device, values)
    assert (len(drawer._bands) > 1) == (limit == 300)
    room = drawer.pair_capacity
    for name in ("positions", "orientations", "scales", "opacities"):
        getattr(arrays, name).assign(getattr(moved, name))
    drawer.set_cameras([around(azimuth=110.0)])
    drawer.redraw()
    assert drawer.pair_capacity == room
    assert drawer.pair_count() <= room
    assert_like_fresh(drawer, moved, values)


@pytest.mark.parametrize("limit", [2**24, 300])
def test_values_are_redrawn_alone(device, made, values, monkeypatch, limit):
    """The bits of a frame drawn anew, and the gradients of what is shown now; also where there are bands."""
    monkeypatch.setattr(forward, "MAX_BAND_PAIRS", limit)
    drawer, arrays = drawn(made, [around(50, 40), around(20, 40, 80.0)], device, values, normals=True)
    arrays.values.assign(1.0 - values)
    drawer.redraw_values()
    assert_like_fresh(drawer, made, 1.0 - values, normals=True)


def test_prepared_cameras_are_the_cameras(device, made, values):
    """One view after the other with cameras that were brought before: the bits of rasterisers of their own."""
    cameras = [around(), around(azimuth=110.0), around(azimuth=200.0)]
    drawer, arrays = drawn(made, cameras[:1], device, values)
    prepared = [drawer.prepare_cameras([camera]) for camera in cameras]
    for camera, brought in [*zip(cameras, prepared, strict=True), (cameras[0], prepared[0])]:
        drawer.set_cameras(brought)
        assert drawer.cameras == (camera,)
        drawer.draw(arrays)
        assert_like_fresh(drawer, made, values)


def test_rasterisers_share_their_images(device, rng, made, values):
    """Two that draw into one's images, by turns: the bits of rasterisers of their own, back-projected ones too."""
    pixels = rng.uniform(0, 1, (50 * 40 + 7 * 33, 4)).astype(np.float32)
    views = [[around(50, 40), around(7, 33)], [around(40, 36, 80.0)], [around(1, 1, 150.0)]]
    owner = Rasterizer(200, views[0], value_count=3, device=device)
    arrays = upload_gaussians(made, owner.device, values=values)
    drawers = [owner, *(Rasterizer(200, v, value_count=3, device=device, images_of=owner) for v in views[1:])]
    fresh = [Rasterizer(200, v, value_count=3, device=device) for v in views]
    for drawer in (*drawers, *fresh):
        drawer.draw(arrays)
    for drawer, alone in zip(drawers, fresh, strict=True):
        count = drawer.first_pixels[-1]
        held = upload(pixels[:count], float, drawer.device)
        sums = []
        for one in (drawer, alone):
            one.redraw_values()
            room = wp.zeros((200 * len(one.cameras), 4), dtype=float, device=one.device)
            one.back_project(held, room)
            sums.append(room.numpy())
        np.testing.assert_array_equal(*sums)
        for one, other in zip(images(drawer), images(alone), strict=True):
            assert len(one) == count
            np.testing.assert_array_equal(one, other)
    assert owner.images.alpha.ptr == drawers[1].images.alpha.ptr
    for other in ({"cameras": [around(60, 50)], "value_count": 3}, {"cameras": views[1], "value_count": 5}):
        with pytest.raises(InvalidOptionError, match="images_of must have at least"):
            Rasterizer(200, **other, device=device, images_of=owner)


def test_prepared_cameras_of_other_sizes_are_refused(device):
    drawer, other = Rasterizer(1, [around(33, 17)], device=device), Rasterizer(1, [around(17, 33)], device=device)
    for wrong in ([around(17, 33)], [around(33, 17)] * 2):
        with pytest.raises(InvalidOptionError, match="cameras must have the sizes"):
            drawer.prepare_cameras(wrong)
    with pytest.raises(InvalidOptionError, match="cameras must have the sizes"):
        drawer.set_cameras(other.prepare_cameras([around(17, 33)]))
    assert drawer.cameras[0].width == 33


def test_redraw_without_room_says_so_and_draw_makes_it(device, made, values):
    """Few splats first, then ten times as many pairs; nothing crashes in between."""
    drawer, arrays = drawn(made.with_arrays(scales=0.02 * made.scales), [around(100, 90)], device, values)
    filled(np.random.default_rng(1), drawer)
    kept = drawer.adjoints()
    arrays.scales.assign(made.scales)
    drawer.redraw()
    assert drawer.pair_count() > drawer.pair_capacity
    assert all(np.isfinite(array).all() for array in state(drawer))
    drawer.draw(arrays)
    assert drawer.pair_count() <= drawer.pair_capacity
    assert drawer.adjoints() is kept
    assert_like_fresh(drawer, made, values)


def test_a_frame_and_its_gradients_are_one_graph(rng, made, values):
    if not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
    drawer, arrays = drawn(made, [around()], "cuda:0", values)
    filled(np.random.default_rng(1), drawer)
    drawer.backward()
    with wp.ScopedCapture(drawer.device) as capture:
        drawer.redraw()
        found = drawer.backward()
    arrays.positions.assign(cloud(rng).positions)
    drawer.set_cameras([around(azimuth=200.0)])
    wp.capture_launch(capture.graph)
    got = [drawer.images.alpha.numpy(), found.positions.numpy(), found.values.numpy()]
    drawer.draw(arrays)
    found = drawer.backward()
    for one, other in zip(got, [drawer.images.alpha, found.positions, found.values], strict=True):
        np.testing.assert_array_equal(one, other.numpy())


def test_a_list_of_cameras_of_any_sizes(device, rng, monkeypatch):
    """The same whether they are drawn together or one at a time."""
    made = cloud(rng, base_color=rng.uniform(0, 1, (200, 3)))
    cameras = [around(10, 20), around(33, 5, 70.0), around(16, 16, 140.0)]
    together = rasterize(made, cameras, channels=("base_color", "surface_normals"), device=device)
    monkeypatch.setattr("beam_warp.raster.sources.GROUP_PIXELS", 1)
    apart = rasterize(made, cameras, channels=("base_color", "surface_normals"), device=device)
    assert rasterize(made, [], channels=(), device=device) == []
    for camera, one, other in zip(cameras, together, apart, strict=True):
        assert one.camera is camera
        assert one.alpha.shape == (camera.height, camera.width)
        for name in ("alpha", "depth", "median_depth", "gaussian_ids"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        for name in one.channels:
            np.testing.assert_array_equal(one.channels[name], other.channels[name])


@pytest.mark.parametrize(
    ("limits", "groups"),
    [
        ({"GROUP_PIXELS": 365}, [[0, 1], [2]]),
        ({"GROUP_PIXELS": 364}, [[0], [1], [2]]),
        ({"GROUP_SPLATS": 400}, [[0, 1], [2]]),
        ({"GROUP_SPLATS": 199}, [[0], [1], [2]]),
    ],
)
def test_groups_hold_as_many_cameras_as_their_limits_allow(made, monkeypatch, limits, groups):
    """200, 165 and 256 pixels, 200 splats each; a camera beyond the limit is a group of its own."""
    for name, limit in limits.items():
        monkeypatch.setattr(f"beam_warp.raster.sources.{name}", limit)
    cameras = [around(10, 20), around(33, 5), around(16, 16)]
    drawn_groups = DrawnCloud.of(made, (), "cpu").draw_groups(cameras, None)
    assert [list(places) for _, places in drawn_groups] == groups


def loss_of(made, cameras, adjoints, channels, device):
    """The loss whose derivatives to the buffers are the adjoints, in float64."""
    total = 0.0
    for buffer, given in zip(rasterize(made, cameras, channels=channels, device=device), adjoints, strict=True):
        for name, array in given.items():
            image = buffer.channels[name] if name in buffer.channels else getattr(buffer, name)
            total += float((image.astype(np.float64) * array).sum())
    return total


def test_backward_of_means_and_unit_normals(device, rng):
    """Channels are linear in what they average, so that differences of any size are exact but for roundings."""
    channels = ("base_color", "roughness", "radiance")
    made = cloud(
        rng,
        base_color=rng.uniform(0.2, 0.8, (200, 3)),
        roughness=rng.uniform(0.2, 0.8, 200),
        radiance=rng.normal(0, 0.05, (200, 4, 3)),
        radiance_color_space="srgb_rec709_display",
    )
    cameras = [around(), around(30, 20, 120.0)]
    adjoints = [
        {
            "base_color": rng.normal(size=(c.height, c.width, 3)),
            "roughness": rng.normal(size=(c.height, c.width)),
            "radiance": rng.normal(size=(c.height, c.width, 3)),
        }
        for c in cameras
    ]
    found = rasterize_backward(made, cameras, adjoints, channels=channels, device=device)
    for name, step in (("base_color", 0.1), ("roughness", 0.1), ("radiance", 0.05)):
        way = rng.uniform(-1, 1, getattr(made, name).shape)
        ahead, behind = (made.with_arrays(**{name: getattr(made, name) + s * step * way}) for s in (1, -1))
        difference = loss_of(ahead, cameras, adjoints, channels, device)
        difference = (difference - loss_of(behind, cameras, adjoints, channels, device)) / (2 * step)
        slope = float((found.channels[name].astype(np.float64) * way).sum())
        # Sums of some 2,000 products, rounded to 6e-8 of at most about 3 each, over the step.
        assert abs(slope - difference) <= 2000 * 3 * 6e-8 / step + 1e-5 * abs(difference), name
    assert found.positions.shape == (200, 3)


def test_backward_of_a_mean_knows_that_it_is_one(device, rng):
    """Where all Gaussians have one value the mean is that value, whatever the geometry."""
    made = cloud(rng, roughness=np.full(200, 0.4))
    adjoint = rng.normal(size=(36, 40))
    found = rasterize_backward(made, around(), {"roughness": adjoint}, channels=("roughness",), device=device)
    scale = np.abs(found.channels["roughness"]).max()
    assert scale > 0.1
    for name in ("positions", "scales", "opacities", "orientations"):
        assert np.abs(getattr(found, name)).max() <= 1e-3 * scale, name
    depth = rasterize_backward(made, around(), {"depth": adjoint}, channels=("roughness",), device=device)
    assert np.abs(depth.positions).max() > 0.1
    assert not depth.channels["roughness"].any()


def test_backward_of_surface_normals(device, rng):
    """Turning all of the world turns normals: the derivative along a turn is in closed form."""
    made, camera = cloud(rng, 1), around(60, 60)
    made = made.with_arrays(positions=[[0.0, 0.0, 0.0]], scales=[[0.4, 0.3, 1e-3]], opacities=[0.9])
    buffer = rasterize(made, camera, channels=("surface_normals",), device=device)
    seen = buffer.alpha > 0
    adjoint = np.where(seen[..., None], rng.normal(size=(60, 60, 3)), 0.0)
    found = rasterize_backward(made, camera, {"surface_normals": adjoint}, channels=("surface_normals",), device=device)
    normal = buffer.channels["surface_normals"][seen][0]
    axis = rng.normal(size=3)
    # q' = (axis, 0) q / 2 turns the disc at one radian a second, and its normal with it.
    v, w = made.orientations[0, :3].astype(np.float64), float(made.orientations[0, 3])
    rate = 0.5 * np.array([*(np.cross(axis, v) + w * axis), -axis @ v])
    wanted = adjoint.sum(axis=(0, 1)) @ np.cross(axis, normal)
    np.testing.assert_allclose(found.orientations[0] @ rate, wanted, rtol=1e-3)


def test_errors_name_the_contract(rng):
    made = cloud(rng, roughness=np.full(200, 0.5))
    with pytest.raises(InvalidOptionError, match="cameras must hold at least one camera"):
        Rasterizer(3, [], device="cpu")
    for count in (-1, 2.5, rasterizer.MAX_SPLATS // 2 + 1):
        with pytest.raises(InvalidOptionError, match="gaussian_count must be an integer in"):
            Rasterizer(count, [around()] * 2, device="cpu")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InvalidOptionError, match="value_count must be an integer in"):
        Rasterizer(3, [around()], value_count=-1, device="cpu")
    with pytest.raises(InvalidOptionError, match="cameras must be a sequence of cameras, got Camera"):
        Rasterizer(3, around(), device="cpu")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InvalidOptionError, match="cameras must hold cameras, got int at place 1"):
        rasterize(made, [around(), 7], channels=(), device="cpu")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InvalidOptionError, match="low_pass must"):
        RasterOptions(low_pass=float("nan"))
    with pytest.raises(InvalidOptionError, match="depth must be one of plane, exact"):
        RasterOptions(depth="median")  # pyright: ignore[reportArgumentType]
    drawer = Rasterizer(200, [around()], value_count=2, device="cpu")
    for call in (drawer.redraw, drawer.redraw_values, drawer.backward):
        with pytest.raises(InvalidOptionError, match="must follow draw, got no draw before it"):
            call()
    arrays = upload_gaussians(made, drawer.device, values=np.zeros((200, 2), np.float32))
    with pytest.raises(InvalidArrayError, match=r"values must be a warp array of float32, 200 x 2, on cpu, got none"):
        drawer.draw(arrays._replace(values=None))
    with pytest.raises(
        InvalidArrayError, match=r"positions must be a warp array of vec3f?, 200, on cpu, got vec3f? \(3"
    ):
        drawer.draw(arrays._replace(positions=wp.zeros(3, dtype=wp.vec3, device="cpu")))
    with pytest.raises(InvalidArrayError, match="positions must be a warp array of vec3f, 200, on cpu, got ndarray"):
        drawer.draw(arrays._replace(positions=made.positions))  # pyright: ignore[reportArgumentType]
    colored = Rasterizer(200, [around()], radiance=True, device="cpu")
    for coefficients in (0, 3, 36):  # kernels read as many as the next degree has
        radiance = np.zeros((200, coefficients, 3), np.float32)
        with pytest.raises(InvalidArrayError, match="radiance must be a warp array of vec3f, 200 x 1 or 4 or 9 or 16"):
            colored.draw(upload_gaussians(made, colored.device, radiance=radiance))
    with pytest.raises(InvalidOptionError, match="cameras must have the sizes"):
        drawer.set_cameras([around(41)])
    with pytest.raises(InvalidOptionError, match="adjoints must be one of alpha, depth, median_depth, roughness"):
        rasterize_backward(made, around(), {"rough": 0.0}, channels=("roughness",), device="cpu")
    with pytest.raises(InvalidOptionError, match="adjoints must hold one mapping for each of 2 cameras, got 1"):
        rasterize_backward(made, [around()] * 2, [{}], channels=("roughness",), device="cpu")
    with pytest.raises(InvalidArrayError, match="roughness must"):
        rasterize_backward(made, around(), {"roughness": np.zeros((3, 3))}, channels=("roughness",), device="cpu")


def test_colour_towards_a_camera_that_is_in_a_gaussian(device):
    """No direction, no NaN: it is not drawn."""
    made = GaussianCloud(
        positions=[around().position],
        orientations=[[0, 0, 0, 1]],
        scales=[[0.1] * 3],
        opacities=[0.9],
        radiance=np.ones((1, 4, 3)),
        radiance_color_space="srgb_rec709_display",
    )
    buffer = rasterize(made, around(), channels=("radiance",), device=device)
    assert not buffer.alpha.any()
    assert np.isfinite(buffer.channels["radiance"]).all()
    assert np.isfinite(sh_color(made.radiance, np.zeros((1, 3)))).all()
