"""Relighting by rays from every Gaussian: cast shadows, light between surfaces, occluded highlights.

The way of decomposition taken backwards: light is gathered once per Gaussian, where views show the surface; what it
sends towards each camera is base colour times diffuse residue, plus the specular one; the rasteriser blends that.
Shadows are as fine as the Gaussians are. Nothing but the specular part depends on the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from beam_warp.checks import require_count
from beam_warp.device.arrays import upload
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.kernels.materials.residues import Observations, launch_trace_bounce
from beam_warp.light.ggx import DIELECTRIC_F0, specular_albedo_table
from beam_warp.light.prepared import MaterialLight
from beam_warp.materials.direct import LitPoints, MaterialOptions, light_batches, make_points, without_report
from beam_warp.materials.evidence import view_evidence
from beam_warp.materials.normals import SurfacePoints
from beam_warp.raster.records import RasterOptions
from beam_warp.trace.rays import ray_batches
from beam_warp.trace.scene import Scene
from beam_warp.trace.transmittance import EXACT
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

SURROUNDING = 32
"""Cameras around the subject that together see what can be seen of it."""

SURROUNDING_SIDE = 384
"""Their images' height and width [pixel]: a Gaussian of 5 mm on a subject of 2 m is as large as a pixel."""

GOLDEN_ANGLE = 180.0 * (3.0 - 5.0**0.5)


@dataclass(frozen=True, kw_only=True)
class TraceOptions:
    """How light is gathered.

    Attributes:
        sample_count: Rays per Gaussian towards the light.
        bounces: How often light goes from surface to surface; 0 for none.
        seed: Same seed, same device, same bits.

    Raises:
        InvalidOptionError: An option is out of range.
    """

    sample_count: int = 128
    bounces: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every option once."""
        require_count("sample_count", self.sample_count, 4, 4096)
        require_count("bounces", self.bounces, 0, 16)


def traced_radiance(
    cloud: GaussianCloud,
    light: MaterialLight,
    cameras: Sequence[Camera],
    *,
    raster: RasterOptions | None = None,
    options: TraceOptions | None = None,
) -> NDArray[np.float32]:
    """Return the radiance that every Gaussian sends towards each camera, scene-linear Rec.709, ``(V, N, 3)``.

    Args:
        cloud: Relightable Gaussians, axes "rfu": base colour, roughness and normals.
        light: The environment, on the device that does the work.
        cameras: At least one.
        raster: How splats are drawn: as they were fitted.
        options: See `TraceOptions`.

    Raises:
        InvalidArrayError: The cloud lacks a material.

    Source: BEAM Eqs. 3 to 5, forwards; ratio estimator, Heitz et al. 2018.
    """
    chosen = options or TraceOptions()
    for name in ("base_color", "roughness", "normals"):
        if getattr(cloud, name) is None:
            raise InvalidArrayError(f"{name} must be given to relight, got None. Decompose the Gaussians first.")
    assert cloud.base_color is not None
    assert cloud.roughness is not None
    scene = Scene.from_gaussians(cloud, str(light.device))
    points = _points(cloud, scene, cameras, raster)
    rows = np.flatnonzero(points.seen)
    measured = _towards(cloud, points, rows, cameras, light)
    material = MaterialOptions(sample_count=chosen.sample_count, bounce=False, seed=chosen.seed)
    lit = measured.without_views()
    for _ in light_batches(scene, points, light, lit, material, None, 0, without_report):
        pass
    reflectance = cloud.base_color[rows] * (1.0 - _mean_albedo(cloud.roughness[rows]))[:, None]
    reflectance += _mean_albedo(cloud.roughness[rows])[:, None]
    arriving = lit.light.arriving.numpy()
    bounced = np.zeros_like(arriving)
    for bounce in range(chosen.bounces):
        sent = np.zeros((len(cloud), 3), np.float32)
        sent[rows] = reflectance * (arriving + bounced)
        sent[~points.seen] = _nearest(cloud, rows, sent[rows])
        bounced = _gather(scene, points, rows, sent, chosen, bounce)
    measured.light.bounce.assign(bounced)
    for _ in light_batches(scene, points, light, measured, material, None, 0, without_report):
        pass
    diffuse = (measured.light.arriving.numpy() + bounced) * cloud.base_color[rows]
    result = np.empty((len(cameras), len(cloud), 3), np.float32)
    specular, share = measured.views.specular.numpy(), measured.views.diffuse_share.numpy()
    for view in range(len(cameras)):
        sent = diffuse * share[view][:, None] + specular[view]
        result[view, rows] = sent
        result[view, ~points.seen] = _nearest(cloud, rows, sent)
    return result


def _points(
    cloud: GaussianCloud, scene: Scene, cameras: Sequence[Camera], raster: RasterOptions | None
) -> SurfacePoints:
    """Find where the surface is seen, by the cameras and by others all around."""
    plain = cloud
    if cloud.radiance is None:
        plain = cloud.with_arrays(radiance=np.zeros((len(cloud), 1, 3), np.float32), radiance_color_space=LINEAR_REC709)
    around = [
        Camera.frame_cloud(
            cloud.positions,
            cloud.opacities,
            azimuth=float((GOLDEN_ANGLE * k) % 360.0),
            elevation=float(np.degrees(np.arcsin(1.0 - (2.0 * k + 1.0) / SURROUNDING))),
            width=SURROUNDING_SIDE,
            height=SURROUNDING_SIDE,
        )
        for k in range(SURROUNDING)
    ]
    evidence = view_evidence(plain, [*around, *cameras], options=raster, device=str(scene.device))
    found = SurfacePoints.seen_by(cloud, evidence, scene)
    assert cloud.normals is not None
    return replace(found, normals=upload(cloud.normals, wp.vec3, scene.device))


def _towards(
    cloud: GaussianCloud,
    points: SurfacePoints,
    rows: NDArray[np.int64],
    cameras: Sequence[Camera],
    light: MaterialLight,
) -> LitPoints:
    """Make room for what points send towards cameras."""
    assert cloud.roughness is not None
    at = cloud.positions[rows]
    toward = np.stack([camera.position for camera in cameras])[:, None] - at
    toward /= np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-12)
    views = Observations()
    views.colors = wp.full((len(cameras), len(rows)), wp.vec4(0.0, 0.0, 0.0, 1.0), dtype=wp.vec4, device=light.device)
    views.directions = upload(toward.astype(np.float32), wp.vec3, light.device)
    return make_points(points, cloud.roughness, light, rows, views)


def _gather(
    scene: Scene,
    points: SurfacePoints,
    rows: NDArray[np.int64],
    sent: NDArray[np.float32],
    options: TraceOptions,
    bounce: int,
) -> NDArray[np.float32]:
    """Return the irradiance over pi from what surfaces send, ``(M, 3)``; every bounce has rays of its own."""
    device = scene.device
    at = upload(rows.astype(np.int32), int, device)
    radiance = upload(sent, wp.vec3, device)
    result = wp.zeros(len(rows), dtype=wp.vec3, device=device)
    for batch in ray_batches(
        scene,
        points.positions[at].contiguous(),
        points.normals[at].contiguous(),
        points.offsets[at].contiguous(),
        options.sample_count,
    ):
        launch_trace_bounce(
            scene,
            EXACT.settings(scene),
            batch,
            radiance,
            (options.seed, bounce),
            max(options.sample_count // 2, 2),
            result,
        )
    return result.numpy()


def _mean_albedo(roughness: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the share of diffuse light that the specular lobe reflects: its directional albedo, cosine-weighted."""
    table = specular_albedo_table()
    root = np.linspace(0.0, 1.0, table.shape[1])  # columns are square roots of n.v
    weight = 4.0 * root**3  # 2 (n.v) d(n.v)
    albedo = DIELECTRIC_F0 * table[..., 0] + table[..., 1]
    mean = (albedo * weight).sum(axis=1) / weight.sum()
    return np.interp(roughness, np.linspace(0.0, 1.0, table.shape[0]), mean)


def _nearest(cloud: GaussianCloud, rows: NDArray[np.int64], values: NDArray[Any]) -> NDArray[Any]:
    """Return the values of the seen Gaussians that are nearest to the unseen ones."""
    unseen = np.ones(len(cloud), bool)
    unseen[rows] = False
    if not len(rows) or not unseen.any():
        return np.zeros((int(unseen.sum()), values.shape[1]), values.dtype)
    return values[cKDTree(cloud.positions[rows]).query(cloud.positions[unseen], workers=-1)[1]]
