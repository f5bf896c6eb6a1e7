"""The surface that photographs without masks agree on: a plane for every pixel, by photometric consistency, fused.

Nothing is known but cameras and images. Every pixel of every view finds the plane whose patch looks most alike in the
views beside it (`kernels.reconstruction.patch_match`), from coarse images to fine ones. Then all views search again,
and a point that another view shows elsewhere costs too. Planes that go on from pixel to pixel are fused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_count
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import LUMINANCE, linear_to_srgb
from beam_warp.kernels.reconstruction.patch_match import (
    StereoNeighbor,
    StereoView,
    launch_begin_planes,
    launch_improve_planes,
)
from beam_warp.mesh.consistency import depth_consistency
from beam_warp.mesh.depths import DepthImages, DepthView
from beam_warp.mesh.fusion import fuse_depths
from beam_warp.reconstruction.hull import viewing_focus
from beam_warp.world.camera import Camera

if TYPE_CHECKING:
    import trimesh

LEVELS = 3
"""Most sizes of images, each half of the next: the search begins with the smallest, where the plain has texture."""

SMALLEST_SIDE = 24
"""Shortest side of the smallest images [pixel]: a patch is half as long."""

ROUNDS = 6
"""Times that all pixels improve their planes at each level; half as often where views look at each other's depths."""

AGREEMENTS = 2
"""Times that views look at each other's depths, at the finest level."""

MOST_NEIGHBORS = 6
"""Most views that a view is compared with: those that look from the nearest directions."""

WIDEST = 75.0
"""Largest angle between the directions of two views that are compared [degree]."""

DEPTHS = (0.2, 4.0)
"""Least and largest depth that is looked for, in distances of the camera from the point that all look at."""

LARGEST_COST = 1.0
"""Cost up to which a plane counts: more than chance has in common."""

LARGEST_STEP = 2.0
"""Distance [pixel] up to which a neighbour is on a pixel's plane."""

LEAST_SHARE = 0.005
LEAST_PIXELS = 121
"""Least part of an image, and least number of pixels, that are a surface and not chance: those of a patch, at least."""

SMALLEST_PART = 0.002
"""Parts of the surface with less area than this share of the largest one's are left out."""


@dataclass(frozen=True, eq=False)
class ViewPlanes:
    """The planes of a view's pixels.

    Attributes:
        camera: The view's, with as many pixels as there are planes.
        depth: Depth of each plane on its pixel's ray [m], ``(H, W)`` float32.
        normals: Unit, in the world, towards the camera, ``(H, W, 3)`` float32.
        costs: 0 where the patch looks the same in two other views, 1 where it has nothing in common with them, 2 where
            no two see it, ``(H, W)`` float32.
    """

    camera: Camera
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    costs: NDArray[np.float32]


def find_planes(
    views: Sequence[CapturedView], pixels: int, *, device: str | None = None, seed: int = 0
) -> list[ViewPlanes]:
    """Find the plane of every pixel of reduced views.

    Args:
        views: Photographs of one moment, at least two; their exposures need not agree. Coverage is not looked at.
        pixels: How many pixels a view is reduced to, about, by whole factors.
        device: Warp device; the first GPU without, or the CPU where there is none.
        seed: Same seed, same device, same result.

    Raises:
        InvalidArrayError: There are fewer than two views.
        InvalidOptionError: ``pixels`` or ``seed`` is out of range.
        DeviceError: The device is not there.
    """
    require_count("pixels", pixels, 1)
    require_count("seed", seed, 0)
    if len(views) < 2:
        raise InvalidArrayError(f"views must be at least two, got {len(views)}. One view alone shows no depth.")
    target = resolve_device(device)
    finest = [view.reduced(reduction(view.camera, pixels)) for view in views]
    side = min(min(view.camera.width, view.camera.height) for view in finest)
    levels = int(np.clip(1 + np.log2(max(side / SMALLEST_SIDE, 1.0)), 1, LEVELS))
    search = _Search(views, target, seed)
    for level in reversed(range(levels)):
        search.improve([view.reduced(2**level) for view in finest], ROUNDS, with_depths=False)
    for _ in range(AGREEMENTS):
        search.improve(finest, ROUNDS // 2, with_depths=True)
    return search.planes()


@dataclass(frozen=True, eq=False)
class AgreedSurface:
    """What is known of the surface.

    Attributes:
        mesh: The planes of all views fused, open where nothing is known; its faces look outward.
        depths: The depth of each view's own planes that are part of it [m], 0 elsewhere, ``(H, W)`` each.
    """

    mesh: trimesh.Trimesh
    depths: tuple[NDArray[np.float32], ...]


def agreed_surface(planes: Sequence[ViewPlanes], *, device: str | None = None) -> AgreedSurface | None:
    """Fuse planes that go on from pixel to pixel and that other views do not contradict; None if nothing is left.

    Chance finds planes too, but not the same surface over many pixels. So what two views show of a face at too wide an
    angle to be sure of each pixel is still known where it is smooth.
    """
    images = DepthImages.of(
        [
            DepthView(camera=found.camera, depth=found.depth, alpha=np.ones_like(found.depth), normals=found.normals)
            for found in planes
        ],
        device=device,
    )
    large = np.concatenate([_in_large_parts(found) for found in planes], axis=None)
    images.keep(upload(large, int, images.device))  # what is left out says nothing, not that nothing is there
    images.keep(depth_consistency(images).mask(0))
    kept = np.split(images.pixels.numpy()[:, 2] > 0.0, images.first_pixels[1:-1])
    depths = [np.where(part.reshape(f.depth.shape), f.depth, 0.0) for f, part in zip(planes, kept, strict=True)]
    try:
        mesh = fuse_depths(images, smallest_part=SMALLEST_PART)
    except InvalidArrayError:
        return None
    return AgreedSurface(mesh, tuple(depths))


def _in_large_parts(planes: ViewPlanes) -> NDArray[np.bool_]:
    """Tell which pixels belong to a large surface, ``(H, W)``: one whose neighbours lie on each other's planes."""
    camera, shape = planes.camera, planes.depth.shape
    rays = camera.directions()
    rays /= (rays @ camera.forward)[..., None]
    distances = planes.depth * (planes.normals * rays).sum(axis=-1)
    number = np.arange(planes.depth.size).reshape(shape)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        tied = (planes.costs[a] < LARGEST_COST) & (planes.costs[b] < LARGEST_COST)
        for here, there in ((a, b), (b, a)):
            expected = distances[here] / (planes.normals[here] * rays[there]).sum(axis=-1)
            tied &= np.abs(expected / planes.depth[there] - 1.0) < LARGEST_STEP / camera.focal_x
        pairs.append(np.stack([number[a][tied], number[b][tied]]))
    ends = np.concatenate(pairs, axis=1)
    graph = coo_matrix((np.ones(ends.shape[1]), tuple(ends)), shape=(number.size, number.size))
    parts = connected_components(graph, directed=False)[1]
    return (np.bincount(parts)[parts] >= max(LEAST_SHARE * number.size, LEAST_PIXELS)).reshape(shape)


def reduction(camera: Camera, pixels: int) -> int:
    """Return the whole factor that leaves about as many pixels of a view."""
    factor = round((camera.width * camera.height / pixels) ** 0.5)
    return max(1, min(factor, min(camera.width, camera.height)))


class _Search:
    """The planes of all views, from one size of images to the next."""

    def __init__(self, views: Sequence[CapturedView], device: Any, seed: int) -> None:
        focus = viewing_focus(views)[0]
        away = np.array([view.camera.position - focus for view in views])
        self.distances = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        self.neighbors = _neighbors(away / self.distances[:, None])
        self.device, self.stage, self.seed = device, 0, seed
        self.cameras: list[Camera] = []
        self.found = [wp.empty(0, dtype=wp.vec4, device=device) for _ in views]
        self.costs = [wp.empty(0, dtype=float, device=device) for _ in views]

    def improve(self, views: Sequence[CapturedView], rounds: int, *, with_depths: bool) -> None:
        """Search in images of one size, from the planes so far; look at those of other views if asked to."""
        device, before = self.device, self.cameras
        self.cameras = [view.camera for view in views]
        firsts = np.cumsum([0, *(camera.width * camera.height for camera in self.cameras)])
        grey = [linear_to_srgb(view.color) @ LUMINANCE.astype(np.float32) for view in views]
        levels = upload(np.concatenate(grey, axis=None), float, device)
        depths = wp.empty(0, dtype=float, device=device)
        if with_depths:
            depths = upload(np.concatenate([planes.numpy()[:, 3] for planes in self.found]), float, device)
        self.found = list(self.found)
        for i, camera in enumerate(self.cameras):
            view, others = self._view(i, firsts), self._others(i, firsts)
            count = camera.width * camera.height
            planes, costs = wp.empty(count, dtype=wp.vec4, device=device), wp.empty(count, dtype=float, device=device)
            width = before[i].width if before else 0
            stream = ((self.seed * 64 + self.stage) * len(self.cameras) + i) % 2**24
            launch_begin_planes(levels, depths, view, others, self.found[i], width, stream, planes, costs, device)
            for number in range(rounds):
                spread = 0.5 ** (number + self.stage)
                launch_improve_planes(levels, depths, view, others, spread, stream * 16 + number, planes, costs, device)
            self.found[i], self.costs[i] = planes, costs
        self.stage += 1

    def planes(self) -> list[ViewPlanes]:
        """Return what was found, in the world's axes."""
        result = []
        for camera, found, costs in zip(self.cameras, self.found, self.costs, strict=True):
            size = (camera.height, camera.width)
            planes = found.numpy().reshape(*size, 4)
            normals = planes[..., :3] @ camera.camera_to_world[:3, :3].T.astype(np.float32)
            result.append(ViewPlanes(camera, planes[..., 3], normals, costs.numpy().reshape(size)))
        return result

    def _view(self, index: int, firsts: NDArray[np.int64]) -> StereoView:
        camera, view = self.cameras[index], StereoView()
        view.focal = wp.vec2(camera.focal_x, camera.focal_y)
        view.center = wp.vec2(camera.center_x, camera.center_y)
        view.width, view.height, view.first_pixel = camera.width, camera.height, int(firsts[index])
        view.nearest, view.farthest = (1.0 / (depth * self.distances[index]) for depth in DEPTHS)
        return view

    def _others(self, index: int, firsts: NDArray[np.int64]) -> wp.array:
        others = []
        for number in self.neighbors[index]:
            camera, other = self.cameras[number], StereoNeighbor()
            move = camera.world_to_camera @ self.cameras[index].camera_to_world
            other.turn, other.shift = wp.mat33(move[:3, :3].astype(np.float32)), wp.vec3(*move[:3, 3])
            other.focal = wp.vec2(camera.focal_x, camera.focal_y)
            other.center = wp.vec2(camera.center_x, camera.center_y)
            other.width, other.height, other.first_pixel = camera.width, camera.height, int(firsts[number])
            others.append(other)
        if not others:
            return wp.empty(0, dtype=StereoNeighbor, device=self.device)
        return wp.array(others, dtype=StereoNeighbor, device=self.device)


def _neighbors(directions: NDArray[np.float64]) -> list[list[int]]:
    """Return the views that each view is compared with, the nearest directions first."""
    cosines = directions @ directions.T
    np.fill_diagonal(cosines, -2.0)
    orders = np.argsort(-cosines, axis=1, kind="stable")[:, :MOST_NEIGHBORS]
    least = np.cos(np.radians(WIDEST))
    return [[int(i) for i in order if row[i] >= least] for row, order in zip(cosines, orders, strict=True)]
