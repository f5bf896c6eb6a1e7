"""Shapes tiled with flat Gaussians, for tests with closed forms; used by several test files."""

import numpy as np

from beam_warp.image.color import LINEAR_REC709, linear_to_srgb
from beam_warp.world.directions import even_directions
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0
from beam_warp.world.quaternions import turns_from_z


def tiles(points, normals, spacing, *, flatness=0.1, opacity=0.95):
    """One Gaussian per point: tangential deviation 0.65 spacing, so that the surface is closed."""
    count = len(points)
    return {
        "positions": np.asarray(points),
        "orientations": turns_from_z(normals),
        "scales": np.tile([0.65 * spacing, 0.65 * spacing, 0.65 * spacing * flatness], (count, 1)),
        "opacities": np.full(count, opacity),
    }


def cloud_of(*parts, **fields):
    return GaussianCloud(**{k: np.concatenate([p[k] for p in parts]) for k in parts[0]}, **fields)


def colored(cloud, linear, color_space=LINEAR_REC709):
    """The cloud with one captured colour for each Gaussian, ``(N, 3)`` scene-linear, whatever it is stored in."""
    color = np.asarray(linear if color_space == LINEAR_REC709 else linear_to_srgb(linear))
    return cloud.with_arrays(
        radiance=((color - 0.5) / SH_C0)[:, None, :].astype(np.float32), radiance_color_space=color_space
    )


def sphere_points(count):
    """Spherical Fibonacci set and its spacing on the unit sphere."""
    return even_directions(count), np.sqrt(4.0 * np.pi / count)


def disc_points(radius, spacing):
    """Sunflower set on a disc in the plane z = 0."""
    count = int(np.pi * radius**2 / spacing**2)
    i = np.arange(count) + 0.5
    r = radius * np.sqrt(i / count)
    phi = np.pi * (1.0 + np.sqrt(5.0)) * i
    return np.stack([r * np.cos(phi), r * np.sin(phi), np.zeros(count)], axis=1)


def random_cloud(rng, count, *, scale=(-3.5, 0.8), opacity=(0.0, 1.0)):
    q = rng.normal(size=(count, 4))
    return GaussianCloud(
        positions=rng.uniform(-1.0, 1.0, (count, 3)),
        orientations=q / np.linalg.norm(q, axis=1, keepdims=True),
        scales=np.exp(rng.normal(*scale, (count, 3))),
        opacities=rng.uniform(*opacity, count),
    )


def aligned(positions, opacities=0.5, scales=0.1, **fields):
    """Gaussians whose axes are the world's."""
    count = len(positions)
    return GaussianCloud(
        positions=positions,
        orientations=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        scales=np.broadcast_to(scales, (count, 3)),
        opacities=np.broadcast_to(opacities, count),
        **fields,
    )


def one_gaussian(opacity=0.7, scales=(0.1, 0.2, 0.3), orientation=(0.0, 0.0, 0.0, 1.0), **fields):
    """A Gaussian at the origin."""
    return GaussianCloud(
        positions=[[0, 0, 0]], orientations=[orientation], scales=[scales], opacities=[opacity], **fields
    )


def along_x(y=0.0, z=0.0, x=-2.0, count=1):
    """Origins and directions of equal rays along +x."""
    return np.tile([[x, y, z]], (count, 1)), np.tile([[1.0, 0.0, 0.0]], (count, 1))


def unit(vectors):
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def random_rays(rng, count):
    d = rng.normal(size=(count, 3))
    return rng.uniform(-1.0, 1.0, (count, 3)).astype(np.float32), unit(d)
