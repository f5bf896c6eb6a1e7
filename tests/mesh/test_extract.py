"""Meshes of Gaussian clouds, and previews of them."""

import numpy as np
import pytest
import trimesh
from support.moving_ball import RADIUS, ball_cloud

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.mesh.extract import draw_depths, mesh_of_gaussians, surrounding_cameras
from beam_warp.mesh.preview import shaded_image
from beam_warp.mesh.topology import mesh_report
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera

COUNT = 6000
SPACING = float(np.sqrt(4.0 * np.pi * RADIUS**2 / COUNT))


@pytest.fixture(scope="module")
def cloud():
    """Flat, opaque discs on a sphere, as wide as they are apart."""
    return ball_cloud(COUNT).with_arrays(
        scales=np.tile([0.7 * SPACING, 0.7 * SPACING, 0.05 * SPACING], (COUNT, 1)),
        opacities=np.full(COUNT, 0.98),
        base_color=np.tile((0.8, 0.4, 0.2), (COUNT, 1)),
        radiance=None,
        radiance_color_space=None,
    )


@pytest.fixture(scope="module")
def mesh(cloud):
    return mesh_of_gaussians(cloud, surrounding_cameras(cloud, side=64), color="base_color", device="cpu")


def test_ball_of_discs(mesh):
    """Closed, and as near to the ball as its discs are.

    Discs are tangent planes that reach out to where their alpha is 1/255, 3.3 deviations: they are above the ball by
    at most that squared over twice the radius; the fusion adds what its `test_sphere` derives for a voxel and a pixel
    of that width seen at 60 degrees, and a disc's thickness.
    """
    report = mesh_report(mesh)
    assert report.closed
    assert report.parts == 1
    voxel = mesh.metadata["voxel"]
    error = np.linalg.norm(mesh.vertices, axis=1) - RADIUS
    discs = (3.3 * 0.7 * SPACING) ** 2 / (2.0 * RADIUS)
    bound = discs + (9.0 + 1.0 + 0.75) * voxel**2 / (2.0 * RADIUS) + 0.05 * 0.7 * SPACING
    assert np.abs(error).max() < bound
    assert mesh.metadata["consistency"]["confirmed"] > 0.99


def test_vertices_carry_the_base_colour_as_display_values(mesh):
    colors = np.unique(mesh.visual.vertex_colors[:, :3], axis=0).astype(int)
    assert np.abs(colors - [231, 170, 124]).max() <= 1  # the transfer function of 0.8, 0.4, 0.2


def test_radiance(cloud):
    """Degree 0 of the harmonics: 0.5 + 0.28209479 c, already display values."""
    value = np.array([0.9, 0.5, 0.1])
    colored = cloud.with_arrays(
        radiance=np.tile((value - 0.5) / 0.28209479, (COUNT, 1)).reshape(-1, 1, 3),
        radiance_color_space="srgb_rec709_display",
    )
    cameras = surrounding_cameras(cloud, side=48)
    found = mesh_of_gaussians(colored, cameras, voxel=0.04, color="radiance", device="cpu")
    assert np.abs(found.visual.vertex_colors[:, :3].astype(int) - np.rint(value * 255)).max() <= 1


@pytest.mark.parametrize("depth", ["median", "mean"])
def test_depth_modes(cloud, depth, device):
    cameras = surrounding_cameras(cloud, side=48)
    options = RasterOptions(depth="exact")
    found = mesh_of_gaussians(cloud, cameras, voxel=0.03, depth=depth, options=options, device=device)
    assert mesh_report(found).parts == 1
    assert np.abs(np.linalg.norm(found.vertices, axis=1) - RADIUS).max() < 0.03


def test_cameras_of_several_sizes(cloud):
    """One rasteriser after another; each view lands where its pixels are."""
    cameras = [
        Camera.orbit((0, 0, 0), 2.0, 60.0 * i, 30.0 * (-1) ** i, width=64 + 8 * (i % 3), height=64, vertical_fov=35.0)
        for i in range(6)
    ]
    images = draw_depths(cloud, cameras, device="cpu")
    for index, camera in enumerate(cameras):
        part = slice(images.first_pixels[index], images.first_pixels[index + 1])
        pixels = images.pixels.numpy()[part].reshape(camera.height, camera.width, 3)
        assert 1.0 / pixels[32, camera.width // 2, 0] == pytest.approx(1.5, abs=0.02)
        assert pixels[0, 0, 0] == 0.0


def test_one_camera_sees_one_side(cloud):
    camera = Camera.orbit((0, 0, 0), 2.0, 0.0, 0.0, width=96, height=96, vertical_fov=35.0)
    found = mesh_of_gaussians(cloud, [camera], device="cpu")
    report = mesh_report(found)
    assert report.boundary_edges
    assert report.nonmanifold_edges == 0
    # The camera is at -y; nothing is behind the widest ring that it sees, but for a few voxels of truncation.
    assert found.vertices[:, 1].max() < -(RADIUS**2) / 2.0 + 4.0 * found.metadata["voxel"]


def test_bad_input(cloud):
    cameras = surrounding_cameras(cloud, side=16)
    away = [Camera.look_at((3, 0, 0), (6, 0, 0), width=16, height=16, vertical_fov=35.0)]
    with pytest.raises(InvalidArrayError, match="depth must be seen with an alpha of at least"):
        mesh_of_gaussians(cloud, away, device="cpu")
    with pytest.raises(InvalidArrayError, match="cloud must have radiance, got none"):
        mesh_of_gaussians(cloud, cameras, color="radiance", device="cpu")
    with pytest.raises(InvalidOptionError, match="depth must be one of median, mean"):
        mesh_of_gaussians(cloud, cameras, depth="middle", device="cpu")
    with pytest.raises(InvalidOptionError, match="cameras must hold at least one camera"):
        mesh_of_gaussians(cloud, [], device="cpu")
    with pytest.raises(InvalidArrayError, match="positions must hold at least one point"):
        surrounding_cameras(cloud.select(np.zeros(COUNT, bool)))


def test_preview(device):
    """A triangle that faces the camera is as bright as its colour under the camera's light and the sky's half."""
    corners, red = [[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.tile(np.uint8([255, 0, 0, 255]), (4, 1))
    square = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], vertex_colors=red, process=False)
    front = Camera.orbit((0, 0, 0), 4.0, 0.0, 0.0, width=33, height=33, vertical_fov=60.0)
    image = shaded_image(square, front, device)
    assert image.dtype == np.uint8
    # 3/4 + 1/4 * 1/2 of linear 1, encoded: 1.055 * 0.875^(1/2.4) - 0.055.
    assert image[16, 16].tolist() == pytest.approx([round(255 * (1.055 * 0.875 ** (1 / 2.4) - 0.055)), 0, 0], abs=1)
    assert image[0, 0].tolist() == [255, 255, 255]
    behind = shaded_image(square, Camera.orbit((0, 0, 0), 4.0, 180.0, 0.0, width=33, height=33, vertical_fov=60.0))
    assert behind[16, 16, 0] < 120
    bare = trimesh.Trimesh(square.vertices, square.faces, process=False)
    clay = shaded_image(bare, front, device)[16, 16].astype(int)
    assert np.ptp(clay) < 20
    with pytest.raises(InvalidArrayError, match="mesh must hold at least one triangle"):
        shaded_image(trimesh.Trimesh(), front, device)
