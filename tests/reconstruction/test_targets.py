"""Targets: crops, the gradient of a whole step against float64, shares, what is measured, views of any kind."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from reference import image_losses
from reference.activation import activate, thin_axes
from reference.depth_normals import depth_normals, has_normal
from reference.raster_splats import RasterScene
from reference.rasterizing import decide, replay
from scipy import ndimage
from support.moving_ball import ball_cloud, ball_views, block_means, rig

from beam_warp.capture.mattes import Uncut
from beam_warp.capture.views import CapturedView
from beam_warp.image.color import LINEAR_REC709, linear_to_srgb
from beam_warp.raster.depth_normals import LARGEST_JUMP, STEEPEST
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.parameters import GaussianParameters
from beam_warp.reconstruction.targets import (
    CROP_MARGIN,
    CROP_STEP,
    MATTE_SHARE,
    LossWeights,
    TargetSet,
    ViewTargets,
    crop_views,
)
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

RASTER = RasterOptions(antialiased=True, low_pass=0.1)

NAMES = ("positions", "orientations", "radiance", "log_scales", "logits")


def camera_of(width, height):
    return Camera(width, height, 1.1 * width, 1.2 * width, 0.5 * width + 0.3, 0.5 * height - 0.2, np.eye(4))


def masked(width, height, box):
    """A view whose subject is a box: first column and row, and the ones after the last; none for an empty mask."""
    alpha = np.zeros((height, width), np.float32)
    if box is not None:
        (x0, y0), (x1, y1) = box
        alpha[y0:y1, x0:x1] = 0.5
    y, x = np.mgrid[:height, :width]
    color = np.stack([x, y, alpha], axis=-1).astype(np.float32)  # every pixel says where it was
    return CapturedView(name="a", camera=camera_of(width, height), color=color, alpha=alpha)


def sizes(views):
    return [(view.camera.width, view.camera.height) for view in views]


class TestCrops:
    def test_a_point_keeps_its_pixel(self):
        given = masked(120, 90, ((50, 40), (61, 47)))
        (part,) = crop_views([given])
        left, top = part.color[0, 0, :2]
        point = np.array([[0.05, 0.02, 1.3]])
        np.testing.assert_allclose(part.camera.project(point)[0, :2] + (left, top), given.camera.project(point)[0, :2])
        expected = given.color[int(top) :, int(left) :][: part.camera.height, : part.camera.width]
        np.testing.assert_array_equal(part.color, expected)

    def test_margins_and_steps(self):
        """11 x 7 pixels and twice the margin are 27 x 23: two tiles each, around the subject."""
        (part,) = crop_views([masked(120, 90, ((50, 40), (61, 47)))])
        assert sizes([part]) == [(32, 32)]
        corner = part.color[0, 0, :2]
        assert (corner <= np.array([50, 40]) - CROP_MARGIN).all()
        assert (corner + 32 >= np.array([61, 47]) + CROP_MARGIN).all()

    @pytest.mark.parametrize(
        "box",
        [((0, 0), (5, 5)), ((115, 0), (120, 90)), ((0, 80), (3, 90)), ((0, 0), (120, 90)), ((119, 89), (120, 90))],
    )
    def test_a_subject_at_the_border_stays_whole(self, box):
        given = masked(120, 90, box)
        (part,) = crop_views([given])
        assert part.alpha.sum() == given.alpha.sum()
        assert all(side % CROP_STEP == 0 or side == full for side, full in zip(*sizes([part]), (120, 90), strict=True))

    def test_views_of_one_resolution_have_one_size(self):
        views = [masked(120, 90, ((5, 5), end)) for end in ((10, 60), (70, 10))]
        views.append(masked(60, 90, ((5, 5), (6, 6))))
        assert sizes(crop_views(views)) == [(96, 80), (96, 80), (32, 32)]

    def test_empty_masks(self):
        """A view that shows nothing must still say so; alone, with the least of pixels."""
        assert sizes(crop_views([masked(120, 90, None)])) == [(CROP_STEP, CROP_STEP)]
        views = crop_views([masked(120, 90, None), masked(120, 90, ((50, 40), (61, 47)))])
        assert sizes(views) == [(32, 32)] * 2

    @pytest.mark.parametrize("box", [((50, 40), (61, 47)), ((0, 0), (5, 5)), ((115, 80), (120, 90)), None])
    @pytest.mark.parametrize("factor", [2, 7, 8])
    def test_reduced_parts_are_parts_of_reduced_views(self, factor, box):
        """Only what is left of an image is read, and it is what reducing all of it would have given."""
        views = [masked(120, 90, box), masked(120, 90, ((30, 20), (80, 70)))]
        for found, expected in zip(
            crop_views(views, [factor] * 2), crop_views([view.reduced(factor) for view in views]), strict=True
        ):
            np.testing.assert_array_equal(found.color, expected.color)
            np.testing.assert_array_equal(found.alpha, expected.alpha)
            assert found.camera.center_x == pytest.approx(expected.camera.center_x, abs=1e-9)

    def test_without_alpha_views_stay_whole(self):
        views = [replace(masked(120, 90, None), alpha=None), masked(60, 90, ((5, 5), (6, 6)))]
        cropped = crop_views(views)
        assert sizes(cropped) == [(120, 90), (32, 32)]
        assert cropped[0].alpha is None

    @pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (15, 17)])
    def test_images_smaller_than_a_step(self, width, height):
        view = masked(width, height, ((0, 0), (1, 1)))
        assert sizes(crop_views([view])) == [(min(width, 32), min(height, 32))]
        assert crop_views([view])[0].alpha.sum() == view.alpha.sum()


def near_cloud(rng, count=6):
    """Thick Gaussians in front of the camera at the origin, apart in depth, that hide one another in part."""
    return GaussianCloud(
        positions=np.stack([*rng.uniform(-0.25, 0.25, (2, count)), np.linspace(1.2, 1.5, count)], axis=-1),
        orientations=(lambda q: q / np.linalg.norm(q, axis=1, keepdims=True))(rng.normal(size=(count, 4))),
        scales=np.exp(rng.uniform(np.log(0.05), np.log(0.25), (count, 3))),
        opacities=rng.uniform(0.4, 0.9, count),
        radiance=rng.normal(0.0, 0.4, (count, 4, 3)),
        radiance_color_space=LINEAR_REC709,
    )


def random_view(rng, camera):
    size = (camera.height, camera.width)
    alpha = rng.uniform(size=size)
    return CapturedView(name="a", camera=camera, color=rng.uniform(size=(*size, 3)), alpha=alpha)


def with_backdrop(rng, view):
    """The same before a backdrop that is known in two thirds of the columns."""
    scene, behind = rng.uniform(size=(2, *view.color.shape)).astype(np.float32)
    behind[:, ::3] = 0.0
    return replace(view, uncut=Uncut(scene, behind))


def set_up(views, cloud, device, samples=1, kind=TargetSet, **options):
    """Targets and the Gaussians to draw for them."""
    target = wp.get_device(device)
    return kind(views, len(cloud), RASTER, samples, target), GaussianParameters(cloud, target, **options)


def encode(values):
    low = 12.92 * values
    return np.where(values > 0.0031308, 1.055 * np.maximum(values, 0.0031308) ** (1.0 / 2.4) - 0.055, low)


class Twin:
    """The loss of one step in float64, with the rasteriser's decisions and the stencils of normals held still."""

    def __init__(self, rows, filters, view, samples, weights):
        self.rows, self.filters, self.view = {n: a.astype(np.float64) for n, a in rows.items()}, filters, view
        self.samples, self.weights = samples, weights
        self.thin = thin_axes(rows["log_scales"])
        scene = self.scene(self.rows)
        self.decisions = decide(scene)
        drawn = replay(scene, self.decisions)
        self.mask = drawn.alpha
        focal = min(view.camera.focal_x, view.camera.focal_y) * samples
        self.found = has_normal(
            drawn.depth, drawn.alpha, largest_jump=min(LARGEST_JUMP, np.tan(np.radians(STEEPEST)) / focal)
        )

    def scene(self, rows):
        scales, opacities = activate(rows["log_scales"], rows["logits"], self.filters, self.thin)
        return RasterScene(
            rows["positions"],
            rows["orientations"],
            scales,
            opacities,
            self.view.camera.supersampled(self.samples),
            radiance=rows["radiance"],
            antialiased=RASTER.antialiased,
            low_pass=RASTER.low_pass,
        )

    def loss(self, **changed):
        drawn = replay(self.scene({**self.rows, **changed}), self.decisions)
        weights, everywhere = self.weights, np.ones(self.view.alpha.shape)
        linear, covered = block_means(drawn.channels, self.samples), block_means(drawn.alpha, self.samples)
        target, share = self.view.color.astype(np.float64), 1.0
        if self.view.uncut is not None:
            target = self.view.uncut.scene.astype(np.float64)
            linear = linear + (1.0 - covered) * self.view.uncut.behind.astype(np.float64)
            share = self.weights.estimated * MATTE_SHARE
        color, target = encode(linear), linear_to_srgb(target)
        trust = (everywhere if self.view.doubt is None else 1.0 - self.view.doubt.astype(np.float64))[..., None]
        color = target + trust * (color - target)
        total = weights.l1 * image_losses.l1(color, target, everywhere)
        total += weights.ssim * image_losses.ssim(color, target, everywhere)
        known = self.view.alpha[..., None].astype(np.float64)
        alpha = known + trust * (covered - known)
        total += share * weights.alpha * image_losses.l1(alpha, known, everywhere)
        surface = depth_normals(drawn.depth, self.view.camera.supersampled(self.samples), self.found)
        return total + weights.normal * image_losses.normal(
            drawn.normals, surface, self.mask, weights.normal_tolerance or np.inf
        )

    def gradient(self, name, step=1e-6):
        return image_losses.slope(lambda moved: self.loss(**{name: moved}), self.rows[name], step)


@pytest.mark.parametrize(
    ("size", "samples", "weights", "is_doubted", "has_backdrop"),
    [
        ((19, 14), 1, LossWeights(normal=0.3), False, False),
        ((17, 11), 2, LossWeights(normal=0.3, normal_tolerance=0.1), True, False),
        ((19, 14), 2, LossWeights(l1=0.0, ssim=0.0, alpha=0.0, normal=1.0), False, False),
        ((17, 11), 2, LossWeights(normal=0.3), True, True),
        ((19, 14), 1, LossWeights(ssim=0.0), False, True),
    ],
)
def test_the_gradient_of_a_step_is_that_of_its_loss(device, size, samples, weights, is_doubted, has_backdrop):
    """Encoding, samples, four terms, rasteriser and activation at once: from photographs to the parameters.

    1e-5 of every gradient's length is the goal that all gradients here have; 3.5e-6 was the most in twelve scenes.
    """
    rng = np.random.default_rng(3)
    view = random_view(rng, camera_of(*size))
    if is_doubted:
        view = replace(view, doubt=np.random.default_rng(4).uniform(size=view.alpha.shape))
    if has_backdrop:
        view = with_backdrop(np.random.default_rng(5), view)
    targets, parameters = set_up([view], near_cloud(rng), device, samples, ViewTargets, sh_degree=1)
    filters = rng.uniform(0.0, 0.1, 6).astype(np.float32)
    parameters.filters.assign(filters)
    parameters.activate()
    targets.draw(0, parameters.drawn)
    terms = targets.add_losses(0, weights)
    parameters.zero_gradients()
    parameters.add_gradients(targets.rasterizer.backward())
    twin = Twin(parameters.rows(), filters, view, samples, weights)
    assert not twin.decisions.near_jump.any()  # else float32 may see another image
    assert twin.found.sum() > 10
    assert sum(float(term.numpy()[0]) for term in terms) == pytest.approx(twin.loss(), rel=1e-6)
    errors = {}
    for name in NAMES:
        expected, found = twin.gradient(name), parameters.gradient(name).numpy()
        errors[name] = np.linalg.norm(found - expected) / max(np.linalg.norm(expected), 1e-12)
    assert max(errors.values()) <= 1e-5, errors


def test_coverage_that_is_an_estimate_counts_less(device):
    """What is drawn is the scene: only coverage pulls at it, by its share of what it does where it is all there is."""
    (view,) = ball_views(rig(1))
    cloud, behind = ball_cloud(60), np.float32([0.2, 0.3, 0.4])
    targets, parameters = set_up([view], cloud, device, kind=ViewTargets)
    targets.draw(0, parameters.drawn)
    images = targets.rasterizer.images
    size, colors = view.alpha.shape, targets.rasterizer.color_channels
    color, alpha = images.channels[0].numpy()[:, colors.start : colors.stop].reshape(*size, 3), images.alpha.numpy()
    alpha = alpha.reshape(size)
    grown = ndimage.maximum_filter(alpha, 3)
    wrong = replace(view, color=color, alpha=grown)
    scene = color + (1.0 - alpha)[..., None] * behind
    pulls = []
    before = replace(wrong, uncut=Uncut(scene, np.broadcast_to(behind, scene.shape)))
    for given in (wrong, before, replace(wrong, is_recut=True)):
        targets, parameters = set_up([given], cloud, device, kind=ViewTargets)
        targets.draw(0, parameters.drawn)
        targets.add_losses(0, LossWeights(l1=1.0, ssim=0.2, alpha=1.0, estimated=0.7))
        pulls.append(targets.rasterizer.adjoints().alpha.numpy())
    assert np.abs(pulls[0]).sum() > 0.0
    for share, found in ((0.7 * MATTE_SHARE, pulls[1]), (0.7, pulls[2])):
        np.testing.assert_allclose(found, share * pulls[0], atol=0.02 * np.abs(pulls[0]).max())
    together = ViewTargets([wrong, replace(wrong, is_recut=True)], len(cloud), RASTER, 1, device)
    assert together.kind(0) != together.kind(1)  # a recorded step has the share of its kind


def test_terms_that_count_nothing_ask_for_nothing(device):
    """All weights 0: no derivative anywhere. No term of coverage without alpha, whatever it weighs."""
    rng = np.random.default_rng(5)
    view = random_view(rng, camera_of(19, 14))
    targets, parameters = set_up([view, replace(view, alpha=None)], near_cloud(rng), device, kind=ViewTargets)
    for index, weights in ((0, LossWeights(0.0, 0.0, 0.0, 0.0)), (1, LossWeights(0.0, 0.0, 1.0, 0.0))):
        targets.draw(index, parameters.drawn)
        terms = targets.add_losses(index, weights)
        assert sum(float(term.numpy()[0]) for term in terms) == 0.0
        adjoints = targets.rasterizer.adjoints()
        assert not any(array.numpy().any() for array in (*adjoints.channels, adjoints.alpha, adjoints.depth))


@pytest.mark.parametrize(("size", "samples"), [((1, 1), 1), ((1, 1), 2), ((1, 9), 2), ((3, 2), 1), ((16, 33), 2)])
def test_small_images(device, rng, size, samples):
    """Every loss and gradient of small, reduced photographs is finite."""
    cloud = near_cloud(rng)
    targets, parameters = set_up([random_view(rng, camera_of(*size))], cloud, device, samples, ViewTargets)
    targets.draw(0, parameters.drawn)
    terms = targets.add_losses(0, LossWeights(normal=1.0))
    parameters.add_gradients(targets.rasterizer.backward())
    assert len(terms) == 4
    assert all(np.isfinite(term.numpy()).all() for term in terms)
    assert all(np.isfinite(parameters.gradient(name).numpy()).all() for name in NAMES)


def test_steps_of_several_views_do_not_mix(device):
    """Looking from one view after another gives the bits of targets that have that view only."""
    views, cloud = ball_views(rig(3)), ball_cloud(60, painted=False)
    together, parameters = set_up(views, cloud, device, 2, ViewTargets)
    together.draw(0, parameters.drawn)
    for index in (0, 2, 1, 0):
        together.select(index)
        together.rasterizer.redraw()
        found = [term.numpy().copy() for term in together.add_losses(index, LossWeights(normal=0.3))]
        found += [getattr(together.rasterizer.backward(), name).numpy().copy() for name in ("positions", "opacities")]
        alone, _ = set_up([views[index]], cloud, device, 2, ViewTargets)
        alone.draw(0, parameters.drawn)
        expected = [term.numpy() for term in alone.add_losses(0, LossWeights(normal=0.3))]
        expected += [getattr(alone.rasterizer.backward(), name).numpy() for name in ("positions", "opacities")]
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other)


class TestMeasure:
    def test_psnr_is_that_of_the_crops(self, device):
        """Two resolutions, numbered as they were given: what `rasterize` draws for each crop, encoded and compared."""
        views = [view for pair in zip(ball_views(rig(2)), ball_views(rig(2, 56)), strict=True) for view in pair]
        targets, parameters = set_up(views, ball_cloud(60), device)
        psnr, _ = targets.make_room(parameters.drawn)
        assert psnr.shape == targets.gaps(parameters.drawn).shape == (4,)
        for found, part in zip(psnr, crop_views(views), strict=True):
            buffer = rasterize(parameters.cloud(), part.camera, channels=("radiance",), options=RASTER, device=device)
            linear = buffer.channels["radiance"].astype(np.float64) * buffer.alpha[..., None]
            ours, theirs = (np.clip(linear_to_srgb(image), 0.0, 1.0) for image in (linear, part.color))
            assert found == pytest.approx(-10.0 * np.log10(np.mean((ours - theirs) ** 2)), abs=1e-3)

    def test_what_is_not_covered(self, device):
        """A half of the ball that nobody drew is the largest gap; what covers it all leaves none."""
        cloud = ball_cloud(200)
        half = cloud.with_arrays(opacities=np.where(cloud.positions[:, 2] > 0.0, 0.8, 0.0))
        for given, low, high in ((cloud, 0.0, 0.0), (half, 0.2, 0.8)):
            targets, parameters = set_up(ball_views(rig(2)), given, device)
            gaps = targets.gaps(parameters.drawn)
            assert ((low <= gaps) & (gaps <= high)).all()

    def test_without_alpha_nothing_is_known_to_be_missing(self, device):
        cloud = ball_cloud(20).with_arrays(opacities=np.zeros(20))
        targets, parameters = set_up(ball_views(rig(2), with_alpha=False), cloud, device)
        assert not targets.gaps(parameters.drawn).any()
        assert np.isfinite(targets.make_room(parameters.drawn)[0]).all()

    def test_a_black_view(self, device):
        """An empty mask and black pixels are met by nothing at all: they say nothing of what was drawn."""
        (view,) = ball_views(rig(1))
        black = replace(view, color=0.0 * view.color, alpha=0.0 * view.alpha)
        cloud = ball_cloud(20).with_arrays(opacities=np.zeros(20))
        targets, parameters = set_up([black, view], cloud, device)
        psnr, _ = targets.make_room(parameters.drawn)
        assert np.isnan(psnr).tolist() == [True, False]
        assert targets.gaps(parameters.drawn)[0] == 0.0


@pytest.mark.parametrize("samples", [1, 3])
def test_shares_are_weights_summed_over_pixels(device, samples):
    """Together they are the sum of alpha over the pixels of all crops; those that nobody sees have none."""
    views = [*ball_views(rig(2)), *ball_views(rig(1, 56))]
    cloud = ball_cloud(60)
    cloud = cloud.with_arrays(positions=np.where(np.arange(60)[:, None] == 7, 50.0, cloud.positions))
    targets, parameters = set_up(views, cloud, device, samples)
    found = targets.shares(parameters.drawn)
    assert found.shape == (60,)
    assert (found >= 0.0).all()
    assert found[7] == 0.0
    cameras = [part.camera.supersampled(samples) for part in crop_views(views)]
    drawn = [rasterize(cloud, camera, channels=(), options=RASTER, device=device).alpha for camera in cameras]
    assert found.sum() == pytest.approx(sum(alpha.sum(dtype=np.float64) for alpha in drawn) / samples**2, rel=1e-5)


def test_room_is_made_when_more_is_drawn(device):
    targets, parameters = set_up(ball_views(rig(2)), ball_cloud(60), device)
    assert targets.make_room(parameters.drawn)[1]
    assert not targets.make_room(parameters.drawn)[1]
    parameters.set_rows({"log_scales": parameters.rows()["log_scales"] + np.float32(1.5)})
    parameters.activate()
    psnr, is_new = targets.make_room(parameters.drawn)
    assert is_new
    fresh = TargetSet(ball_views(rig(2)), 60, RASTER, 1, targets.device)
    np.testing.assert_array_equal(psnr, fresh.make_room(parameters.drawn)[0])  # nothing was left out for lack of room
