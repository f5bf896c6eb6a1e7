"""Reflections of a known light: against the split sum, float64 least squares and differences; what a fit gains."""

import numpy as np
import pytest
import warp as wp
from support.lit_balls import LIGHTS
from support.moving_ball import RADIUS, ball_cloud, rig
from support.split_sum import shade, smooth_environment

from beam_warp.capture.views import CapturedView
from beam_warp.kernels.raster.project import RasterView
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.raster.layout import ViewLayout
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.reconstruction.fit import FIT_RASTER, FitOptions, Fitter, LearningRates
from beam_warp.reconstruction.parameters import GaussianParameters
from beam_warp.reconstruction.reflections import RIDGE
from beam_warp.world.directions import even_directions
from beam_warp.world.harmonics import SH_C0, sh_basis

CAMERAS = rig(3)
ROUGHNESS = (0.05, 0.3, 1.0)


def logit(x):
    return np.log(x / (1.0 - x))


def glossy(device, light, count=60, *, roughness=0.3, part=0.6, radiance=-0.5 / SH_C0, rows=None):
    """Discs of a ball that reflect, and scatter nothing unless they are told to."""
    cloud = ball_cloud(count)
    cloud = cloud.with_arrays(radiance=np.full_like(cloud.radiance, radiance))
    parameters = GaussianParameters(cloud, device, environment=light, row_count=rows)
    rough = np.clip((np.broadcast_to(roughness, count) - 0.05) / 0.95, 1e-6, 1.0 - 1e-6)
    gloss = np.stack([logit(rough), np.full(count, logit(part))], axis=1)
    parameters.reflections.gloss[:count].assign(gloss.astype(np.float32))
    return parameters


def directions_to(camera, positions):
    away = camera.position - positions
    return away / np.linalg.norm(away, axis=-1, keepdims=True)


def reflected_by(parameters, cameras):
    """What every splat reflects, ``(V, N, 3)``."""
    views = wp.array(ViewLayout.of(cameras).views, dtype=RasterView, device=parameters.device)
    colors = wp.zeros(len(cameras) * len(parameters), dtype=wp.vec3, device=parameters.device)
    parameters.reflections.add(parameters.drawn, views, colors)
    return colors.numpy().reshape(len(cameras), -1, 3)


def drawn_by(parameters, cameras):
    """Images of colour."""
    images = Rasterizer(len(parameters), cameras, radiance=True, device=parameters.device).draw(parameters.drawn)
    return images.channels[0].numpy()[:, :3]


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_an_open_part_of_what_a_dark_surface_reflects(device, roughness):
    """The split sum of a black base colour, without occlusion, times the part; on the side that is seen."""
    light = smooth_environment()
    parameters = glossy(device, light, roughness=roughness)
    found = reflected_by(parameters, CAMERAS)
    positions = parameters.positions.numpy().astype(np.float64)
    normals = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    away = np.stack([directions_to(camera, positions) for camera in CAMERAS])
    facing = (away * normals).sum(axis=-1, keepdims=True)
    normals = np.where(facing < 0.0, -normals, normals)
    ones = np.ones(away.shape[:2])
    expected = shade(
        PreparedEnvironment(light, device=device),
        base_color=np.zeros_like(away),
        roughness=roughness * ones,
        ambient_occlusion=ones,
        normals=normals,
        alpha=0.6 * ones,
        view_directions=-away,
    )
    seen = np.abs(facing[..., 0]) > 0.11
    np.testing.assert_allclose(found[seen], expected[seen], rtol=2e-4)


def test_gradients_of_gloss_are_those_of_a_loss(device, rng):
    """Central differences of the sum over the image, by an arbitrary weight for each pixel and channel."""
    parameters = glossy(device, LIGHTS["studio"], roughness=rng.uniform(0.2, 0.8, 60), radiance=0.0)
    rasterizer = Rasterizer(60, CAMERAS, radiance=True, device=device)
    rasterizer.draw(parameters.drawn)
    weights = rng.normal(size=rasterizer.images.channels[0].shape).astype(np.float32)

    def loss():
        return float((rasterizer.redraw().channels[0].numpy().astype(np.float64)[:, :3] * weights[:, :3]).sum())

    rasterizer.adjoints().channels[0].assign(weights)
    rasterizer.backward()
    found = parameters.reflections.gradients.numpy().copy()
    gloss, step = parameters.reflections.gloss.numpy().copy(), 0.05
    scale = np.abs(found).max(axis=0)
    for row in rng.choice(60, 12, replace=False):
        for column in range(2):
            sums = []
            for sign in (1.0, -1.0):
                moved = gloss.copy()
                moved[row, column] += sign * step
                parameters.reflections.gloss.assign(moved)
                sums.append(loss())
            slope = (sums[0] - sums[1]) / (2.0 * step)
            assert found[row, column] == pytest.approx(slope, abs=0.01 * float(scale[column]))


@pytest.mark.parametrize("degree", [0, 2])
def test_harmonics_are_the_nearest_to_what_is_reflected(device, degree):
    """Float64 least squares of what the rasteriser shows cameras in the same directions, each Gaussian on its own."""
    parameters = glossy(device, LIGHTS["studio"], 12, roughness=np.linspace(0.2, 0.9, 12), rows=15)
    positions = parameters.positions.numpy().astype(np.float64)
    normals = positions[:12] / RADIUS
    found = parameters.reflections.harmonics(parameters.drawn, np.float32(positions), degree)
    assert (found[12:] == 0.0).all()
    towards = even_directions(96)
    basis = sh_basis(-towards, degree)
    cosine = normals @ towards.T
    bounded = normals[:, None] + np.maximum(0.1 - cosine, 0.0)[..., None] * towards  # no view grazes more than that
    shown = shade(
        PreparedEnvironment(LIGHTS["studio"], device=device),
        base_color=np.zeros((12, 96, 3)),
        roughness=np.repeat(np.linspace(0.2, 0.9, 12), 96).reshape(12, 96),
        ambient_occlusion=np.ones((12, 96)),
        normals=bounded,
        alpha=np.full((12, 96), 0.6),
        view_directions=np.broadcast_to(-towards, (12, 96, 3)),
    )
    for i in range(12):
        weights = np.maximum(cosine[i], 0.0)
        ridge = RIDGE / (4.0 * np.pi) * weights.sum() * np.diag([0.0] + [1.0] * (basis.shape[1] - 1))
        expected = np.linalg.solve((basis.T * weights) @ basis + ridge, (basis.T * weights) @ shown[i])
        np.testing.assert_allclose(found[i], expected, atol=1e-3 * np.abs(expected).max())


def test_what_is_settled_is_drawn_by_harmonics_alone(device):
    """Under a smooth light a rough ball reflects smoothly: images stay within 3 %."""
    parameters = glossy(device, smooth_environment(), 300, roughness=0.9, radiance=0.0)
    before = drawn_by(parameters, CAMERAS)
    parameters.settle_reflections(parameters.positions.numpy())
    assert parameters.reflections is None
    assert parameters.drawn.extra is None
    after = drawn_by(parameters, CAMERAS)
    np.testing.assert_allclose(after, before, atol=0.03 * before.max())
    parameters.settle_reflections(parameters.positions.numpy())  # nothing is left to settle
    np.testing.assert_array_equal(drawn_by(parameters, CAMERAS), after)


def photographs(device, parameters, cameras):
    """What the rasteriser draws, one sample a pixel."""
    views = []
    for k, camera in enumerate(cameras):
        images = Rasterizer(len(parameters), [camera], radiance=True, options=FIT_RASTER, device=device).draw(
            parameters.drawn
        )
        shape = (camera.height, camera.width)
        color, alpha = images.channels[0].numpy()[:, :3].reshape(*shape, 3), images.alpha.numpy().reshape(shape)
        views.append(CapturedView(name=f"view {k}", camera=camera, color=color.copy(), alpha=alpha.copy()))
    return views


def still(**rates):
    """Rates that leave shapes and places as they are."""
    return LearningRates(**dict.fromkeys(("positions", "orientations", "scales", "opacities"), 0.0), **rates)


def fitter_of(views, light, device, **changes):
    """A fit of matte grey discs in the right places."""
    kept = {"color_iterations": 0, "normal_iterations": 240, "refine_every": 0, "samples": 1, "sampling_filter": False}
    options = FitOptions(**{**kept, "rates": still(), "gaussian_count": 300, **changes})
    return Fitter(views, ball_cloud(300, painted=False), options, wp.get_device(device), environment=light)


def test_roughness_and_openness_are_found(device):
    """Discs in the right places, of unknown paint: within .06, and five times nearer than harmonics come."""
    light = LIGHTS["studio"]
    views = photographs(device, glossy(device, light, 300, roughness=0.35, part=0.6, radiance=-0.8), rig(10))
    fitter, plain = (fitter_of(views, known, device, rates=still(gloss=0.05)) for known in (light, None))
    heard = []

    def listen(done, total, facts):
        if fitter.parameters.reflections is not None:
            heard.append((fitter.parameters.gloss.numpy().astype(np.float64), fitter.psnr().mean()))

    fitter.run(listen)
    plain.run()
    gloss, psnr = heard[-1]
    roughness, part = 0.05 + 0.95 / (1.0 + np.exp(-gloss[:, 0])), 1.0 / (1.0 + np.exp(-gloss[:, 1]))
    assert np.median(roughness) == pytest.approx(0.35, abs=0.06)
    assert np.median(part) == pytest.approx(0.6, abs=0.06)
    assert psnr > plain.psnr().mean() + 14.0
    assert fitter.psnr().mean() > plain.psnr().mean() - 0.5  # and settled, it is as near as one of harmonics alone


def test_without_a_light_nothing_differs(device):
    """Nor if reflections are not wanted."""
    views = photographs(device, glossy(device, LIGHTS["studio"], 300), rig(2))
    some = {"normal_iterations": 5, "rates": LearningRates()}
    plain, unwanted = (
        fitter_of(views, light, device, **some, **changes)
        for light, changes in ((None, {}), (LIGHTS["studio"], {"reflect_until": 0.0}))
    )
    for fitter in (plain, unwanted):
        assert fitter.parameters.reflections is None
        fitter.run()
    for name, array in plain.parameters.rows().items():
        np.testing.assert_array_equal(unwanted.parameters.rows()[name], array)
