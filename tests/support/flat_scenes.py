"""Flat Gaussians and level squares of triangles with materials, and the BSDF in float64, for tests of renderers."""

import numpy as np

from beam_warp.light.ggx import DIELECTRIC_F0, ggx_distribution, schlick_weight, smith_lambda
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.quaternions import turns_from_z
from beam_warp.world.shot import ShotMesh

UP = np.array([0.0, 0.0, 1.0])


def discs(positions, normals, radius, *, color=1.0, roughness=1.0, openness=1.0, opacity=1.0):
    """Flat Gaussians; the rasteriser caps alpha at 0.99."""
    positions = np.atleast_2d(np.asarray(positions, np.float32))
    count = len(positions)
    n = np.broadcast_to(np.asarray(normals, float), (count, 3))
    return GaussianCloud(
        positions=positions,
        orientations=turns_from_z(n),
        scales=np.tile([radius, radius, 0.0], (count, 1)),
        opacities=np.full(count, opacity),
        base_color=np.broadcast_to(np.asarray(color, np.float32), (count, 3)),
        roughness=np.broadcast_to(np.float32(roughness), (count,)),
        ambient_occlusion=np.full(count, openness),
        normals=n,
    )


def nothing():
    return discs(np.zeros((0, 3)), np.zeros((0, 3)), 1.0)


def plate(z=0.0, half=3.0, x=0.0, *, catches=False, color=1.0, flip=False):
    """A level square, white and rough."""
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]]) + np.array([x, 0, 0])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    surface = MaterialMesh(
        vertices=corners,
        faces=faces[:, ::-1] if flip else faces,
        normals=np.tile(-UP if flip else UP, (4, 1)),
        base_color=np.full((4, 3), color),
        roughness=np.ones(4),
    )
    return ShotMesh(surface=surface, catches_shadows=np.full(2, catches))


def mesh_of(*plates):
    """Several plates as one mesh."""
    parts = [part.surface for part in plates]
    rows = {
        n: np.concatenate([getattr(p, n) for p in parts]) for n in ("vertices", "normals", "base_color", "roughness")
    }
    faces = np.concatenate([part.faces + 4 * k for k, part in enumerate(parts)])
    caught = np.concatenate([part.catches_shadows for part in plates])
    return ShotMesh(surface=MaterialMesh(**rows, faces=faces.astype(np.int32)), catches_shadows=caught)


def brdf_twin(normal, view, light, roughness):
    """Float64: the dielectric GGX lobe, without the cosine."""
    n, v, d = (np.asarray(a, float) / np.linalg.norm(a, axis=-1, keepdims=True) for a in (normal, view, light))
    half = v + d
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    alpha = roughness**2
    n_l, n_v = (n * d).sum(-1), (n * v).sum(-1)
    shadowing = 1.0 / (1.0 + smith_lambda(n_l, alpha) + smith_lambda(n_v, alpha))
    fresnel = DIELECTRIC_F0 + (1.0 - DIELECTRIC_F0) * schlick_weight((v * half).sum(-1))
    return ggx_distribution((n * half).sum(-1), alpha) * shadowing * fresnel / (4.0 * n_l * n_v)
