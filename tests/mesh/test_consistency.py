"""Consistency of depth images: closed forms of a sphere, a shifted view, hidden points, and what enters a fusion."""

from dataclasses import replace

import numpy as np
import pytest
from support.depth_scenes import around, plane_view, points_of, sphere_view
from support.threads import require_same_on_any_threads

from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.mesh.consistency import depth_consistency
from beam_warp.mesh.depths import DepthImages
from beam_warp.mesh.fusion import fuse_depths

RADIUS = 0.5


def part(images, index):
    return slice(images.first_pixels[index], images.first_pixels[index + 1])


def moved(view, by):
    """The same view, wrong by a length along the optical axis."""
    return replace(view, depth=np.where(view.depth > 0.0, view.depth + by, 0.0).astype(np.float32))


@pytest.fixture(scope="module")
def views():
    return [sphere_view(camera, RADIUS) for camera in around((0.0, 0.0, 0.0), width=64)]


def test_views_of_one_sphere_agree(device, views):
    images = DepthImages.of(views, device=device)
    found = depth_consistency(images)
    summary = found.as_dict()
    assert summary["seen"] > 0.99
    assert summary["confirmed"] > 0.999
    assert summary["contradicted"] < 1e-3
    # The plane of a pixel and the sphere are apart by the sagitta of half a pixel, seen at most at 84 degrees.
    assert summary["mean_residual"] < (0.5 * images.footprint() / 0.1) ** 2 / (2.0 * RADIUS)
    assert found.mask().numpy().sum() == pytest.approx(summary["pixels"] * summary["seen"], rel=2e-3)


def test_a_view_that_is_wrong_is_found(device, views):
    """One view is 0.2 m too near: the others look through its points."""
    images = DepthImages.of([moved(views[0], -0.2), *views[1:]], device=device)
    found = depth_consistency(images)
    assert found.as_dict()["worst_view"] == 0
    assert found.views[0].contradicted > 0.9
    assert min(view.confirmed for view in found.views[1:]) > 0.9
    assert not found.mask().numpy()[part(images, 0)].mean() > 0.05


def test_a_plane_hidden_by_a_sphere_is_not_contradicted():
    """A sphere, seen from above, hides a disc of the plane below it; the disc is seen from the side."""
    above, aside = around((0.0, 0.0, 0.0), width=64, azimuths=1, elevations=(89.0, 40.0))
    floor = plane_view(aside, -0.6)
    images = DepthImages.of([sphere_view(above, RADIUS), floor], device="cpu")
    found = depth_consistency(images)
    # Of the floor, the view from above sees the sphere in front, or nothing: where it sees nothing it objects.
    rows = part(images, 1)
    places = above.project(points_of(floor).reshape(-1, 3))[:, :2]
    disc = RADIUS * above.focal_x / np.sqrt(4.0 - RADIUS**2)
    from_middle = np.hypot(*(places - (above.center_x, above.center_y)).T)
    usable = images.pixels.numpy()[rows, 2] > 0.0
    inside = usable & (from_middle < disc - 2.0)  # well inside, where places are rounded to pixels
    assert inside.sum() > 100
    assert not found.contradicted.numpy()[rows][inside].any()
    assert not found.confirmed.numpy()[rows][inside].any()  # 0, not -1: they count


def test_occluded_views_say_nothing():
    """Two cameras on opposite sides of a sphere share no point: each is unseen, not contradicted."""
    cameras = around((0.0, 0.0, 0.0), width=48, azimuths=2, elevations=(0.0,))
    images = DepthImages.of([sphere_view(camera, RADIUS) for camera in cameras], device="cpu")
    found = depth_consistency(images)
    assert [view.seen for view in found.views] == [0.0, 0.0]
    assert not found.contradicted.numpy().any()
    assert not found.mask(1).numpy().any()
    assert np.array_equal(found.mask(0).numpy() == 1, images.pixels.numpy()[:, 2] > 0.0)


def test_tolerance_is_in_pixels(views):
    """A gap of three pixels between parallel planes: confirmed with a tolerance of 3.5, contradicted with 2.5."""
    camera = around((0.0, 0.0, 0.0), width=32, azimuths=1, elevations=(90.0,))[0]
    gap = 3.0 * 2.0 / camera.focal_x
    images = DepthImages.of([plane_view(camera, 0.0), plane_view(camera, gap)], device="cpu")
    # In widths of the coarser pixel, that of the farther plane, gap is 3 pixels.
    lower, upper = depth_consistency(images, tolerance=3.5).views
    assert (lower.confirmed, upper.confirmed) == (1.0, 1.0)
    assert lower.mean_residual == pytest.approx(gap, rel=1e-5)
    lower, upper = depth_consistency(images, tolerance=2.5).views
    assert (lower.seen, upper.contradicted) == (0.0, 1.0)  # the lower plane is hidden by the upper one


def test_mask_keeps_what_is_wrong_out_of_the_fusion(views):
    images = DepthImages.of([moved(views[0], -0.2), *views[1:]], device="cpu")
    images.keep(depth_consistency(images).mask())
    mesh = fuse_depths(images, voxel=0.03)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - RADIUS).max() < 0.03


def test_same_bits_on_any_number_of_threads(device, views, monkeypatch):
    images = DepthImages.of(views[:6], device=device)

    def run():
        found = depth_consistency(images)
        return [array.numpy() for array in (found.confirmed, found.contradicted, found.residuals)]

    require_same_on_any_threads(monkeypatch, run)


def test_bad_options(views):
    images = DepthImages.of(views[:2], device="cpu")
    with pytest.raises(InvalidOptionError, match="tolerance must be a number"):
        depth_consistency(images, tolerance=float("nan"))
    with pytest.raises(InvalidOptionError, match="confirmations must be an integer"):
        depth_consistency(images).mask(-1)
    with pytest.raises(InvalidArrayError, match=r"mask must be a warp array of \d+ int32"):
        images.keep(np.ones(3, bool))
