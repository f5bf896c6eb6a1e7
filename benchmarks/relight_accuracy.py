"""How near relit images come to path-traced truth, and what each costs: deferred and path traced.

Geometry is perfect: Gaussians on the true surface with the truth's materials. The demo figure's materials are known at
every point, so that nothing but the renderer is in the way of its truth. Decomposed reconstructions are relit with more
and fewer shadow maps and bounces; with the usual ones `materials_evaluation` relights them, in both ways.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh
from materials_truth import true_cloud
from numpy.typing import NDArray
from parts import Row, say
from relight_scenes import Bench, seconds_of
from scipy.spatial import cKDTree
from timing import spread

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.capture.matching import match_frames
from beam_warp.demo.figure import build_figure
from beam_warp.demo.lights import demo_environments
from beam_warp.image.metrics import as_compared, bounding_box, compare, psnr
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.scores import truth_frames
from beam_warp.render.deferred import DeferredOptions, DeferredRenderer
from beam_warp.render.path import PathOptions, PathProgress, PathRenderer
from beam_warp.study.true_surface import SHARP, gaussians_on_mesh
from beam_warp.trace.mesh_paths import TracedMesh, trace_radiance
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.shot import RenderedImage, Shot

DANCE_PHASE = 0.15
"""The moment of the demo figure's dance that is rendered."""

CANDIDATES = 24
"""Triangles, by their middles' distance, among which the one below a point is looked for."""

OPENNESS_RAYS = 64


@dataclass(frozen=True, eq=False)
class Known:
    """A relit image that is known: scene-linear radiance multiplied by alpha, and alpha."""

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class RelitSubject:
    """What is rendered, and what that should look like.

    Attributes:
        name: Name in tables.
        cloud: Relightable Gaussians.
        raster: How splats are drawn.
        cameras: Views, at least one.
        lights: Environments by name.
        truth: For each light, an image a camera.
    """

    name: str
    cloud: GaussianCloud
    raster: RasterOptions
    cameras: Sequence[Camera]
    lights: Mapping[str, EnvironmentMap]
    truth: Mapping[str, Sequence[Known]]


@dataclass(frozen=True, eq=False)
class Rendered:
    """One way's images of all cameras under a light, and what one takes [ms], over cameras and repeats."""

    method: str
    setting: str
    images: Sequence[Known]
    milliseconds: Sequence[float]


def measure_accuracy(bench: Bench) -> Iterator[Row]:
    """Yield scores so far of every subject under every light."""
    result: Row = {"side": bench.effort.side, "subjects": {}}
    pictures: dict[str, NDArray[Any]] = {}
    warm_up(bench)
    for subject in subjects(bench):
        row: Row = {
            "gaussians": len(subject.cloud),
            "views": len(subject.cameras),
            "size": [subject.cameras[0].width, subject.cameras[0].height],
            "lights": {},
        }
        result["subjects"][subject.name] = row
        for light in subject.lights:
            row["lights"][light] = found = measure_light(bench, subject, light, pictures)
            for entry in found["rows"]:
                say(f"{subject.name}, {light}, {described(entry)}")
            yield result
        if bench.pictures is not None:
            bench.pictures.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(bench.pictures / "relight.npz", **pictures)  # pyright: ignore[reportArgumentType]


def warm_up(bench: Bench) -> None:
    """Compile what the rows need."""
    shot = replace(bench.small_figure(), lights=(), mesh=None)
    assert shot.environment is not None
    device = str(bench.device)
    PathRenderer(PathOptions(samples=1), device=device).draw(shot)
    for count in sorted({min(bench.effort.scored_shadows), max(bench.effort.scored_shadows)}):
        DeferredRenderer(bench.deferred_options(count, side=bench.effort.side), device=device).frame(shot).launch()


def subjects(bench: Bench) -> Iterator[RelitSubject]:
    """Yield the captures' perfect geometry, and the demo figure."""
    for name, capture in bench.captures.items():
        frame = truth_frames(capture)[0]
        started = time.perf_counter()
        cloud = true_cloud(capture, frame, bench.effort.perfect_gaussians, bench.device)
        say(f"{name}: true materials of {len(cloud):,} Gaussians in {time.perf_counter() - started:.1f} s")
        yield captured_subject(name, capture, frame, cloud, SHARP, bench.effort.views)
    yield demo_subject(bench)


def measure_shadows(bench: Bench) -> Iterator[Row]:
    """Yield how near decomposed reconstructions come to the truth so far, by shadow maps and bounces; none is timed."""
    if not bench.assets:
        raise FileNotFoundError("assets must be given to be relit, got none. Make them with materials.py --keep.")
    result: Row = {"side": bench.effort.side, "subjects": {}}
    for name, path in bench.assets.items():
        capture, sequence = bench.captures[name], converters.read(path)
        matched = match_frames(sequence)
        frame = next(frame for frame in truth_frames(capture) if frame in matched)
        cloud = change_axes(sequence[matched[frame]], "rfu")
        raster = RasterOptions.from_metadata(sequence.metadata)
        subject = captured_subject(name, capture, frame, cloud, raster, views=None)
        row: Row = {"gaussians": len(cloud), "views": len(subject.cameras), "lights": {}}
        result["subjects"][name] = row
        for light, truth in subject.truth.items():
            prepared = [PreparedEnvironment(subject.lights[light], bench.device)]
            row["lights"][light] = rows = []
            for shadows, bounces in bench.effort.settings:
                options = replace(bench.deferred_options(shadows, side=bench.effort.side), bounces=bounces)
                renderer = DeferredRenderer(options, raster=raster, device=str(bench.device), prepared=prepared)
                images = [renderer.draw(shot_of(subject, light, camera)) for camera in subject.cameras]
                score = float(np.mean([box_psnr(*pair) for pair in zip(images, truth, strict=True)]))
                rows.append({"shadows": shadows, "bounces": bounces, "psnr": score})
            say(f"{name}, {light}: {', '.join(format(entry['psnr'], '.2f') for entry in rows)}")
            yield result


def box_psnr(image: RenderedImage, known: Known) -> float:
    """Return PSNR in the subject's box."""
    pair = as_compared(
        image.rgb, known.rgb, alpha=image.alpha, truth_alpha=known.alpha, is_color=True, premultiplied=True
    )
    return psnr(pair.image, pair.truth)


def captured_subject(
    name: str, capture: Capture, frame: int, cloud: GaussianCloud, raster: RasterOptions, views: int | None
) -> RelitSubject:
    """Return Gaussians with a capture's truth under its lights: of so many views far from each other, or of all."""
    records = [r for r in capture.select(split="test", frames=[frame]) if r.truth_path is not None and r.relit_paths]
    if views is not None:
        records = records[:: max(1, len(records) // views)][:views]
    names = sorted(records[0].relit_paths)
    return RelitSubject(
        name,
        cloud,
        raster,
        [record.camera for record in records],
        {light: EnvironmentMap.read(capture.folder / "truth" / f"{light}.exr") for light in names},
        {
            light: [Known(r.relit(light).linear_rgba()[..., :3], r.truth().channels["A"]) for r in records]
            for light in names
        },
    )


def demo_subject(bench: Bench) -> RelitSubject:
    """Return the demo figure as Gaussians whose materials are the mesh's own, and the mesh path traced."""
    effort, device = bench.effort, str(bench.device)
    mesh = build_figure(effort.demo_spacing).at(DANCE_PHASE)
    bare = gaussians_on_mesh(mesh.vertices, mesh.faces, effort.perfect_gaussians)
    assert bare.normals is not None
    color, roughness = materials_at(mesh, bare.positions)
    scene = Scene.from_gaussians(bare, device)
    openness = ambient_occlusion(scene, bare.positions, bare.normals, sample_count=OPENNESS_RAYS).visibility
    cloud = bare.with_arrays(
        base_color=color, roughness=roughness, ambient_occlusion=np.clip(openness, 0.0, 1.0).astype(np.float32)
    )
    cameras = [
        Camera.frame_points(
            mesh.vertices,
            azimuth=20.0 + 360.0 / effort.views * view,
            elevation=8.0,
            width=effort.demo_size[0],
            height=effort.demo_size[1],
        )
        for view in range(effort.views)
    ]
    lights = {name: light for name, light in demo_environments().items() if name != "stage"}
    traced = TracedMesh.from_mesh(mesh, device=device)
    truth: dict[str, list[Known]] = {}
    for name, light in lights.items():
        images = [
            trace_radiance(traced, c, light, sample_count=effort.truth_samples, bounce_count=effort.bounces, seed=1)
            for c in cameras
        ]
        truth[name] = [Known(image.rgb, image.alpha) for image in images]
    say(f"demo figure: {len(cloud):,} Gaussians, truth of {effort.truth_samples} paths a pixel")
    return RelitSubject("demo figure", cloud, SHARP, cameras, lights, truth)


def materials_at(mesh: MaterialMesh, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return base colour and roughness of a mesh at points on its surface."""
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    near = cKDTree(corners.mean(axis=1)).query(points, k=min(CANDIDATES, len(corners)), workers=-1)[1]
    near = near.reshape(len(points), -1)
    best = np.full(len(points), np.inf)
    faces, weights = near[:, 0].copy(), np.zeros((len(points), 3))
    for candidate in near.T:
        found = trimesh.triangles.points_to_barycentric(corners[candidate], points)
        found = np.clip(found, 0.0, 1.0)
        found /= found.sum(axis=1, keepdims=True)
        away = np.linalg.norm(np.einsum("nk,nkc->nc", found, corners[candidate]) - points, axis=1)
        nearer = away < best
        best[nearer], faces[nearer], weights[nearer] = away[nearer], candidate[nearer], found[nearer]
    color = mesh.interpolate(mesh.base_color, faces, weights)
    roughness = mesh.interpolate(mesh.roughness, faces, weights)
    return np.clip(color, 0.0, 1.0).astype(np.float32), np.clip(roughness, 0.0, 1.0).astype(np.float32)


def measure_light(bench: Bench, subject: RelitSubject, light: str, kept: dict[str, NDArray[Any]]) -> Row:
    """Return a row of every way under one light; images of the first camera go to ``kept``."""
    reference, rendered = path_traced(bench, subject, light)
    prepared = PreparedEnvironment(subject.lights[light], bench.device)
    for count in bench.effort.scored_shadows:
        rendered.append(deferred(bench, subject, light, count, prepared))
    best = max((r for r in rendered if r.method == "path traced"), key=lambda r: int(r.setting.split()[0]))
    usual = DeferredOptions().environment_shadows
    shown = min((r for r in rendered if r.method == "deferred"), key=lambda r: abs(int(r.setting.split()[-1]) - usual))
    known = subject.truth[light][0]
    box = bounding_box(known.alpha)
    for name, image in (("deferred", shown.images[0]), ("path", best.images[0]), ("truth", known)):
        kept[f"{subject.name} {light} {name}"] = image.rgb[box].astype(np.float16)
    return {
        **reference,
        "shown": {"deferred": shown.setting, "path": best.setting},
        "rows": [
            {
                "method": way.method,
                "setting": way.setting,
                "ms": spread(np.array(way.milliseconds)),
                **scores(way.images, subject.truth[light]),
                "against_path": scores(way.images, best.images) if way is not best else None,
            }
            for way in rendered
        ],
    }


def path_traced(bench: Bench, subject: RelitSubject, light: str) -> tuple[Row, list[Rendered]]:
    """Return every level of samples of a pixel, each with what all before took; progressive, so that none is redone."""
    effort, device = bench.effort, bench.device
    renderer = PathRenderer(PathOptions(samples=max(effort.levels), bounces=effort.bounces), device=str(device))
    shots = [shot_of(subject, light, camera) for camera in subject.cameras]
    prepared = seconds_of(lambda: renderer.start(shots[0]), device)
    images: dict[int, list[Known]] = {}
    spent: dict[int, list[float]] = {}
    rate = 0.0  # samples of a pixel in a second, of the slowest image so far
    levels = list(effort.levels)
    for number, shot in enumerate(shots):
        progress, seconds = renderer.start(shot), 0.0
        for level in list(levels):
            missing = level - progress.sample_count
            if number == 0 and rate > 0.0 and missing > rate * effort.level_seconds:
                levels = levels[: levels.index(level)]
                break
            took = seconds_of(lambda p=progress, m=missing: p.advance(m), device)
            rate, seconds = missing / max(took, 1e-9), seconds + took
            images.setdefault(level, []).append(known_of(progress))
            spent.setdefault(level, []).append(1e3 * seconds)
    facts = {"prepare_ms": 1e3 * prepared, "left_out": [level for level in effort.levels if level not in levels]}
    return facts, [Rendered("path traced", f"{level} samples", images[level], spent[level]) for level in levels]


def known_of(progress: PathProgress) -> Known:
    """Return what is known of an image."""
    image = progress.image()
    return Known(image.rgb, image.alpha)


def deferred(bench: Bench, subject: RelitSubject, light: str, count: int, prepared: PreparedEnvironment) -> Rendered:
    """Return deferred images, each timed with all shadow maps drawn again."""
    options = bench.deferred_options(count, side=bench.effort.side)
    renderer = DeferredRenderer(options, raster=subject.raster, device=str(bench.device), prepared=[prepared])
    images, spent = [], []
    for camera in subject.cameras:
        frame = renderer.frame(shot_of(subject, light, camera))
        image = frame.image()
        images.append(Known(image.rgb, image.alpha))
        frame.launch()
        spent += [1e3 * seconds_of(frame.launch, bench.device) for _ in range(bench.effort.repeats)]
    return Rendered("deferred", f"N = {count}", images, spent)


def shot_of(subject: RelitSubject, light: str, camera: Camera) -> Shot:
    """Return a subject under one of its lights."""
    return Shot(cloud=subject.cloud, camera=camera, environment=subject.lights[light])


def scores(images: Sequence[Known], truth: Sequence[Known]) -> Row:
    """Return means over views.

    ``psnr`` and ``ssim`` are of the subject's box, ``solid_psnr`` where the truth is solid, ``true_coverage_psnr`` of
    the box with the truth's coverage in place of ours: silhouettes are the geometry's. ``view_psnr`` is of each view.
    """
    how: dict[str, Any] = {"is_color": True, "premultiplied": True}
    found, covered = [], []
    for image, known in zip(images, truth, strict=True):
        found.append(compare(image.rgb, known.rgb, alpha=image.alpha, truth_alpha=known.alpha, **how))
        straight = image.rgb / np.maximum(image.alpha, 1e-6)[..., None]
        covering = straight * known.alpha[..., None]
        covered.append(compare(covering, known.rgb, alpha=known.alpha, truth_alpha=known.alpha, **how).psnr)
    return {
        **{name: float(np.mean([getattr(s, name) for s in found])) for name in ("psnr", "ssim", "solid_psnr")},
        "true_coverage_psnr": float(np.mean(covered)),
        "view_psnr": [score.psnr for score in found],
    }


def described(row: Row) -> str:
    """Return a row in words."""
    return (
        f"{row['method']}, {row['setting']}: {row['psnr']:.2f} dB / {row['ssim']:.4f}, solid {row['solid_psnr']:.2f}, "
        f"true coverage {row['true_coverage_psnr']:.2f}, {row['ms']['median']:.2f} ms"
    )
