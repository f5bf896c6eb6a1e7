"""The Gaussians that reconstruction starts from: discs on the visual hull, or balls at given points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from beam_warp.capture.views import CapturedView
from beam_warp.checks import require_array, require_count, require_finite, require_same_length
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.device.morton import morton_order
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import LINEAR_REC709
from beam_warp.kernels.reconstruction.even_points import ShadedMesh, launch_push_apart
from beam_warp.kernels.reconstruction.seen_colors import SeenImage, launch_agree_colors, launch_sample_colors
from beam_warp.raster.layout import ViewLayout
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays
from beam_warp.raster.resolution import DISC_WIDTH
from beam_warp.reconstruction.hull import VisualHull, masked_views, viewing_focus, visual_hull
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud
from beam_warp.world.harmonics import SH_C0

if TYPE_CHECKING:
    import trimesh

DISC_THICKNESS = 0.15
"""Standard deviation of a disc along its normal, in spacings: a surface to the eye, with room to learn
in both directions."""

DISC_OPACITY = 0.8
"""Opacity of a disc. With discs of `DISC_WIDTH` at each spacing, the alphas over a point add up to 2 pi 0.7^2 0.8 =
2.5: one layer leaves less than exp(-2.5) = 8 % of the light, front and back together less than 1 %."""

BALL_OPACITY = 0.1
"""Opacity of a ball: given points may be wrong, and are easily pruned when they start faint (Kerbl et al. 2023)."""

HEXAGONAL = (2.0 / np.sqrt(3.0)) ** 0.5
"""Distance of neighbours in the densest arrangement of one point for each unit of area."""

RELAXATIONS = 3
"""Rounds in which points look up their neighbours and push each other apart."""

NEIGHBORS = 10
"""Points that a point may have to keep away from, itself included: six surround it where all is even."""

HIDING_OPACITY = 0.9
"""Opacity with which Gaussians are drawn to find which ones are hidden: one is enough to be the median surface."""

DEPTH_SLACK = 3.0
"""Distance by which a Gaussian's centre may lie behind the median surface and still be seen, in largest scales."""

LEAST_FACING = 0.2
"""Cosine between normal and view below which a view says nothing about a point's colour."""


FALLBACK_ROUNDS = 16
"""Rounds of random points of which some lie where the most views look."""


def initial_gaussians(
    views: Sequence[CapturedView],
    count: int,
    *,
    points: ArrayLike | None = None,
    point_colors: ArrayLike | None = None,
    device: str | None = None,
    seed: int = 0,
) -> GaussianCloud:
    """Return Gaussians to start a reconstruction from.

    With masks, discs that lie evenly on the visual hull: local z is its outward normal. With ``points``, balls at them
    as large as the distance to their neighbours (Kerbl et al. 2023): some of them if there are more than ``count``,
    jittered copies if there are fewer. With neither, balls at random where the images of as many views as possible
    overlap, from which only a long optimisation finds a surface; `beam_warp.reconstruction.unmasked` finds more.

    Colours are what most of the views that see a point agree on, towards which its normal turns.

    Args:
        views: What the cameras saw.
        count: Number of Gaussians.
        points: Positions [m], ``(N, 3)``, such as those of structure from motion.
        point_colors: Their colours, scene-linear Rec.709, ``(N, 3)``; those that the views show without.
        device: Warp device; the first GPU without, or the CPU where there is none.
        seed: Same seed, same device, same result.

    Returns:
        ``count`` Gaussians with radiance of degree 0 in scene-linear Rec.709 and ids from 0 on.

    Raises:
        InvalidArrayError: There are no views, their masks share no volume, or ``points`` or
            ``point_colors`` break their contracts.
        InvalidOptionError: ``count`` is out of range.
        DeviceError: The device is not there.
    """
    require_count("count", count, 1, 2**26)
    require_count("seed", seed, 0)
    if not len(views):
        raise InvalidArrayError("views must be at least one, got none. Pass the captured views.")
    if points is None and point_colors is not None:
        raise InvalidArrayError("point_colors need points, got none. Pass the points too.")
    target = str(resolve_device(device))
    rng = np.random.default_rng(seed)
    if points is None and len(masked_views(views)[0]) >= 2:
        shapes = _discs(views, count, target, seed)
    else:
        given = _common_points(views, rng, count) if points is None else require_array("points", points, (None, 3))
        require_finite("points", given)
        if not len(given):
            raise InvalidArrayError("points must be at least one, got none. Leave them out to start from the masks.")
        rows = np.sort(rng.permutation(len(given))[:count]) if count <= len(given) else np.arange(count) % len(given)
        shapes = _balls(views, given, rows, rng)
    if point_colors is None:
        colors = seen_colors(views, shapes, device=target)
    else:
        table = require_array("point_colors", point_colors, (None, 3))
        require_same_length("point_colors", table, "points", len(given))
        require_finite("point_colors", table)
        colors = table[rows]
    return shapes.with_arrays(
        normals=None, radiance=((colors - 0.5) / SH_C0)[:, None, :], radiance_color_space=LINEAR_REC709
    )


def _discs(views: Sequence[CapturedView], count: int, device: str, seed: int) -> GaussianCloud:
    """Return discs on the visual hull, with its normals."""
    hull = visual_hull(views, device=device)
    return surface_discs(*even_surface_points(hull, count, device=device, seed=seed))


def surface_discs(
    positions: NDArray[np.float32], normals: NDArray[np.float32], spacing: float | NDArray[np.float32]
) -> GaussianCloud:
    """Return discs on a surface, local z along its normals, ids from 0 on.

    Args:
        positions: Centres [m], ``(N, 3)``.
        normals: Unit outward normals, ``(N, 3)``.
        spacing: Distance to the neighbours [m], of all or of each, ``(N,)``.
    """
    count = len(positions)
    parts = np.array([DISC_WIDTH, DISC_WIDTH, DISC_THICKNESS], np.float32)
    return GaussianCloud(
        positions=positions,
        orientations=_facing_orientations(normals),
        scales=np.broadcast_to(np.asarray(spacing, np.float32).reshape(-1, 1), (count, 1)) * parts,
        opacities=np.full(count, DISC_OPACITY, np.float32),
        normals=normals,
        ids=np.arange(count),
        axes=WORLD_AXES,
    )


def _balls(
    views: Sequence[CapturedView], points: NDArray[np.float32], rows: NDArray[np.int64], rng: np.random.Generator
) -> GaussianCloud:
    """Return balls at rows of the points; those past the number of points are copies, half a scale away."""
    count = len(rows)
    sizes = _neighbor_distances(points, views)[rows, None]
    shift = np.where(np.arange(count)[:, None] < len(points), 0.0, 0.5 * sizes * rng.standard_normal((count, 3)))
    return GaussianCloud(
        positions=points[rows] + shift,
        orientations=np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (count, 1)),
        scales=np.repeat(sizes, 3, axis=1),
        opacities=np.full(count, BALL_OPACITY, np.float32),
        ids=np.arange(count),
        axes=WORLD_AXES,
    )


def even_surface_points(
    mesh: trimesh.Trimesh | VisualHull, count: int, *, device: str | None = None, seed: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Spread points evenly over a mesh.

    Points start at equal steps of area along a space-filling curve, and then push each other apart along the surface.

    Args:
        mesh: Faces outward.
        count: Number of points.
        device: Warp device; the first GPU without, or the CPU where there is none.
        seed: Same seed, same device, same result.

    Returns:
        Positions [m] and unit normals, ``(count, 3)`` each, and the spacing [m]: the root of the area for one point.
    """
    target = resolve_device(device)
    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int64)
    corners = vertices[faces]
    area_normals = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    vertex_normals = np.stack(
        [sum(np.bincount(faces[:, k], area_normals[:, axis], len(vertices)) for k in range(3)) for axis in range(3)],
        axis=1,
    )
    vertex_normals /= np.maximum(np.linalg.norm(vertex_normals, axis=1, keepdims=True), 1e-300)
    rng = np.random.default_rng(seed)
    areas = np.linalg.norm(area_normals, axis=1)
    centers = upload(corners.mean(axis=1), wp.vec3, target)
    order = morton_order(centers, centers, wp.ones(len(faces), dtype=int, device=target))[0].numpy()[: len(faces)]
    ends = np.cumsum(areas[order])
    chosen = np.searchsorted(ends, ends[-1] * (np.arange(count) + rng.random(count)) / count, side="right")
    face = order[np.minimum(chosen, len(faces) - 1)]
    root, part = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    weights = np.concatenate([1.0 - root, root * (1.0 - part), root * part], axis=1)[:, :, None]
    spacing = float(np.sqrt(ends[-1] / count))

    triangles = wp.Mesh(upload(vertices, wp.vec3, target), upload(faces.ravel(), int, target))
    surface = ShadedMesh()
    surface.mesh, surface.faces = triangles.id, triangles.indices
    surface.normals = upload(vertex_normals, wp.vec3, target)
    positions = upload((weights * corners[face]).sum(axis=1), wp.vec3, target)
    normals = (weights * vertex_normals[faces[face]]).sum(axis=1)
    normals = upload(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300), wp.vec3, target)
    for _ in range(RELAXATIONS if count > 1 else 0):
        places = positions.numpy()
        found = cKDTree(places, balanced_tree=False).query(places, k=min(NEIGHBORS, count), workers=-1)[1]
        neighbors = upload(found.reshape(count, -1).astype(np.int32), int, target)
        moved, turned = (wp.empty(count, dtype=wp.vec3, device=target) for _ in range(2))
        launch_push_apart(positions, normals, neighbors, HEXAGONAL * spacing, surface, moved, turned, target)
        positions, normals = moved, turned
    return positions.numpy(), normals.numpy(), spacing


def seen_colors(
    views: Sequence[CapturedView], cloud: GaussianCloud, *, device: str | None = None
) -> NDArray[np.float32]:
    """Return the colour of every Gaussian that most of the views that see it agree on.

    Drawing the Gaussians shows which ones are hidden. Those that no view sees take the colour of the nearest seen one;
    grey if none is.

    Args:
        views: What the cameras saw.
        cloud: Gaussians; those of a cloud with normals are seen from their side only.
        device: Warp device; the first GPU without, or the CPU where there is none.

    Returns:
        Scene-linear Rec.709, ``(N, 3)`` float32.
    """
    target = resolve_device(device)
    count = len(cloud)
    normals = np.zeros((count, 3)) if cloud.normals is None else cloud.normals
    samples = view_samples(views, cloud, normals, device=device)
    colors = wp.empty(count, dtype=wp.vec3, device=target)
    seen = wp.empty(count, dtype=int, device=target)
    launch_agree_colors(len(colors), samples, colors, seen, target)
    result, known = colors.numpy(), seen.numpy() > 0
    if not known.any():
        return np.full((count, 3), 0.5, np.float32)
    if not known.all():
        result[~known] = result[known][cKDTree(cloud.positions[known]).query(cloud.positions[~known], workers=-1)[1]]
    return result


def view_samples(
    views: Sequence[CapturedView], cloud: GaussianCloud, normals: NDArray[np.floating], *, device: str | None = None
) -> wp.array:
    """Return the colour of every Gaussian in each view, on the device.

    Args:
        views: What the cameras saw.
        cloud: Gaussians.
        normals: Side from which each Gaussian is seen, ``(N, 3)``; all sides where it is 0.
        device: Warp device; the first GPU without, or the CPU where there is none.

    Returns:
        Scene-linear Rec.709, not premultiplied, and a weight in [0, 1], 0 where the view does not see the Gaussian:
        ``(V, N)`` vec4.
    """
    target, count = resolve_device(device), len(cloud)
    gaussians = GaussianArrays(
        upload(cloud.positions, wp.vec3, target),
        upload(cloud.orientations, wp.quat, target),
        upload(cloud.scales, wp.vec3, target),
        wp.full(count, HIDING_OPACITY, dtype=float, device=target),
    )
    directions = upload(normals.astype(np.float32), wp.vec3, target)
    samples = wp.empty((len(views), count), dtype=wp.vec4, device=target)
    slack = DEPTH_SLACK * float(np.median(cloud.scales.max(axis=1)))
    rasterizers: dict[tuple[int, int], Rasterizer] = {}
    for row, view in enumerate(views):
        size = (view.camera.width, view.camera.height)
        alpha = np.ones(size[0] * size[1], np.float32) if view.alpha is None else view.alpha.reshape(-1)
        if size not in rasterizers:
            rasterizers[size] = Rasterizer(count, [view.camera], device=target)
        rasterizers[size].set_cameras([view.camera])
        images = rasterizers[size].draw(gaussians)
        image = SeenImage()
        image.view = ViewLayout.of([view.camera]).views[0]
        image.color = upload(view.color.reshape(-1, 3), wp.vec3, target)
        image.alpha = upload(alpha, float, target)
        image.depth = images.median_depth
        launch_sample_colors(gaussians.positions, directions, image, slack, LEAST_FACING, row, samples, target)
    return samples


def _facing_orientations(normals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return quaternions xyzw that turn z into the normals."""
    z = normals.astype(np.float64)
    z /= np.linalg.norm(z, axis=1, keepdims=True)  # else SciPy finds axes that are off by rounding, and mends each
    helper = np.where(np.abs(z[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=2)).as_quat().astype(np.float32)


def _neighbor_distances(points: NDArray[np.float32], views: Sequence[CapturedView]) -> NDArray[np.float32]:
    """Return the root mean square distance of each point to its three nearest (Kerbl et al. 2023), never 0."""
    origins = np.array([view.camera.position for view in views])
    least = 1e-4 * float(np.median(np.linalg.norm(origins - points.mean(axis=0), axis=1)))
    if len(points) == 1:
        return np.full(1, max(100.0 * least, 1e-6), np.float32)
    distances = cKDTree(points).query(points, k=min(4, len(points)), workers=-1)[0][:, 1:]
    return np.maximum(np.sqrt((distances**2).mean(axis=1)), max(least, 1e-6)).astype(np.float32)


def _common_points(views: Sequence[CapturedView], rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Return random points in the volume that the most views see; fewer than asked for if it is hard to hit."""
    middle, reach = viewing_focus(views)
    reach = max(reach, 1e-3)
    lower, upper = middle - reach, middle + reach
    kept, most, batch = np.zeros((0, 3)), 0, max(4 * count, 4096)
    for _ in range(FALLBACK_ROUNDS):
        candidates = rng.uniform(lower, upper, (batch, 3))
        seen = np.zeros(batch, np.int64)
        for view in views:
            x, y, _ = view.camera.project(candidates).T
            seen += (x >= 0.0) & (y >= 0.0) & (x <= view.camera.width) & (y <= view.camera.height)
        if seen.max() > most:
            kept, most = np.zeros((0, 3)), int(seen.max())
        kept = np.concatenate([kept, candidates[seen == most]])
        if len(kept) >= count:
            break
        if len(kept) > 100:  # enough to know where they are, to a few per cent
            margin = 0.1 * (kept.max(axis=0) - kept.min(axis=0))
            lower, upper = kept.min(axis=0) - margin, kept.max(axis=0) + margin
    return kept[:count].astype(np.float32)
