"""Scenes that break rasterisers, each for one reason. All numbers are ones that single precision holds."""

import numpy as np
from reference.raster_splats import RasterScene
from scipy.spatial.transform import Rotation

from beam_warp.world.camera import Camera

HAZARDS = {}


def hazard(make):
    HAZARDS[make.__name__] = make
    return make


def ahead(width=29, height=21, focal=30.0):
    """A camera at the origin, its axes those of the world; no side is a multiple of a tile's."""
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, np.eye(4))


def make(rng, positions, scales, opacities=0.7, orientations=None, camera=None, **options):
    count = len(positions)
    if orientations is None:
        orientations = rng.normal(size=(count, 4))
        orientations /= np.linalg.norm(orientations, axis=1, keepdims=True)
    return RasterScene(
        positions=np.asarray(positions, np.float32),
        orientations=np.asarray(orientations, np.float32),
        scales=np.array(np.broadcast_to(scales, (count, 3)), np.float32),
        opacities=np.array(np.broadcast_to(opacities, (count,)), np.float32),
        camera=camera or ahead(),
        values=rng.uniform(size=(count, 3)).astype(np.float32),
        **options,
    )


def in_view(rng, count, near=1.5, far=3.0, reach=0.4):
    """Positions in front of `ahead`, up to ``reach`` off its axis at depth 1."""
    z = rng.uniform(near, far, count)
    return np.stack([*(rng.uniform(-reach, reach, (2, count)) * z), z], axis=-1)


@hazard
def needles(rng):
    """A thousand times as long as wide, at every angle: the determinant of what they project to cancels."""
    return make(rng, in_view(rng, 30), np.stack([[0.3, 3e-4, 3e-4]] * 30))


@hazard
def needles_along_the_view(rng):
    """Seen from the tip, where a degree turns a point into a line; three thin ones at exactly the axis."""
    positions = in_view(rng, 20, reach=0.05)
    positions[:3, :2] = 0.0
    turns = Rotation.from_euler("xy", rng.normal(0.0, 2.0, (20, 2)), degrees=True).as_quat()
    turns[:3] = [0.0, 0.0, 0.0, 1.0]
    return make(rng, positions, [1e-3, 1e-3, 0.3], orientations=turns)


def grazing(rng, degrees, thickness):
    """Discs whose plane is ``degrees`` from the ray to their centre."""
    positions = in_view(rng, 20)
    frames = []
    for position in positions:
        ray = position / np.linalg.norm(position)
        aside = np.cross(ray, rng.normal(size=3))
        aside /= np.linalg.norm(aside)
        normal = np.cos(np.radians(degrees)) * aside + np.sin(np.radians(degrees)) * ray
        tangent = np.cross(normal, rng.normal(size=3))
        tangent /= np.linalg.norm(tangent)
        frames.append(np.stack([tangent, np.cross(normal, tangent), normal], axis=1))
    return make(rng, positions, [0.1, 0.08, thickness], orientations=Rotation.from_matrix(frames).as_quat())


@hazard
def discs_at_five_degrees(rng):
    return grazing(rng, 5.0, 1e-3)


@hazard
def discs_past_their_horizon(rng):
    """The low-pass shows them up to three degrees away from their plane: nearly half of those rays never meet it."""
    return grazing(rng, 1.0, 1e-5)


@hazard
def discs_at_a_tenth_of_a_degree(rng):
    """Less than thickness over width: the surface of largest response leaves the disc's plane."""
    return grazing(rng, 0.1, 1e-3)


@hazard
def discs_edge_on(rng):
    """That surface swings through a right angle within a millionth of a radian: no input determines it."""
    return grazing(rng, 0.0, 1e-4)


@hazard
def discs_without_thickness(rng):
    return grazing(rng, 20.0, 0.0)


@hazard
def lines_and_points(rng):
    """Two or three scales 0: nothing but the low-pass, and no determinant."""
    scales = np.zeros((20, 3))
    scales[:10, 0] = 0.1
    return make(rng, in_view(rng, 20), scales)


@hazard
def through_the_near_plane(rng):
    """Centres just before and just behind 0.01 m, and all around the camera: a Jacobian of thousands of pixels."""
    z = np.concatenate([rng.uniform(0.0101, 0.05, 15), rng.uniform(-0.05, 0.0099, 10)])
    return make(rng, np.stack([*rng.normal(0.0, 0.02, (2, 25)), z], axis=-1), np.exp(rng.normal(-3.0, 1.0, (25, 3))))


@hazard
def around_the_camera(rng):
    """The camera stands inside splats of a hundred metres; those with centres behind it are not drawn."""
    return make(rng, rng.normal(0.0, 2.0, (20, 3)), np.exp(rng.normal(3.0, 1.0, (20, 3))), opacities=0.3)


@hazard
def behind_the_camera(rng):
    return make(rng, in_view(rng, 20) * [1.0, 1.0, -1.0], 1.0)


@hazard
def outside_the_image(rng):
    """Up to forty images away and so large that they reach it: the Jacobian is clamped."""
    positions = in_view(rng, 20, reach=1.0)
    away = rng.normal(size=(20, 2))
    positions[:, :2] = away / np.linalg.norm(away, axis=1, keepdims=True) * rng.uniform(1.0, 40.0, (20, 1))
    largest = 0.5 * np.linalg.norm(positions[:, :2], axis=1, keepdims=True)
    return make(rng, positions, largest * rng.uniform(0.3, 1.0, (20, 3)))


@hazard
def far_outside_the_image(rng):
    """None of them reaches it, whatever its pixel coordinates overflow to."""
    away = np.array([[1e3, 0, 1], [0, -1e6, 1], [1e10, 1e10, 1], [1e18, 0, 0.02], [-1e30, 1e30, 1e-1]])
    return make(rng, away, 0.1)


@hazard
def below_a_pixel(rng):
    """A thousandth of a pixel wide, on pixel centres, edges, corners and anywhere."""
    x = np.array([0.5, 1.0, 1.5, 7.0, 8.0, 8.5, 28.5, 29.0, 0.0, *rng.uniform(0, 29, 40)])
    y = np.array([0.5, 0.5, 2.0, 7.0, 8.0, 8.5, 20.5, 21.0, 0.0, *rng.uniform(0, 21, 40)])
    z = rng.uniform(1.5, 3.0, len(x))
    positions = np.stack([(x - 14.5) / 30.0 * z, (y - 10.5) / 30.0 * z, z], axis=-1)
    return make(rng, positions, [6e-5, 5e-5, 4e-5])


@hazard
def at_one_depth(rng):
    """Bit for bit: drawn in the order of their rows."""
    positions = in_view(rng, 20, reach=0.2)
    positions[:, 2] = 2.0
    return make(rng, positions, np.exp(rng.normal(-2.0, 0.3, (20, 3))))


@hazard
def copies(rng):
    """The same splat twenty times with other values."""
    one = rng.normal(size=4)
    turns = np.tile(one / np.linalg.norm(one), (20, 1))
    return make(rng, np.tile([[0.05, -0.03, 2.0]], (20, 1)), [0.3, 0.2, 0.1], 0.2, turns)


@hazard
def opaque(rng):
    """Opacity 1: capped at 0.99, and two of them end a pixel."""
    return make(rng, in_view(rng, 25), np.exp(rng.normal(-2.0, 0.5, (25, 3))), opacities=1.0)


@hazard
def transparent(rng):
    """Opacity 0 (whose logarithm is not finite), and just below and above 1/255."""
    return make(rng, in_view(rng, 30), 0.3, opacities=np.repeat([0.0, 0.0038, 0.0041], 10))


@hazard
def balls(rng):
    """Three equal scales: which is largest or least must not matter, and turning must do nothing."""
    return make(rng, in_view(rng, 30), np.repeat(np.exp(rng.normal(-2.5, 0.5, (30, 1))), 3, axis=1))


@hazard
def many_layers(rng):
    """Two hundred wide faint ones: no pixel stops, and rounding adds up."""
    return make(rng, in_view(rng, 200, reach=0.1), [0.9, 1.0, 1.1], opacities=0.02, camera=ahead(9, 5))


@hazard
def a_tiny_world(rng):
    """A millionth of everything: the near plane, in metres, hides it all."""
    return make(rng, 1e-6 * in_view(rng, 10), 1e-7)


@hazard
def a_huge_world(rng):
    return make(rng, 1e6 * in_view(rng, 30), 1e6 * np.exp(rng.normal(-3.0, 0.7, (30, 3))))


@hazard
def far_from_the_origin(rng):
    """A kilometre away from the world's origin, seen from two metres: positions are rounded to 0.1 mm."""
    pose = np.eye(4)
    pose[:3, 3] = [1024.0, -512.0, 2048.0]
    camera = Camera(29, 21, 30.0, 30.0, 14.5, 10.5, pose)
    return make(rng, in_view(rng, 30) + pose[:3, 3], np.exp(rng.normal(-3.0, 0.7, (30, 3))), camera=camera)


@hazard
def odd_cameras(rng):
    """Focal lengths that differ, and a principal point outside the image."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [3.0, -4.0, 170.0], degrees=True).as_matrix()
    camera = Camera(23, 31, 60.0, 25.0, -10.0, 40.0, pose)
    return make(rng, in_view(rng, 60, reach=0.9), np.exp(rng.normal(-2.5, 0.5, (60, 3))), camera=camera)


@hazard
def nothing(rng):
    return make(rng, np.zeros((0, 3)), np.zeros((0, 3)))
