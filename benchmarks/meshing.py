"""Fusion of depth images: time and error of sparse blocks beside a dense grid of the same voxels, in one run.

    python benchmarks/meshing.py [--device cuda:0] [--quick] --out result.json

Two scenes with truth. A sphere: depth in closed form, so that all error is the fusion's. The demo figure: Gaussians on
its surface, drawn by the rasteriser, so that what discs that lie on a curved surface stand off it by is in the error
too. The dense grid is the usual way to do it: all voxels of a box, nearest pixel, distance along the optical axis,
equal weights, unseen voxels in front of everything, marching cubes over the whole.
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from typing import Any

import numpy as np
import record
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation
from timing import Task, spread, take_turns
from warp.geometry import IsoSurfaceMarchingCubes

from beam_warp.demo.figure import build_figure
from beam_warp.demo.stand_in import FLATNESS, TANGENTIAL_DEVIATION, sample_surface, tangent_frames
from beam_warp.device.arrays import resolve_device
from beam_warp.kernels.mesh.depth_pixels import DepthCamera, project_point
from beam_warp.mesh.consistency import depth_consistency
from beam_warp.mesh.depths import DepthImages, DepthView
from beam_warp.mesh.extract import draw_depths, surrounding_cameras
from beam_warp.mesh.fusion import fuse_depths
from beam_warp.mesh.topology import mesh_report
from beam_warp.mesh.unwrap import unwrapped
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

RADIUS = 0.5
TRUNCATION = 4.0
SAMPLES = 50_000


@wp.kernel(enable_backward=False)
def fuse_dense_kernel(
    cameras: wp.array[DepthCamera],
    pixels: wp.array[wp.vec3],
    low: wp.vec3,
    voxel: float,
    out_distances: wp.array3d[float],
):
    i, j, k = wp.tid()
    point = low + voxel * wp.vec3(float(i), float(j), float(k))
    total = wp.float32(0.0)
    weights = wp.float32(0.0)
    for view in range(cameras.shape[0]):
        camera = cameras[view]
        at = project_point(camera, point)
        inside = at[0] >= 0.0 and at[1] >= 0.0 and at[0] < float(camera.width) and at[1] < float(camera.height)
        if at[2] > 0.0 and inside:
            pixel = pixels[camera.first_pixel + int(at[1]) * camera.width + int(at[0])]
            if pixel[0] > 0.0:
                distance = (1.0 / pixel[0] - at[2]) / voxel
                if distance > -TRUNCATION:
                    total += wp.min(1.0, distance / TRUNCATION)
                    weights += 1.0
    value = wp.float32(1.0)
    if weights > 0.0:
        value = total / weights
    out_distances[i, j, k] = value


@wp.kernel(enable_backward=False)
def surface_distances_kernel(mesh: wp.uint64, points: wp.array[wp.vec3], out_distances: wp.array[float]):
    index = wp.tid()
    query = wp.mesh_query_point_sign_normal(mesh, points[index], 100.0)
    if query.result:
        nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        out_distances[index] = query.sign * wp.length(nearest - points[index])


def fuse_dense(images: DepthImages, voxel: float, low: np.ndarray, high: np.ndarray) -> trimesh.Trimesh:
    """Fuse over a box [m]."""
    sides = [int(side) for side in np.ceil((high - low) / voxel) + 1]
    corner = low - images.origin
    with wp.ScopedDevice(images.device):
        distances = wp.empty(sides, dtype=float)
        inputs = [images.views, images.pixels, wp.vec3(*corner), voxel]
        wp.launch(fuse_dense_kernel, sides, inputs, [distances])
        upper = corner + voxel * (np.array(sides) - 1)
        points, indices = IsoSurfaceMarchingCubes.extract(
            distances, 0.0, lower=tuple(map(float, corner)), upper=tuple(map(float, upper))
        )
    return trimesh.Trimesh(points.numpy() + images.origin, indices.numpy().reshape(-1, 3), process=False)


def distances_to(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Signed distances from a mesh [m], positive outside."""
    tree = wp.Mesh(
        wp.array(np.asarray(mesh.vertices, np.float32), dtype=wp.vec3, device="cpu"),
        wp.array(np.asarray(mesh.faces, np.int32).reshape(-1), dtype=int, device="cpu"),
    )
    found = wp.zeros(len(points), dtype=float, device="cpu")
    at = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(surface_distances_kernel, len(points), [tree.id, at], [found], device="cpu")
    return found.numpy()


def errors(mesh: trimesh.Trimesh, truth: trimesh.Trimesh | None) -> dict[str, Any]:
    """Compare with a sphere or with a mesh [mm], and count edges."""
    found: dict[str, Any] = asdict(mesh_report(mesh))
    if truth is None:
        off = 1e3 * (np.linalg.norm(mesh.vertices, axis=1) - RADIUS)
        found["radius_mm"] = {"mean": off.mean(), "mean_size": np.abs(off).mean(), "largest": np.abs(off).max()}
        return found
    there = 1e3 * distances_to(truth, trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0])
    back = 1e3 * distances_to(mesh, trimesh.sample.sample_surface(truth, SAMPLES, seed=0)[0])
    found["to_truth_mm"] = {
        "mean": there.mean(),
        "mean_size": np.abs(there).mean(),
        "p95": np.quantile(np.abs(there), 0.95),
    }
    found["from_truth_mm"] = {"mean_size": np.abs(back).mean(), "p95": np.quantile(np.abs(back), 0.95)}
    return found


def sphere_images(side: int, device: Any) -> DepthImages:
    """A sphere from 32 cameras."""
    index = np.arange(400) + 0.5
    z = 1.0 - index / 200.0
    points = RADIUS * np.stack([np.sqrt(1 - z * z) * np.cos(9 * index), np.sqrt(1 - z * z) * np.sin(9 * index), z], 1)
    cameras = [
        Camera.frame_points(points, azimuth=36.0 * i + elevation, elevation=elevation, width=side, height=side)
        for elevation in (-45.0, 0.0, 45.0)
        for i in range(10)
    ]
    views = []
    for camera in cameras:
        rays = camera.directions()
        half = rays @ camera.position
        root = half**2 - (camera.position @ camera.position - RADIUS**2)
        depth = (-half - np.sqrt(np.maximum(root, 0.0))) * (rays @ camera.forward)
        views.append(DepthView(camera=camera, depth=np.where(root > 0.0, depth, 0.0), alpha=1.0 * (root > 0.0)))
    return DepthImages.of(views, device=device)


def demo_gaussians(count: int) -> tuple[GaussianCloud, trimesh.Trimesh]:
    """Gaussians on the demo figure, with the noise of its stand-in for a training, and its surface."""
    figure = build_figure()
    samples = sample_surface(figure.rest, count, np.random.default_rng(0))
    mesh = figure.at(0.1)
    points = mesh.interpolate(mesh.vertices, samples.faces, samples.weights)
    normals = mesh.interpolate(mesh.normals, samples.faces, samples.weights)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sigma = TANGENTIAL_DEVIATION * samples.spacing
    color = mesh.interpolate(mesh.base_color, samples.faces, samples.weights)
    cloud = GaussianCloud(
        positions=points + normals * (samples.lift * FLATNESS * sigma)[:, None],
        orientations=Rotation.from_matrix(tangent_frames(normals, samples.turn, samples.tilt)).as_quat(),
        scales=np.tile([sigma, sigma, FLATNESS * sigma], (len(points), 1)),
        opacities=samples.opacities,
        base_color=np.clip(color, 0.0, 1.0),
    )
    return cloud, trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False)


def compare(
    images: DepthImages, truth: trimesh.Trimesh | None, low: np.ndarray, high: np.ndarray, voxel: float, repeats: int
) -> dict[str, Any]:
    """Time both ways in turn, and measure what each made."""
    ways = {"sparse": lambda: fuse_depths(images, voxel=voxel), "dense": lambda: fuse_dense(images, voxel, low, high)}
    times = take_turns({name: Task(work) for name, work in ways.items()}, repeats, images.device)
    found: dict[str, Any] = {
        name: {"seconds": spread(times[name].alone), **errors(work(), truth)} for name, work in ways.items()
    }
    found["voxel_mm"] = 1e3 * voxel
    found["faster_than_dense"] = spread(times["dense"].alone / times["sparse"].alone)
    return found


def main() -> int:
    parser = record.parser(__doc__, device=True, quick="small images and one repeat")
    parser.add_argument("--side", type=int, default=256, metavar="PX", help="of the depth images")
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    device = resolve_device(args.device)
    side, repeats, count = (96, 1, 8_000) if args.quick else (args.side, args.repeats, 45_000)
    result: dict[str, Any] = {"image_side": side}

    images = sphere_images(side, device)
    reach = np.full(3, RADIUS + 0.05)
    result["sphere"] = compare(images, None, -reach, reach, 3.0 / side, repeats)
    record.write_result(args, device, result)

    cloud, truth = demo_gaussians(count)
    cameras = surrounding_cameras(cloud, side=side)
    drawn = draw_depths(cloud, cameras, device=device)
    agreed = depth_consistency(drawn)
    stages = {
        "draw": Task(lambda: draw_depths(cloud, cameras, device=device)),
        "check": Task(lambda: depth_consistency(drawn)),
    }
    times = take_turns(stages, repeats, device)
    drawn.keep(agreed.mask())
    low, high = truth.bounds[0] - 0.05, truth.bounds[1] + 0.05
    result["figure"] = {
        "gaussians": len(cloud),
        "cameras": len(cameras),
        "consistency": agreed.as_dict(),
        "seconds": {name: spread(times[name].alone) for name in stages},
        **compare(drawn, truth, low, high, drawn.footprint(), repeats),
    }
    record.write_result(args, device, result)
    surface = fuse_depths(drawn, voxel=drawn.footprint())
    for _ in range(3):
        goal = 5_000 if args.quick else 20_000
        voxel = surface.metadata["voxel"] * float(np.sqrt(len(surface.faces) / goal))
        surface = fuse_depths(drawn, voxel=voxel)
    started = time.perf_counter()
    flat = unwrapped(surface)
    seconds = time.perf_counter() - started
    result["unwrap"] = {"faces": len(flat.faces), "vertices": len(flat.vertices), "seconds": seconds}
    record.write_result(args, device, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
