"""Fusion of depth images: closed forms of spheres and planes, what is open and closed, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from support.depth_scenes import around, plane_view, points_of, sphere_view
from support.threads import require_same_on_any_threads

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.mesh import fusion
from beam_warp.mesh.depths import DepthImages, DepthView
from beam_warp.mesh.fusion import fuse_depths
from beam_warp.mesh.topology import mesh_report
from beam_warp.world.camera import Camera

RADIUS = 0.5


def sphere_views(width, center=(0.0, 0.0, 0.0), **options):
    return [sphere_view(camera, RADIUS, center) for camera in around(center, width=width, **options)]


@pytest.fixture(scope="module")
def coarse():
    """Views that are read only: tests that change weights make their own."""
    return sphere_views(64)


def test_sphere(device, coarse):
    """Closed, manifold, outward, and as near to the sphere as planes through its pixels are.

    A view at an angle a to the normal meets a corner of a cell, at most a diagonal away from the surface, sideways of
    its foot by up to tan(a) times that, and takes the tangent plane there for the sphere: it errs by the square of that
    over twice the radius. Interpolation between pixels, p / cos(a) apart, and between corners, adds the sagittas of
    those lengths. Weights are cos(a)^4: over views from everywhere the means of tan(a)^2 and 1 / cos(a)^2 are 2/3 and
    5/3; where views happen to be worst, none is as bad as one at 60 degrees alone.
    """
    images = DepthImages.of(coarse, device=device)
    pixel = images.footprint()
    for voxel in (0.02, 0.03):
        mesh = fuse_depths(images, voxel=voxel)
        report = mesh_report(mesh)
        assert (report.boundary_edges, report.nonmanifold_edges, report.parts) == (0, 0, 1)
        assert mesh.is_winding_consistent
        assert mesh.euler_number == 2
        assert mesh.volume > 0.0
        error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS)

        def bound(squared_tangent, voxel=voxel):
            shift = 3.0 * voxel**2 * squared_tangent
            return (shift + pixel**2 * (1.0 + squared_tangent) / 4.0 + 3.0 * voxel**2 / 4.0) / (2.0 * RADIUS)

        assert error.mean() < bound(2.0 / 3.0)
        assert error.max() < bound(3.0)
        normals = mesh.face_normals
        assert (np.einsum("ij,ij->i", normals, mesh.triangles_center) > 0.0).all()


def test_automatic_voxel_is_the_pixel(coarse):
    """The nearest point is 1.5 m away, the farthest that is seen about 1.94 m."""
    camera = coarse[0].camera
    voxel = fuse_depths(coarse, device="cpu").metadata["voxel"]
    assert 1.5 / camera.focal_y < voxel < 1.94 / camera.focal_y


def test_automatic_voxel_grows_until_it_fits(coarse, monkeypatch):
    images = DepthImages.of(coarse, device="cpu")
    free = fuse_depths(images).metadata["voxel"]
    monkeypatch.setattr(fusion, "MAX_BLOCKS", 300)
    tight = fuse_depths(images).metadata["voxel"]
    steps = np.log(tight / free) / np.log(1.25)
    assert steps > 0.5
    assert steps == pytest.approx(round(steps))
    with pytest.raises(InvalidOptionError, match=r"voxel must need at most 300 blocks of 8\^3 voxels, got 0.005 m"):
        fuse_depths(images, voxel=0.005)


def test_plane_is_exact(device):
    """Inverse depth is linear over a plane's image: the fused plane is off by rounding alone.

    Half an ulp of a distance of 2 m is 1.2e-7; some forty operations on such lie between depth and vertex.
    """
    cameras = around((0.0, 0.0, 0.0), width=48, azimuths=4, elevations=(60.0,))
    views = [plane_view(camera, 0.013) for camera in cameras]  # on no point of the grid
    mesh = fuse_depths(views, voxel=0.02, device=device)
    assert np.abs(mesh.vertices[:, 2] - 0.013).max() < 40 * 1.2e-7
    assert (mesh.face_normals[:, 2] > 0.0).all()
    assert mesh_report(mesh).boundary_edges > 0


def test_hole_in_what_is_seen_is_one_in_the_surface(coarse):
    """A cap that no pixel shows: one loop of boundary edges as long as its circle, within a cell on every side."""
    views = [replace(view, alpha=view.alpha * (points_of(view)[..., 2] < 0.4)) for view in coarse]
    voxel = 0.02
    report = mesh_report(fuse_depths(views, voxel=voxel, device="cpu"))
    assert report.holes == 1
    assert report.nonmanifold_edges == 0
    assert not report.closed
    circle = 2.0 * np.pi * 0.3
    # A staircase around a circle is at most 4 / pi times as long, and each of its steps an edge inside one cell.
    assert circle / (np.sqrt(3.0) * voxel) < report.boundary_edges < 3 * 4.0 / np.pi * circle / voxel


def test_no_surface_in_the_shadow_of_silhouettes():
    """Few cameras, and a truncation of two fifths of the radius: behind an edge a camera still sees solid, others air.

    Without the others' word there are sheets up to the truncation away from the sphere, 0.2 m.
    """
    voxel = 0.05
    cameras = [
        Camera.orbit((0, 0, 0), 3.0, 45.0 * i, 40.0 * (-1) ** i, width=64, height=64, vertical_fov=30.0)
        for i in range(8)
    ]
    mesh = fuse_depths([sphere_view(camera, RADIUS) for camera in cameras], voxel=voxel, device="cpu")
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).max() < voxel


def test_far_from_the_origin(coarse):
    """Positions on the device are counted from between the cameras: shifted by whole metres, the mesh is the same."""
    shift = np.array([4.0e5, -3.0e5, 100.0])
    near = fuse_depths(coarse, voxel=0.03, device="cpu")
    far = fuse_depths(sphere_views(64, shift), voxel=0.03, device="cpu")
    assert len(far.faces) == pytest.approx(len(near.faces), rel=1e-3)
    # Cameras in double precision are rounded at 4e5 m to 6e-11 m, rays through them no better than float32 here.
    assert np.abs(np.linalg.norm(far.vertices - shift, axis=1) - RADIUS).max() < 0.02


def test_small_parts_are_left_out(coarse):
    both = []
    for view in coarse:
        crumb = sphere_view(view.camera, 0.06, (0.8, 0.0, 0.0))
        nearer = (crumb.alpha > 0) & ((view.alpha == 0) | (crumb.depth < view.depth))
        depth = np.where(nearer, crumb.depth, view.depth)
        both.append(replace(view, depth=depth, alpha=np.maximum(view.alpha, crumb.alpha)))
    images = DepthImages.of(both, device="cpu")
    share = (0.06 / RADIUS) ** 2
    assert mesh_report(fuse_depths(images, voxel=0.03, smallest_part=0.5 * share)).parts == 2
    assert mesh_report(fuse_depths(images, voxel=0.03, smallest_part=2.0 * share)).parts == 1


def test_same_bits_on_any_number_of_threads(device, coarse, monkeypatch):
    def run():
        mesh = fuse_depths(coarse[::2], voxel=0.03, device=device)
        return mesh.vertices, mesh.faces

    require_same_on_any_threads(monkeypatch, run, ("1", "3", "3"))


def test_noisy_depth_stays_manifold(rng):
    """Contradictory distances bring out every case of marching cubes; no edge may have more than two triangles."""
    views = sphere_views(48)
    noise = [rng.normal(0.0, 0.03, view.depth.shape).astype(np.float32) * (view.depth > 0) for view in views]
    noisy = [replace(view, depth=view.depth + off) for view, off in zip(views, noise, strict=True)]
    report = mesh_report(fuse_depths(noisy, voxel=0.02, smallest_part=0.0, device="cpu"))
    assert report.faces > 10_000
    assert report.nonmanifold_edges == 0


def test_colors(coarse):
    views = [replace(view, color=np.full((*view.depth.shape, 3), (1.0, 0.5, 0.0))) for view in coarse]
    mesh = fuse_depths(views, voxel=0.03, device="cpu")
    assert np.array_equal(np.unique(mesh.visual.vertex_colors, axis=0), [[255, 188, 0, 255]])


def test_given_normals_and_those_of_the_depth_agree(coarse):
    """Given the sphere's own normals, weights differ, the surface hardly: both are bounded as in `test_sphere`."""
    views = [replace(view, normals=3.0 * points_of(view)) for view in coarse]  # of any length
    mesh = fuse_depths(views, voxel=0.02, device="cpu")
    assert mesh_report(mesh).closed
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).max() < 0.02


def test_arrays_of_the_device_are_taken_as_they_are(device, coarse):
    def moved(array):
        return wp.array(array, dtype=float, device=device)

    there = [replace(view, depth=moved(view.depth.reshape(-1)), alpha=moved(view.alpha)) for view in coarse]
    one, other = (fuse_depths(views, voxel=0.03, device=device) for views in (there, coarse))
    assert np.array_equal(one.vertices, other.vertices)


def test_broken_depth_is_no_depth(coarse):
    depth, alpha = coarse[0].depth.copy(), coarse[0].alpha.copy()
    depth[:20] = np.nan
    depth[20:30] = -1.0
    depth[30:40] = np.inf
    alpha[50:] = np.nan
    mesh = fuse_depths([replace(coarse[0], depth=depth, alpha=alpha), *coarse[1:]], voxel=0.03, device="cpu")
    assert np.isfinite(mesh.vertices).all()
    assert mesh_report(mesh).closed


@pytest.mark.parametrize("size", [(1, 1), (7, 1)])
def test_images_of_a_pixel_or_a_line_show_no_surface(size, coarse):
    height, width = size
    camera = replace(coarse[0].camera, width=width, height=height, center_x=width / 2, center_y=height / 2)
    view = DepthView(camera=camera, depth=np.full(size, 1.5, np.float32), alpha=np.ones(size, np.float32))
    with pytest.raises(InvalidArrayError, match="depth must be seen"):
        fuse_depths([view], device="cpu")


def test_what_cannot_be_fused_is_refused(coarse):
    empty = [replace(view, alpha=np.zeros_like(view.alpha)) for view in coarse]
    with pytest.raises(InvalidArrayError, match=r"depth must be seen with an alpha of at least 0\.5 in some view"):
        fuse_depths(empty, device="cpu")
    with pytest.raises(InvalidArrayError, match="depth must be seen in some view, got no pixel that counts"):
        fuse_depths(empty, voxel=0.01, device="cpu")
    with pytest.raises(InvalidOptionError, match="cameras must hold at least one camera, got none"):
        fuse_depths([], device="cpu")
    with pytest.raises(InvalidOptionError, match="voxel must be so large that"):  # its numbers have a range
        fuse_depths([plane_view(coarse[0].camera, 1e6, side=4)], voxel=1e-3, device="cpu")
    tinted = replace(coarse[0], color=np.ones((*coarse[0].depth.shape, 3)))
    with pytest.raises(InvalidArrayError, match="color must be given for all views or none"):
        fuse_depths([tinted, *coarse[1:]], device="cpu")
