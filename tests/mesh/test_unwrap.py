"""Texture coordinates: what unwrapping keeps, and the whole way from a painted texture to Gaussians."""

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.shapes import aligned, unit

from beam_warp.errors import InvalidArrayError, InvalidOptionError, MissingPackageError
from beam_warp.materials.roughness_source import texel_positions, textured_roughness
from beam_warp.mesh.files import write_mesh
from beam_warp.mesh.unwrap import unwrapped

RESOLUTION = 256


def ball(radius=0.5):
    return trimesh.creation.icosphere(subdivisions=3, radius=radius)


def double_areas(mesh):
    corners = np.asarray(mesh.visual.uv)[mesh.faces]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])


def test_surface_is_kept():
    mesh = ball()
    flat = unwrapped(mesh, resolution=RESOLUTION)
    assert np.array_equal(flat.triangles, mesh.triangles)
    assert np.array_equal(flat.vertex_normals[flat.faces], mesh.vertex_normals[mesh.faces])
    assert flat.visual.uv.min() >= 0.0
    assert flat.visual.uv.max() <= 1.0
    assert len(flat.vertices) > len(mesh.vertices)


def test_texels_of_a_square_are_at_their_centres():
    """Two triangles in the right half of 8 x 12 texels: each texel there is once or, on the diagonal, twice."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    square = trimesh.Trimesh(np.insert(corners, 2, 7.0, axis=1), [[0, 1, 2], [0, 2, 3]], process=False)
    square.visual = trimesh.visual.TextureVisuals(uv=0.5 * corners * [1.0, 2.0] + [[0.5, 0.0]])
    positions, texels = texel_positions(square, 12, 8)
    assert np.array_equal(np.unique(texels), np.arange(96).reshape(12, 8)[:, 4:].ravel())
    row, column = np.divmod(texels, 8)
    expected = np.stack([(column - 3.5) / 4, 1.0 - (row + 0.5) / 12, np.full(len(texels), 7.0)], axis=1)
    np.testing.assert_allclose(positions, expected, atol=1e-12)


def test_charts_do_not_overlap():
    """No texel's centre is in two triangles, but for those on edges, which neighbours share."""
    flat = unwrapped(ball(), resolution=RESOLUTION)
    _, texels = texel_positions(flat, RESOLUTION, RESOLUTION)
    _, uses = np.unique(texels, return_counts=True)
    assert len(texels) > 0.4 * RESOLUTION**2
    assert (uses > 1).mean() < 1e-3
    assert (double_areas(flat) > 0.0).all()


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_scale_and_place_do_not_matter(scale):
    mesh = ball()
    far = trimesh.Trimesh(mesh.vertices * scale + 100.0 * scale, mesh.faces, process=False)
    flat = unwrapped(far, resolution=RESOLUTION)
    assert len(flat.faces) == len(mesh.faces)
    # Charts cover about as much of the square whatever the mesh's size.
    assert 0.5 * double_areas(flat).sum() > 0.4


def stripes(points):
    """A roughness that depends on the place: bands a fifth of a metre wide."""
    return np.where(np.floor(points[:, 2] / 0.2) % 2 == 0, 51, 204)


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_painted_roughness_reaches_every_gaussian(suffix, tmp_path, rng):
    """Paint the texels of an unwrapped mesh by place; each Gaussian near the surface gets its own place's value.

    A texel's spacing on the ball is its share of the charts' area; the nearest valid texel is at most about one of
    them away, or one of the mesh's sagitta: Gaussians so near to a band's edge are left out.
    """
    flat = unwrapped(ball(), resolution=RESOLUTION)
    positions, texels = texel_positions(flat, RESOLUTION, RESOLUTION)
    image = np.full(RESOLUTION * RESOLUTION, 255, np.uint8)  # what no triangle covers is never read
    image[texels] = stripes(positions)
    Image.fromarray(image.reshape(RESOLUTION, RESOLUTION)).save(tmp_path / "roughness.png")
    write_mesh(flat, tmp_path / f"canonical.{suffix}")

    points = 0.5 * unit(rng.normal(size=(2000, 3)))
    spacing = np.sqrt(np.pi / len(texels))
    clear = np.abs(points[:, 2] / 0.2 - np.rint(points[:, 2] / 0.2)) * 0.2 > 3.0 * spacing
    points = points[clear]
    found = textured_roughness(aligned(points), tmp_path / "roughness.png", tmp_path / f"canonical.{suffix}")
    assert len(points) > 1000
    assert np.array_equal(np.rint(found * 255.0), stripes(points))


def test_bad_input(monkeypatch):
    with pytest.raises(InvalidArrayError, match="mesh must hold 1 to 2097152 triangles, got 0"):
        unwrapped(trimesh.Trimesh())
    with pytest.raises(InvalidOptionError, match="resolution must be an integer"):
        unwrapped(ball(), resolution=0)
    monkeypatch.setitem(__import__("sys").modules, "xatlas", None)
    with pytest.raises(MissingPackageError, match=r"pip install beam-warp\[unwrap\]"):
        unwrapped(ball())
