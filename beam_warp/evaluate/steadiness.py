"""Steadiness of base colour and ambient occlusion over time: per Gaussian, and at points fixed on the true surface.

Such a point is what a texel of a texture is, so that the latter is flicker in texture space too, whatever the layout.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.checks import require_count
from beam_warp.evaluate.compared import ComparedAsset
from beam_warp.evaluate.drawn import DrawnMaterials, draw_materials, true_channel
from beam_warp.image.color import linear_to_srgb
from beam_warp.jobs.listeners import CountProgress, no_progress
from beam_warp.mesh.distances import SurfaceTree
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.resolution import LEAST_SAMPLES
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
    """Standard deviations over time of a channel from 0 to 1, root mean square over its components.

    Base colour is encoded for display, and does not change: its deviation is from the mean over all frames. Occlusion
    changes as the subject moves: its deviation is the noise that second differences show (`RunningFlicker`).

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
    """Steadiness of a channel at points that are fixed on the true surface, as test cameras see them.

    Attributes:
        ours: Over all frames whose true surface is known.
        ours_where_known: Over the frames whose true images are known as well; None if they are too few.
        truth: The same of the true images: what drawing points as pixels costs, and, of occlusion, uneven change.
        error: Root mean square difference of ours to the true images at those points; None without true images.
    """

    ours: Deviation
    ours_where_known: Deviation | None
    truth: Deviation | None
    error: float | None


@dataclass(frozen=True)
class TemporalScores:
    """Steadiness over time.

    Attributes:
        gaussians: Of Gaussians that persist, base colour, all frames of the asset.
        surface: Of points of the true surface, base colour.
        occlusion_gaussians: Of Gaussians, ambient occlusion.
        occlusion_surface: Of points of the true surface, ambient occlusion.
        absent: By name of an attribute, why there is none.
    """

    gaussians: Deviation | None
    surface: SurfaceScores | None
    occlusion_gaussians: Deviation | None
    occlusion_surface: SurfaceScores | None
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

    def add(self, frame: int, values: NDArray[np.floating[Any]], seen: NDArray[np.bool_] | None = None) -> None:
        """Take the values of a frame, ``(rows, columns)``, where they are seen; its number does not matter."""
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


class RunningFlicker:
    """Noise of rows that come one frame at a time and change evenly; a row may be missing in a frame.

    Three frames that are as far from each other have the second difference d = x_1 - 2 x_2 + x_3: 0 where x changes at
    an even rate, and of the variance 6 σ² where x has independent noise of the deviation σ.
    """

    def __init__(self, rows: int, columns: int) -> None:
        """Start with nothing."""
        self._counts = np.zeros(rows, np.int64)
        self._squares = np.zeros(rows)
        self._columns = columns
        self._before: list[tuple[int, FloatArray, NDArray[np.bool_]]] = []

    def add(self, frame: int, values: NDArray[np.floating[Any]], seen: NDArray[np.bool_] | None = None) -> None:
        """Take the values of a frame of this number, ``(rows, columns)``, where they are seen; numbers rise."""
        there = np.ones(len(self._counts), bool) if seen is None else seen
        self._before = [*self._before, (frame, np.array(values, np.float64), np.array(there))][-3:]
        if len(self._before) < 3:
            return
        (first, one, a), (middle, two, b), (_, three, c) = self._before
        if frame - middle == middle - first:
            rows = np.flatnonzero(a & b & c)
            self._counts[rows] += 1
            self._squares[rows] += ((one - 2.0 * two + three)[rows] ** 2).mean(axis=1)

    def deviations(self) -> FloatArray:
        """Return the standard deviation of the noise, root mean square over columns, ``(rows,)``; NaN if not known."""
        return np.where(self._counts > 0, np.sqrt(self._squares / np.maximum(6 * self._counts, 1)), np.nan)


Running = RunningVariance | RunningFlicker

RUNNING: Mapping[str, type[RunningVariance] | type[RunningFlicker]] = MappingProxyType(
    {"base_color": RunningVariance, "ambient_occlusion": RunningFlicker}
)
"""What is followed over time, and what of it counts."""


def gaussian_deviation(
    sequence: GaussianSequence, frames: Sequence[int], channel: str = "base_color"
) -> Deviation | str:
    """Return the deviations of Gaussians over all frames of an asset, or why there are none.

    Args:
        sequence: Relightable; every Gaussian counts alike.
        frames: The capture's number of every frame.
        channel: Which one of `RUNNING`.
    """
    if len(sequence) < 2:
        return "the asset has one frame"
    if sequence.topology != "constant":
        return "Gaussians do not persist from frame to frame"
    if channel in sequence.constant:
        return Deviation(0.0, 0.0, len(sequence[0]), tuple(frames))
    running: Running | None = None
    for frame, cloud in zip(frames, sequence, strict=True):
        values = encoded(channel, np.asarray(getattr(cloud, channel), np.float64).reshape(len(cloud), -1))
        running = running or RUNNING[channel](*values.shape)
        running.add(frame, values)
    if running is not None and not np.isfinite(running.deviations()).any():
        return "no three frames of the asset are evenly apart"
    found = None if running is None else Deviation.of(running.deviations(), frames)
    return found or "the asset has no Gaussians"


def encoded(channel: str, values: FloatArray) -> FloatArray:
    """Return values of a channel as they are compared: base colour encoded for display."""
    return linear_to_srgb(np.clip(values, 0.0, 1.0)) if channel == "base_color" else values


def surface_scores(
    asset: ComparedAsset,
    *,
    raster: RasterOptions | None = None,
    samples: int = LEAST_SAMPLES,
    point_count: int = POINT_COUNT,
    device: str | None = None,
    progress: CountProgress = no_progress,
) -> dict[str, SurfaceScores | str]:
    """Follow points of the true surface through the test views: by channel of `RUNNING` its scores, or why it has none.

    Points are uniform by area on the surface of the first frame, and stay on their triangles. In every frame and view
    a point counts that the camera sees past every triangle, from the front by a cosine of at least `LEAST_COSINE`, and
    whose four nearest pixels lie on the same piece of surface: there channels are interpolated between those pixels.
    Their deviation over frames is taken for each view by itself, so that nothing but time changes, and averaged over
    the views in which the point is seen in enough frames: two for base colour, three evenly apart for occlusion.

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
        return dict.fromkeys(RUNNING, "fewer than two frames of the asset have a true surface")
    lasting = _lasting_faces(capture, frames)
    if not lasting.mean() >= LEAST_LASTING:
        return dict.fromkeys(RUNNING, "the true surface is not of one topology in all frames")
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
                cloud, camera, channels=tuple(RUNNING), raster=raster, samples=samples, device=device
            )
            followed.add(frame, name, camera, drawn, record)
        progress(done, len(frames))
    assert followed is not None
    too_few = {"base_color": "two frames", "ambient_occlusion": "three frames that are evenly apart"}
    return {
        channel: followed.scores(channel, frames) or f"no point of the true surface is seen in {few} by a camera"
        for channel, few in too_few.items()
    }


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
        self._seen = {channel: _Seen(channel) for channel in RUNNING}

    def add(self, frame: int, view: str, camera: Camera, drawn: DrawnMaterials, record: CaptureRecord | None) -> None:
        """Take what a view shows of the points."""
        places, seen = readable_points(self.tree, camera, self._faces, self._weights)
        truth = None if record is None or record.truth_path is None else record.truth()
        for channel, kept in self._seen.items():
            ours = interpolated(drawn.channels[channel], drawn.alpha, places[:, :2], seen)
            known = None if truth is None else true_channel(truth, channel)
            theirs = None
            if truth is not None and known is not None:
                theirs = interpolated(known, truth.channels["A"], places[:, :2], seen)
            kept.add(frame, view, ours, theirs, seen)

    def scores(self, channel: str, frames: Sequence[int]) -> SurfaceScores | None:
        """Summarise all frames."""
        return self._seen[channel].scores(frames)


class _Seen:
    """What was seen of a channel at the points, view by view."""

    def __init__(self, channel: str) -> None:
        self._channel = channel
        self._ours, self._where_known, self._truth = (dict[str, Running]() for _ in range(3))
        self._known_frames: set[int] = set()
        self._squares, self._compared = 0.0, 0

    def add(self, frame: int, view: str, ours: FloatArray, truth: FloatArray | None, seen: NDArray[np.bool_]) -> None:
        """Take the values of a view, ``(N, C)``, and the true ones, if they are known."""
        ours = encoded(self._channel, ours)
        self._take(self._ours, frame, view, ours, seen)
        if truth is None:
            return
        truth = encoded(self._channel, truth)
        self._take(self._where_known, frame, view, ours, seen)
        self._take(self._truth, frame, view, truth, seen)
        self._known_frames.add(frame)
        self._squares += float(((ours - truth)[seen] ** 2).sum())
        self._compared += ours.shape[1] * int(np.count_nonzero(seen))

    def _take(
        self, running: dict[str, Running], frame: int, view: str, values: FloatArray, seen: NDArray[np.bool_]
    ) -> None:
        if view not in running:
            running[view] = RUNNING[self._channel](*values.shape)
        running[view].add(frame, values, seen)

    def scores(self, frames: Sequence[int]) -> SurfaceScores | None:
        """Summarise all frames; None if there is no deviation."""
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
    """Return an image ``(H, W, C)`` or ``(H, W)``, not multiplied by alpha, between pixel centres, weighted by alpha.

    Args:
        image: What is read.
        alpha: Coverage, ``(H, W)``; where a place has none, the result is 0.
        places: x and y [pixel], ``(N, 2)``; pixel centres are at 0.5.
        seen: Which places are read, all of them between four pixels.

    Returns:
        ``(N, C)``, C of an image without channels being 1; 0 for what is not read.
    """
    image = image.reshape(*image.shape[:2], -1)
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


def _mean_over_views(running: Mapping[str, Running]) -> FloatArray:
    """Return the mean over views of every point's deviation; NaN where no view has one."""
    if not running:
        return np.zeros(0)
    table = np.stack([view.deviations() for view in running.values()])
    known = np.isfinite(table)
    sums = np.where(known, table, 0.0).sum(axis=0)
    return np.divide(sums, known.sum(axis=0), out=np.full(table.shape[1], np.nan), where=known.any(axis=0))
