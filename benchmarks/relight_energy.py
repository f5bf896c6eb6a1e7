"""Whether renderers keep the light: white things in a white furnace, and few samples against many.

The second compares the path tracer with itself: a bias that all numbers of samples share stays unseen. What does not
depend on it is the furnace, a closed form, and the tracer of meshes that `relight_accuracy` takes as the truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import raster_scenes
import scipy.stats
import trimesh
from numpy.typing import NDArray
from parts import Row, say
from relight_scenes import LAMPS, Bench, ground

from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.stability.relighting_cases.scenes import relightable, sheet
from beam_warp.study.true_surface import gaussians_on_mesh
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.shot import Renderer, Shot

ROUGHNESS = (0.03, 0.1, 0.3, 0.6, 1.0)

WHITE = EnvironmentMap.constant((1.0, 1.0, 1.0))

INSIDE = 0.98
"""Coverage above which a pixel counts."""

FURNACE_BOUNCES = 16
"""Neighbours on a ball see a little of each other; white ones send all of it on."""

FEW_SAMPLES = 16
MORE = 16
"""How many times as many samples an image of the reference has."""

FAR = 3.0
"""Standard deviations beyond which pixels are counted."""


def measure_furnace(bench: Bench) -> Iterator[Row]:
    """Yield how far white surfaces under radiance 1 are from sending 1 back, so far."""
    effort, device = bench.effort, str(bench.device)
    usual = DeferredOptions().environment_shadows
    path = PathOptions(samples=effort.furnace_samples, bounces=FURNACE_BOUNCES)
    renderers: dict[str, Renderer] = {
        "path traced": PathRenderer(path, device=device),
        "deferred, no shadow maps": DeferredRenderer(bench.deferred_options(0), device=device),
        f"deferred, N = {usual}": DeferredRenderer(bench.deferred_options(usual), device=device),
    }
    result: Row = {"samples": effort.furnace_samples, "rows": []}
    for shape, shot in (("plane", white_plane(effort.furnace_size)), ("ball", white_ball(bench))):
        for name, renderer in renderers.items():
            for roughness in ROUGHNESS:
                cloud = shot.cloud.with_arrays(roughness=np.full(len(shot.cloud), roughness, np.float32))
                image = renderer.draw(replace(shot, cloud=cloud))
                inside = image.alpha > INSIDE
                sent = image.rgb[inside].mean(axis=-1, dtype=np.float64) / image.alpha[inside]
                row: Row = {
                    "shape": shape,
                    "renderer": name,
                    "roughness": roughness,
                    "pixels": int(inside.sum()),
                    "mean_error": float(sent.mean() - 1.0),
                    "standard_error": float(sent.std() / np.sqrt(max(len(sent), 1))),
                    "largest_error": float(np.abs(sent - 1.0).max()),
                }
                result["rows"].append(row)
            errors = [f"{100.0 * row['mean_error']:+.2f} %" for row in result["rows"][-len(ROUGHNESS) :]]
            say(f"{shape}, {name}: {', '.join(errors)}")
            yield result


def white_plane(size: int) -> Shot:
    """Return one Gaussian so large that a narrow view of its middle is a plane."""
    cloud = relightable(sheet((0.0, 0.0, 0.0), 1.0, 0.99))
    camera = Camera.look_at((1.0, 0.0, 1.5), (0.0, 0.0, 0.0), width=size, height=size, vertical_fov=2.0)
    return Shot(cloud=cloud, camera=camera, environment=WHITE)


def white_ball(bench: Bench) -> Shot:
    """Return a ball of radius 1 of many Gaussians."""
    sphere = trimesh.creation.icosphere(subdivisions=5)
    cloud = relightable(gaussians_on_mesh(sphere.vertices, sphere.faces, bench.effort.furnace_gaussians))
    size = bench.effort.furnace_size
    camera = Camera.look_at((0.0, -4.0, 0.5), (0.0, 0.0, 0.0), width=size, height=size, vertical_fov=32.0)
    return Shot(cloud=cloud, camera=camera, environment=WHITE)


def measure_consistent(bench: Bench) -> Iterator[Row]:
    """Yield z-scores of pixels: the mean of many images of few samples less that of images of sixteen times as many."""
    effort, device = bench.effort, str(bench.device)
    scene = raster_scenes.figure(effort.bias_gaussians, *effort.bias_size)
    shot = Shot(cloud=scene.cloud, camera=scene.camera, environment=bench.sky, lights=LAMPS, mesh=ground())
    renderer = PathRenderer(device=device)
    means, variances = [], []
    for samples, seeds, first in (
        (FEW_SAMPLES, effort.bias_seeds[0], 0),
        (FEW_SAMPLES * MORE, effort.bias_seeds[1], 1 << 20),
    ):
        images = []
        for seed in range(first, first + seeds):
            renderer.options = PathOptions(samples=samples, bounces=effort.bounces, seed=seed)
            images.append(renderer.draw(shot).rgb.mean(axis=-1, dtype=np.float64))
        means.append(np.mean(images, axis=0))
        variances.append(np.var(images, axis=0, ddof=1) / seeds)
        say(f"{seeds} images of {samples} samples")
    result = z_scores(means, variances, effort.bias_seeds)
    result |= {"size": list(effort.bias_size), "samples": [FEW_SAMPLES, FEW_SAMPLES * MORE], "seeds": effort.bias_seeds}
    say(f"z-scores: mean {result['mean']:+.3f}, largest {result['largest']:.2f}, beyond 3: {result['beyond']:.4f}")
    yield result


def z_scores(
    means: list[NDArray[np.float64]], variances: list[NDArray[np.float64]], seeds: tuple[int, int]
) -> dict[str, Any]:
    """Return the z-scores of pixels that are not the same in all images, and what chance alone gives."""
    variance = variances[0] + variances[1]
    noisy = variance > 0.0
    z = (means[0] - means[1])[noisy] / np.sqrt(variance[noisy])
    # Welch's degrees of freedom, of every pixel
    freedom = variance[noisy] ** 2 / (
        variances[0][noisy] ** 2 / (seeds[0] - 1) + variances[1][noisy] ** 2 / (seeds[1] - 1)
    )
    return {
        "pixels": len(z),
        "mean": float(z.mean()),
        "mean_in_standard_errors": float(z.mean() * np.sqrt(len(z))),
        "root_mean_square": float(np.sqrt(np.square(z).mean())),
        "largest": float(np.abs(z).max()),
        "beyond": float((np.abs(z) > FAR).mean()),
        "beyond_by_chance": float(2.0 * scipy.stats.t.sf(FAR, freedom).mean()),
        "largest_by_chance": float(scipy.stats.t.isf(0.25 / len(z), np.median(freedom))),
        "relative_bias": float((means[0] - means[1]).sum() / means[1].sum()),
        "relative_bias_standard_error": float(np.sqrt(variance.sum()) / means[1].sum()),
    }
