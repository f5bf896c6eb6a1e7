"""Depth to normals: planes in closed form, the float64 twin, gradients, edges, sizes, broken depths."""

import numpy as np
import pytest
import warp as wp
from reference.depth_normals import depth_normals, has_normal, rays
from support.float32 import EPSILON
from support.kernel_runs import upload_floats as upload

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.raster.depth_normals import DepthNormals
from beam_warp.world.camera import Camera


def camera_of(width, height, focal=80.0):
    """A camera that looks somewhere from somewhere, with a principal point off the centre."""
    seen = Camera.look_at((0.3, -2.0, 0.7), (0.0, 0.1, 0.2), width=width, height=height, vertical_fov=40.0)
    return Camera(width, height, focal, 1.1 * focal, 0.45 * width, 0.56 * height, seen.camera_to_world)


def normals_of(depth, camera, device, alpha=None, *, largest_jump=0.03, **options):
    options |= {"largest_jump": largest_jump}
    shape = (camera.height, camera.width)
    normals = wp.full((*shape, 3), 7.0, dtype=float, device=device)
    alpha = np.ones(shape) if alpha is None else alpha
    DepthNormals(camera, device=device, **options).write(upload(depth, device), upload(alpha, device), normals)
    return normals.numpy()


def gradients_of(depth, camera, upstream, device, alpha=None, *, largest_jump=0.03, **options):
    options |= {"largest_jump": largest_jump}
    gradients = wp.zeros(depth.shape, dtype=float, device=device)
    alpha = np.ones(depth.shape) if alpha is None else alpha
    DepthNormals(camera, device=device, **options).add_gradients(
        upload(depth, device), upload(alpha, device), upload(upstream, device), gradients
    )
    return gradients.numpy()


def bumpy_depth(rng, camera):
    """A smooth surface with every slope, and a rectangle in front of it, as float32."""
    y, x = np.mgrid[: camera.height, : camera.width]
    depth = 2.0 + 0.004 * x + 0.05 * np.sin(0.3 * x + 0.5) * np.cos(0.25 * y) + 0.004 * rng.standard_normal(x.shape)
    depth[camera.height // 3 : camera.height // 2, camera.width // 3 : camera.width // 2] -= 0.8
    return depth.astype(np.float32)


class TestClosedForm:
    @pytest.mark.parametrize("tilt", [(0.0, 0.0), (1.5, -1.5)])
    def test_plane(self, device, tilt):
        camera = camera_of(37, 29)
        normal = np.array([*tilt, -1.0]) / np.linalg.norm([*tilt, -1.0])
        depth = 3.0 * normal[2] / (rays(camera) @ normal)
        found = normals_of(depth, camera, device, largest_jump=0.2)[1:-1, 1:-1]
        # A depth is rounded once; p = f (z1 - z0) / (z1 + z0) then moves by at most f * 2^-24, q likewise, and the unit
        # normal by no more than the two together; another 4 roundings of a length of at most 1 for the rotation.
        tolerance = (np.hypot(camera.focal_x, camera.focal_y) + 8.0) * EPSILON
        assert np.abs(found - camera.camera_to_world[:3, :3] @ normal).max() <= tolerance


class TestTwin:
    @pytest.mark.parametrize("size", [(3, 3), (33, 31)])
    def test_normals(self, device, rng, size):
        camera = camera_of(*size)
        depth = bumpy_depth(rng, camera)
        alpha = rng.uniform(0.4, 1.0, depth.shape).astype(np.float32) ** 0.3
        found = has_normal(depth, alpha)
        assert found.any()
        normals = normals_of(depth, camera, device, alpha)
        assert ((np.abs(normals).max(axis=-1) > 0.0) == found).all()
        # u, v, p, q: two roundings each of numbers below 2; sum, length, quotient and rotation: 8 more
        assert np.abs(normals - depth_normals(depth, camera, found)).max() <= 16.0 * 2.0 * EPSILON

    def test_gradients(self, device, rng):
        camera = camera_of(33, 35)
        depth = bumpy_depth(rng, camera)
        alpha = (rng.uniform(size=depth.shape) > 0.02).astype(np.float32)
        upstream = rng.standard_normal((*depth.shape, 3)).astype(np.float32)
        found = has_normal(depth, alpha)
        assert 0.3 < found.mean() < 0.9
        step = 1e-6
        expected = np.zeros(depth.shape)
        # Pixels four apart share no normal: moved together, each one's share is the sum over its neighbourhood.
        for y in range(4):
            for x in range(4):
                moved = np.zeros(depth.shape)
                moved[y::4, x::4] = step
                change = depth_normals(depth + moved, camera, found) - depth_normals(depth - moved, camera, found)
                change = np.pad((change * upstream).sum(axis=-1) / (2.0 * step), 1)
                near = change[:-2, 1:-1] + change[2:, 1:-1] + change[1:-1, :-2] + change[1:-1, 2:]
                expected[y::4, x::4] = near[y::4, x::4]
        gradients = gradients_of(depth, camera, upstream, device, alpha)
        assert np.linalg.norm(gradients - expected) <= 1e-6 * np.linalg.norm(expected)  # about 16 roundings

    def test_gradients_add_up(self, device, rng):
        camera = camera_of(20, 20)
        depth, upstream = upload(bumpy_depth(rng, camera), device), upload(rng.standard_normal((20, 20, 3)), device)
        alpha = wp.ones((20, 20), dtype=float, device=device)
        normals = DepthNormals(camera, device=device)
        once, twice = (wp.zeros((20, 20), dtype=float, device=device) for _ in range(2))
        normals.add_gradients(depth, alpha, upstream, once)
        for _ in range(2):
            normals.add_gradients(depth, alpha, upstream, twice)
        assert (twice.numpy() == 2.0 * once.numpy()).all()

    def test_strided_views_and_threads(self, device, rng, monkeypatch):
        camera = camera_of(70, 64)
        depth, alpha = bumpy_depth(rng, camera), np.ones((64, 70), np.float32)
        upstream = rng.standard_normal((64, 70, 3)).astype(np.float32)
        rows = wp.zeros((64, 70, 8), dtype=float, device=device)
        wide = upload(np.concatenate([upstream, depth[..., None], alpha[..., None], 0 * upstream], axis=-1), device)
        normals = DepthNormals(camera, device=device)
        monkeypatch.setenv("BEAM_WARP_THREADS", "3")
        normals.write(wide[:, :, 3], wide[:, :, 4], rows[:, :, 1:4])
        normals.add_gradients(wide[:, :, 3], wide[:, :, 4], wide[:, :, 0:3], rows[:, :, 5])
        monkeypatch.setenv("BEAM_WARP_THREADS", "1")
        assert (rows.numpy()[..., 1:4] == normals_of(depth, camera, device)).all()
        assert (rows.numpy()[..., 5] == gradients_of(depth, camera, upstream, device)).all()
        assert (rows.numpy()[..., [0, 4, 6, 7]] == 0.0).all()


class TestMasks:
    def test_silhouette(self, device):
        camera = camera_of(20, 16)
        alpha = np.zeros((16, 20))
        alpha[4:12, 5:15] = 1.0
        alpha[4:12, 14] = 0.5  # not above the threshold
        there = np.abs(normals_of(np.full((16, 20), 2.0), camera, device, alpha)).max(axis=-1) > 0.0
        expected = np.zeros((16, 20), dtype=bool)
        expected[5:11, 6:13] = True
        assert (there == expected).all()

    def test_jump(self, device):
        camera = camera_of(20, 16)
        depth = np.full((16, 20), 2.0)
        depth[:, 10:] = 2.1
        there = np.abs(normals_of(depth, camera, device)).max(axis=-1) > 0.0
        assert not there[:, 9:11].any()
        assert there[1:-1, 1:9].all()
        assert there[1:-1, 11:-1].all()
        wide = np.abs(normals_of(depth, camera, device, largest_jump=np.inf)).max(axis=-1) > 0.0
        assert wide[1:-1, 1:-1].all()

    @pytest.mark.parametrize(("tilt", "is_surface"), [(83.0, True), (85.0, False)])
    def test_steep_surfaces_count_and_ledges_do_not(self, device, tilt, is_surface):
        camera = Camera(20, 16, 400.0, 400.0, 10.0, 8.0, np.eye(4))
        depth = 2.0 * np.exp(np.tan(np.radians(tilt)) / 400.0 * np.arange(20))[None].repeat(16, axis=0)
        there = np.abs(normals_of(depth, camera, device, largest_jump=None)).max(axis=-1) > 0.0
        assert (there[1:-1, 1:-1] == is_surface).all()

    @pytest.mark.parametrize(
        ("broken", "largest_jump"),
        [(np.nan, 0.03), (np.nan, np.inf), (np.inf, np.inf), (-1.0, np.inf), (1e-30, np.inf)],
    )
    def test_broken_depth_takes_its_stencil_and_no_more(self, device, rng, broken, largest_jump):
        camera = camera_of(12, 12)
        depth = np.full((12, 12), 2.0)
        depth[5, 6] = broken
        there = np.abs(normals_of(depth, camera, device, largest_jump=largest_jump)).max(axis=-1) > 0.0
        expected = np.zeros((12, 12), dtype=bool)
        expected[1:-1, 1:-1] = True
        for y, x in ((5, 6), (4, 6), (6, 6), (5, 5), (5, 7)):
            expected[y, x] = False
        assert (there == expected).all()
        upstream = np.where(expected[..., None], rng.standard_normal((12, 12, 3)), np.nan)  # not read elsewhere
        gradients = gradients_of(depth, camera, upstream, device, largest_jump=largest_jump)
        assert np.isfinite(gradients).all()
        assert gradients[5, 6] == 0.0

    def test_broken_alpha(self, device):
        camera = camera_of(9, 9)
        alpha = np.ones((9, 9))
        alpha[4, 4] = np.nan
        normals = normals_of(np.full((9, 9), 2.0), camera, device, alpha)
        assert (np.abs(normals).max(axis=-1) > 0.0).sum() == 49 - 5

    @pytest.mark.parametrize("size", [(1, 1), (2, 9), (9, 2)])
    def test_no_interior(self, device, size):
        camera = camera_of(*size)
        depth = np.full((camera.height, camera.width), 2.0)
        assert (normals_of(depth, camera, device) == 0.0).all()
        assert (gradients_of(depth, camera, np.ones((*depth.shape, 3)), device) == 0.0).all()


class TestRefusals:
    def test_shapes(self):
        camera = camera_of(6, 5)
        normals, out = DepthNormals(camera, device="cpu"), wp.zeros((5, 6, 3), dtype=float, device="cpu")
        with pytest.raises(InvalidArrayError, match=r"depth must have shape \(5, 6\), got \(6, 5\)"):
            normals.write(np.ones((6, 5)), np.ones((5, 6)), out)
        with pytest.raises(InvalidArrayError, match=r"normals must be a warp array of float32 of shape \(5, 6, 3\)"):
            normals.write(np.ones((5, 6)), np.ones((5, 6)), wp.zeros((5, 6), dtype=float, device="cpu"))
        with pytest.raises(InvalidArrayError, match="depth_gradients must be a warp array on cpu, got ndarray"):
            normals.add_gradients(np.ones((5, 6)), np.ones((5, 6)), np.ones((5, 6, 3)), np.zeros((5, 6)))

    @pytest.mark.parametrize(
        ("name", "value"), [("minimum_alpha", 1.5), ("largest_jump", -0.1), ("largest_jump", np.nan)]
    )
    def test_options(self, name, value):
        with pytest.raises(InvalidOptionError, match=f"{name} must be a number in"):
            DepthNormals(camera_of(4, 4), device="cpu", **{name: value})
