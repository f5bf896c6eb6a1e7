"""The embedded demo: a figure whose truth is known, as Gaussians and from images, decomposed, relit and scored."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from beam_warp.demo.figure import build_figure
from beam_warp.demo.from_images import FromImagesOptions, demo_from_images
from beam_warp.demo.lights import demo_environments
from beam_warp.demo.truth import Truth, comparison, relit_views, score_views
from beam_warp.image.color import DISPLAY_SRGB, linear_to_srgb
from beam_warp.image.files import write_exr, write_png
from beam_warp.jobs.progress import Progress, no_progress
from beam_warp.jobs.report import write_report
from beam_warp.materials.job import OverviewOptions, RunOptions, RunResult, run
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED
from beam_warp.render.sheet import Relighting
from beam_warp.trace.mesh_paths import TracedMesh, outgoing_radiance
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud, GaussianSequence
from beam_warp.world.harmonics import sh_basis
from beam_warp.world.mesh import MaterialMesh

TANGENTIAL_DEVIATION = 0.7
"""Of a Gaussian, in spacings: neighbours overlap so far that the surface is closed (composited alpha above 0.99)."""

FLATNESS = 0.12
"""Deviation across the surface over that along it."""

NORMAL_NOISE = 0.05
"""Standard deviation of the tilt of a Gaussian, per axis [rad]: 2.9 degrees, what a good training leaves."""

POSITION_NOISE = 0.3
"""Standard deviation of its distance from the surface, in deviations across it."""

OPACITY = (0.94, 0.99)
SH_DEGREE = 2
DIRECTION_COUNT = 12
PATHS_PER_DIRECTION = 12
SH_RIDGE = 0.03
"""Weight of the bands above 0 against one direction's residual: half of the sphere is never seen."""

VIEWS = ((25.0, 8.0), (-150.0, 14.0))
"""Azimuth and elevation of the cameras with truth [degree]."""

TRUTH_PATHS = 64

RASTER = RasterOptions(antialiased=True)
"""The stand-in was not trained against a widening filter, so the one that keeps energy is the fair one."""


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Size of the demo.

    Attributes:
        frame_count: Frames of the figure's dance.
        gaussian_count: Gaussians on the figure, about.
        image_height: Height of the images with truth [pixel].
        device: Warp device; None takes the first CUDA device, or the CPU.
        seed: Same seed, same device: same result.
        images: Size of the second half, which starts from photographs.
    """

    frame_count: int = 1
    gaussian_count: int = 45_000
    image_height: int = 300
    device: str | None = None
    seed: int = 0
    images: FromImagesOptions = field(default_factory=FromImagesOptions)


@dataclass(frozen=True, eq=False)
class DemoScene:
    """What the demo starts from.

    Attributes:
        sequence: Gaussians as training would leave them: display-referred radiance, no material.
        lights: Environments by name; the figure was captured under ``studio``.
        truth: Views of ``truth_frame``.
        truth_frame: The frame that has truth.
    """

    sequence: GaussianSequence
    lights: Mapping[str, EnvironmentMap]
    truth: Sequence[Truth]
    truth_frame: int


@dataclass(frozen=True, eq=False)
class _SurfaceSamples:
    """Points that stay with the surface, and the randomness that stays with them."""

    faces: NDArray[np.int64]
    weights: NDArray[np.float64]
    spacing: float
    turn: NDArray[np.float64]
    tilt: NDArray[np.float64]
    lift: NDArray[np.float64]
    opacities: NDArray[np.float64]


def build_demo(options: DemoOptions, progress: Progress = no_progress) -> DemoScene:
    """Build the figure, capture it as Gaussians, and path trace the truth."""
    rng = np.random.default_rng(options.seed)
    figure = build_figure()
    lights = demo_environments()
    samples = _sample_surface(figure.rest, options.gaussian_count, rng)
    truth_frame = options.frame_count // 2
    clouds, truth = [], []
    for frame in range(options.frame_count):
        mesh = figure.at(frame / options.frame_count * 0.5)
        traced = TracedMesh.from_mesh(mesh, device=options.device)
        clouds.append(_capture(mesh, traced, samples, lights["studio"], options.seed + frame))
        progress("capture", frame + 1, options.frame_count)
        if frame == truth_frame:
            for azimuth, elevation in VIEWS:
                camera = Camera.frame_points(
                    mesh.vertices,
                    azimuth=azimuth,
                    elevation=elevation,
                    width=round(options.image_height * 0.8),
                    height=options.image_height,
                )
                truth.append(Truth.of(traced, camera, lights, TRUTH_PATHS))
                progress("path trace truth", len(truth), len(VIEWS))
    metadata = {"producer": "beam demo", **RASTER.as_metadata()}
    sequence = GaussianSequence.from_clouds(clouds, frames_per_second=6.0, metadata=metadata)
    return DemoScene(sequence, lights, truth, truth_frame)


def _sample_surface(mesh: MaterialMesh, count: int, rng: np.random.Generator) -> _SurfaceSamples:
    """Spread points evenly; dart throwing leaves a little fewer than asked for."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    spacing = float(np.sqrt(shape.area / count))
    # Three quarters of the darts stay; the library's warning about that is not for our users.
    logging.getLogger("trimesh").setLevel(logging.ERROR)
    points, faces = trimesh.sample.sample_surface_even(
        shape, round(count / 0.76), radius=0.63 * spacing, seed=int(rng.integers(2**31))
    )
    weights = np.clip(trimesh.triangles.points_to_barycentric(shape.triangles[faces], points), 0.0, 1.0)
    weights /= weights.sum(axis=1, keepdims=True)
    kept = len(points)
    return _SurfaceSamples(
        np.asarray(faces),
        weights,
        float(np.sqrt(shape.area / kept)),
        rng.uniform(0.0, 2.0 * np.pi, kept),
        rng.normal(0.0, NORMAL_NOISE, (kept, 2)),
        rng.normal(0.0, POSITION_NOISE, kept),
        rng.uniform(*OPACITY, kept),
    )


def _capture(
    mesh: MaterialMesh, traced: TracedMesh, samples: _SurfaceSamples, light: EnvironmentMap, seed: int
) -> GaussianCloud:
    """Return what a training would leave: geometry with its noise, and the radiance that leaves the surface."""
    points = mesh.interpolate(mesh.vertices, samples.faces, samples.weights)
    normals = mesh.interpolate(mesh.normals, samples.faces, samples.weights)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sigma = TANGENTIAL_DEVIATION * samples.spacing
    axes = _frames(normals, samples.turn, samples.tilt)
    count = len(points)
    outward = _views(normals)
    radiance = outgoing_radiance(
        traced,
        samples.faces,
        samples.weights,
        outward,
        light,
        sample_count=PATHS_PER_DIRECTION,
        seed=seed,
    )
    return GaussianCloud(
        positions=points + normals * (samples.lift * FLATNESS * sigma)[:, None],
        orientations=_quaternions(axes).astype(np.float32),
        scales=np.tile([sigma, sigma, FLATNESS * sigma], (count, 1)),
        opacities=samples.opacities.astype(np.float32),
        radiance=_fit_harmonics(linear_to_srgb(np.clip(radiance, 0.0, 1.0)), -outward).astype(np.float32),
        radiance_color_space=DISPLAY_SRGB,
        ids=np.arange(count),
    )


def _frames(normals: NDArray[np.float64], turn: NDArray[np.float64], tilt: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrices whose third column is the normal, tilted, with the others turned at random, ``(N, 3, 3)``."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(helper, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    third = normals + tilt[:, :1] * first + tilt[:, 1:] * second
    third /= np.linalg.norm(third, axis=1, keepdims=True)
    around = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
    around -= (around * third).sum(axis=1, keepdims=True) * third
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    return np.stack([around, np.cross(third, around), third], axis=2)


def _quaternions(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions xyzw of rotation matrices."""
    return Rotation.from_matrix(rotations).as_quat()


def _views(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions in which a dome of cameras sees each point, evenly over its visible side, ``(N, D, 3)``."""
    index = np.arange(DIRECTION_COUNT) + 0.5
    z = 1.0 - 0.85 * index / DIRECTION_COUNT
    phi = np.pi * (1.0 + np.sqrt(5.0)) * index
    radius = np.sqrt(1.0 - z * z)
    local = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1)
    zero = np.zeros(len(normals))
    return np.einsum("nij,dj->ndi", _frames(normals, zero, np.zeros((len(normals), 2))), local)


def _fit_harmonics(colors: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit ``colour = 0.5 + sum Y_k(d) c_k`` to colours ``(N, D, 3)`` seen along ``(N, D, 3)``."""
    basis = sh_basis(directions, SH_DEGREE)
    ridge = np.full(basis.shape[-1], SH_RIDGE * directions.shape[1])
    ridge[0] = 0.0
    normal = np.einsum("ndk,ndl->nkl", basis, basis) + np.diag(ridge)
    right = np.einsum("ndk,ndc->nkc", basis, np.asarray(colors, np.float64) - 0.5)
    return np.linalg.solve(normal, right)


def run_demo(out: Path, options: DemoOptions | None = None, progress: Progress = no_progress) -> RunResult:
    """Build the demo, run the main job on it, score the result and draw it; then do the same from images.

    Writes what `beam_warp.run` writes, ``out/lights/*.exr`` and ``out/relit.png``: ours above, truth below; and what
    `demo_from_images` writes. The scores are in the report, under ``scores`` and ``from_images``.

    Args:
        out: Folder; made if its parent exists.
        options: See `DemoOptions`.
        progress: Called with (stage, done, total).
    """
    options = options or DemoOptions()
    started = time.perf_counter()
    scene = build_demo(options, progress)
    built = time.perf_counter() - started
    result = run(
        scene.sequence,
        scene.lights["studio"],
        out,
        # The light is known, so its exposure is stated, not estimated: that is what makes the scores unscaled.
        RunOptions(exposure=0.0, roughness=0.5, device=options.device),
        overview=OverviewOptions(
            second_light=Relighting("relit by a sunset", scene.lights["sunset"]),
            azimuth=VIEWS[0][0],
            elevation=VIEWS[0][1],
        ),
        progress=progress,
    )
    folder = out / "lights"
    folder.mkdir(exist_ok=True)
    for name, light in scene.lights.items():
        write_exr(folder / f"{name}.exr", {c: light.radiance[..., i] for i, c in enumerate("RGB")})
    renderer = DeferredRenderer(UNSHADOWED, raster=RASTER, device=options.device)
    relit = relit_views(
        result.sequence[scene.truth_frame],
        [truth.camera for truth in scene.truth],
        scene.lights,
        renderer,
        raster=RASTER,
        device=options.device,
    )
    result.report["scores"] = score_views(scene.truth, relit)
    write_png(out / "relit.png", comparison(scene.truth[0], relit[0], scene.lights))
    images = demo_from_images(
        out, options.images, scene.lights, device=options.device, seed=options.seed, progress=progress
    )
    result.report["from_images"] = images.report
    result.report["seconds"]["build demo"] = built
    result.report["seconds"]["total"] = time.perf_counter() - started
    write_report(out, result.report)
    return replace(result, report=result.report)
