"""Path-traced truth for meshes: what a camera sees under an environment, and what radiance surface points send out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_count, require_finite, require_range, require_same_length
from beam_warp.device.arrays import resolve_device, upload, zero_struct
from beam_warp.errors import InvalidArrayError
from beam_warp.kernels.mesh.channels import MeshChannels, launch_trace_channels
from beam_warp.kernels.mesh.paths import LitMesh, launch_trace_outgoing, launch_trace_pixels, lit_mesh
from beam_warp.kernels.mesh.surface import MeshSurface
from beam_warp.light.ggx import specular_albedo_table
from beam_warp.light.sampled import environment_distribution
from beam_warp.trace.camera_rays import pixel_rays
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.mesh import MaterialMesh

MOST_SAMPLES = 2**20
MOST_BOUNCES = 64


@dataclass(frozen=True, eq=False)
class TracedMesh:
    """A mesh and its bounding volume hierarchy on a device; build it once, trace it often.

    Attributes:
        surface: What kernels read.
        device: Where it is.
        face_count: Number of triangles.
    """

    surface: MeshSurface
    device: Any
    face_count: int
    _mesh: wp.Mesh

    @classmethod
    def from_mesh(cls, mesh: MaterialMesh, *, device: str | None = None) -> TracedMesh:
        """Upload a mesh; ``device`` None takes the first CUDA device, or the CPU where there is none.

        Raises:
            DeviceError: There is no such device.
        """
        target = resolve_device(device)
        surface = mesh_surface(mesh, target)
        tree = wp.Mesh(surface.points, upload(mesh.faces.reshape(-1), int, target))
        surface.mesh = tree.id
        return cls(surface, target, len(mesh.faces), tree)


def mesh_surface(mesh: MaterialMesh, device: Any, origin: ArrayLike = (0.0, 0.0, 0.0)) -> MeshSurface:
    """Upload a mesh for kernels, its vertices relative to ``origin`` [m], without a hierarchy."""
    surface = MeshSurface()
    vertices = mesh.vertices.astype(np.float64) - np.asarray(origin, np.float64)
    surface.points = upload(vertices.astype(np.float32), wp.vec3, device)
    surface.faces = upload(mesh.faces, wp.vec3i, device)
    surface.normals = upload(mesh.normals, wp.vec3, device)
    surface.base_color = upload(mesh.base_color, wp.vec3, device)
    surface.roughness = upload(mesh.roughness, float, device)
    return surface


@dataclass(frozen=True, eq=False)
class TracedRadiance:
    """What a camera sees.

    Attributes:
        rgb: Scene-linear Rec.709 radiance, premultiplied by coverage; the environment itself is not seen,
            ``(H, W, 3)`` float32.
        alpha: Coverage in [0, 1], ``(H, W)`` float32.
    """

    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TracedChannels:
    """Means over the covered part of each pixel, not multiplied by coverage; 0 where nothing is.

    Attributes:
        base_color: Scene-linear Rec.709, ``(H, W, 3)`` float32.
        roughness: ``(H, W)`` float32.
        normals: Unit world vectors, ``(H, W, 3)`` float32.
        depth: Along the optical axis [m], ``(H, W)`` float32.
        ambient_occlusion: Cosine-weighted visibility to infinity, 1 is open, ``(H, W)`` float32.
    """

    base_color: NDArray[np.float32]
    roughness: NDArray[np.float32]
    normals: NDArray[np.float32]
    depth: NDArray[np.float32]
    ambient_occlusion: NDArray[np.float32]


def trace_radiance(
    mesh: TracedMesh,
    camera: Camera,
    environment: EnvironmentMap,
    *,
    sample_count: int = 64,
    bounce_count: int = 4,
    seed: int = 0,
) -> TracedRadiance:
    """Path trace an image, with a box pixel filter.

    Args:
        mesh: What is seen.
        camera: Who sees it.
        environment: The light.
        sample_count: Paths per pixel; a power of two is best.
        bounce_count: How often light may be scattered before its last scattering; 0 is direct light.
        seed: Same seed, same device, same bits. The pixel positions are those of `trace_channels`.

    Returns:
        Radiance and coverage.

    Raises:
        InvalidOptionError: A count or the seed is out of range.
    """
    _require_counts(sample_count, bounce_count, seed)
    pixels = camera.width * camera.height
    rgb = wp.zeros(pixels, dtype=wp.vec3, device=mesh.device)
    alpha = wp.zeros(pixels, dtype=float, device=mesh.device)
    launch_trace_pixels(_lit(mesh, environment), pixel_rays(camera), seed, sample_count, bounce_count, rgb, alpha)
    shape = (camera.height, camera.width)
    return TracedRadiance(rgb.numpy().reshape(*shape, 3), alpha.numpy().reshape(shape))


def trace_channels(
    mesh: TracedMesh, camera: Camera, *, sample_count: int = 16, visibility_count: int = 8, seed: int = 0
) -> TracedChannels:
    """Trace what a pixel sees besides light.

    Args:
        mesh: What is seen.
        camera: Who sees it.
        sample_count: Points per pixel.
        visibility_count: Rays per point for ambient occlusion.
        seed: Same seed, same device, same bits.

    Returns:
        Material, normal, depth and ambient occlusion.

    Raises:
        InvalidOptionError: A count or the seed is out of range.
    """
    require_count("sample_count", sample_count, 1, MOST_SAMPLES)
    require_count("visibility_count", visibility_count, 1, MOST_SAMPLES // sample_count)
    require_count("seed", seed, 0, 2**32 - 1)
    pixels = camera.width * camera.height
    channels = zero_struct(MeshChannels, pixels, mesh.device)
    launch_trace_channels(mesh.surface, pixel_rays(camera), seed, sample_count, visibility_count, channels)
    shape = (camera.height, camera.width)
    return TracedChannels(
        base_color=channels.base_color.numpy().reshape(*shape, 3),
        roughness=channels.roughness.numpy().reshape(shape),
        normals=channels.normal.numpy().reshape(*shape, 3),
        depth=channels.depth.numpy().reshape(shape),
        ambient_occlusion=channels.ambient_occlusion.numpy().reshape(shape),
    )


def outgoing_radiance(
    mesh: TracedMesh,
    faces: ArrayLike,
    weights: ArrayLike,
    directions: ArrayLike,
    environment: EnvironmentMap,
    *,
    sample_count: int = 16,
    bounce_count: int = 4,
    seed: int = 0,
) -> NDArray[np.float32]:
    """Path trace the radiance that leaves surface points.

    Args:
        mesh: The surface.
        faces: The triangle of each point, ``(N,)``.
        weights: Barycentric weights of its corners, ``(N, 3)``.
        directions: Unit world directions away from the surface, ``(N, D, 3)``; a direction below the surface gets the
            radiance of the grazing one.
        environment: The light.
        sample_count: Paths per point and direction; D × sample_count a power of two is best.
        bounce_count: See `trace_radiance`.
        seed: Same seed, same device, same bits.

    Returns:
        Scene-linear Rec.709, ``(N, D, 3)`` float32.

    Raises:
        InvalidArrayError: An array breaks its contract.
        InvalidOptionError: A count or the seed is out of range.
    """
    _require_counts(sample_count, bounce_count, seed)
    where = require_array("faces", faces, (None,), np.int32)
    require_range("faces", where, 0, mesh.face_count - 1, "Index existing triangles.")
    corner_weights = require_array("weights", weights, (None, 3))
    require_same_length("weights", corner_weights, "faces", len(where))
    require_range("weights", corner_weights, -1e-5, 1.0 + 1e-5, "Pass barycentric weights.")
    away = require_array("directions", directions, (None, None, 3))
    require_same_length("directions", away, "faces", len(where))
    require_finite("directions", away)
    if len(where) and not np.abs(np.linalg.norm(away, axis=-1) - 1.0).max(initial=0.0) <= 1e-3:
        raise InvalidArrayError("directions must have unit length, got other lengths. Normalise them.")
    out = wp.zeros(away.shape[:2], dtype=wp.vec3, device=mesh.device)
    launch_trace_outgoing(
        _lit(mesh, environment),
        upload(where, int, mesh.device),
        upload(corner_weights, wp.vec3, mesh.device),
        upload(away, wp.vec3, mesh.device),
        seed,
        sample_count,
        bounce_count,
        out,
    )
    return out.numpy()


def _require_counts(sample_count: int, bounce_count: int, seed: int) -> None:
    """Check what every tracing of paths takes."""
    require_count("sample_count", sample_count, 1, MOST_SAMPLES)
    require_count("bounce_count", bounce_count, 0, MOST_BOUNCES)
    require_count("seed", seed, 0, 2**32 - 1)


def _lit(mesh: TracedMesh, environment: EnvironmentMap) -> LitMesh:
    """Put a mesh and its light together for kernels."""
    distribution = environment_distribution(environment, mesh.device)
    return lit_mesh(mesh.surface, distribution, upload(specular_albedo_table(), wp.vec2, mesh.device))
