"""Truth of the materials benchmark: exact channels of test views, light by many rays, true geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from parts import Row

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.capture.views import CapturedView
from beam_warp.evaluate.relighters import Relighter
from beam_warp.image.files import read_image
from beam_warp.image.metrics import SOLID_ALPHA, Score, block_means, compare, mean_scores, root_mean_square
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.evidence import ViewEvidence, view_evidence
from beam_warp.materials.normals import SurfacePoints
from beam_warp.raster.gbuffer import rasterize_values
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.study.materials import without_color
from beam_warp.study.true_surface import SHARP, colored_by_views, gaussians_on_mesh, surface_of_capture
from beam_warp.trace.incident import irradiance
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import TraceOptions
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.shot import Shot

REFERENCE_SEED = 1 << 31
"""References draw other samples than what is measured, whose seeds count up from 0."""


@dataclass(frozen=True, eq=False)
class Materials:
    """Scored base colour ``(N, 3)`` and ambient occlusion ``(N,)``; roughness and normals to relight with."""

    base_color: NDArray[np.float32]
    ambient_occlusion: NDArray[np.float32]
    roughness: NDArray[np.float32] | None = None
    normals: NDArray[np.float32] | None = None


class TruthViews:
    """The test views of one frame, and how close what is drawn for them comes."""

    def __init__(self, capture: Capture, frame: int, raster: RasterOptions, samples: int, device: str) -> None:
        """Read the exact channels; ``samples`` is the side of the square of samples of a drawn pixel."""
        self.records = [r for r in capture.select(split="test", frames=[frame]) if r.truth_path is not None]
        self._truths = [record.truth() for record in self.records]
        self.raster, self.samples, self.device = raster, samples, device
        self._lights: dict[str, EnvironmentMap] = {}
        for name in sorted({name for record in self.records for name in record.relit_paths}):
            path = capture.folder / "truth" / f"{name}.exr"
            if path.exists():
                self._lights[name] = EnvironmentMap.read(path)

    def score(self, cloud: GaussianCloud, found: Materials) -> Row:
        """Return means over views of every channel.

        ``psnr`` and ``ssim`` are of the subject's box as drawn, ``solid_psnr`` where the truth is solid, and
        ``true_coverage_psnr`` of the box with the truth's coverage in place of ours: what silhouettes cost is the
        Gaussians', not the materials'. Colours are encoded as sRGB; unscaled, and in ``base_color_scaled`` times the
        one scale per channel that is best over all views, which is ``scale``.
        """
        scores: dict[str, list[Score]] = {}
        covered: dict[str, list[float]] = {}
        scaled: list[Any] = []
        sums = np.zeros((2, 3))
        for record, truth in zip(self.records, self._truths, strict=True):
            camera = record.camera.supersampled(self.samples)
            columns = np.concatenate([found.base_color, found.ambient_occlusion[:, None]], axis=1, dtype=np.float32)
            drawn = rasterize_values(cloud, camera, columns, options=self.raster, device=self.device)
            alpha = block_means(drawn.alpha, self.samples)
            means = block_means(drawn.values, self.samples) / np.maximum(alpha, 1e-6)[..., None]
            true_alpha = truth.channels["A"]
            exact = {
                "base_color": truth.stack("base_color.R", "base_color.G", "base_color.B"),
                "ambient_occlusion": truth.stack("ambient_occlusion")[..., 0],
            }
            for name, image in (("base_color", means[..., :3]), ("ambient_occlusion", means[..., 3])):
                how: dict[str, Any] = {"truth_alpha": true_alpha, "premultiplied": False}
                how["is_color"] = name == "base_color"
                scores.setdefault(name, []).append(compare(image, exact[name], alpha=alpha, **how))
                covered.setdefault(name, []).append(compare(image, exact[name], alpha=true_alpha, **how).psnr)
            solid = true_alpha > SOLID_ALPHA
            ours, theirs = means[solid][:, :3].astype(np.float64), exact["base_color"][solid].astype(np.float64)
            sums += ((ours * theirs).sum(axis=0), (ours * ours).sum(axis=0))
            scaled.append((means[..., :3], exact["base_color"], alpha, true_alpha))
        scale = sums[0] / np.maximum(sums[1], 1e-12)
        scores["base_color_scaled"] = [
            compare(image * scale, truth, alpha=alpha, truth_alpha=true_alpha, is_color=True, premultiplied=False)
            for image, truth, alpha, true_alpha in scaled
        ]
        result: Row = mean_scores(scores)
        for name, values in covered.items():
            result[name]["true_coverage_psnr"] = float(np.mean(values))
        result["base_color"]["scale"] = scale.tolist()
        result["views"] = len(self.records)
        return result

    def score_relit(self, cloud: GaussianCloud, found: Materials, relighter: Relighter) -> Row:
        """Return means over views of PSNR and SSIM under every light that the truth has, nothing scaled."""
        lit = relightable(cloud, found)
        renderer = relighter(self.raster, self.samples, self.device)
        result: Row = {}
        for name, light in self._lights.items():
            shown = [
                (record.camera, truth.channels["A"], read_image(record.relit_paths[name]).linear_rgba()[..., :3])
                for record, truth in zip(self.records, self._truths, strict=True)
                if name in record.relit_paths
            ]
            images = [renderer.draw(Shot(cloud=lit, camera=camera, environment=light)) for camera, _, _ in shown]
            scores = [
                compare(image.rgb, exact, alpha=image.alpha, truth_alpha=true_alpha, is_color=True, premultiplied=True)
                for image, (_, true_alpha, exact) in zip(images, shown, strict=True)
            ]
            result[name] = mean_scores({name: scores})[name]
        if result:
            result["mean"] = {key: float(np.mean([row[key] for row in result.values()])) for key in ("psnr", "ssim")}
        return result


def relightable(cloud: GaussianCloud, found: Materials) -> GaussianCloud:
    """Return a cloud that can be relit; normals and roughness where they are given, else the cloud's own."""
    count = len(cloud)
    return cloud.with_arrays(
        base_color=np.clip(found.base_color, 0.0, 1.0).astype(np.float32),
        ambient_occlusion=np.clip(found.ambient_occlusion, 0.0, 1.0).astype(np.float32),
        roughness=np.full(count, 0.5, np.float32) if found.roughness is None else found.roughness,
        normals=cloud.normals if found.normals is None else found.normals,
    )


@dataclass(frozen=True, eq=False)
class PerfectFrame:
    """Gaussians on the true surface of a frame, with all that measuring their materials asks for.

    Attributes:
        capture: Where the truth is from.
        frame: Its number.
        cloud: Gaussians with normals and radiance of degree 0, solved from the training images.
        scene: The same, uploaded.
        views: The training views.
        evidence: What they show, at the points that they see.
    """

    capture: Capture
    frame: int
    cloud: GaussianCloud
    scene: Scene
    views: Sequence[CapturedView]
    evidence: ViewEvidence

    @classmethod
    def of(cls, capture: Capture, frame: int, count: int, device: Any) -> PerfectFrame:
        """Sample the truth's mesh, and solve colours from the training images."""
        cloud, views = surface_of_capture(capture, frame, count, options=SHARP, device=str(device))
        evidence = view_evidence(cloud, [v.camera for v in views], views, options=SHARP, device=str(device))
        return cls(capture, frame, cloud, Scene.from_gaussians(cloud, str(device)), views, evidence)

    def points(self, offset: Any = "auto", *, exact: bool = True) -> SurfacePoints:
        """Return the Gaussians' own points and normals, which are the mesh's, or those that views see."""
        if not exact:
            return SurfacePoints.seen_by(self.cloud, self.evidence, self.scene, offset)
        assert self.cloud.normals is not None
        device = self.scene.device
        evidence = replace(
            self.evidence,
            positions=wp.array(self.cloud.positions, dtype=wp.vec3, device=device),
            normals=wp.array(self.cloud.normals, dtype=wp.vec3, device=device),
            agreement=wp.full(len(self.cloud), 1.0, dtype=float, device=device),
        )
        return replace(SurfacePoints.seen_by(self.cloud, evidence, self.scene, offset), normals=evidence.normals)

    def images_spread_back(self) -> ViewEvidence:
        """Return what views show if images are spread back as they are."""
        cameras, device = [view.camera for view in self.views], str(self.scene.device)
        return view_evidence(without_color(self.cloud), cameras, self.views, options=SHARP, device=device)

    def true_roughness(self, device: Any) -> NDArray[np.float32]:
        """Return the truth's roughness as its test views show it; the nearest neighbour's where they do not."""
        records = [r for r in self.capture.select(split="test", frames=[self.frame]) if r.truth_path is not None]
        return np.clip(shown_by_truth(self.cloud, records, ("roughness",), device)[:, 0], 0.05, 1.0)


def shown_by_truth(
    cloud: GaussianCloud, records: Sequence[CaptureRecord], names: Sequence[str], device: Any
) -> NDArray[np.float32]:
    """Return what exact channels of some views, one or three, say of every Gaussian, ``(N, 3)`` in [0, 1]."""
    shown = []
    for record in records:
        truth = record.truth()
        values = np.broadcast_to(truth.stack(*names), (*truth.channels["A"].shape, 3))
        shown.append(
            CapturedView(
                name=record.name,
                camera=record.camera,
                color=(values * truth.channels["A"][..., None]).astype(np.float32),
                alpha=np.clip(truth.channels["A"], 0.0, 1.0).astype(np.float32),
            )
        )
    fitted = colored_by_views(cloud, shown, options=SHARP, device=str(device)).radiance
    assert fitted is not None
    return np.clip(0.5 + SH_C0 * fitted[:, 0], 0.0, 1.0)


def true_cloud(capture: Capture, frame: int, count: int, device: Any) -> GaussianCloud:
    """Return relightable Gaussians on the true surface with the materials that the truth of the test views shows."""
    mesh = read_truth_mesh(capture, frame)
    cloud = gaussians_on_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), count)
    records = [r for r in capture.select(split="test", frames=[frame]) if r.truth_path is not None]
    return cloud.with_arrays(
        base_color=shown_by_truth(cloud, records, ("base_color.R", "base_color.G", "base_color.B"), device),
        roughness=shown_by_truth(cloud, records, ("roughness",), device)[:, 0],
        ambient_occlusion=shown_by_truth(cloud, records, ("ambient_occlusion",), device)[:, 0],
    )


@dataclass(frozen=True, eq=False)
class LightReference:
    """Irradiance over pi at some points, by many rays, ``(P, 3)``, its standard error, and what is in rays' way."""

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    tracing: TraceOptions
    value: NDArray[np.float64]
    standard_error: NDArray[np.float64]


def light_reference(
    scene: Scene, points: SurfacePoints, rows: NDArray[np.int64], light: PreparedEnvironment, rays: int
) -> LightReference:
    """Trace many rays, half by the cosine, half by the light, from lifted points and past as much as measuring does."""
    normals = points.normals.numpy()[rows]
    lifted = (points.positions.numpy()[rows] + normals * points.offsets.numpy()[rows, None]).astype(np.float32)
    how: Row = {"density": "mis", "ratio": True, "offset": 0.0, "options": points.tracing, "seed": REFERENCE_SEED}
    found = irradiance(scene, lifted, normals, light, sample_count=rays, **how)
    return LightReference(
        lifted, normals, points.tracing, found.value.astype(np.float64), found.standard_error.astype(np.float64)
    )


def light_errors(scene: Scene, reference: LightReference, light: PreparedEnvironment, **how: Any) -> Row:
    """Return relative errors of irradiance estimated with the options given.

    ``relative_rmse`` is relative to the irradiance at each point, or to a twentieth of its mean where it is less;
    ``rmse_over_mean`` to the mean.
    """
    how |= {"offset": 0.0, "options": reference.tracing}
    found = irradiance(scene, reference.points, reference.normals, light, **how)
    difference = np.float64(found.value) - reference.value
    mean = reference.value.mean()
    floor = np.maximum(reference.value, 0.05 * mean)
    return {
        "relative_rmse": root_mean_square(difference / floor),
        "rmse_over_mean": root_mean_square(difference) / mean,
        "relative_bias": float((difference / floor).mean()),
        "reference_relative_standard_error": root_mean_square(reference.standard_error / floor),
    }


def row_of(scores: Mapping[str, Any]) -> str:
    """Return a row's scores in a line."""
    color, openness = scores["base_color"], scores["ambient_occlusion"]
    scale = ", ".join(f"{value:.3f}" for value in color["scale"])
    return (
        f"AO {openness['psnr']:.2f} dB / {openness['ssim']:.3f}, base colour {color['psnr']:.2f} dB / "
        f"{color['ssim']:.3f}, scale {scale}"
    )
