"""The surface that photographs without masks agree on: depth by photometric consistency, checked and fused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.capture.views import CapturedView
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.image.color import LUMINANCE, linear_to_srgb
from beam_warp.kernels.reconstruction.patch_match import (
    StereoNeighbor,
    StereoView,
    launch_begin_planes,
    launch_improve_planes,
)
from beam_warp.reconstruction.hull import viewing_focus
from beam_warp.world.camera import Camera

SIDE = 480
"""Longest side of the images that are compared, about [pixel]."""

LEVELS = 3
"""Sizes of images, each half of the next: the search begins with the smallest, where plain surfaces have texture."""

ROUNDS = 6
"""Times that all pixels improve their planes, at each level."""

MOST_NEIGHBORS = 6
"""Most views that a view is compared with: those that look from the nearest directions."""

WIDEST = 75.0
"""Largest angle between the directions of two views that are compared [degree]."""

DEPTHS = (0.2, 4.0)
"""Least and largest depth that is looked for, in distances of the camera from the point that all look at."""


@dataclass(frozen=True, eq=False)
class Planes:
    camera: Camera
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    costs: NDArray[np.float32]


AGREEMENTS = 2
"""Times that views look at each other's depths, after the finest level."""


def find_planes(views: Sequence[CapturedView], *, device=None, side=SIDE, rounds=ROUNDS, agreements=AGREEMENTS, seed=0) -> list[Planes]:
    target = resolve_device(device)
    focus = viewing_focus(views)[0]
    away = np.array([view.camera.position - focus for view in views])
    distances = np.linalg.norm(away, axis=1)
    directions = away / distances[:, None]
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0)))
    near = []
    for row in angles:
        order = np.argsort(row, kind="stable")[1:]
        near.append([int(i) for i in order[row[order] <= WIDEST][:MOST_NEIGHBORS]])
    factor = max(1, round(max(max(v.camera.width, v.camera.height) for v in views) / side))
    found = [(wp.empty(0, dtype=wp.vec4, device=target), 0, None)] * len(views)
    none = wp.empty(0, dtype=float, device=target)
    stages = [(level, False) for level in range(LEVELS - 1, -1, -1)] + [(0, True)] * agreements
    for stage, (level, agree) in enumerate(stages):
        if not agree:
            small = [view.reduced(factor * 2**level) for view in views]
            levels = np.concatenate([linear_to_srgb(v.color) @ LUMINANCE.astype(np.float32) for v in small], axis=None)
            array = upload(levels, float, target)
            firsts = np.cumsum([0] + [v.camera.width * v.camera.height for v in small])
        depths = upload(np.concatenate([f[0].numpy()[:, 3] for f in found]), float, target) if agree else none
        new = []
        for i, view in enumerate(small):
            sv = StereoView()
            cam = view.camera
            sv.focal, sv.center = wp.vec2(cam.focal_x, cam.focal_y), wp.vec2(cam.center_x, cam.center_y)
            sv.width, sv.height, sv.first_pixel = cam.width, cam.height, int(firsts[i])
            sv.nearest, sv.farthest = 1.0 / (DEPTHS[0] * distances[i]), 1.0 / (DEPTHS[1] * distances[i])
            others = []
            for j in near[i]:
                o, n = small[j].camera, StereoNeighbor()
                move = o.world_to_camera @ cam.camera_to_world
                n.turn, n.shift = wp.mat33(move[:3, :3].astype(np.float32)), wp.vec3(*move[:3, 3])
                n.focal, n.center = wp.vec2(o.focal_x, o.focal_y), wp.vec2(o.center_x, o.center_y)
                n.width, n.height, n.first_pixel = o.width, o.height, int(firsts[j])
                others.append(n)
            nbs = wp.array(others, dtype=StereoNeighbor, device=target)
            pixels = cam.width * cam.height
            planes, costs = wp.empty(pixels, dtype=wp.vec4, device=target), wp.empty(pixels, dtype=float, device=target)
            launch_begin_planes(array, depths, sv, nbs, *found[i][:2], seed + 1000 * stage + i, planes, costs, target)
            for r in range(rounds // (2 if agree else 1)):
                spread = 0.5 ** (r + stage)
                launch_improve_planes(array, depths, sv, nbs, spread, seed + 7919 * (r + 1) + 31 * stage + i, planes, costs, target)
            new.append((planes, cam.width, costs))
        found = new
    result = []
    for (planes, width, costs), view in zip(found, small):
        cam = view.camera
        p = planes.numpy().reshape(cam.height, cam.width, 4)
        result.append(Planes(cam, p[..., 3], p[..., :3] @ cam.camera_to_world[:3, :3].T.astype(np.float32), costs.numpy().reshape(cam.height, cam.width)))
    return result
