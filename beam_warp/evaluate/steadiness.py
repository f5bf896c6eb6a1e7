"""Steadiness of base colour over time: per Gaussian, and at points that are fixed on the true surface."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.checks import require_count
from beam_warp.evaluate.compared import ComparedAsset
from beam_warp.evaluate.drawn import SAMPLES, draw_materials
from beam_warp.image.color import linear_to_srgb
from beam_warp.jobs.listeners import CountProgress
from beam_warp.mesh.distances import SurfaceTree
from beam_warp.raster.records import RasterOptions
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianSequence

POINT_COUNT = 20_000
"""Points on the surface of a person: 10 mm apart."""

LEAST_COSINE = 0.3
"""Points that turn further away from a camera share their pixels with much else of the surface."""

LEVEL_PIXELS = 5.0
"""Depths around a point may differ by so many widths of a pixel there: 3.2 come of a slope of `LEAST_COSINE`."""

LEAST_LASTING = 0.9
"""Part of the triangles that must stay: exporters cut a few squares along the other diagonal as they bend."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Deviation:
    """Standard deviations over time of display-encoded base colour (0 to 1), root mean square over channels.

    Attributes:
        mean: Mean over Gaussians or points.
        p95: 95 % are steadier.
        count: Over how many.
        frames: The capture's frames.
    """

    mean: float
    p95: float
    count: int
    frames: tuple[int, ...]

    @classmethod
    def of(cls, deviations: FloatArray, frames: Iterable[int]) -> Deviation | None:
        """Summarise deviations ``(N,)``, those that are NaN left out; None if none is left."""
        found = deviations[np.isfinite(deviations)]
        if not len(found):
            return None
        return cls(float(found.mean()), float(np.quantile(found, 0.95)), len(found), tuple(frames))


@dataclass(frozen=True)
class SurfaceScores:
    """Steadiness of the base colour of points that are fixed on the true surface, as test cameras see them.

    Attributes:
        ours: Over all frames whose true surface is known.
        ours_where_known: Over the frames whose true images are known as well; None if they are fewer than two.
        truth: The same of the true images: what drawing points as pixels costs, for the surface itself does not change.
        error: Root mean square difference of ours to the true images at those points; None without true images.
    """

    ours: Deviation
    ours_where_known: Deviation | None
    truth: Deviation | None
    error: float | None


@dataclass(frozen=True)
class TemporalScores:
    """Steadiness of base colour over time.

    Attributes:
        gaussians: Of Gaussians that persist, all frames of the asset.
        surface: Of points of the true surface.
        absent: By name of an attribute, why there is none.
    """

    gaussians: Deviation | None
    surface: SurfaceScores | None
    absent: Mapping[str, str]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record."""
        return asdict(self)


class RunningVariance:
    """Mean and variance of rows that come one frame at a time, by Welford's sums; a row may be missing in a frame."""

    def __init__(self, rows: int, columns: int) -> None:
        """Start with nothing."""
        self.counts = np.zeros(rows, np.int64)
        self._means = np.zeros((rows, columns))
        self._squares = np.zeros((rows, columns))

    def add(self, values: NDArray[np.floating[Any]], seen: NDArray[np.bool_] | None = None) -> None:
        """Take the values of a frame, ``(rows, columns)``, where they are seen."""
        rows = np.arange(len(self.counts)) if seen is None else np.flatnonzero(seen)
        self.counts[rows] += 1
        away = values[rows] - self._means[rows]
        self._means[rows] += away / self.counts[rows, None]
        self._squares[rows] += away * (values[rows] - self._means[rows])

    def deviations(self) -> FloatArray:
        """Return the standard deviation over frames, root mean square over columns, ``(rows,)``; NaN of less than two.

        It is that of these frames themselves, not an estimate for others: divided by their number.
        """
        variances = self._squares.mean(axis=1) / np.maximum(self.counts, 1)
        return np.where(self.counts >= 2, np.sqrt(variances), np.nan)


def gaussian_deviation(sequence: GaussianSequence, frames: Sequence[int]) -> Deviation | str:
    """Return the deviations of Gaussians' base colour over all frames of an asset, or why there are none.

    Args:
        sequence: With base colour; every Gaussian counts alike.
        frames: The capture's number of every frame.
    """
    if len(sequence) < 2:
        return "the asset has one frame"
    if sequence.topology != "constant":
        return "Gaussians do not persist from frame to frame"
    if "base_color" in sequence.constant:
        return Deviation(0.0, 0.0, len(sequence[0]), tuple(frames))
    running: RunningVariance | None = None
    for cloud in sequence:
        colors = linear_to_srgb(np.asarray(cloud.base_color, np.float64))
        running = running or RunningVariance(*colors.shape)
        running.add(colors)
    found = None if running is None else Deviation.of(running.deviations(), frames)
    return found or "the asset has no Gaussians"


def surface_scores(
    asset: ComparedAsset,
    *,
    raster: RasterOptions | None = None,
    samples: int = SAMPLES,
    point_count: int = POINT_COUNT,
    device: str | None = None,
    progress: CountProgress | None = None,
) -> SurfaceScores | str:
    """Follow points of the true surface through the test views, or say why that cannot be.

    Points are uniform by area on the surface of the first frame, and stay on their triangles. In every frame and view
    a point counts that the camera sees past every triangle, from the front by a cosine of at least `LEAST_COSINE`, and
    whose four nearest pixels lie on the same piece of surface: there base colour is interpolated between those
    pixels. Its standard deviation over frames is taken for each view by itself, so that nothing but time changes, and
    averaged over the views in which the point is seen in at least two frames.

    Args:
        asset: Relightable. The capture's ``truth/mesh_FFFF.npz`` are of one topology; triangles that are cut otherwise
            in some frame are left out. Records of its split are the views; a camera that stands still is used in all
            frames, also in those of which there is no image.
        raster: How splats are drawn.
        samples: Side of the square of samples of a pixel.
        point_count: Points on the surface.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        progress: Called with (frames done, frames in all).

    Raises:
        AssetFormatError: A file of the truth is damaged.
    """
    require_count("point_count", point_count, 1, 10**8)
    capture = asset.capture
    frames = [frame for frame in sorted(asset.matched) if (capture.folder / f"truth/mesh_{frame:04d}.npz").is_file()]
    if len(frames) < 2:
        return "fewer than two frames of the asset have a true surface"
    lasting = _lasting_faces(capture, frames)
    if not lasting.mean() >= LEAST_LASTING:
        return "the true surface is not of one topology in all frames"
    followed: _Followed | None = None
    for done, frame in enumerate(frames, start=1):
        mesh = read_truth_mesh(capture, frame)
        tree = SurfaceTree(mesh.vertices, mesh.faces, device=device)
        if followed is None:
            faces, weights = tree.sample(point_count, 0)
            followed = _Followed(tree, faces[lasting[faces]], weights[lasting[faces]])
        followed.tree = tree
        cloud = asset.cloud(frame)
        for name, camera, record in _views(capture, asset.split, frame):
            drawn = draw_materials(
                cloud, camera, channels=("base_color",), raster=raster, samples=samples, device=device
            )
            followed.add(name, camera, drawn.channels["base_color"], drawn.alpha, record)
        if progress is not None:
            progress(done, len(frames))
    found = None if followed is None else followed.scores(frames)
    return found or "no point of the true surface is seen in two frames by a camera"


def _lasting_faces(capture: Capture, frames: Sequence[int]) -> NDArray[np.bool_]:
    """Return which triangles are of the same vertices in all frames, ``(F,)``; one False if surfaces differ in size."""
    first = read_truth_mesh(capture, frames[0])
    lasting = np.ones(len(first.faces), bool)
    for frame in frames[1:]:
        mesh = read_truth_mesh(capture, frame)
        if mesh.faces.shape != first.faces.shape or mesh.vertices.shape != first.vertices.shape:
            return np.zeros(1, bool)
        lasting &= (np.asarray(mesh.faces) == first.faces).all(axis=1)
    return lasting


def _views(capture: Capture, split: str, frame: int) -> list[tuple[str, Camera, CaptureRecord | None]]:
    """Return the cameras of a frame with their records, and those that stand still without one."""
    by_name: dict[str, list[CaptureRecord]] = {}
    for record in capture.select(split=split):
        by_name.setdefault(record.camera_name, []).append(record)
    views: list[tuple[str, Camera, CaptureRecord | None]] = []
    for name, records in by_name.items():
        (here,) = [record for record in records if record.frame == frame] or [None]
        if here is not None:
            views.append((name, here.camera, here))
        elif all(_same(record.camera, records[0].camera) for record in records):
            views.append((name, records[0].camera, None))
    return views


def _same(one: Camera, two: Camera) -> bool:
    return all(np.array_equal(getattr(one, field.name), getattr(two, field.name)) for field in fields(Camera))


class _Followed:
    """Points of the surface, and what was seen of them so far; ``tree`` is the surface of the present frame."""

    def __init__(self, tree: SurfaceTree, faces: NDArray[np.int32], weights: FloatArray) -> None:
        self.tree = tree
        self._faces, self._weights = faces, weights
        self._ours, self._where_known, self._truth = (
            defaultdict[str, RunningVariance](lambda: RunningVariance(len(faces), 3)) for _ in range(3)
        )
        self._known_frames: set[int] = set()
        self._squares, self._compared = 0.0, 0

    def add(
        self,
        view: str,
        camera: Camera,
        colors: NDArray[np.float32],
        alpha: NDArray[np.float32],
        record: CaptureRecord | None,
    ) -> None:
        """Take what a view shows of the points."""
        places, seen = readable_points(self.tree, camera, self._faces, self._weights)
        ours = linear_to_srgb(np.clip(interpolated(colors, alpha, places[:, :2], seen), 0.0, 1.0))
        self._ours[view].add(ours, seen)
        truth = None if record is None or record.truth_path is None else record.truth()
        if truth is None or record is None or "base_color.R" not in truth.channels:
            return
        known = truth.stack("base_color.R", "base_color.G", "base_color.B")
        theirs = linear_to_srgb(np.clip(interpolated(known, truth.channels["A"], places[:, :2], seen), 0.0, 1.0))
        self._where_known[view].add(ours, seen)
        self._truth[view].add(theirs, seen)
        self._known_frames.add(record.frame)
        self._squares += float(((ours - theirs)[seen] ** 2).sum())
        self._compared += 3 * int(np.count_nonzero(seen))

    def scores(self, frames: Sequence[int]) -> SurfaceScores | None:
        """Summarise all frames."""
        known = sorted(self._known_frames)
        ours = Deviation.of(_mean_over_views(self._ours), frames)
        if ours is None:
            return None
        return SurfaceScores(
            ours,
            Deviation.of(_mean_over_views(self._where_known), known),
            Deviation.of(_mean_over_views(self._truth), known),
            float(np.sqrt(self._squares / self._compared)) if self._compared else None,
        )


def readable_points(
    tree: SurfaceTree, camera: Camera, faces: NDArray[np.int32], weights: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return where points of a surface are on an image, and which of them four pixels of the same piece show.

    Args:
        tree: The surface.
        camera: Who sees it.
        faces: The triangle of each point, ``(N,)``.
        weights: Barycentric weights of its corners, ``(N, 3)``.

    Returns:
        x, y [pixel] and depth [m], ``(N, 3)``, and ``(N,)``: True where the camera sees the point past every triangle,
        from the front by at least `LEAST_COSINE`, and the surface in its four nearest pixels is as deep as
        `LEVEL_PIXELS` says.
    """
    places = camera.project(tree.at(faces, weights))
    readable = tree.seen_by([camera], faces, weights, least_cosine=LEAST_COSINE)
    first = np.floor(places[:, :2] - 0.5)  # NaN, behind the camera, is not inside
    readable &= (first >= 0.0).all(axis=1) & (first + 1.0 < (camera.width, camera.height)).all(axis=1)
    rows = np.flatnonzero(readable)
    limit = LEVEL_PIXELS * places[rows, 2] / min(camera.focal_x, camera.focal_y)
    for right in (0.5, 1.5):
        for down in (0.5, 1.5):
            x, y = (first[rows, 0] + right - camera.center_x), (first[rows, 1] + down - camera.center_y)
            local = np.stack([x / camera.focal_x, y / camera.focal_y, np.ones(len(rows))], axis=-1)
            length = np.linalg.norm(local, axis=1)
            along = (local / length[:, None]) @ camera.camera_to_world[:3, :3].T
            depth = tree.cast(np.tile(camera.position, (len(rows), 1)), along) / length
            readable[rows] &= np.abs(depth - places[rows, 2]) <= limit  # NaN, beside the surface, is not
    return places, readable


def interpolated(
    image: NDArray[np.floating[Any]], alpha: NDArray[np.floating[Any]], places: FloatArray, seen: NDArray[np.bool_]
) -> FloatArray:
    """Return an image ``(H, W, C)``, not multiplied by alpha, between pixel centres, weighted by alpha.

    Args:
        image: What is read.
        alpha: Coverage, ``(H, W)``; where a place has none, the result is 0.
        places: x and y [pixel], ``(N, 2)``; pixel centres are at 0.5.
        seen: Which places are read, all of them between four pixels.

    Returns:
        ``(N, C)``; 0 for what is not read.
    """
    result = np.zeros((len(places), image.shape[-1]))
    x, y = (places[seen] - 0.5).T
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    sums, total = np.zeros((len(x), image.shape[-1])), np.zeros(len(x))
    for right in (0, 1):
        for down in (0, 1):
            share = np.abs(1 - right - (x - column)) * np.abs(1 - down - (y - row))
            weight = share * alpha[row + down, column + right]
            sums += weight[:, None] * image[row + down, column + right]
            total += weight
    result[seen] = np.divide(sums, total[:, None], out=np.zeros_like(sums), where=total[:, None] > 0.0)
    return result


def _mean_over_views(running: Mapping[str, RunningVariance]) -> FloatArray:
    """Return the mean over views of every point's deviation; NaN where no view has one."""
    if not running:
        return np.zeros(0)
    table = np.stack([view.deviations() for view in running.values()])
    known = np.isfinite(table)
    sums = np.where(known, table, 0.0).sum(axis=0)
    return np.divide(sums, known.sum(axis=0), out=np.full(table.shape[1], np.nan), where=known.any(axis=0))
