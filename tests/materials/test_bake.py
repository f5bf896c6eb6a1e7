"""Baking: the bounded least-squares problem against a dense solver, what it recovers, its pulls, Adam beside it."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import warp as wp
from scipy.optimize import lsq_linear
from support.shapes import cloud_of, random_cloud, sphere_points, tiles

from beam_warp import Camera
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.materials import bake as baking
from beam_warp.materials.bake import BakeOptions, BakeTarget, bake
from beam_warp.raster.gbuffer import rasterize_values
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.sources import upload_gaussians


def cameras(cloud, sizes):
    turn = 360.0 / len(sizes)
    return [
        Camera.frame_cloud(cloud.positions, cloud.opacities, azimuth=i * turn, elevation=10.0, width=w, height=h)
        for i, (w, h) in enumerate(sizes)
    ]


def weights_of(cloud, camera, device):
    """W as a matrix, column by column."""
    identity = np.eye(len(cloud), dtype=np.float32)
    parts = [
        rasterize_values(cloud, camera, np.ascontiguousarray(identity[:, k : k + 16]), device=device).values
        for k in range(0, len(cloud), 16)
    ]
    return np.concatenate(parts, axis=-1).reshape(-1, len(cloud)).astype(np.float64)


class Problem:
    """A small cloud, views with random targets and masks, and the dense matrix of it all."""

    def __init__(self, device, columns=4, count=60, sizes=((24, 20), (17, 23), (20, 20)), seed=0):
        rng = np.random.default_rng(seed)
        self.cloud = random_cloud(rng, count, scale=(-1.8, 0.4), opacity=(0.3, 0.9))
        self.device = resolve_device(device)
        self.cameras = cameras(self.cloud, sizes)
        self.matrices = [weights_of(self.cloud, camera, device) for camera in self.cameras]
        shapes = [(h, w, columns) for w, h in sizes]
        self.targets = [rng.uniform(-0.5, 1.5, shape).astype(np.float32) for shape in shapes]
        self.masks = [rng.integers(0, 2, shape).astype(np.float32) for shape in shapes]
        self.prior = rng.uniform(0, 1, (count, columns)).astype(np.float32)
        self.previous = rng.uniform(0, 1, (count, columns)).astype(np.float32)

    @property
    def views(self):
        return [BakeTarget(*parts) for parts in zip(self.cameras, self.targets, self.masks, strict=True)]

    def bake(self, **options):
        arrays = {k: options.pop(k) for k in ("prior", "start", "previous") if k in options}
        gaussians = upload_gaussians(self.cloud, self.device)
        return bake(gaussians, self.views, options=BakeOptions(**options), device=self.device, **arrays)

    def dense(self, column, ridge=0.0, temporal=0.0):
        """Rows and right-hand side of the column's problem."""
        root = [np.sqrt(mask[..., column].reshape(-1, 1)) for mask in self.masks]
        rows = [r * w for r, w in zip(root, self.matrices, strict=True)]
        sides = [(r * t[..., column].reshape(-1, 1))[:, 0] for r, t in zip(root, self.targets, strict=True)]
        for strength, anchor in ((ridge, self.prior), (temporal, self.previous)):
            rows.append(np.sqrt(strength) * np.eye(len(self.cloud)))
            sides.append(np.sqrt(strength) * anchor[:, column].astype(np.float64))
        return np.concatenate(rows), np.concatenate(sides)

    def best(self, column, low=0.0, high=1.0, **pulls):
        """The column's values, by a dense solver on the triangle of its rows."""
        a, b = self.dense(column, **pulls)
        q, r = np.linalg.qr(a)
        return lsq_linear(r, q.T @ b, (low, high), method="bvls", tol=1e-14, max_iter=1000).x

    def objective(self, values, column, **pulls):
        a, b = self.dense(column, **pulls)
        return np.sum((a @ values.astype(np.float64) - b) ** 2)


@cache
def problem(device):
    return Problem(device)


class TestOptimum:
    @pytest.mark.parametrize(("columns", "temporal"), [(4, 0.0), (5, 0.3)])
    def test_gradients_reach_the_dense_solution(self, device, columns, temporal):
        made = Problem(device, columns)
        pulls = {"ridge": 0.01, "temporal": temporal}
        previous = {"previous": made.previous} if temporal else {}
        found = made.bake(prior=made.prior, passes=200, tolerance=1e-6, **pulls, **previous)
        assert found.values.shape == (60, columns)
        assert found.values.min() >= 0.0
        assert found.values.max() <= 1.0
        at_bounds = 0
        for column in range(columns):
            wanted = made.best(column, **pulls)
            # both residuals are below 1e-6 of their start, of length 20 or so; the condition of A'A is below 1e3
            np.testing.assert_allclose(found.values[:, column], wanted, atol=2e-5)
            at_bounds += ((wanted < 1e-6) | (wanted > 1.0 - 1e-6)).sum()
        assert at_bounds > 10 * columns

    def test_other_bounds(self, device):
        made = problem(device)
        found = made.bake(prior=made.prior, ridge=0.01, low=0.2, high=0.6, passes=200, tolerance=1e-6)
        np.testing.assert_allclose(found.values[:, 0], made.best(0, 0.2, 0.6, ridge=0.01), atol=2e-5)
        # the bounds themselves, as float32 holds them
        assert found.values.min() == np.float32(0.2)
        assert found.values.max() == np.float32(0.6)

    def test_residuals_say_when_it_is_done(self, device):
        found = problem(device).bake(ridge=0.01, passes=200, tolerance=1e-3)
        assert (found.residuals[0] == 1.0).all()
        assert (found.residuals[-1] <= 1e-3).all()
        assert len(found.residuals) < 60
        assert found.passes == len(found.residuals) + 1  # and one for the means, one for the first gradient

    def test_tens_of_passes_do_what_hundreds_of_steps_do(self, device):
        made = problem(device)
        quick = made.bake(prior=made.prior, ridge=0.01, passes=30, tolerance=0.0)
        slow = made.bake(prior=made.prior, ridge=0.01, solver="adam", steps=300)
        gaps = []
        for column in range(4):
            best = made.objective(made.best(column, ridge=0.01), column, ridge=0.01)
            found = (made.objective(v.values[:, column], column, ridge=0.01) for v in (quick, slow))
            gaps.append([objective / best - 1.0 for objective in found])
        gradients, adam = np.mean(gaps, axis=0)
        assert slow.passes == pytest.approx(100)
        assert adam < 0.01  # it is at the same problem
        assert gradients < adam


class TestRecovery:
    def test_what_was_drawn_comes_back(self, device):
        """Values of Gaussians that are clearly seen, from their own images; passes bring the residual down."""
        points, spacing = sphere_points(300)
        cloud = cloud_of(tiles(points, points, spacing, opacity=0.8))
        truth = np.random.default_rng(1).uniform(0.1, 0.9, (300, 4)).astype(np.float32)
        views = []
        for camera in cameras(cloud, [(40, 40)] * 5):
            drawn = rasterize_values(cloud, camera, truth, device=device).values
            views.append(BakeTarget(camera, drawn, np.ones_like(drawn)))
        where = resolve_device(device)
        options = BakeOptions(ridge=0.0, passes=60, tolerance=1e-5)
        found = bake(upload_gaussians(cloud, where), views, options=options, device=where)
        seen = found.evidence[:, 0] > 5.0
        assert seen.sum() > 200
        error = np.abs(found.values - truth)[seen]
        start = np.abs(truth - truth.mean(axis=0))[seen]
        assert np.sqrt((error**2).mean()) < 0.1 * np.sqrt((start**2).mean())
        for view in views:
            shown = rasterize_values(cloud, view.camera, found.values, device=device).values
            assert np.abs(shown - view.targets).max() < 5e-3

    def test_unseen_values_are_the_prior(self, device):
        made = Problem(device)
        for mask in made.masks:
            mask[..., 1] = 0.0
        found = made.bake(prior=made.prior, ridge=0.01)
        assert not found.evidence[:, 1].any()
        np.testing.assert_array_equal(found.values[:, 1], made.prior[:, 1])
        without = made.bake(ridge=0.0)
        np.testing.assert_array_equal(without.values[:, 1], 0.5)

    def test_what_is_masked_may_hold_anything(self, device):
        made = Problem(device)
        wanted = made.bake(passes=10)
        for target, mask in zip(made.targets, made.masks, strict=True):
            target[mask == 0.0] = np.nan
        np.testing.assert_array_equal(made.bake(passes=10).values, wanted.values)

    def test_the_start_is_the_mean_of_what_is_seen(self, device):
        made = problem(device)
        found = made.bake(passes=1, ridge=1e9)  # so strong a pull keeps the prior
        for column in range(4):
            a, b = made.dense(column)
            seen = a.T @ (a @ np.ones(60))
            np.testing.assert_allclose(found.evidence[:, column], seen, rtol=1e-4)
            means = np.clip((a.T @ b) / seen, 0.0, 1.0)
            np.testing.assert_allclose(found.values[:, column], means, atol=1e-4)


class TestPulls:
    def test_a_mean_beyond_the_bounds_pulls_no_further_than_the_bound(self, device):
        """Pixels alone take such a value to the bound: only a frame before that pulls the other way tells."""
        made = Problem(device)
        pulls, bounds = {"ridge": 1.0, "temporal": 20.0}, {"low": 0.3, "high": 0.7}
        found = made.bake(previous=made.previous, passes=200, tolerance=1e-6, **pulls, **bounds)
        for column in range(4):
            a, b = made.dense(column)
            made.prior[:, column] = np.clip((a.T @ b) / (a.T @ (a @ np.ones(60))), 0.3, 0.7)
            np.testing.assert_allclose(found.values[:, column], made.best(column, 0.3, 0.7, **pulls), atol=2e-5)
        assert np.isin(made.prior, np.float32([0.3, 0.7])).mean() > 0.2

    def test_a_strong_temporal_term_repeats_the_frame_before(self, device):
        made = problem(device)
        found = made.bake(previous=made.previous[:, :3], temporal=1e7, tolerance=1e-7)
        np.testing.assert_allclose(found.values[:, :3], made.previous[:, :3], atol=1e-4)
        np.testing.assert_array_equal(found.values[:, 3], made.bake(tolerance=1e-7).values[:, 3])  # has none


class TestRepeats:
    @pytest.mark.parametrize("solver", ["cg", "adam"])
    def test_same_bits_for_any_threads(self, device, monkeypatch, solver):
        options = {"solver": solver, "steps": 20, "passes": 8, "seed": 4}
        first = problem(device).bake(**options).values
        monkeypatch.setenv("BEAM_WARP_THREADS", "3")
        np.testing.assert_array_equal(problem(device).bake(**options).values, first)
        if solver == "adam":
            assert not np.array_equal(problem(device).bake(**(options | {"seed": 5})).values, first)

    def test_groups_change_rounding_only(self, device, monkeypatch):
        made = problem(device)
        whole = made.bake(prior=made.prior, ridge=0.01, passes=100, tolerance=1e-6).values
        monkeypatch.setattr(baking, "GROUP_PIXELS", 500)
        parts = made.bake(prior=made.prior, ridge=0.01, passes=100, tolerance=1e-6).values
        np.testing.assert_allclose(parts, whole, atol=2e-5)


def device_bytes(made, views, where, **options):
    """Most bytes that a bake of targets on the device allocates there, its targets and weights included."""
    told = []
    with wp.ScopedMemoryTracker("bake", report_func=told.append) as tracker:
        tracker.clear()  # of what was tracked before
        held = [BakeTarget(v.camera, *(upload(a, float, where) for a in (v.targets, v.weights))) for v in views]
        bake(upload_gaussians(made, where), held, options=BakeOptions(passes=2, **options), device=where)
    number, unit = re.search(rf"Peak usage:.*?{where.alias}\s+([\d.]+) (\w+)", told[0], re.DOTALL).groups()
    return float(number) * 1024 ** ["B", "KB", "MB", "GB"].index(unit)


class TestMemory:
    """The formula in the docstring of `bake`, against what Warp counts."""

    @pytest.mark.parametrize(
        ("solver", "size", "count", "group"),
        [("cg", 160, 50, 2**23), ("cg", 160, 50, 2 * 160**2), ("cg", 16, 4000, 2**23), ("adam", 160, 50, 2**23)],
    )
    def test_bytes_are_what_is_said(self, device, monkeypatch, size, count, group, solver):
        monkeypatch.setattr(baking, "GROUP_PIXELS", group)
        where = resolve_device(device)
        cloud = random_cloud(np.random.default_rng(0), count, scale=(-2.5, 0.3))
        views = [
            BakeTarget(camera, *np.ones((2, size, size, 4), np.float32))
            for camera in cameras(cloud, [(size, size)] * 6)
        ]
        pairs = 0
        for view in views:
            drawer = Rasterizer(count, [view.camera], device=where)
            drawer.draw(upload_gaussians(cloud, where))
            pairs += drawer.pair_count()
        together = 1 if solver == "adam" else min(6, group // size**2)
        pixels, splats, tiles = 6 * size**2, 6 * count, 6 * (-(-size // 16)) ** 2
        said = 32 * pixels + (44 + 16 * where.is_cpu) * together * size**2
        said += 104 * splats + 16 * together * count + 50 * pairs + 12 * tiles + 224 * count
        found = device_bytes(cloud, views, where, solver=solver, steps=6)
        # above it: small tables, blocks of sums, room of the sorts; below it: arrays of a solver that the other lacks
        assert 0.9 * said < found < 1.05 * said + 2**17


BAD_OPTIONS = {
    "solver": "lu", "passes": 0, "steps": 0, "ridge": -1.0, "temporal": np.nan, "tolerance": 2.0, "high": -1.0,
}  # fmt: skip


class TestRefusals:
    @pytest.mark.parametrize(("name", "value"), BAD_OPTIONS.items())
    def test_options(self, name, value):
        with pytest.raises(InvalidOptionError, match=f"^{name} must be"):
            BakeOptions(**{name: value})

    def test_arrays(self, device):
        made = problem(device)
        with pytest.raises(InvalidOptionError, match=r"^views must hold at least one view"):
            bake(upload_gaussians(made.cloud, made.device), [], device=made.device)
        flat = [replace(view, targets=view.targets[..., 0]) for view in made.views]
        with pytest.raises(InvalidOptionError, match=r"^columns of targets must"):
            bake(upload_gaussians(made.cloud, made.device), flat, device=made.device)
        with pytest.raises(InvalidArrayError, match=r"^prior must"):
            made.bake(prior=made.prior[:, :3])
        with pytest.raises(InvalidArrayError, match=r"^previous must be given"):
            made.bake(temporal=1.0)
        with pytest.raises(InvalidArrayError, match=r"^previous must have at most the 4 columns"):
            made.bake(previous=np.zeros((60, 5), np.float32), temporal=1.0)
        other = Problem(device)
        other.masks[1] = other.masks[1][..., :3]
        with pytest.raises(InvalidArrayError, match=r"^views\[1\].weights must"):
            other.bake()
