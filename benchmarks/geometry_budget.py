"""What does ambient occlusion lack on a figure: places, normals, what occludes, or how it is carried by Gaussians?

    python benchmarks/geometry_budget.py --assets FOLDER [--captures robot] [--device cuda:0] --out JSON

FOLDER holds what `beam run CAPTURE --frames 0:1 --out FOLDER/CAPTURE` writes. Every pixel of the training views of the
first frame is asked for its occlusion with one part after the other taken from the truth: the place that it sees, the
normal there, and the occluder. *Pixels* is how close that comes to what the true mesh has at the pixels' own centres.
*Drawn* carries it to the Gaussians, by the least squares that give Gaussians on a true surface their colours, and
draws them for the test views, scored against the capture's own truth: the first of these rows is what no geometry can
exceed with these Gaussians. *Places* are the same pixels sorted by what they lie beside: signed distance of ours along
the true normal (positive is outside), and angles between ours and the true normal.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import record
from materials_truth import Materials, TruthViews
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device
from beam_warp.image.color import LUMINANCE
from beam_warp.mesh.distances import SurfaceTree
from beam_warp.mesh.extract import mesh_of_gaussians
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.study.true_surface import colored_by_views
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.scene import Scene
from beam_warp.world.axes import change_axes
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.quaternions import rotation_matrices

CAPTURES = ("walker", "runner", "robot")
RAYS = 64
LIFT = 1e-4
"""Lift of rays from a mesh [m]; `GAUSSIAN_LIFTS` are those from Gaussians."""
GAUSSIAN_LIFTS = (0.005, 0.01)
EDGE_DEGREES = 30.0
"""Turn of the true normal from pixel to pixel from which on there is an edge between them."""
EDGE_PIXELS = 2.0
"""Distance from an edge within which a pixel counts as beside it."""

Vectors = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of all views at which both the truth and ours are there: rows; and where they lie in the images."""

    views: Sequence[CapturedView]
    there: NDArray[np.bool_]
    rays: Vectors
    true_points: Vectors
    true_normals: Vectors
    points: Vectors
    normals: Vectors
    own_normals: Vectors
    beside: NDArray[np.str_]
    edge_distance: NDArray[np.float64]

    def images(self, values: NDArray[Any]) -> list[NDArray[np.float32]]:
        """Return values of rows as images, one a view; 0 elsewhere."""
        full = np.zeros(len(self.there), np.float32)
        full[self.there] = values
        sizes = [view.camera.height * view.camera.width for view in self.views]
        parts = np.split(full, np.cumsum(sizes)[:-1])
        return [
            part.reshape(view.camera.height, view.camera.width) for part, view in zip(parts, self.views, strict=True)
        ]


def unit(vectors: Vectors) -> Vectors:
    """Return vectors of unit length; 0 stays."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def degrees_between(a: Vectors, b: Vectors) -> NDArray[np.float64]:
    """Return angles of unit vectors."""
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1.0, 1.0)))


def sides_of_edges(
    points: Vectors, normals: Vectors, inside: NDArray[np.bool_]
) -> tuple[NDArray[np.str_], NDArray[np.float64]]:
    """Sort pixels of one view into flat, crease, ridge and ledge, and say how far the nearest edge is [pixel].

    At a ledge the surface itself jumps, by more than a pixel's width along the normal.
    """
    kinds = {kind: np.zeros(inside.shape, bool) for kind in ("ledge", "crease", "ridge")}
    for axis in (0, 1):
        near: tuple[Any, ...] = tuple(slice(None, -1) if k == axis else slice(None) for k in range(2))
        far: tuple[Any, ...] = tuple(slice(1, None) if k == axis else slice(None) for k in range(2))
        both = inside[near] & inside[far]
        step = points[far] - points[near]
        above = 0.5 * ((step * normals[near]).sum(axis=-1) - (step * normals[far]).sum(axis=-1))
        turned = degrees_between(normals[near], normals[far]) > EDGE_DEGREES
        spacing = np.median(np.linalg.norm(step[both], axis=-1)) if both.any() else 1.0
        jumps = np.minimum(abs((step * normals[near]).sum(axis=-1)), abs((step * normals[far]).sum(axis=-1))) > spacing
        for kind, met in (("ledge", jumps), ("crease", turned & (above > 0.0)), ("ridge", turned & (above <= 0.0))):
            met = met & both & (True if kind == "ledge" else ~jumps)
            kinds[kind][near] |= met
            kinds[kind][far] |= met
    kinds["ledge"] |= inside & (distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1] < 1.5)  # the outline
    away = {
        kind: distance_transform_edt(~met) if met.any() else np.full(met.shape, np.inf) for kind, met in kinds.items()
    }
    nearest = np.min(list(away.values()), axis=0)
    beside = np.full(inside.shape, "flat", dtype="<U6")
    for kind, distance in away.items():
        beside[(distance == nearest) & (nearest <= EDGE_PIXELS)] = kind
    return beside, nearest


def pixels_of(views: Sequence[CapturedView], cloud: GaussianCloud, truth: SurfaceTree, raster: RasterOptions) -> Pixels:
    """Draw a cloud for views and cast the rays of their pixels at the true mesh."""
    axes = rotation_matrices(cloud.orientations)[np.arange(len(cloud)), :, np.argmin(cloud.scales, axis=1)]
    columns: dict[str, list[Any]] = {name: [] for name in Pixels.__dataclass_fields__ if name != "views"}
    for view in views:
        camera, shape = view.camera, (view.camera.height, view.camera.width)
        rays = unit(np.asarray(camera.directions(), np.float64).reshape(-1, 3))
        reached = truth.cast(np.broadcast_to(camera.position, rays.shape), rays)
        hit = np.isfinite(reached)
        true_points = np.where(hit[:, None], camera.position + rays * np.where(hit, reached, 0.0)[:, None], 0.0)
        true_normals = truth.normals(truth.closest(true_points).faces)
        true_normals *= np.where((true_normals * rays).sum(axis=1, keepdims=True) > 0.0, -1.0, 1.0)
        towards = np.where(((camera.position - cloud.positions) * axes).sum(axis=1, keepdims=True) < 0.0, -axes, axes)
        drawn = rasterize(cloud, camera, channels=("normals",), options=raster, device=str(truth.device))
        own = rasterize(
            cloud.with_arrays(normals=towards.astype(np.float32)),
            camera,
            channels=("normals",),
            options=raster,
            device=str(truth.device),
        )
        along = drawn.median_depth.reshape(-1) / np.maximum(rays @ camera.forward, 1e-9)
        there = hit & (drawn.alpha.reshape(-1) > 0.5)
        beside, edge = sides_of_edges(
            true_points.reshape(*shape, 3), true_normals.reshape(*shape, 3), hit.reshape(shape)
        )
        found = {
            "rays": rays,
            "true_points": true_points,
            "true_normals": true_normals,
            "points": camera.position + rays * along[:, None],
            "normals": unit(drawn.channels["normals"].reshape(-1, 3).astype(np.float64)),
            "own_normals": unit(own.channels["normals"].reshape(-1, 3).astype(np.float64)),
            "beside": beside.reshape(-1),
            "edge_distance": edge.reshape(-1),
        }
        columns["there"].append(there)
        for name, values in found.items():
            columns[name].append(values[there])
    return Pixels(views=views, **{name: np.concatenate(parts) for name, parts in columns.items()})


def mesh_occlusion(mesh: SurfaceTree, points: Vectors, normals: Vectors, lift: float, rays: int) -> NDArray[np.float64]:
    """Return the cosine-weighted visibility of points among a mesh's triangles, by stratified rays."""
    rng = np.random.default_rng(0)
    across = unit(np.cross(normals, np.where(abs(normals[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))))
    other = np.cross(normals, across)
    open_count = np.zeros(len(points))
    for k in range(rays):
        height = (k + rng.random(len(points))) / rays
        turn, radius = 2.0 * np.pi * rng.random(len(points)), np.sqrt(height)
        along = (
            across * (radius * np.cos(turn))[:, None]
            + other * (radius * np.sin(turn))[:, None]
            + normals * np.sqrt(1.0 - height)[:, None]
        )
        open_count += np.isnan(mesh.cast(points + lift * normals, unit(along)))
    return open_count / rays


class Budget:
    """Scores of one capture, row by row."""

    def __init__(self, capture: Capture, cloud: GaussianCloud, raster: RasterOptions, device: str, rays: int) -> None:
        """Draw the cloud, and ask the true mesh for the true occlusion."""
        frame = capture.frames[0]
        mesh = read_truth_mesh(capture, frame)
        self.cloud, self.raster, self.device, self.rays = cloud, raster, device, rays
        self.truth = SurfaceTree(mesh.vertices, mesh.faces, device=device)
        views = [entry.view() for entry in capture.select(split="train", frames=[frame])]
        self.pixels = pixels_of(views, cloud, self.truth, raster)
        self.scored = TruthViews(capture, frame, raster, 2, device)
        self.true_occlusion = mesh_occlusion(self.truth, self.pixels.true_points, self.pixels.true_normals, LIFT, rays)

    def drawn(self, occlusion: NDArray[Any]) -> dict[str, float]:
        """Score the occlusion of Gaussians as test views show it."""
        found = Materials(np.full((len(self.cloud), 3), 0.5, np.float32), occlusion.astype(np.float32))
        score = self.scored.score(self.cloud, found)["ambient_occlusion"]
        return {"psnr": score["psnr"], "ssim": score["ssim"], "true_coverage_psnr": score["true_coverage_psnr"]}

    def carried(self, occlusion: NDArray[Any]) -> dict[str, float]:
        """Score the occlusion of pixels: against the true one, and carried to the Gaussians and drawn."""
        images = self.pixels.images(occlusion)
        shown = [
            replace(view, color=np.repeat((image * view.alpha)[..., None], 3, axis=-1).astype(np.float32))
            for view, image in zip(self.pixels.views, images, strict=True)
        ]
        levels = colored_by_views(self.cloud, shown, options=self.raster, device=self.device).radiance
        assert levels is not None
        error = np.mean((occlusion - self.true_occlusion) ** 2)
        pixels = float(-10.0 * np.log10(max(error, 1e-12)))
        return {"pixels_psnr": pixels, **self.drawn(np.clip(levels[:, 0, 0] * SH_C0 + 0.5, 0.0, 1.0))}

    def rows(self) -> dict[str, dict[str, float]]:
        """Score every combination of true and our places, normals and occluders."""
        pixels, scene = self.pixels, Scene.from_gaussians(self.cloud, self.device)
        fused = mesh_of_gaussians(
            self.cloud, [view.camera for view in pixels.views], options=self.raster, device=self.device
        )
        ours = SurfaceTree(np.asarray(fused.vertices), np.asarray(fused.faces), device=self.device)
        places = {"true": pixels.true_points, "ours": pixels.points}
        normals = {"true": pixels.true_normals, "ours": pixels.normals, "own axes": pixels.own_normals}
        own = self.cloud.ambient_occlusion
        assert own is not None
        rows = {"the asset as it is": self.drawn(own)}
        rows["true places, true normals, true mesh"] = self.carried(self.true_occlusion)
        for name in ("ours", "own axes"):
            found = mesh_occlusion(self.truth, places["true"], normals[name], LIFT, self.rays)
            rows[f"true places, normals {name}, true mesh"] = self.carried(found)
        for place, at in places.items():
            for name in ("true", "ours"):
                for lift in GAUSSIAN_LIFTS:
                    found = ambient_occlusion(
                        scene,
                        at.astype(np.float32),
                        normals[name].astype(np.float32),
                        sample_count=self.rays,
                        offset=lift,
                    ).visibility
                    row = f"{place} places, {name} normals, our Gaussians lifted {1e3 * lift:.0f} mm"
                    rows[row] = self.carried(np.asarray(found, np.float64))
        at = ours.closest(pixels.points).points
        for name in ("true", "ours"):
            found = mesh_occlusion(ours, at, normals[name], 10.0 * LIFT, self.rays)
            rows[f"fused places, {name} normals, fused mesh"] = self.carried(found)
        return rows

    def places(self) -> dict[str, dict[str, Any]]:
        """Return distances and angles of ours, sorted by what pixels lie beside, how open, steep and dark they are."""
        pixels = self.pixels
        signed = 1e3 * ((pixels.points - pixels.true_points) * pixels.true_normals).sum(axis=1)
        angle, own = (degrees_between(pixels.true_normals, n) for n in (pixels.normals, pixels.own_normals))
        light = np.concatenate([(view.color @ LUMINANCE).reshape(-1) for view in pixels.views])[pixels.there]
        incidence = np.degrees(np.arccos(np.clip(-(pixels.rays * pixels.true_normals).sum(axis=1), 0.0, 1.0)))
        groups: dict[str, NDArray[np.bool_]] = {"all": np.ones(len(signed), bool)}
        groups |= {
            f"beside a {kind}" if kind != "flat" else kind: pixels.beside == kind
            for kind in ("flat", "crease", "ridge", "ledge")
        }
        for name, values, bounds in (
            ("pixels to the next edge", pixels.edge_distance, (0, 2, 4, 8, np.inf)),
            ("openness", self.true_occlusion, (0, 0.3, 0.5, 0.7, 0.9, 1.001)),
            ("degrees of incidence", incidence, (0, 30, 50, 70, 90)),
            ("luminance", light, (0, 0.02, 0.05, 0.15, np.inf)),
        ):
            for low, high in itertools.pairwise(bounds):
                groups[f"{name} {low:g} to {high:g}"] = (values >= low) & (values < high)
        return {
            name: {
                "share": float(rows.mean()),
                "signed_mm": np.percentile(signed[rows], (10, 50, 90)).tolist(),
                "normal_degrees": [*np.percentile(angle[rows], (50, 90)).tolist(), float(angle[rows].mean())],
                "own_normal_degrees": [*np.percentile(own[rows], (50, 90)).tolist(), float(own[rows].mean())],
            }
            for name, rows in groups.items()
            if rows.any()
        }


def main() -> None:
    """Account for every capture and write what came out."""
    parser = record.parser(__doc__, device=True, data=True)
    parser.add_argument("--assets", type=Path, required=True, metavar="FOLDER", help="what beam run made of captures")
    parser.add_argument("--captures", nargs="+", default=CAPTURES, choices=CAPTURES)
    parser.add_argument("--rays", type=int, default=RAYS, help="rays of a pixel")
    given = parser.parse_args()
    device = resolve_device(given.device)
    rows: dict[str, Any] = {}
    for name in given.captures:
        sequence = converters.read(given.assets / name / "asset.usda")
        cloud, raster = change_axes(sequence[0], "rfu"), RasterOptions.from_metadata(sequence.metadata)
        capture = Capture.read(Path(given.data) / "captures" / name)
        budget = Budget(capture, cloud, raster, str(device), given.rays)
        rows[name] = {"rows": budget.rows(), "places": budget.places(), "pixels": len(budget.pixels.points)}
        for kind in ("rows", "places"):
            for row, found in rows[name][kind].items():
                print(name, row, found, flush=True)
        record.write_result(given, device, {"captures": rows})


if __name__ == "__main__":
    main()
