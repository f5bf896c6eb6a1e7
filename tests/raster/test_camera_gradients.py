"""Derivatives of images to cameras: the float64 oracle, moved cameras, the gauge, several views, what is not seen."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from reference.raster_differences import camera_gradients, random_upstream
from reference.raster_splats import RasterScene
from reference.rasterizing import RasterImage, decide, replay
from reference.single_precision import ROUNDING, rounded
from scipy.spatial.transform import Rotation
from support.drawn_hazards import APPROXIMATIONS, STABILITY, Drawn, remoteness
from support.raster_clouds import around, cloud, drawn, set_upstream
from support.raster_hazards import HAZARDS

from beam_warp.errors import InvalidArrayError
from beam_warp.raster.gbuffer import rasterize_backward
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import CAMERA_PARAMETERS, RasterOptions
from beam_warp.raster.sources import upload_gaussians

GRADIENT_ERROR = 1e-5
"""Error of a camera's derivative over the root of the summed squares of what each splat adds to it."""

OUTPUTS = ("alpha", "depth", "median_depth", "channels", "normals")


def scene_of(made, camera, **more):
    return RasterScene(made.positions, made.orientations, made.scales, made.opacities, camera, **more)


def moved_camera(camera, move):
    """The camera after a move, made without the code under test: its exact rigid motion; no lens."""
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = Rotation.from_rotvec(move[:3]).as_matrix()
    world_to_camera[:3, 3] = move[3:6]
    pose = np.linalg.inv(world_to_camera @ np.linalg.inv(camera.camera_to_world))
    focal_x, focal_y, center_x, center_y = np.add(
        (camera.focal_x, camera.focal_y, camera.center_x, camera.center_y), move[6:10]
    )
    return replace(camera, camera_to_world=pose, focal_x=focal_x, focal_y=focal_y, center_x=center_x, center_y=center_y)


def loss(image, upstream):
    return sum(float((getattr(upstream, name) * getattr(image, name)).sum()) for name in OUTPUTS)


def camera_rows(drawer):
    rows = wp.zeros((len(drawer.cameras), len(CAMERA_PARAMETERS)), dtype=float, device=drawer.device)
    return rows, drawer.backward(rows)


def test_oracle_against_moved_cameras(rng):
    """Central differences in float64 over cameras that are really moved; decisions held still."""
    camera = around(33, 25)
    scene = scene_of(cloud(rng, 40), camera, radiance=rng.normal(0.3, 0.4, (40, 9, 3)))
    decisions = decide(scene)
    upstream = random_upstream(rng, scene, decisions)
    wanted = camera_gradients(scene, upstream, decisions)
    for k, step in enumerate((1e-6,) * 6 + (1e-4,) * 4):
        ends = [
            loss(replay(replace(scene, camera=moved_camera(camera, sign * step * np.eye(12)[k])), decisions), upstream)
            for sign in (-1.0, 1.0)
        ]
        error = (ends[1] - ends[0]) / (2.0 * step) - wanted[:, k].sum()
        assert abs(error) <= 1e-6 * np.linalg.norm(wanted[:, k]), CAMERA_PARAMETERS[k]


def test_oracle_lens_moves_centres_by_its_polynomial():
    """The first moment of a small ball off the axis follows its centre, f u (1 + k1 r^2 + k2 r^4), as it follows c."""
    camera = around(64, 64)
    local = np.array([0.3, 0.2, 2.5, 1.0])
    u, v = local[:2] / local[2]
    position = (camera.camera_to_world @ local)[:3]
    scene = RasterScene([position], [[0, 0, 0, 1.0]], [[0.02] * 3], [0.5], camera, values=[[1.0]])
    decisions = decide(scene)
    from_center = np.tile(np.arange(64) + 0.5, (64, 1)) - camera.focal_x * u - camera.center_x
    zero = np.zeros((64, 64))
    along = RasterImage(from_center, zero, zero, zero[..., None], np.zeros((64, 64, 3)))
    found = camera_gradients(scene, along, decisions)[0]
    square = u * u + v * v
    wanted = camera.focal_x * u * np.array([square, square**2])
    # A ball of a pixel also grows by about r^2 of k1, which the pixels' grid makes a small part of the moment.
    np.testing.assert_allclose(found[10:] / found[8], wanted, rtol=1e-2)


@pytest.mark.parametrize(
    ("held", "options"),
    [
        ({"values": (4,)}, RasterOptions()),
        ({"values": (2,)}, RasterOptions(depth="exact")),
        ({"radiance": (9, 3)}, RasterOptions(antialiased=True)),
    ],
    ids=str,
)
def test_against_the_oracle(device, rng, held, options):
    """Every number of three cameras of other sizes and lenses, one of which sees some Gaussians behind it."""
    made = cloud(rng, 60)
    inside = around(21, 30, 140.0)
    cameras = [
        around(33, 25),
        replace(around(20, 36, 250.0), focal_x=41.0, center_y=11.0),
        replace(inside, camera_to_world=moved_camera(inside, [0.1, 0.2, 0, 0, 0, -2.2, 0, 0, 0, 0]).camera_to_world),
    ]
    colors = {name: rng.normal(0.3, 0.4, (60, *shape)).astype(np.float32) for name, shape in held.items()}
    scenes = [
        scene_of(made, camera, **colors, antialiased=options.antialiased, depth_mode=options.depth)
        for camera in cameras
    ]
    upstreams = [random_upstream(rng, scene, decide(scene)) for scene in scenes]
    kind = {"value_count": held["values"][0]} if "values" in held else {"radiance": True}
    drawer = Rasterizer(60, cameras, **kind, normals=True, options=options, device=device)
    drawer.draw(upload_gaussians(made, drawer.device, **colors))
    set_upstream(drawer, together(upstreams))
    rows, _ = camera_rows(drawer)
    for got, scene, upstream in zip(rows.numpy(), scenes, upstreams, strict=True):
        parts = camera_gradients(scene, upstream)
        assert (np.abs(got - parts.sum(axis=0)) <= GRADIENT_ERROR * np.linalg.norm(parts, axis=0)).all()


def together(upstreams):
    """Derivatives to the images of several views, one view after the other."""
    columns = {
        name: np.concatenate([getattr(one, name).reshape(one.alpha.size, -1) for one in upstreams]) for name in OUTPUTS
    }
    return RasterImage(**columns)


def test_cameras_are_the_other_side_of_a_rigid_motion(device, rng):
    """Moving all Gaussians is moving all cameras: derivatives to Gaussians alone give those to twists, summed up."""
    made, cameras = cloud(rng, 200), [around(), around(azimuth=120.0), around(azimuth=250.0)]
    drawer, _ = drawn(made, cameras, device, rng.uniform(0, 1, (200, 3)).astype(np.float32))
    for rows in drawer.adjoints().channels:
        rows.assign(rng.normal(size=rows.shape).astype(np.float32))
    drawer.adjoints().depth.assign(rng.normal(size=drawer.adjoints().depth.shape).astype(np.float32))
    rows, found = camera_rows(drawer)
    to_position, to_orientation = (getattr(found, name).numpy().astype(np.float64) for name in GEOMETRY)
    turned = np.stack([(Rotation.from_quat(np.r_[axis, 0.0]) * turns(made)).as_quat() for axis in np.eye(3)])
    spin = np.einsum("nk,ank->na", to_orientation, 0.5 * turned * handed(made, turned)) + np.cross(
        made.positions, to_position
    )
    shift, spin_of_cameras = np.zeros(3), np.zeros(3)
    for camera, row in zip(cameras, rows.numpy().astype(np.float64), strict=True):
        back = camera.camera_to_world[:3, :3]
        shift += back @ row[3:6]
        spin_of_cameras += back @ row[:3] + np.cross(camera.position, back @ row[3:6])
    scale = np.linalg.norm(to_position)
    np.testing.assert_allclose(shift, to_position.sum(axis=0), atol=1e-5 * scale)
    np.testing.assert_allclose(spin_of_cameras, spin.sum(axis=0), atol=1e-5 * scale)


GEOMETRY = ("positions", "orientations")


def turns(made):
    return Rotation.from_quat(made.orientations)


def handed(made, turned):
    """Signs that undo the choice between q and -q: an infinitesimal turn is orthogonal to q."""
    x, y, z, w = made.orientations.T
    wanted = np.stack([np.stack([w, -z, y, -x], -1), np.stack([z, w, -x, -y], -1), np.stack([-y, x, w, -z], -1)])
    return np.sign((wanted * turned).sum(axis=-1, keepdims=True))


@pytest.mark.parametrize("name", HAZARDS)
def test_every_hazard_is_stable(device, rng, name):
    """Derivatives to cameras are as good as roundings of the Gaussians let them be; zeros for what is not seen."""
    scene = HAZARDS[name](rng)
    decisions = decide(scene)
    upstream = random_upstream(rng, scene, decisions)
    parts = camera_gradients(scene, upstream, decisions)
    wanted = parts.sum(axis=0)
    others = [camera_gradients(rounded(rng, scene), upstream, decisions).sum(axis=0) for _ in range(3)]
    spread = np.abs(np.array(others) - wanted).max(axis=0)
    shown = Drawn(scene, device)
    set_upstream(shown.rasterizer, upstream)
    found = camera_rows(shown.rasterizer)[0].numpy()[0]
    rounding = ROUNDING * (APPROXIMATIONS if wp.get_device(device).is_cuda else 1.0)
    limit = STABILITY * remoteness(scene, decisions) * (spread + rounding * np.linalg.norm(parts, axis=0))
    assert np.isfinite(found).all()
    assert (np.abs(found - wanted) <= limit).all()


def test_what_is_not_seen_has_no_part(device, rng):
    """Gaussians behind the camera, outside the image, too faint or of NaN add exactly nothing."""
    camera = around()
    made = cloud(rng, 30)
    lost = cloud(rng, 4)
    positions = lost.positions.copy()
    positions[0] = camera.position - camera.forward
    positions[1] = camera.position + camera.forward + 500.0 * camera.camera_to_world[:3, 0]
    positions[3] = np.nan
    lost = lost.with_arrays(opacities=np.array([0.9, 0.9, 1e-4, 0.9], np.float32))
    found = []
    for more in (False, True):
        arrays = {
            name: np.concatenate([getattr(made, name), *([getattr(lost, name)] if more else [])])
            for name in ("positions", "orientations", "scales", "opacities")
        }
        if more:
            arrays["positions"][30:] = positions
        kinds = {"positions": wp.vec3, "orientations": wp.quat, "scales": wp.vec3, "opacities": float}
        drawer = Rasterizer(len(arrays["positions"]), [camera], normals=True, device=device)
        gaussians = upload_gaussians(made, device)._replace(
            **{name: wp.array(array, dtype=kinds[name], device=device) for name, array in arrays.items()}
        )
        drawer.draw(gaussians)
        upstream = np.random.default_rng(3).normal(size=camera.width * camera.height).astype(np.float32)
        for array in (drawer.adjoints().alpha, drawer.adjoints().depth):
            array.assign(upstream)
        found.append(camera_rows(drawer)[0].numpy())
    assert np.isfinite(found[1]).all()
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)  # sums take other lanes


def test_nothing_else_changes_and_bits_are_kept(device, rng):
    """Gradients to Gaussians are those without cameras, to roundings; the same call gives the same bits."""
    made, cameras = cloud(rng), [around(), around(50, 20, 90.0)]
    drawer, _ = drawn(made, cameras, device, rng.uniform(0, 1, (200, 3)).astype(np.float32))
    for rows in drawer.adjoints().channels:
        rows.assign(rng.normal(size=rows.shape).astype(np.float32))
    alone = [array.numpy() for array in drawer.backward()[:5] if array is not None]
    rows, found = camera_rows(drawer)
    for array, expected in zip((array for array in found[:5] if array is not None), alone, strict=True):
        assert np.linalg.norm(array.numpy() - expected) <= 1e-6 * np.linalg.norm(expected)
    np.testing.assert_array_equal(camera_rows(drawer)[0].numpy(), rows.numpy())
    with pytest.raises(InvalidArrayError, match="to_cameras must be a compact warp array of float32, 2 x 12, on"):
        drawer.backward(wp.zeros((1, 12), dtype=float, device=device))


def test_gbuffers_pass_their_derivatives_on(device, rng):
    """The mean of a value that is the same everywhere moves with no camera; its coverage does, as the sums say."""
    made = cloud(rng, 50, base_color=np.full((50, 3), 0.4))
    cameras = [around(), around(30, 20, 70.0)]
    upstreams = [rng.normal(size=(camera.height, camera.width)) for camera in cameras]
    adjoints = [{"base_color": np.repeat(one[..., None], 3, axis=-1)} for one in upstreams]
    still = rasterize_backward(made, cameras, adjoints, channels=("base_color",), cameras_too=True, device=device)
    covered = [{"alpha": one} for one in upstreams]
    found = rasterize_backward(made, cameras, covered, channels=("base_color",), cameras_too=True, device=device)
    drawer, _ = drawn(made, cameras, device)
    drawer.adjoints().alpha.assign(np.concatenate([one.ravel() for one in upstreams]).astype(np.float32))
    np.testing.assert_allclose(found.cameras, camera_rows(drawer)[0].numpy(), rtol=1e-4, atol=1e-4)
    assert still.cameras.shape == (2, len(CAMERA_PARAMETERS))
    assert (np.abs(still.cameras) <= 1e-3 * np.abs(found.cameras).max(axis=0)).all()
    assert rasterize_backward(made, cameras, covered, channels=("base_color",), device=device).cameras is None
