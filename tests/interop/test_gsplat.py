"""Drawing torch tensors: the rasteriser's own bits both ways, whatever is drawn in between, and every refusal."""

import numpy as np
import pytest
import warp as wp
from reference.harmonics import sh_color
from reference.rasterizing import RasterImage
from support.raster_clouds import set_upstream

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.raster.gbuffer import rasterize_values
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

torch = pytest.importorskip("torch")

from beam_warp.interop import gsplat  # noqa: E402
from beam_warp.interop.gsplat import forget_rasterizers, rasterization  # noqa: E402
from beam_warp.interop.torch import TorchRasterizer  # noqa: E402

WIDTH, HEIGHT = 40, 33
GEOMETRY = ("means", "quats", "scales", "opacities")


@pytest.fixture
def place(device):
    """The torch device of a Warp device."""
    if device != "cpu" and not torch.cuda.is_available():
        pytest.skip("torch sees no CUDA device")
    return torch.device(device)


@pytest.fixture(autouse=True)
def forget():
    """No test draws with what another left."""
    yield
    forget_rasterizers()


def gaussians(rng, place, count=120, channels=3, bases=None):
    """Tensors by gsplat's names, gradients asked for; quaternions of any length."""
    shape = (count, channels) if bases is None else (count, bases, 3)
    arrays = {
        "means": rng.uniform(-0.8, 0.8, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "scales": np.exp(rng.normal(-2.5, 0.7, (count, 3))),
        "opacities": rng.uniform(0.05, 0.95, count),
        "colors": rng.uniform(0, 1, shape) if bases is None else rng.normal(size=shape),
    }
    return {name: torch.tensor(a, dtype=torch.float32, device=place, requires_grad=True) for name, a in arrays.items()}


def views(*azimuths):
    """Cameras, and their gsplat matrices on the host in float64."""
    size = {"width": WIDTH, "height": HEIGHT, "vertical_fov": 45.0}
    cameras = [Camera.orbit((0, 0, 0), 2.5, azimuth, 12.0, **size) for azimuth in azimuths or (20.0,)]
    viewmats = torch.tensor(np.stack([camera.world_to_camera for camera in cameras]))
    ks = np.zeros((len(cameras), 3, 3))
    for k, camera in zip(ks, cameras, strict=True):
        k[:] = [[camera.focal_x, 0, camera.center_x], [0, camera.focal_y, camera.center_y], [0, 0, 1]]
    return cameras, {"viewmats": viewmats, "Ks": torch.tensor(ks), "width": WIDTH, "height": HEIGHT}


@pytest.fixture
def given(place, rng):
    return gaussians(rng, place)


@pytest.fixture
def where():
    """One camera, as gsplat takes it."""
    return views()[1]


def xyzw(quats):
    return quats[:, [1, 2, 3, 0]]


def as_arrays(given, device, colors_are):
    """The same Gaussians for a `Rasterizer` of one's own."""
    data = {name: tensor.detach().cpu().numpy() for name, tensor in given.items()}
    with wp.ScopedDevice(device):
        return GaussianArrays(
            wp.array(data["means"], dtype=wp.vec3),
            wp.array(np.ascontiguousarray(xyzw(data["quats"])), dtype=wp.quat),
            wp.array(data["scales"], dtype=wp.vec3),
            wp.array(data["opacities"], dtype=float),
            **{colors_are: wp.array(data["colors"], dtype=wp.vec3 if colors_are == "radiance" else float)},
        )


def numpy_of(tensor):
    return tensor.detach().cpu().numpy()


def gradients(given):
    """Gradients by name, and none left behind."""
    found = {name: None if t.grad is None else t.grad.clone() for name, t in given.items()}
    for tensor in given.values():
        tensor.grad = None
    return found


def assert_same(first, second):
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


@pytest.mark.parametrize("channels", [3, 21])
def test_images_have_the_bits_of_rasterize_values(place, rng, channels):
    given = gaussians(rng, place, channels=channels)
    (camera,), where = views()
    unit = xyzw(numpy_of(given["quats"]))
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    arrays = {name: numpy_of(given[name]) for name in ("scales", "opacities")}
    cloud = GaussianCloud(positions=numpy_of(given["means"]), orientations=unit, **arrays)
    with torch.no_grad():  # a cloud's quaternions are of unit length: draw the very same ones
        given["quats"].copy_(torch.tensor(cloud.orientations[:, [3, 0, 1, 2]]))
    expected = rasterize_values(cloud, camera, numpy_of(given["colors"]), device=str(place))
    assert expected.alpha.mean() > 0.3
    sums = expected.depth * expected.alpha
    depths = {"RGB": None, "D": sums, "RGB+D": sums, "ED": expected.depth, "RGB+ED": expected.depth}
    for mode, depth in depths.items():
        renders, alphas, meta = rasterization(**given, **where, render_mode=mode)
        layers = ([expected.values] if "RGB" in mode else []) + ([] if depth is None else [depth[..., None]])
        np.testing.assert_array_equal(numpy_of(renders), np.concatenate(layers, axis=-1)[None])
        assert renders.is_contiguous()
        np.testing.assert_array_equal(numpy_of(alphas), expected.alpha[None, ..., None])
        np.testing.assert_array_equal(numpy_of(meta["depth"]), expected.depth[None, ..., None])
        np.testing.assert_array_equal(numpy_of(meta["median_depth"]), expected.median_depth[None, ..., None])
        np.testing.assert_array_equal(numpy_of(meta["last_gaussian_ids"]), expected.gaussian_ids[None])
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (WIDTH, HEIGHT, 1)
    led, _, _ = rasterization(**{**given, "colors": given["colors"][None]}, **where)  # a first dimension of cameras
    np.testing.assert_array_equal(numpy_of(led[0]), expected.values)


def test_options_reach_the_rasteriser(place, given):
    cameras, where = views(10.0, 200.0)
    options = RasterOptions(antialiased=True, low_pass=0.7, near=2.2, depth="exact")
    own = Rasterizer(120, cameras, value_count=3, normals=True, options=options, device=str(place))
    images = own.draw(as_arrays(given, own.device, "values"))
    renders, alphas, meta = rasterization(
        **given,
        **where,
        near_plane=2.2,
        eps2d=0.7,
        rasterize_mode="antialiased",
        depth="exact",
        return_normals=True,
        packed=False,
        tile_size=8,
        channel_chunk=4,
        segmented=True,
        far_plane=1e10,
        camera_model="pinhole",
        covars=None,
    )
    rows = images.channels[0].numpy().reshape(2, HEIGHT, WIDTH, -1)
    np.testing.assert_array_equal(numpy_of(meta["normals"]), rows[..., 0:3])
    np.testing.assert_array_equal(numpy_of(renders), rows[..., 3:6])
    np.testing.assert_array_equal(numpy_of(alphas).reshape(-1), images.alpha.numpy())
    np.testing.assert_array_equal(numpy_of(meta["depth"]).reshape(-1), images.depth.numpy())


@pytest.mark.parametrize("degree", [0, 3, 4])
def test_spherical_harmonics_have_the_signs_of_3dgs(place, rng, degree):
    given = gaussians(rng, place, bases=25)
    (camera,), where = views()
    renders, _, _ = rasterization(**given, **where, sh_degree=degree)
    toward = numpy_of(given["means"]).astype(np.float64) - camera.position
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    colors = sh_color(numpy_of(given["colors"])[:, : (degree + 1) ** 2], toward)
    plain = {**given, "colors": torch.tensor(colors, dtype=torch.float32, device=place)}
    expected, _, _ = rasterization(**plain, **where)
    # 25 terms of at most 3 sigma times a basis of about 1, each rounded a few times; weights sum to at most 1.
    np.testing.assert_allclose(numpy_of(renders), numpy_of(expected), atol=25 * 4 * 6e-8 * np.abs(colors).max())
    renders.sum().backward()
    found = given["colors"].grad.abs().amax(dim=(0, 2))
    assert (found[: (degree + 1) ** 2] > 0.0).all()
    assert (found[(degree + 1) ** 2 :] == 0.0).all()


def test_a_batch_of_cameras_is_each_of_them(given):
    _, where = views(0.0, 90.0, 200.0)
    together = rasterization(**given, **where, render_mode="RGB+ED", return_normals=True)
    for i in range(3):
        one = {**where, "viewmats": where["viewmats"][i : i + 1], "Ks": where["Ks"][i : i + 1]}
        alone = rasterization(**given, **one, render_mode="RGB+ED", return_normals=True)
        for image, single in zip(together[:2], alone[:2], strict=True):
            assert torch.equal(image[i], single[0])
        for name in ("depth", "median_depth", "last_gaussian_ids", "normals"):
            assert torch.equal(together[2][name][i], alone[2][name][0])


def test_background_is_seen_through_what_is_left(place, rng, given):
    _, where = views(0.0, 90.0)
    backgrounds = torch.tensor(rng.uniform(0, 1, (2, 3)), dtype=torch.float32, device=place, requires_grad=True)
    plain, alphas, _ = rasterization(**given, **where)
    renders, _, _ = rasterization(**given, **where, render_mode="RGB+D", backgrounds=backgrounds)
    depth, _, _ = rasterization(**given, **where, render_mode="D", backgrounds=backgrounds)
    assert torch.equal(renders[..., :3], plain + (1.0 - alphas) * backgrounds[:, None, None, :])
    assert torch.equal(renders[..., 3:], depth)
    upstream = torch.tensor(rng.normal(size=renders.shape), dtype=torch.float32, device=place)
    (renders * upstream).sum().backward()
    expected = ((1.0 - alphas) * upstream[..., :3]).double().sum(dim=(1, 2))
    # Sums of 1320 products in single precision.
    torch.testing.assert_close(backgrounds.grad.double(), expected, rtol=0.0, atol=1320 * 6e-8)


@pytest.mark.parametrize("bases", [None, 9])
def test_gradients_have_the_bits_of_the_rasteriser(place, rng, bases):
    given = gaussians(rng, place, channels=18, bases=bases)
    cameras, where = views(10.0, 130.0)
    kind = {"value_count": 18} if bases is None else {"radiance": True}
    own = Rasterizer(120, cameras, normals=True, **kind, device=str(place))
    own.draw(as_arrays(given, own.device, "values" if bases is None else "radiance"))
    degree = None if bases is None else 2
    renders, alphas, meta = rasterization(**given, **where, sh_degree=degree, return_normals=True)
    images = (alphas, meta["depth"], meta["median_depth"], renders, meta["normals"])
    upstream = [rng.normal(size=image.shape).astype(np.float32) for image in images]
    set_upstream(own, RasterImage(*upstream))
    expected = own.backward()
    torch.autograd.backward(images, [torch.tensor(array, device=place) for array in upstream])
    pairs = {
        "means": expected.positions,
        "quats": expected.orientations,
        "scales": expected.scales,
        "opacities": expected.opacities,
        "colors": expected.values if bases is None else expected.radiance,
    }
    for name, array in pairs.items():
        wanted = array.numpy()[:, [3, 0, 1, 2]] if name == "quats" else array.numpy()
        assert np.abs(wanted).max() > 0.0
        np.testing.assert_array_equal(numpy_of(given[name].grad), wanted, err_msg=name)


def test_a_loss_leaves_nothing_for_the_next(given, where):

    def images():
        renders, alphas, meta = rasterization(**given, **where, return_normals=True)
        return {"renders": renders, "alphas": alphas, **{n: meta[n] for n in ("depth", "median_depth", "normals")}}

    alone = {}
    for name in images():
        forget_rasterizers()
        images()[name].square().sum().backward()
        alone[name] = {n: g for n, g in gradients(given).items() if g is not None}
    assert len(alone) == 5
    for name in reversed(alone):
        images()[name].square().sum().backward()
        assert_same(alone[name], gradients(given))


def test_only_what_is_asked_for_has_a_gradient(given, where):
    rasterization(**given, **where)[0].sum().backward()
    everything = gradients(given)
    for name in GEOMETRY:
        given[name].requires_grad_(False)
    rasterization(**given, **where)[0].sum().backward()
    found = gradients(given)
    assert torch.equal(found["colors"], everything["colors"])
    assert all(found[name] is None for name in GEOMETRY)


def test_draws_between_do_not_matter(place, rng):
    first, second = gaussians(rng, place), gaussians(rng, place)
    _, here = views(10.0)
    _, there = views(130.0)

    def draw(given, where):
        renders, alphas, meta = rasterization(**given, **where, render_mode="RGB+ED", return_normals=True)
        seen = torch.cat([renders, alphas, meta["median_depth"], meta["normals"]], dim=-1)
        loss = seen.square().sum()
        return (renders, alphas, meta["median_depth"], meta["normals"], meta["last_gaussian_ids"]), loss

    alone = []
    for given, where in ((first, here), (second, there)):
        images, loss = draw(given, where)
        loss.backward()
        alone.append(([image.clone() for image in images], gradients(given)))
    for order in ((0, 1), (1, 0)):
        images, losses = zip(*(draw(*pair) for pair in ((first, here), (second, there))), strict=True)
        for i in order:
            losses[i].backward()
            assert_same(gradients((first, second)[i]), alone[i][1])
        for got, (expected, _) in zip(images, alone, strict=True):
            assert all(map(torch.equal, got, expected))  # no later draw writes to what was returned
    _, loss = draw(first, here)
    with torch.no_grad():
        draw(second, there)
    loss.backward(retain_graph=True)
    assert_same(gradients(first), alone[0][1])
    draw(second, there)[1].backward()
    loss.backward()
    assert_same(gradients(first), alone[0][1])
    assert_same(gradients(second), alone[1][1])
    assert len(gsplat._kept) == 1  # and all of it with one rasteriser


def test_what_was_written_to_since_is_refused(given, where):
    loss = rasterization(**given, **where)[0].sum()
    with torch.no_grad():
        given["scales"].mul_(1.1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_second_derivatives_are_refused(given, where):
    (found,) = torch.autograd.grad(
        rasterization(**given, **where)[0].square().sum(), given["colors"], create_graph=True
    )
    with pytest.raises(RuntimeError, match="once_differentiable"):
        found.sum().backward()


def test_tensors_go_in_without_a_copy_whatever_their_rows(place, given):
    packed = torch.cat([given["means"], given["scales"], given["opacities"][:, None], given["colors"]], dim=1).detach()
    cameras, _ = views()
    drawer = TorchRasterizer(120, cameras, value_count=3, device=place)
    orientations = xyzw(given["quats"].detach())
    parts = packed[:, 0:3], orientations, packed[:, 3:6], packed[:, 6], packed[:, 7:10]
    strided = drawer.draw(*parts)
    held = drawer._rasterizer._gaussians
    for array, tensor in zip(held, parts, strict=False):
        assert array.ptr == tensor.data_ptr()
    compact = drawer.draw(*(tensor.contiguous() for tensor in parts))
    for image, expected in zip(strided, compact, strict=True):
        assert image is expected is None or torch.equal(image, expected)


def test_views_share_the_rasterisers_memory(place, given):
    cameras, _ = views(0.0, 90.0)
    drawer = TorchRasterizer(120, cameras, value_count=3, device=place)
    with torch.no_grad():
        images = drawer.draw(given["means"], xyzw(given["quats"]), given["scales"], given["opacities"], given["colors"])
    rasterizer = drawer._rasterizer
    view = drawer.view_images()[1]
    shared = torch.from_dlpack(view.select(range(0, 3)))
    assert shared.data_ptr() == rasterizer.images.channels[0].ptr + WIDTH * HEIGHT * 4 * 4
    assert torch.equal(shared.reshape(-1, 3), images.values[WIDTH * HEIGHT :])
    assert torch.equal(torch.from_dlpack(view.alpha).reshape(-1), images.alpha[WIDTH * HEIGHT :])
    assert images.alpha.data_ptr() != rasterizer.images.alpha.ptr


def test_a_rasteriser_is_kept_for_the_next_call_and_four_at_most(place, rng, where):
    for count in range(1, 8):
        given = gaussians(rng, place, count=count)
        rasterization(**given, **where)
        kept = list(gsplat._kept.values())
        rasterization(**given, **where, render_mode="RGB+ED")
        assert list(gsplat._kept.values()) == kept
        assert len(kept) == min(count, gsplat.KEPT_RASTERIZERS)
    loss = rasterization(**given, **where)[0].sum()
    forget_rasterizers()
    assert not gsplat._kept
    loss.backward()
    assert given["colors"].grad.abs().max() > 0.0


def test_streams_of_torch_are_followed(place, given, where):
    if place.type == "cpu":
        pytest.skip("streams are CUDA's")
    rasterization(**given, **where)[0].square().sum().backward()
    expected = gradients(given)
    for _ in range(3):
        stream = torch.cuda.Stream(place)
        stream.wait_stream(torch.cuda.current_stream(place))
        with torch.cuda.stream(stream):
            renders = rasterization(**given, **where)[0]
            renders.square().sum().backward()
        torch.cuda.current_stream(place).wait_stream(stream)
        assert_same(gradients(given), expected)


@pytest.mark.parametrize("width", [1, 17])
def test_few_pixels_and_no_gaussians(place, rng, where, width):
    given = gaussians(rng, place, count=3)
    renders, alphas, _ = rasterization(**given, **{**where, "width": width, "height": 1})
    assert renders.shape == (1, 1, width, 3)
    empty = {name: tensor[:0].detach().requires_grad_() for name, tensor in given.items()}
    renders, alphas, _ = rasterization(**empty, **where, backgrounds=torch.ones((1, 3), device=place))
    assert (renders == 1.0).all()
    assert (alphas == 0.0).all()
    renders.sum().backward()
    assert empty["means"].grad.shape == (0, 3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("far_plane", 100.0),
        ("radius_clip", 1.0),
        ("sparse_grad", True),
        ("absgrad", True),
        ("distributed", True),
        ("camera_model", "fisheye"),
        ("covars", torch.zeros(120, 3, 3)),
        ("with_ut", True),
        ("with_eval3d", True),
        ("radial_coeffs", torch.zeros(1, 6)),
        ("tangential_coeffs", torch.zeros(1, 2)),
        ("thin_prism_coeffs", torch.zeros(1, 4)),
        ("ftheta_coeffs", object()),
        ("rolling_shutter", "ROLLING_TOP_TO_BOTTOM"),
        ("viewmats_rs", torch.zeros(1, 4, 4)),
    ],
)
def test_arguments_without_a_counterpart_are_refused(rng, where, name, value):
    with pytest.raises(InvalidOptionError, match=rf"^{name} must be .*, the only one that is drawn here, got .*\. \w+"):
        rasterization(**gaussians(rng, "cpu"), **where, **{name: value})


def test_every_refused_argument_is_tested():
    marks = test_arguments_without_a_counterpart_are_refused.pytestmark
    assert [case[0] for case in marks[0].args[1]] == list(gsplat.REFUSED)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": torch.zeros(2, 120, 3)}, r"means must be a tensor of shape \(N, 3\), got .*\(2, 120, 3\)"),
        ({"means": torch.zeros(120, 3).double()}, r"means must be a tensor of torch.float32 of .*, got .*float64"),
        ({"quats": torch.zeros(120, 3)}, r"quats must be a tensor of torch.float32 of shape \(120, 4\)"),
        ({"scales": torch.zeros(120)}, r"scales must be a tensor of torch.float32 of shape \(120, 3\)"),
        ({"opacities": torch.zeros(120, 1)}, r"opacities must be a tensor of torch.float32 of shape \(120,\)"),
        ({"opacities": np.zeros(120)}, r"opacities must be a tensor of torch.float32 of .*, got ndarray"),
        ({"colors": torch.zeros(120)}, r"colors must be a tensor of shape \(N, D\), the same for every camera"),
        ({"colors": torch.zeros(119, 3)}, r"colors must be a tensor of torch.float32 of shape \(120, 3\)"),
        ({"colors": torch.zeros(2, 120, 3)}, r"colors must be .*\(2, 120, 3\).* one by one"),
        ({"colors": torch.zeros(120, 3), "sh_degree": 0}, r"colors must be a tensor of shape \(N, K, 3\)"),
        ({"colors": torch.zeros(120, 4, 3), "sh_degree": 2}, r"colors must hold the 9 coefficients of degree 2, got 4"),
        ({"backgrounds": torch.zeros(3)}, r"backgrounds must be a tensor of torch.float32 of shape \(1, 3\)"),
        ({"viewmats": torch.eye(4)}, r"viewmats must be a tensor of shape \(C, 4, 4\), got .*\(4, 4\)"),
        ({"viewmats": 2.0 * torch.eye(4)[None]}, r"viewmats and Ks must be .* at index 0: a viewmat must end in"),
        (
            {"viewmats": torch.diag(torch.tensor([2.0, 1.0, 1.0, 1.0]))[None]},
            r"viewmats and Ks must be rigid .* index 0: .* must hold a rotation",
        ),
        ({"viewmats": torch.diag(torch.tensor([0.0, 0.0, 0.0, 1.0]))[None]}, r"index 0: Singular"),
        ({"viewmats": torch.full((1, 4, 4), torch.nan)}, r"viewmats and Ks must be rigid motions"),
        ({"viewmats": torch.eye(4)[None].requires_grad_()}, r"viewmats must not ask for a gradient"),
        ({"Ks": torch.eye(3)[None].requires_grad_()}, r"Ks must not ask for a gradient"),
        ({"Ks": torch.eye(3)[None].repeat(2, 1, 1)}, r"Ks must hold a matrix for each of 1 viewmats, got 2"),
        ({"Ks": torch.tensor([[[9.0, 1, 5], [0, 9, 5], [0, 0, 1]]])}, r"K must be fx 0 cx, .* Take out skew"),
        ({"viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)}, "cameras must hold at least one camera"),
        ({"render_mode": "RGB+N"}, "render_mode must be one of RGB, D, ED"),
        ({"rasterize_mode": "sharp"}, "rasterize_mode must be one of classic, antialiased"),
        ({"depth": "center"}, "depth must be one of plane, exact"),
        ({"eps2d": 0.0}, "low_pass must be a number in"),
        ({"near_plane": 0.0}, "near must be a number in"),
        ({"extra_signals": None}, "extra_signals must be an argument of rasterization"),
    ],
)
def test_arguments_that_break_their_contract(rng, where, changes, message):
    with pytest.raises((InvalidArrayError, InvalidOptionError), match=message):
        rasterization(**{**gaussians(rng, "cpu"), **where, **changes})


def test_cameras_may_ask_for_a_gradient_where_none_is_taken(rng, where):
    given = gaussians(rng, "cpu")
    expected = rasterization(**given, **where)[0]
    where["viewmats"].requires_grad_()
    with torch.no_grad():
        assert torch.equal(rasterization(**given, **where)[0], expected)


def test_a_torch_rasteriser_refuses_what_it_was_not_made_for(rng):
    given = gaussians(rng, "cpu")
    cameras, _ = views()
    drawer = TorchRasterizer(120, cameras, device="cpu")
    geometry = given["means"], given["quats"], given["scales"], given["opacities"]
    with pytest.raises(InvalidArrayError, match="values must be left out of what draws none"):
        drawer.draw(*geometry, given["colors"])
    with pytest.raises(InvalidOptionError, match="cameras must have the sizes"):
        drawer.draw(*geometry, cameras=[*cameras, *cameras])
    with pytest.raises(InvalidOptionError, match="coefficient_count must be one of"):
        TorchRasterizer(120, cameras, coefficient_count=3)
