"""Which estimator reaches which error at how many rays: occlusion by sampler, irradiance by density, ratio and sampler.

    python benchmarks/estimators.py [--scene figure] [--device cuda:0] --out result.json

Scenes, tiled with Gaussians: "ball", a sphere resting on a floor before a wall, with points on all three; "figure",
the embedded human figure of `beam demo`, with points where a camera that looks towards the sun sees it. Skies: made
here, 128 x 256 texels whose brightest is 51, 1,600 and 20,000 times their mean. Every error is the root mean square
over points, channels and seeds against 16,384 rays of the same tracer (occlusion: cosine, Owen; irradiance: product,
ratio, Owen), relative to the irradiance there, or to a twentieth of its mean where it is less. What all rays of the
tracer share is therefore not in these errors. The ball also has curves of the error against the number of rays.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import record
from numpy.typing import NDArray

from beam_warp import GaussianCloud, Scene, ambient_occlusion, visibility
from beam_warp.demo.figure import build_figure
from beam_warp.image.metrics import root_mean_square
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.trace.incident import irradiance
from beam_warp.world.directions import even_directions
from beam_warp.world.environment import EnvironmentMap, texel_directions
from beam_warp.world.quaternions import turns_from_z

REFERENCE_RAYS = 16_384
SEEDS = range(1, 5)
CURVE_COUNTS = (4, 16, 64, 256, 1024)
SKY_HEIGHT = 128
PEAKS = {"courtyard": 51.0, "sunset": 1.6e3, "sunrise": 2e4}
"""Brightest texel over mean of each sky."""


@dataclass(frozen=True)
class Row:
    """An estimator of the table."""

    density: str
    ratio: bool
    sampler: str
    count: int

    @property
    def name(self) -> str:
        return f"{self.density}{' ratio' if self.ratio else ''} {self.sampler} {self.count}"


ROWS = (
    Row("cosine", False, "iid", 50),
    Row("cosine", False, "iid", 1000),
    Row("cosine", True, "owen", 64),
    Row("environment", False, "iid", 50),
    Row("environment", True, "owen", 64),
    Row("mis", False, "iid", 50),
    Row("mis", True, "owen", 64),
    Row("product", False, "iid", 50),
    Row("product", False, "owen", 64),
    Row("product", True, "owen", 64),
)

OCCLUSION_ROWS = (
    ("iid", 50),
    ("stratified", 49),
    ("owen", 50),
    ("stratified", 64),
    ("owen", 64),
    ("owen", 256),
    ("iid", 1000),
)
"""Sampler and rays."""

CURVES = (
    ("cosine", False, "iid"),
    ("cosine", True, "owen"),
    ("environment", True, "owen"),
    ("mis", True, "owen"),
    ("product", False, "iid"),
    ("product", False, "owen"),
    ("product", True, "owen"),
)


def discs(points: NDArray, normals: NDArray, spacing: float) -> dict[str, NDArray]:
    """One flat Gaussian a point, wide enough to close the surface."""
    return {
        "positions": points,
        "orientations": turns_from_z(normals),
        "scales": np.tile([0.65 * spacing, 0.65 * spacing, 0.065 * spacing], (len(points), 1)),
        "opacities": np.full(len(points), 0.98),
    }


def make_figure(device: str | None, count: int) -> tuple[Scene, NDArray, NDArray]:
    """The demo's figure in mid-step, one Gaussian a vertex; points spread evenly over what a camera sees of it."""
    mesh = build_figure().at(0.125)
    corners = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    cloud = GaussianCloud(**discs(mesh.vertices, mesh.normals.astype(np.float64), math.sqrt(area / len(mesh.vertices))))
    scene = Scene.from_gaussians(cloud, device)
    away = mesh.vertices.mean(axis=0) + np.float32([-1.6, -2.0, 0.4]) - mesh.vertices
    away = (away / np.linalg.norm(away, axis=1, keepdims=True)).astype(np.float32)
    lifted = mesh.vertices + np.float32(0.01) * mesh.normals
    seen = np.maximum((mesh.normals * away).sum(axis=1), 0.0).astype(np.float64) * visibility(scene, lifted, away)
    chosen = np.random.default_rng(1).choice(len(seen), count, replace=False, p=seen / seen.sum())
    return scene, mesh.vertices[chosen], mesh.normals[chosen]


def make_ball(device: str | None, count: int) -> tuple[Scene, NDArray, NDArray]:
    """A sphere of radius 0.5 m on a floor, a wall 1.2 m high at x = -1 m; half of the points lie on the floor."""
    spacing = 0.05
    side = np.arange(-2.0, 2.0, spacing)
    grid = np.stack(np.meshgrid(side, side, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    y, z = (a.ravel() for a in np.meshgrid(side, np.arange(spacing / 2, 1.2, spacing), indexing="ij"))
    wall = np.stack([np.full(len(y), -1.0), y, z], axis=1)
    ball = even_directions(2500)
    parts = [
        discs(grid, np.tile([0.0, 0.0, 1.0], (len(grid), 1)), spacing),
        discs(wall, np.tile([1.0, 0.0, 0.0], (len(wall), 1)), spacing),
        discs(0.5 * ball + [0.0, 0.0, 0.5], ball, 0.5 * math.sqrt(4.0 * math.pi / len(ball))),
    ]
    scene = Scene.from_gaussians(GaussianCloud(**{k: np.concatenate([p[k] for p in parts]) for k in parts[0]}), device)
    rng = np.random.default_rng(1)
    on_wall, on_ball = count // 6, count // 3
    on_floor = count - on_wall - on_ball
    radius, turn = np.sqrt(rng.uniform(0.15**2, 0.95**2, on_floor)), rng.uniform(0, 2 * np.pi, on_floor)
    floor_points = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(on_floor)], axis=1)
    out = rng.normal(size=(on_ball, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    wall_points = np.stack([np.full(on_wall, -1.0), *rng.uniform([-1, 0.1], [1, 1.1], (on_wall, 2)).T], axis=1)
    points = np.concatenate([floor_points, 0.5 * out + [0.0, 0.0, 0.5], wall_points])
    normals = np.concatenate([np.tile([0.0, 0.0, 1.0], (on_floor, 1)), out, np.tile([1.0, 0.0, 0.0], (on_wall, 1))])
    return scene, points.astype(np.float32), normals.astype(np.float32)


def make_sky(name: str) -> EnvironmentMap:
    """A gradient over a darker ground with a lamp of a few degrees (courtyard) or a sun of one texel, at its peak."""
    directions = texel_directions(SKY_HEIGHT, 2 * SKY_HEIGHT)
    z = directions[..., 2]
    warm, cool = np.array([1.0, 0.85, 0.7]), np.array([0.55, 0.75, 1.1])
    blend = np.clip(z, 0.0, 1.0)[..., None] ** 0.5
    radiance = np.where(z[..., None] > 0.0, warm * (1.0 - blend) + cool * blend, 0.15 * warm)
    azimuth, elevation = np.radians([35.0, 30.0])
    aim = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    towards = directions @ aim
    if name == "courtyard":
        radiance[z < np.sin(np.radians(25.0))] *= 0.25  # walls around: light comes from above and through one gap
        hot = towards > np.cos(np.radians(6.0))
    else:
        hot = towards == towards.max()
    # The largest channel of the hot texels is peak times the mean over texels and channels, which they are part of.
    color = warm / warm.max()
    part = hot.sum() / hot.size * color.mean() * PEAKS[name]
    if part >= 1.0:
        raise ValueError(f"{name}: {hot.sum()} texels of {PEAKS[name]} times the mean exceed it")
    mean = radiance[~hot].sum() / radiance.size / (1.0 - part)
    radiance[hot] = PEAKS[name] * mean * color
    return EnvironmentMap(radiance.astype(np.float32))


def relative_errors(values: NDArray, truth: NDArray) -> NDArray:
    return (values - truth) / np.maximum(truth, 0.05 * truth.mean())


def mean_in_standard_errors(errors: NDArray) -> float:
    """The mean of errors ``(seeds, points, channels)`` over its standard error; only points are independent."""
    by_point = errors.astype(np.float64).mean(axis=(0, 2))
    return float(by_point.mean() / (by_point.std(ddof=1) / math.sqrt(len(by_point))))


def measure_occlusion(scene: Scene, points: NDArray, normals: NDArray, curve_counts: Sequence[int]) -> dict:
    truth = ambient_occlusion(scene, points, normals, sample_count=REFERENCE_RAYS, seed=99)

    def error(sampler: str, count: int) -> float:
        return root_mean_square(
            np.stack(
                [
                    ambient_occlusion(scene, points, normals, sample_count=count, sampler=sampler, seed=s).visibility
                    - truth.visibility
                    for s in SEEDS
                ]
            )
        )

    # The variance of independent rays falls as one over their number: one measurement says how many another is worth.
    one_ray = error("iid", 256) * math.sqrt(256)
    rows = []
    for sampler, count in OCCLUSION_ROWS:
        found = error(sampler, count)
        rows.append(
            {
                "name": f"{sampler} {count}",
                "rmse": found,
                "psnr_db": -20.0 * math.log10(found),
                "worth_iid_rays": (one_ray / found) ** 2,
            }
        )
    curves = {sampler: [error(sampler, count) for count in curve_counts] for sampler in ("iid", "stratified", "owen")}
    return {
        "mean": float(truth.visibility.mean()),
        "reference_standard_error": root_mean_square(truth.standard_error),
        "rows": rows,
        "curves": curves,
    }


def measure_sky(
    scene: Scene, points: NDArray, normals: NDArray, sky: EnvironmentMap, curve_counts: Sequence[int]
) -> dict:
    light = PreparedEnvironment(sky, scene.device)
    truth = irradiance(scene, points, normals, light, sample_count=REFERENCE_RAYS, seed=99)
    floor = np.maximum(truth.value, 0.05 * truth.value.mean())

    def estimates(density: str, ratio: bool, sampler: str, count: int, seeds: range) -> NDArray:
        options = {"sample_count": count, "sampler": sampler, "density": density, "ratio": ratio}
        return np.stack([irradiance(scene, points, normals, light, seed=s, **options).value for s in seeds])

    rows = []
    for row in ROWS:
        found = estimates(row.density, row.ratio, row.sampler, row.count, SEEDS)
        rows.append(
            {
                "name": row.name,
                "relative_rmse": root_mean_square(relative_errors(found, truth.value)),
                "rmse_over_mean": root_mean_square(found - truth.value) / float(truth.value.mean()),
                "bias_in_standard_errors": mean_in_standard_errors(relative_errors(found, truth.value)),
            }
        )
    curves = {
        f"{density}{' ratio' if ratio else ''} {sampler}": [
            root_mean_square(relative_errors(estimates(density, ratio, sampler, count, range(1, 3)), truth.value))
            for count in curve_counts
        ]
        for density, ratio, sampler in CURVES
    }
    return {
        "peak_over_mean": float(f"{sky.radiance.max() / sky.radiance.mean():.4g}"),
        "reference_relative_standard_error": root_mean_square(truth.standard_error / floor),
        "rows": rows,
        "curves": curves,
    }


def main() -> int:
    parser = record.parser(__doc__, device=True)
    parser.add_argument("--scene", choices=("ball", "figure"), default="ball")
    parser.add_argument("--points", type=int, default=192)
    arguments = parser.parse_args()
    make = make_ball if arguments.scene == "ball" else make_figure
    scene, points, normals = make(arguments.device, arguments.points)
    curve_counts = CURVE_COUNTS if arguments.scene == "ball" else ()
    result = {
        "scene": arguments.scene,
        "gaussians": scene.report.traced,
        "points": len(points),
        "seeds": len(SEEDS),
        "reference_rays": REFERENCE_RAYS,
        "curve_counts": curve_counts,
        "occlusion": measure_occlusion(scene, points, normals, curve_counts),
        "skies": {},
    }
    for name in PEAKS:
        result["skies"][name] = measure_sky(scene, points, normals, make_sky(name), curve_counts)
        record.write_result(arguments, scene.device, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
