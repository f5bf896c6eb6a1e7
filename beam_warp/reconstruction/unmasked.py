"""The Gaussians that a fit begins with where nothing tells the subject from its surroundings.

Discs lie on the surface that photographs agree on. What they do not agree on still has to be somewhere, or the fit
would paint it onto the surface: each view's other pixels take depths that join those of the surface around them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spsolve

from beam_warp.capture.rigs import LEAST_SHARE, seen_by
from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_count
from beam_warp.image.color import LINEAR_REC709, linear_to_srgb
from beam_warp.reconstruction.hull import viewing_focus
from beam_warp.reconstruction.initial import DISC_OPACITY, even_surface_points, seen_colors, surface_discs
from beam_warp.reconstruction.stereo import DEPTHS, AgreedSurface, agreed_surface, find_planes, reduction
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.harmonics import SH_C0

PIXELS_PER_DISC = 2
"""Pixels of a view whose depth is found, for each Gaussian."""

PIXELS = 30_000
"""Pixels to which a view is reduced, about, to join depths."""

ELSEWHERE_SHARE = 0.5
"""Most of the Gaussians that are not on the surface that views see in common."""

ELSEWHERE_OPACITY = 0.3
"""Opacity of discs whose depth no view knows: some are wrong, and are easily pruned when they start faint."""

EDGE = 0.04
LEAST_TIE = 1e-3
"""Difference of display colours at which neighbouring pixels are tied by 1/e, and how strongly all are at least: depth
jumps where colours do."""

FAR_TIE = 1e-3
"""How strongly a pixel of unknown depth is tied to the farthest, beside 1 to a neighbour of its colour: some 30 pixels
from the surface, the backdrop is more likely far behind than beside it, where other views would see it in between."""

SEEN_THROUGH = 0.05
"""A disc is left out if another view shows the surface behind it, by more than this part of the depth."""


def unmasked_gaussians(
    views: Sequence[CapturedView], count: int, *, device: str | None = None, seed: int = 0
) -> GaussianCloud | None:
    """Return discs on the surface that photographs agree on, and, fainter, where each one's other pixels may be.

    Args:
        views: Photographs of one moment, at least two. Coverage is not looked at.
        count: Number of Gaussians.
        device: Warp device; the first GPU without, or the CPU where there is none.
        seed: Same seed, same device, same result.

    Returns:
        ``count`` Gaussians with radiance of degree 0 in scene-linear Rec.709, normals, and ids from 0 on: first those
        on the surface, then the others. None if no two views agree on anything.

    Raises:
        InvalidArrayError: There are fewer than two views.
        InvalidOptionError: ``count`` or ``seed`` is out of range.
        DeviceError: The device is not there.
    """
    found = _surface_in_common(views, count, device, seed)
    if found is None:
        return None
    surface, cameras = found
    others = _elsewhere(views, cameras, surface.depths, int(ELSEWHERE_SHARE * count), seed)
    positions, normals, spacing = even_surface_points(surface.mesh, count - len(others), device=device, seed=seed)
    colors = seen_colors(views, surface_discs(positions, normals, spacing), device=device)
    known = np.column_stack(
        [positions, normals, np.full(len(positions), spacing), np.full(len(positions), DISC_OPACITY), colors]
    )
    table = np.concatenate([known, others]).astype(np.float32)
    return surface_discs(table[:, :3], table[:, 3:6], table[:, 6]).with_arrays(
        opacities=table[:, 7],
        radiance=(table[:, None, 8:] - np.float32(0.5)) / np.float32(SH_C0),
        radiance_color_space=LINEAR_REC709,
    )


def agreed_discs(
    views: Sequence[CapturedView], count: int, *, device: str | None = None, seed: int = 0
) -> GaussianCloud | None:
    """Return discs spread evenly over the surface that photographs agree on; None if no two agree on anything.

    Args:
        views: Photographs of one moment, at least two. Coverage is not looked at.
        count: Number of discs.
        device: Warp device; the first GPU without, or the CPU where there is none.
        seed: Same seed, same device, same result.

    Raises:
        InvalidArrayError: There are fewer than two views.
        InvalidOptionError: ``count`` or ``seed`` is out of range.
        DeviceError: The device is not there.
    """
    found = _surface_in_common(views, count, device, seed)
    if found is None:
        return None
    return surface_discs(*even_surface_points(found[0].mesh, count, device=device, seed=seed))


def seen_in_common(views: Sequence[CapturedView], points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Tell which points lie in as many images as a subject does, ``(N,)``: the others are backdrops of a few views."""
    counts = np.sum([seen_by(view.camera, points.astype(np.float64)) for view in views], axis=0)
    return counts >= max(2, LEAST_SHARE * len(views))


def joined_depth(depth: NDArray[np.floating], colors: NDArray[np.floating], farthest: float) -> NDArray[np.float64]:
    """Return an image of depth in which pixels without any take it from those around them.

    Inverse depth becomes harmonic: each pixel's is the mean of its neighbours', those of similar colour counting more.
    Inverse depths of a plane are linear in the image, so that a plane is continued as a plane. Far from all that is
    known, depth goes to the farthest.

    Args:
        depth: Known depths [m], 0 where there is none, ``(H, W)``; at least one is known.
        colors: Display colours, ``(H, W, 3)``.
        farthest: Largest depth that is given to a pixel, and that of pixels far from known ones [m].

    Returns:
        Depths [m], ``(H, W)``; those known stay.

    Source: Pérez et al. 2003 for the harmonic interpolation; the screened equation, Bhat et al. 2008.
    """
    known = (depth > 0.0).ravel()
    inverse = np.zeros(depth.size)
    inverse[known] = 1.0 / depth.ravel()[known]
    if not known.all():
        ties = _ties(colors)
        system = (diags(np.asarray(ties.sum(axis=1)).ravel() + FAR_TIE) - ties).tocsr()[~known]
        right = FAR_TIE / farthest - system[:, known] @ inverse[known]
        inverse[~known] = np.asarray(spsolve(system[:, ~known].tocsc(), right))
    return 1.0 / np.maximum(inverse, 1.0 / farthest).reshape(depth.shape)


def _surface_in_common(
    views: Sequence[CapturedView], count: int, device: str | None, seed: int
) -> tuple[AgreedSurface, list[Camera]] | None:
    """Return the agreed surface without backdrops of a few views, and the cameras of its depths, if there is any."""
    require_count("count", count, 1, 2**26)
    planes = find_planes(views, PIXELS_PER_DISC * count, device=device, seed=seed)
    surface = agreed_surface(planes, device=device)
    if surface is None:
        return None
    surface.mesh.update_faces(seen_in_common(views, surface.mesh.triangles_center))
    return None if surface.mesh.is_empty else (surface, [found.camera for found in planes])


def _ties(colors: NDArray[np.floating]) -> csr_matrix:
    """Return how strongly neighbouring pixels are tied, symmetric, ``(P, P)``."""
    number = np.arange(colors.shape[0] * colors.shape[1]).reshape(colors.shape[:2])
    pairs = [(np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])]
    weights = [np.exp(-np.abs(colors[a] - colors[b]).max(axis=-1) / EDGE).ravel() + LEAST_TIE for a, b in pairs]
    ends = [np.concatenate([number[pair[k]].ravel() for pair in pairs]) for k in (0, 1)]
    half = csr_matrix((np.concatenate(weights), tuple(ends)), shape=(number.size, number.size))
    return half + half.T


def _elsewhere(
    views: Sequence[CapturedView],
    cameras: Sequence[Camera],
    depths: Sequence[NDArray[np.floating]],
    most: int,
    seed: int,
) -> NDArray[np.float64]:
    """Return discs of what views show beside the surface in common.

    Each is a position, a normal to the camera, spacing, opacity and colour, ``(N, 11)`` with N at most ``most``.
    """
    steps = [reduction(camera, PIXELS) for camera in cameras]
    cameras = [camera.reduced(step) for camera, step in zip(cameras, steps, strict=True)]
    depths = [depth[step // 2 :: step, step // 2 :: step] for depth, step in zip(depths, steps, strict=True)]
    depths = [depth[: camera.height, : camera.width] for depth, camera in zip(depths, cameras, strict=True)]
    focus = viewing_focus(views)[0]
    rows = []
    for index, camera in enumerate(cameras):
        known = depths[index] > 0.0
        if not known.any():
            continue
        color = views[index].reduced(views[index].camera.width // camera.width).color[: camera.height, : camera.width]
        farthest = DEPTHS[1] * float(np.linalg.norm(camera.position - focus))
        depth = joined_depth(depths[index], linear_to_srgb(color), farthest)[..., None]
        rays = camera.directions()
        places = camera.position + rays * depth / (rays @ camera.forward)[..., None]
        opacity = np.where(known, DISC_OPACITY, ELSEWHERE_OPACITY)[..., None]
        table = np.concatenate([places, -rays, depth / camera.focal_x, opacity, color], axis=-1).reshape(-1, 11)
        others = [pair for other, pair in enumerate(zip(cameras, depths, strict=True)) if other != index]
        known = known.ravel()
        shown = known & seen_in_common(views, table[:, :3])
        rows.append(table[~shown & (known | ~_seen_through(table[:, :3], others))])
    table = np.concatenate([np.zeros((0, 11)), *rows])
    picked = table[np.sort(np.random.default_rng(seed).permutation(len(table))[:most])]
    picked[:, 6] *= np.sqrt(len(table) / max(len(picked), 1))
    return picked


def _seen_through(
    places: NDArray[np.floating], others: Sequence[tuple[Camera, NDArray[np.floating]]]
) -> NDArray[np.bool_]:
    """Tell which places other views see the surface behind, ``(N,)``."""
    result = np.zeros(len(places), bool)
    for camera, depth in others:
        x, y, z = camera.project(places).T
        inside = (x >= 0.0) & (y >= 0.0) & (x < camera.width) & (y < camera.height)
        behind = np.zeros(len(places))
        behind[inside] = depth[y[inside].astype(int), x[inside].astype(int)]
        result |= z < (1.0 - SEEN_THROUGH) * behind
    return result
