"""Denoising: what is constant stays, edges of the surface stay, noise goes; and what is not installed is named."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from beam_warp import Camera
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError, MissingPackageError
from beam_warp.trace import denoise as denoising
from beam_warp.trace.denoise import DENOISERS, NoisyImage, SurfaceGuides, chosen_denoiser, denoise

WIDTH, HEIGHT = 72, 60
BESIDE = slice(WIDTH // 2 - 1, WIDTH // 2 + 1)

FILTERS = ("oidn", "bilateral")


@pytest.fixture(params=FILTERS)
def denoiser(request):
    if request.param == "oidn" and denoising._open_image_denoise() is None:
        pytest.skip("Open Image Denoise (extra denoise) is not installed")
    return request.param


class Wall:
    """A wall seen face on whose right half lies ``step`` further away, or is turned by ``turn`` degrees."""

    def __init__(self, device, step=0.0, turn=0.0, hole=0):
        self.device = resolve_device(device)
        self.camera = Camera.orbit((0, 0, 0), 2.0, 0.0, 0.0, width=WIDTH, height=HEIGHT, vertical_fov=40.0)
        self.right = np.arange(WIDTH) >= WIDTH // 2
        back = -self.camera.forward
        side = self.camera.camera_to_world[:3, 0]
        angle = np.radians(turn)
        normals = np.tile(back, (HEIGHT, WIDTH, 1))
        normals[:, self.right] = np.cos(angle) * back + np.sin(angle) * side
        depth = np.full((HEIGHT, WIDTH), 2.0)
        depth[:, self.right] += step
        self.surface = np.ones((HEIGHT, WIDTH), bool)
        self.surface[:hole] = False
        normals[~self.surface] = 0.0
        depth[~self.surface] = 0.0
        self.guides = SurfaceGuides(
            self.camera,
            upload(normals.reshape(-1, 3).astype(np.float32), wp.vec3, self.device),
            upload(depth.ravel().astype(np.float32), float, self.device),
        )

    def image(self, values, error, hdr=False):
        values = np.where(self.surface[..., None] if values.ndim == 3 else self.surface, values, 0.0)
        flat = values.reshape(-1, 3) if values.ndim == 3 else values.ravel()
        return NoisyImage(
            upload(flat.astype(np.float32), wp.vec3 if values.ndim == 3 else float, self.device),
            upload(np.full(HEIGHT * WIDTH, error, np.float32), float, self.device),
            hdr,
        )

    def denoised(self, values, error, denoiser, hdr=False):
        (result,) = denoise([self.image(values, error, hdr)], self.guides, denoiser=denoiser)
        return result.numpy().reshape(values.shape)


def psnr(values, truth):
    return -10.0 * np.log10(np.mean((values - truth) ** 2))


class TestFilters:
    @pytest.mark.parametrize("hdr", [False, True])
    @pytest.mark.parametrize("value", [0.37, 1.0])
    def test_constants_stay(self, device, denoiser, value, hdr):
        found = Wall(device).denoised(np.full((HEIGHT, WIDTH), value), 0.1, denoiser, hdr)
        if denoiser == "bilateral":
            # a mean of 25 equal values in each of five rounds: as many roundings of a sum and of weights
            np.testing.assert_allclose(found, value, rtol=5 * 25 * 2.0**-24)
        else:  # a network: it promises nothing, and falls short at the picture's own border
            np.testing.assert_allclose(found[8:-8, 8:-8], value, rtol=0.01)

    @pytest.mark.parametrize(("spread", "hdr"), [(0.07, False), (0.3, True)])
    def test_noise_goes(self, device, denoiser, rng, spread, hdr):
        """0.07 is what 50 rays leave of half-open; twice the decibels of a mean of 10 pixels."""
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        truth = 0.5 + 0.2 * np.sin(x / 20.0) * np.cos(y / 15.0)
        truth = np.stack([truth, 0.9 * truth, 0.8 * truth], axis=-1)
        noisy = np.maximum(truth + spread * rng.normal(size=truth.shape[:2])[..., None], 0.0)
        noisy = noisy if hdr else np.minimum(noisy, 1.0)
        found = Wall(device).denoised(noisy, spread, denoiser, hdr)
        assert psnr(found, truth) > psnr(noisy, truth) + 8.0

    @pytest.mark.parametrize("edge", [{"step": 0.3}, {"turn": 60.0}])
    def test_edges_of_the_surface_stay(self, device, denoiser, rng, edge):
        wall = Wall(device, **edge)
        truth = np.where(wall.right, 0.8, 0.3)[None].repeat(HEIGHT, axis=0)
        noisy = np.clip(truth + 0.07 * rng.normal(size=truth.shape), 0.0, 1.0)
        found = wall.denoised(noisy, 0.07, denoiser)
        assert psnr(found, truth) > psnr(noisy, truth) + 6.0
        # The step of 0.5 is there in full right at the edge: the mean of a column has a noise of 0.07 / sqrt(60). The
        # network takes off up to a sixth of it in the last column.
        allowed = 0.03 if denoiser == "bilateral" else 0.1
        np.testing.assert_allclose(found[:, BESIDE].mean(axis=0), [0.3, 0.8], atol=allowed)

    def test_background_neither_gives_nor_takes(self, device, denoiser, rng):
        wall = Wall(device, hole=HEIGHT // 2)
        truth = np.full((HEIGHT, WIDTH), 0.9)
        noisy = np.clip(truth + 0.05 * rng.normal(size=truth.shape), 0.0, 1.0)
        found = wall.denoised(noisy, 0.05, denoiser)
        assert not found[: HEIGHT // 2].any()
        first = found[HEIGHT // 2].mean()
        assert abs(first - noisy[HEIGHT // 2 :].mean()) < 0.02

    def test_fireflies_light_up_nothing(self, device, denoiser, rng):
        truth = np.full((HEIGHT, WIDTH, 3), 0.5)
        noisy = truth + 0.05 * rng.normal(size=(HEIGHT, WIDTH, 1))
        noisy[30, 20] = 1e5
        noisy[10, 50] = (1e5, 0.0, 0.0)
        found = Wall(device).denoised(noisy, 0.05, denoiser, hdr=True)
        # at most five times the mean of the neighbours: (5 - 1) 0.5 in a pixel, less once it is spread
        assert np.abs(found - truth).mean(axis=2).max() < 2.5
        assert abs(found.mean() / 0.5 - 1.0) < 0.01

    def test_several_images_and_types(self, device, denoiser, rng):
        wall = Wall(device)
        grey, color = rng.uniform(0, 1, (HEIGHT, WIDTH)), rng.uniform(0, 3, (HEIGHT, WIDTH, 3))
        images = [wall.image(grey, 0.3), wall.image(color, 0.3, hdr=True)]
        found = denoise(images, wall.guides, denoiser=denoiser)
        assert [image.dtype for image in found] == [wp.float32, wp.vec3]
        again = denoise(images[:1], wall.guides, denoiser=denoiser)
        np.testing.assert_array_equal(found[0].numpy(), again[0].numpy())


def test_oidn_sees_the_mean_of_the_surface_behind_it(device, rng, monkeypatch):
    """A stand-in for the package, which need not be installed, gives back the image that it is handed."""
    handed = {}

    class StandIn:
        DeviceType = SimpleNamespace(CPU="cpu")
        Device = str

        def denoise(self, image, **options):
            handed.update(options, image=image)
            return image

    monkeypatch.setattr(denoising, "_open_image_denoise", StandIn)
    wall = Wall(device, hole=20)
    values = rng.uniform(0.0, 1.0, (HEIGHT, WIDTH, 3)).astype(np.float32)
    found = wall.denoised(values, 0.1, "oidn")
    np.testing.assert_array_equal(found, np.where(wall.surface[..., None], values, 0.0))
    mean = values[20:].mean(axis=(0, 1), dtype=np.float64).astype(np.float32)
    np.testing.assert_array_equal(handed["image"][:20], np.broadcast_to(mean, (20, WIDTH, 3)))
    assert (handed["hdr"], handed["clean_aux"], handed["device"]) == (False, True, "cpu")


class TestBilateral:
    def test_known_steps_of_light_stay(self, device, rng):
        """A shadow's edge that no geometry shows, five standard errors high: the errors keep it."""
        wall = Wall(device)
        truth = np.where(wall.right, 0.9, 0.4)[None].repeat(HEIGHT, axis=0)
        noisy = truth + 0.05 * rng.normal(size=truth.shape)
        found = wall.denoised(noisy, 0.05, "bilateral")
        np.testing.assert_allclose(found[:, BESIDE].mean(axis=0), [0.4, 0.9], atol=0.1)
        assert psnr(found, truth) > psnr(noisy, truth) + 5.0

    @pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 9), (33, 1), (5, 65)])
    def test_any_size(self, device, rng, width, height):
        where = resolve_device(device)
        camera = Camera.orbit((0, 0, 0), 2.0, 0.0, 0.0, width=width, height=height, vertical_fov=40.0)
        count = width * height
        guides = SurfaceGuides(
            camera,
            wp.full(count, wp.vec3(*-camera.forward), dtype=wp.vec3, device=where),
            wp.full(count, 2.0, dtype=float, device=where),
        )
        values = rng.uniform(0, 1, count).astype(np.float32)
        image = NoisyImage(upload(values, float, where), wp.full(count, 0.3, dtype=float, device=where), hdr=True)
        (found,) = denoise([image], guides, denoiser="bilateral")
        assert values.min() <= found.numpy().min() <= found.numpy().max() <= values.max()
        assert found.numpy().std() <= values.std()

    def test_a_mean_of_what_agrees_fully(self, device, rng):
        """The first round on a plane, with errors so large that all values agree, is the B-spline itself."""
        from beam_warp.kernels.trace.joint_bilateral import launch_filter_round

        wall = Wall(device)
        values = rng.uniform(0, 1, (HEIGHT, WIDTH))
        colors = np.repeat(values.reshape(-1, 1), 3, axis=1).astype(np.float32)
        variances = rng.uniform(1e7, 2e7, HEIGHT * WIDTH).astype(np.float32)
        out, spread = (wp.zeros(HEIGHT * WIDTH, dtype=t, device=wall.device) for t in (wp.vec3, float))
        launch_filter_round(
            len(colors),
            denoising._kernel_guides(wall.guides),
            2,
            upload(colors, wp.vec3, wall.device),
            upload(variances, float, wall.device),
            out,
            spread,
            wall.device,
        )
        taps = np.array([1, 4, 6, 4, 1]) / 16.0
        y, x = 31, 40
        rows, columns = np.ix_(y + np.arange(-4, 5, 2), x + np.arange(-4, 5, 2))
        kernel = np.outer(taps, taps)
        wanted = (kernel * values[rows, columns]).sum()
        assert out.numpy().reshape(HEIGHT, WIDTH, 3)[y, x, 0] == pytest.approx(wanted, rel=1e-5)
        noise = (kernel**2 * variances.reshape(HEIGHT, WIDTH)[rows, columns]).sum()
        assert spread.numpy().reshape(HEIGHT, WIDTH)[y, x] == pytest.approx(noise, rel=1e-4)


class TestChoice:
    def test_none_gives_images_back(self, device, rng):
        wall = Wall(device)
        values = rng.uniform(0, 1, (HEIGHT, WIDTH)).astype(np.float32)
        np.testing.assert_array_equal(wall.denoised(values, 0.1, "none"), values)

    def test_what_is_missing_is_named(self, monkeypatch):
        monkeypatch.setattr(denoising, "_open_image_denoise", lambda: None)
        assert chosen_denoiser("auto") == "bilateral"
        assert chosen_denoiser("bilateral") == "bilateral"
        with pytest.raises(MissingPackageError, match=r'pip install "beam-warp\[denoise\]"'):
            chosen_denoiser("oidn")

    def test_what_is_there_is_taken(self, monkeypatch):
        monkeypatch.setattr(denoising, "_open_image_denoise", lambda: object())
        assert [chosen_denoiser(name) for name in DENOISERS] == ["oidn", "oidn", "bilateral", "none"]

    def test_refusals(self):
        wall = Wall("cpu")
        image = wall.image(np.ones((HEIGHT, WIDTH)), 0.1)
        with pytest.raises(InvalidOptionError, match=r"^denoiser must be one of auto, oidn, bilateral, none"):
            denoise([image], wall.guides, denoiser="median")
        short = NoisyImage(image.values[:10], image.standard_error, hdr=False)
        with pytest.raises(InvalidArrayError, match=r"^images and guides must have 4320 pixels"):
            denoise([short], wall.guides, denoiser="bilateral")
