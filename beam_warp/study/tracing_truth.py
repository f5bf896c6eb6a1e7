"""What the tracing study compares with: points on the Gaussians, and their occlusion and light by many rays."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.device.arrays import upload
from beam_warp.digests import code_digest
from beam_warp.errors import InvalidArrayError
from beam_warp.image.files import replacing
from beam_warp.jobs.listeners import StageProgress, no_progress
from beam_warp.kernels.trace.surface_rays import launch_local_surface
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.normals import estimate_normals
from beam_warp.study.tracing_plan import TracingPlan, parse_offset
from beam_warp.trace.incident import irradiance
from beam_warp.trace.occlusion import ambient_occlusion
from beam_warp.trace.rays import LIFT_IN_THICKNESSES
from beam_warp.trace.scene import Scene
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud

POINTS = {False: 128, True: 4096}
"""Points on a CPU and on CUDA. The interval of an error narrows with their root; 128 give about ± 10 %."""

BLOCK = {False: 16, True: 1024}
"""Points whose references are traced at a time: time is looked at after each block."""

SEED = 1 << 31
"""References draw other samples than every measurement, whose seeds count up from 0."""


@dataclass(frozen=True, eq=False)
class References:
    """Points and the truth at each, P points.

    Attributes:
        points: Positions [m], ``(P, 3)``.
        normals: Unit normals, ``(P, 3)``.
        surface: Height of the local surface over the point, and its thickness, along the normal [m], ``(P, 2)``.
        occlusion: Ambient occlusion at every offset of the plan, ``(offsets, P)``.
        occlusion_error: Its standard error.
        light: Irradiance over pi at the first offset, ``(P, 3)``.
        light_error: Its standard error.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    surface: NDArray[np.float32]
    occlusion: NDArray[np.float32]
    occlusion_error: NDArray[np.float32]
    light: NDArray[np.float32]
    light_error: NDArray[np.float32]

    def lift_lengths(self, offset: str) -> NDArray[np.float32]:
        """Return how far over its Gaussian's centre each ray starts [m], ``(P,)``."""
        kind, number = parse_offset(offset)
        if kind == "metres":
            return np.full(len(self.points), number, np.float32)
        thicknesses = LIFT_IN_THICKNESSES if kind == "auto" else number
        return (self.surface[:, 0] + thicknesses * self.surface[:, 1]).astype(np.float32)

    def lifted(self, offset: str) -> tuple[NDArray[np.float32], float | Literal["auto"]]:
        """Return points and the offset to pass on with them: multiples of the thickness are applied to the points."""
        kind, number = parse_offset(offset)
        if kind == "auto":
            return self.points, "auto"
        if kind == "metres":
            return self.points, number
        return (self.points + self.normals * self.lift_lengths(offset)[:, None]).astype(np.float32), 0.0


def find_references(
    cloud: GaussianCloud,
    environment: EnvironmentMap,
    plan: TracingPlan,
    scene: Scene,
    *,
    file: Path | None = None,
    seconds: float = np.inf,
    progress: StageProgress = no_progress,
) -> References:
    """Choose points and trace their references, or take them from an earlier run's file if nothing has changed.

    Args:
        cloud: Gaussians; their normals are used if they have some.
        environment: Light of the irradiance.
        plan: Offsets, rays of the references, number of points.
        scene: The same Gaussians, uploaded; references are traced with its tree.
        file: Where references are kept; None keeps none.
        seconds: Fewer points are taken where the planned number would take longer; at least one block.
        progress: Called with (stage, done, total).

    Raises:
        InvalidArrayError: Fewer than two Gaussians can be seen.
        OutputError: The file cannot be written.
    """
    fingerprint = _fingerprint(cloud, environment, plan, scene)
    kept = _load(file, fingerprint) if file is not None else None
    if kept is not None:
        return kept
    seen = np.flatnonzero(cloud.opacities > 1.0 / 255.0)
    if len(seen) < 2:
        raise InvalidArrayError(
            f"scene must hold at least 2 Gaussians of opacity above 1/255, got {len(seen)}. Give another file."
        )
    normals = cloud.normals
    if normals is None:
        normals = estimate_normals(cloud, scene, progress=lambda done, total: progress("normals", done, total)).normals
    number = min(plan.points or POINTS[scene.device.is_cuda], len(seen))
    chosen = np.random.default_rng(plan.seed).permutation(seen)[:number]
    light = PreparedEnvironment(environment, scene.device)
    started, blocks = time.perf_counter(), []
    for start in range(0, number, BLOCK[scene.device.is_cuda]):
        rows = chosen[start : start + BLOCK[scene.device.is_cuda]]
        blocks.append(_trace_block(cloud.positions[rows], normals[rows], light, plan, scene, len(blocks)))
        done = min(start + len(rows), number)
        progress("references", done, number)
        spent = time.perf_counter() - started
        if spent + spent / done * len(rows) > seconds:
            break
    found = References(
        **{
            field.name: np.concatenate(
                [getattr(block, field.name) for block in blocks], axis=1 if field.name.startswith("occlusion") else 0
            )
            for field in fields(References)
        }
    )
    if file is not None:
        with replacing(file) as temporary, temporary.open("wb") as stream:
            np.savez(stream, fingerprint=np.array(fingerprint), **vars(found))
    return found


def _trace_block(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    light: PreparedEnvironment,
    plan: TracingPlan,
    scene: Scene,
    number: int,
) -> References:
    """Trace the references of some points; blocks differ in the frame, so that their samples differ."""
    surface = wp.empty(len(points), dtype=wp.vec2, device=scene.device)
    at, up = upload(points, wp.vec3, scene.device), upload(normals, wp.vec3, scene.device)
    launch_local_surface(len(at), scene.occluders, at, up, surface, scene.device)
    nothing = np.zeros((0, len(points)), np.float32)
    bare = References(points, normals, surface.numpy(), nothing, nothing, points, points)
    common: dict[str, Any] = {"sample_count": plan.reference_rays, "seed": SEED, "frame": number}
    occlusion = []
    for offset in plan.offsets:
        origins, lift = bare.lifted(offset)
        occlusion.append(ambient_occlusion(scene, origins, normals, offset=lift, **common))
    origins, lift = bare.lifted(plan.offsets[0])
    # The ratio's bias falls with the number of rays, its error with the root: of so many rays it is nothing
    arriving = irradiance(scene, origins, normals, light, offset=lift, density="mis", ratio=True, **common)
    return References(
        points,
        normals,
        bare.surface,
        np.stack([each.visibility for each in occlusion]),
        np.stack([each.standard_error for each in occlusion]),
        arriving.value,
        arriving.standard_error,
    )


def _fingerprint(cloud: GaussianCloud, environment: EnvironmentMap, plan: TracingPlan, scene: Scene) -> str:
    """Return a digest of everything that references depend on."""
    digest = hashlib.sha256()
    for array in (cloud.positions, cloud.orientations, cloud.scales, cloud.opacities, cloud.normals):
        digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    digest.update(environment.radiance.tobytes())
    chosen = (plan.offsets, plan.reference_rays, plan.points, plan.seed)
    digest.update(repr((chosen, scene.device.name, scene.device.is_cuda, code_digest())).encode())
    return digest.hexdigest()


def _load(file: Path, fingerprint: str) -> References | None:
    """Return the references of a file, if it is one of ours and of the same fingerprint."""
    try:
        with np.load(file, allow_pickle=False) as stored:
            if str(stored["fingerprint"]) != fingerprint:
                return None
            return References(**{field.name: stored[field.name] for field in fields(References)})
    except (OSError, ValueError, KeyError, BadZipFile):
        return None  # absent, cut short or something else: trace them anew
