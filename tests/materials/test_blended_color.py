"""Base colour by what all pixels say together: the dense problem in float64, noise that cancels, edges that stay."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree
from support.shapes import cloud_of, random_cloud, sphere_points, tiles, unit

from beam_warp.device.arrays import resolve_device, upload, zero_struct
from beam_warp.kernels.materials.residues import GatheredLight, Observations, ShadedPoints
from beam_warp.materials import blended_color
from beam_warp.materials.blended_color import solve_blended
from beam_warp.materials.evidence import ViewEvidence
from beam_warp.materials.light_rays import LitPoints
from beam_warp.raster.gbuffer import rasterize_values
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera

RASTER = RasterOptions(antialiased=True, low_pass=0.1)


class Scene:
    """Gaussians, some of them in light, and what views show of them."""

    def __init__(self, cloud, normals, cameras, device, rng, rows=None):
        self.cloud, self.cameras, self.device = cloud, cameras, resolve_device(device)
        self.rows = np.arange(len(cloud)) if rows is None else rows
        count, views = len(self.rows), len(cameras)
        self.normals = normals[self.rows]
        self.light = rng.uniform(0.4, 1.2, (count, 3))
        self.share = rng.uniform(0.8, 1.0, (views, count))
        self.specular = rng.uniform(0.0, 0.1, (views, count, 3))
        self.toward = unit(np.stack([camera.position for camera in cameras])[:, None] - cloud.positions)
        cosine = np.einsum("vnc,nc->vn", self.toward[:, self.rows], self.normals)
        self.facing = np.clip((cosine - 0.2) / 0.3, 0.0, 1.0)
        self.diffuse = self.light * (self.share * self.facing)[..., None]

    def shown(self, base_color, others=0.3):
        """Return what views show of Gaussians whose base colour is known, ``(V, N, 3)``; grey, of those in no light."""
        colors = np.full((len(self.cameras), len(self.cloud), 3), others)
        colors[:, self.rows] = self.light * self.share[..., None] * base_color + self.specular
        return colors

    def solve(self, colors, separate, weights=1.0, progress=None):
        """Run the solver."""
        count, views, device = len(self.cloud), len(self.cameras), self.device
        weight = np.broadcast_to(np.float32(weights), (views, count))
        seen = np.concatenate([colors, weight[..., None]], axis=-1)
        light, surface, observed = zero_struct(GatheredLight, len(self.rows), device), ShadedPoints(), Observations()
        light.arriving = upload(self.light, wp.vec3, device)
        surface.normals = upload(self.normals, wp.vec3, device)
        observed.colors = upload(np.ascontiguousarray(seen[:, self.rows]), wp.vec4, device)
        observed.directions = upload(np.ascontiguousarray(self.toward[:, self.rows]), wp.vec3, device)
        observed.specular = upload(self.specular, wp.vec3, device)
        observed.diffuse_share = upload(self.share, float, device)
        nothing = np.zeros(len(self.rows), np.int32)
        measured = LitPoints(light, surface, observed, self.rows, nothing, nothing)
        place = upload(self.cloud.positions, wp.vec3, device)
        views_shown = ViewEvidence(
            positions=place,
            normals=place,
            agreement=wp.ones(count, dtype=float, device=device),
            weight=weight.sum(axis=0),
            seen=np.ones(count, bool),
            saturated=np.zeros(count, np.float32),
            colors=upload(seen, wp.vec4, device),
            directions=observed.directions,
            misfit=np.zeros((count, 3), np.float32),
            cameras=tuple(self.cameras),
            raster=RASTER,
        )
        return solve_blended(self.cloud, views_shown, measured, separate, progress=progress)


def cameras_around(count, distance, side):
    return [
        Camera.orbit((0, 0, 0), distance, 360.0 * k / count, 30.0 * (-1) ** k, width=side, height=side, vertical_fov=36)
        for k in range(count)
    ]


def blending(cloud, camera, device):
    """W as a matrix, a row a pixel."""
    parts = np.array_split(np.eye(len(cloud), dtype=np.float32), -(-len(cloud) // 12), axis=1)
    drawn = [rasterize_values(cloud, camera, part, options=RASTER, device=device).values for part in parts]
    return np.concatenate(drawn, axis=-1).reshape(-1, len(cloud)).astype(np.float64)


def dense(scene, colors, start):
    """The same problem by normal equations in float64, and the weights that it is posed with."""
    rows, count = scene.rows, len(scene.rows)
    near = cKDTree(scene.cloud.positions[rows]).query(scene.cloud.positions[rows], k=9)[1][:, 1:]
    pixels = []
    worth = np.zeros((count, 3))
    for view, camera in enumerate(scene.cameras):
        blend = blending(scene.cloud, camera, str(scene.device))
        y = (colors[view, rows] - scene.specular[view]) * scene.facing[view][:, None]
        off = blend[:, rows] @ (y - scene.diffuse[view] * start)
        explained = colors[view].copy()
        explained[rows] -= y - scene.diffuse[view] * start
        spread = np.maximum(0.1 * (blend @ explained).mean(axis=1), 0.01)
        weight = spread**2 / (spread**2 + (off**2).sum(axis=1))
        worth += scene.diffuse[view] ** 2 * (blend[:, rows].T @ weight)[:, None]
        pixels.append((blend[:, rows], y, weight))
    typical, level = np.median(worth[worth > 0.0]), start.mean()
    graph = np.zeros((count, count))
    for i in range(count):
        for j in near[i]:
            apart = (((start[i] - start[j]) / level) ** 2).sum()
            tie = blended_color.SMOOTHNESS * typical / level**2 / np.sqrt(apart + blended_color.EDGE**2)
            tie /= 1.0 + apart / blended_color.CONTRAST**2
            graph[i, j] += tie
            graph[j, i] += tie
    smooth = np.diag(graph.sum(axis=1)) - graph
    found = np.zeros((count, 3))
    for c in range(3):
        left, right = smooth.copy(), np.zeros(count)
        for view, (blend, y, weight) in enumerate(pixels):
            lit = blend * scene.diffuse[view, :, c]
            left += lit.T @ (weight[:, None] * lit)
            right += lit.T @ (weight * (blend @ y[:, c]))
        found[:, c] = np.linalg.solve(left, right)
    return found


def test_it_is_the_solution_of_the_dense_problem(device, rng, monkeypatch):
    monkeypatch.setattr(blended_color, "PASSES", 400)
    cloud = random_cloud(rng, 48, scale=(-1.8, 0.3), opacity=(0.3, 0.9))
    cloud = cloud.with_arrays(positions=cloud.positions - cloud.positions.mean(axis=0))
    normals = unit(cloud.positions + 0.1 * rng.normal(size=(48, 3)))
    rows = np.sort(rng.permutation(48)[:40])  # others are in no light
    scene = Scene(cloud, normals, cameras_around(6, 8.0, 24), device, rng, rows)
    truth = rng.uniform(0.1, 0.9, (40, 3))
    colors = scene.shown(truth) + 0.02 * rng.normal(size=(6, 48, 3))
    start = np.clip(truth + 0.1 * rng.normal(size=(40, 3)), 0.0, 1.0)
    found = scene.solve(colors, start)
    np.testing.assert_allclose(found, dense(scene, colors, start), atol=2e-3)


@pytest.fixture(scope="module")
def ball():
    points, spacing = sphere_points(1500)
    return cloud_of(tiles(points, points, spacing)), points


def test_noise_is_no_paint_least_of_all_where_pixels_blend_it(ball, device, rng):
    """What each shows is off by a tenth of its own, the same to all views: larger pixels say less of it."""
    noise = 0.1 * rng.normal(size=(1500, 3))
    left = []
    for side in (64, 24):
        scene = Scene(*ball, cameras_around(8, 6.0, side), device, rng)
        found = scene.solve(scene.shown(0.5 + noise), 0.5 + noise)
        left.append(np.std(found - 0.5))
        assert abs(np.mean(found) - 0.5) < 0.01
    assert left[1] < 0.9 * left[0] < 0.9 * np.std(noise)


def test_an_edge_of_paint_stays_where_it_is(ball, device, rng):
    scene = Scene(*ball, cameras_around(8, 6.0, 64), device, rng)
    truth = np.where(ball[1][:, :1] > 0.0, 0.8, 0.2) * np.ones(3)
    found = scene.solve(scene.shown(truth), truth)
    assert np.abs(found - truth).max() < 0.05
    assert np.abs(found - truth).mean() < 0.003


def test_what_has_no_evidence_stays_unknown_and_changes_nothing(ball, device, rng):
    scene = Scene(*ball, cameras_around(4, 6.0, 32), device, rng)
    separate = np.full((1500, 3), 0.5)
    separate[::7] = np.nan
    found = scene.solve(scene.shown(np.nan_to_num(separate, nan=0.5)), separate)
    np.testing.assert_array_equal(np.isnan(found).all(axis=1), np.isnan(separate).all(axis=1))
    np.testing.assert_allclose(found[np.isfinite(separate)], 0.5, atol=1e-3)
    separate[1:] = np.nan
    np.testing.assert_array_equal(scene.solve(scene.shown(0.5), separate), separate.astype(np.float32))


def test_progress_counts_the_views_of_all_passes(ball, device, rng):
    scene = Scene(*ball, cameras_around(4, 6.0, 32), device, rng)
    told, noisy = [], rng.uniform(0.3, 0.7, (1500, 3))
    scene.solve(scene.shown(noisy), noisy, progress=lambda *at: told.append(at))
    total = (1 + blended_color.PASSES) * 4
    assert told == [(k + 1, total) for k in range(total)]


def test_views_that_see_nothing_say_nothing(ball, device, rng):
    scene = Scene(*ball, cameras_around(4, 6.0, 32), device, rng)
    separate = np.full((1500, 3), 0.4)
    np.testing.assert_array_equal(scene.solve(0.0 * scene.shown(0.4), separate, weights=0.0), np.float32(separate))
