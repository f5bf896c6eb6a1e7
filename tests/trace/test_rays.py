"""Batches of rays: no result depends on order, batches or streams of the batch."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from support.kernel_runs import run_kernel
from support.shapes import random_cloud, unit

from beam_warp import Scene, ambient_occlusion, irradiance
from beam_warp.device.arrays import upload
from beam_warp.kernels.common import launching
from beam_warp.kernels.common.constants import LARGEST_FLOAT
from beam_warp.kernels.common.sampling import (
    SampleSet,
    draw_square,
    hash_combine,
    square_to_cosine_hemisphere,
    stream_of,
    tangent_frame,
)
from beam_warp.kernels.trace.occluders import transmittance
from beam_warp.kernels.trace.settings import TraceSettings
from beam_warp.kernels.trace.visibility import Rays
from beam_warp.trace.rays import ray_batches, ray_offsets
from beam_warp.trace.sampling import SAMPLERS, sample_set
from beam_warp.trace.transmittance import TraceOptions, trace_rays
from beam_warp.world.environment import EnvironmentMap

POINTS = 300


@pytest.fixture(scope="module")
def surroundings():
    """Soft Gaussians, points in their midst in no order, and unit normals."""
    rng = np.random.default_rng(8)
    cloud = random_cloud(rng, 500, scale=(-2.5, 0.4), opacity=(0.3, 1.0))
    normals = unit(rng.normal(size=(POINTS, 3)))
    return cloud, rng.uniform(-1, 1, (POINTS, 3)).astype(np.float32), normals


@pytest.fixture
def scene(device, surroundings):
    return Scene.from_gaussians(surroundings[0], device)


@pytest.fixture
def uploaded(scene, surroundings):
    """The points and normals on the scene's device."""
    return [upload(array, wp.vec3, scene.device) for array in surroundings[1:]]


def set_rays_at_once(monkeypatch, count):
    for name in ("RAYS_AT_ONCE", "RAYS_AT_ONCE_ON_CUDA"):
        monkeypatch.setattr(f"beam_warp.trace.rays.{name}", count)


def keep_order(lowers, uppers, takes_part):
    return wp.array(np.arange(len(lowers)), dtype=int, device=lowers.device), None


class TestBatches:
    def test_points_come_once_and_neighbours_together(self, scene, surroundings, uploaded, monkeypatch):
        set_rays_at_once(monkeypatch, 70 * 4)
        _, points, normals = surroundings
        batches = ray_batches(scene, *uploaded, 0.1, 4)
        assert [len(batch.rows) for batch in batches] == [70, 70, 70, 70, 20]
        rows = np.concatenate([batch.rows.numpy() for batch in batches])
        assert (np.sort(rows) == np.arange(POINTS)).all()
        assert np.array_equal(np.concatenate([batch.positions.numpy() for batch in batches]), points[rows])
        assert np.array_equal(np.concatenate([batch.normals.numpy() for batch in batches]), normals[rows])

        def step(p):
            return np.linalg.norm(np.diff(p, axis=0), axis=1).mean()

        # 300 points in a cube of side 2 are 0.3 apart; two of them at random 1.3
        assert step(points[rows]) < 0.5 * step(points)

    def test_no_points(self, scene):
        none = wp.empty(0, dtype=wp.vec3, device=scene.device)
        assert ray_batches(scene, none, none, "auto", 4) == []

    def test_points_at_once(self, scene, uploaded):
        batches = ray_batches(scene, *uploaded, 0.1, 4, points_at_once=128)
        assert [len(batch.rows) for batch in batches] == [128, 128, 44]


@wp.kernel
def trace_one_by_one_kernel(
    occluders: Any,
    settings: TraceSettings,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    offsets: wp.array[float],
    samples: SampleSet,
    seed: wp.uint32,
    frame: wp.uint32,
    out_visibility: wp.array2d[float],
):
    point, index = wp.tid()
    n = normals[point]
    stream = stream_of(seed, frame, wp.uint32(point))
    drawn = draw_square(samples, index, stream)
    direction = tangent_frame(n) * square_to_cosine_hemisphere(drawn.u, drawn.v)
    origin = points[point] - occluders.origin + n * offsets[point]
    out_visibility[point, drawn.slot] = transmittance(
        occluders, settings, origin, direction, LARGEST_FLOAT, hash_combine(stream, wp.uint32(index + 16))
    )


class TestOrderDoesNotMatter:
    @pytest.mark.parametrize("sampler", SAMPLERS)
    @pytest.mark.parametrize("sample_count", [32, 27])
    @pytest.mark.parametrize("acceptance", ["product", "bernoulli"])
    def test_batches_trace_the_rays_of_the_direct_form(
        self, scene, surroundings, monkeypatch, sampler, sample_count, acceptance, uploaded
    ):
        """One ray a thread in the caller's order, drawn and traced in one kernel, is what batches must add up to."""
        _, points, normals = surroundings
        options = TraceOptions(acceptance=acceptance)
        set_rays_at_once(monkeypatch, 100 * sample_count)
        result = ambient_occlusion(
            scene, points, normals, sample_count=sample_count, sampler=sampler, options=options, seed=3, frame=2
        )
        offsets, samples = ray_offsets(scene, *uploaded, "auto"), sample_set(sampler, sample_count)
        inputs = [scene.occluders, options.settings(scene), *uploaded, offsets, samples, wp.uint32(3), wp.uint32(2)]
        (traced,) = run_kernel(trace_one_by_one_kernel, (POINTS, sample_count), inputs, [float], scene.device)
        mean = traced.astype(np.float64).mean(axis=1)
        # Transmittances of both forms lie within 2e-4 of the exact product (early stop and rounding). A Bernoulli
        # sample flips where a probability rounds across the random number: about one hit in 1e6.
        allowed = 2e-4 if acceptance == "product" else 1.01 / sample_count
        assert np.abs(result.visibility - mean).max() < allowed
        assert np.abs(result.visibility - mean).mean() < 1e-5

    @pytest.mark.parametrize("acceptance", ["product", "bernoulli"])
    def test_same_bits_for_any_order_batch_and_number_of_threads(self, scene, surroundings, monkeypatch, acceptance):
        _, points, normals = surroundings
        light = EnvironmentMap.constant((1.0, 2.0, 0.5))
        options = TraceOptions(acceptance=acceptance)

        def results():
            occlusion = ambient_occlusion(scene, points, normals, sample_count=16, options=options)
            yield occlusion.visibility
            yield occlusion.standard_error
            for density in ("product", "mis"):
                arriving = irradiance(scene, points, normals, light, sample_count=16, density=density, options=options)
                yield arriving.value
                yield arriving.standard_error

        usual = list(results())
        set_rays_at_once(monkeypatch, 16 * 77)
        assert all(map(np.array_equal, usual, results()))
        monkeypatch.setattr("beam_warp.trace.rays.morton_order", keep_order)
        monkeypatch.setattr(launching, "MIN_CHUNK", 64)
        monkeypatch.setattr(launching, "WORTH_SPREADING", 0.0)
        monkeypatch.setenv("BEAM_WARP_THREADS", "3")
        assert all(map(np.array_equal, usual, results()))

    def test_streams_go_with_rays(self, scene, surroundings):
        """Bernoulli rays that carry their streams give the same results in any order; others need not."""
        _, points, normals = surroundings
        streams = np.random.default_rng(1).integers(0, 2**32, POINTS, dtype=np.uint32)

        def traced(order):
            rays = Rays()
            rays.origins = upload(points[order], wp.vec3, scene.device)
            rays.directions = upload(normals[order], wp.vec3, scene.device)
            rays.reaches = wp.full(1, LARGEST_FLOAT, dtype=float, device=scene.device)
            rays.streams = upload(streams[order], wp.uint32, scene.device)
            rays.base = scene.occluders.origin
            result = wp.empty(POINTS, dtype=float, device=scene.device)
            trace_rays(scene, TraceOptions(acceptance="bernoulli"), rays, result)
            return result.numpy()

        order = np.random.default_rng(2).permutation(POINTS)
        assert np.array_equal(traced(np.arange(POINTS))[order], traced(order))

    def test_negative_reach_is_blocked_and_read_by_nobody(self, scene, surroundings):
        """Rays that are left out may have any direction, none included."""
        _, points, normals = surroundings
        rays = Rays()
        rays.origins = upload(points, wp.vec3, scene.device)
        rays.directions = upload(np.where(np.arange(POINTS)[:, None] % 2, normals, 0.0), wp.vec3, scene.device)
        reaches = np.where(np.arange(POINTS) % 2, LARGEST_FLOAT, -1.0)
        rays.reaches = upload(reaches, float, scene.device)
        rays.base = scene.occluders.origin
        result = wp.full(POINTS, -7.0, dtype=float, device=scene.device)
        trace_rays(scene, TraceOptions(), rays, result)
        assert (result.numpy()[::2] == 0.0).all()
        assert (result.numpy()[1::2] > 0.0).any()
