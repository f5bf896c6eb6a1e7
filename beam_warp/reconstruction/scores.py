"""Scores of one reconstructed frame, against views that training did not see and against the true surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from beam_warp.capture.capture import Capture, CaptureRecord
from beam_warp.errors import AssetFormatError, InvalidArrayError, MissingFileError
from beam_warp.image.color import DISPLAY_SRGB, linear_to_srgb, srgb_to_linear
from beam_warp.image.metrics import SOLID_ALPHA, Score, angles_between, block_means, compare, psnr, ssim
from beam_warp.mesh.distances import SAMPLE_COUNT, SurfaceDistances, surface_distances
from beam_warp.raster.channels import RADIANCE, SURFACE_NORMALS
from beam_warp.raster.gbuffer import GBuffer, rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud


@dataclass(frozen=True)
class ViewScores:
    """Scores of one view that training did not see.

    Attributes:
        name: Name of the view's record.
        novel_view: Scores of colour inside the subject's bounding box and where it is solid, as `Score` says.
        whole_psnr: PSNR of the whole image, composited on black [dB].
        whole_ssim: Structural similarity of the whole image, composited on black.
        normals_mean_degrees: Mean angle between normals of geometry and the truth, where the truth is solid; None
            without truth.
        normals_median_degrees: Median of those angles.
        depth_median_mm: Median of the absolute error of expected depth, where the truth is solid [mm].
        median_depth_median_mm: Median of the absolute error of median depth, likewise [mm].
        alpha_error: Mean absolute error of coverage over the whole image.
    """

    name: str
    novel_view: Score
    whole_psnr: float
    whole_ssim: float
    alpha_error: float
    normals_mean_degrees: float | None = None
    normals_median_degrees: float | None = None
    depth_median_mm: float | None = None
    median_depth_median_mm: float | None = None


@dataclass(frozen=True)
class FrameScores:
    """Scores of one reconstructed frame: means over its views, and its surface.

    Attributes:
        views: Scores of each view.
        surface: Distances between the extracted and the true mesh; None where either is not given.
    """

    views: tuple[ViewScores, ...]
    surface: SurfaceDistances | None = None

    @property
    def psnr(self) -> float:
        """Mean over views inside the subject's bounding box [dB]: the figure of the paper."""
        return float(np.mean([view.novel_view.psnr for view in self.views]))

    @property
    def normals_median_degrees(self) -> float | None:
        """Mean over views of the median angle; None without truth."""
        return self._mean("normals_median_degrees")

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-able record: means over views, under the names of `ViewScores` and `Score`."""
        record: dict[str, Any] = {
            name: float(np.mean([getattr(view.novel_view, name) for view in self.views]))
            for name in ("psnr", "ssim", "solid_psnr")
        }
        means = {score.name: self._mean(score.name) for score in fields(ViewScores)[2:]}
        record |= {name: mean for name, mean in means.items() if mean is not None}
        if self.surface is not None:
            record["surface"] = self.surface.as_dict()
        return record | {"views": len(self.views)}

    def _mean(self, name: str) -> float | None:
        values = [value for view in self.views if (value := getattr(view, name)) is not None]
        return float(np.mean(values)) if values else None


def score_frame(
    cloud: GaussianCloud,
    records: Sequence[CaptureRecord],
    mesh: trimesh.Trimesh | None = None,
    *,
    truth_mesh: trimesh.Trimesh | None = None,
    seeing: Sequence[Camera] = (),
    options: RasterOptions | None = None,
    samples: int = 1,
    sample_count: int = SAMPLE_COUNT,
    device: str | None = None,
) -> FrameScores:
    """Score a reconstructed frame.

    Novel views are composited on black, cut to [0, 1] and encoded as sRGB, both ours and the image. Normals are those
    that geometry gives (`surface_normals`), depths are along the optical axis; both are compared where the truth's
    alpha is above `SOLID_ALPHA`. Where ours covers nothing there, its normal is 90 degrees off and its depth 0.

    Args:
        cloud: Gaussians with radiance, in the capture's world.
        records: Views of the frame that training did not see, at least one; images without alpha are taken as solid.
        mesh: Surface extracted from the Gaussians, for the Chamfer distance.
        truth_mesh: The true surface; `read_truth_mesh` reads it.
        seeing: Cameras that took the training images: only what they see of the truth counts. Those of ``records``
            without.
        options: How splats are drawn: as in training.
        samples: Side of the square of samples of a pixel's colour and alpha: as in training.
        sample_count: Points on each surface.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.

    Raises:
        InvalidArrayError: There is no record, the cloud has no radiance, or a view shows no subject.
        MissingFileError: An image or truth file is not there.
        DeviceError: There is no such device.
    """
    if not records:
        raise InvalidArrayError("records must hold at least one view, got none. Choose the capture's test split.")
    cameras = [record.camera for record in records]
    buffers = rasterize(cloud, cameras, channels=(RADIANCE, SURFACE_NORMALS), options=options, device=device)
    fine = [camera.supersampled(samples) for camera in cameras]
    colors = rasterize(cloud, fine, channels=(RADIANCE,), options=options, device=device) if samples > 1 else buffers
    views = tuple(
        _score_view(
            buffer, block_means(seen_radiance(color, cloud), samples), block_means(color.alpha, samples), record
        )
        for buffer, color, record in zip(buffers, colors, records, strict=True)
    )
    surface = None
    if mesh is not None and truth_mesh is not None:
        surface = surface_distances(mesh, truth_mesh, seeing or cameras, sample_count=sample_count, device=device)
    return FrameScores(views, surface)


def seen_radiance(buffer: GBuffer, cloud: GaussianCloud) -> NDArray[np.float64]:
    """Return what a camera sees as scene-linear colour over black, ``(H, W, 3)``: not below 0, not cut above."""
    over_black = np.maximum(buffer.channels[RADIANCE].astype(np.float64) * buffer.alpha[..., None], 0.0)
    return srgb_to_linear(over_black) if cloud.radiance_color_space == DISPLAY_SRGB else over_black


def read_truth_mesh(capture: Capture, frame: int) -> trimesh.Trimesh:
    """Read the true surface of a frame, ``truth/mesh_FFFF.npz``; its topology is the same in every frame.

    Raises:
        MissingFileError: The capture has none for that frame.
        AssetFormatError: The file is damaged.
    """
    path = capture.folder / f"truth/mesh_{frame:04d}.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            return trimesh.Trimesh(file["vertices"], file["faces"], process=False)
    except FileNotFoundError as error:
        raise MissingFileError(
            f"truth must have a mesh for every frame scored, got none at {path}. Choose a capture that has it."
        ) from error
    except (OSError, ValueError, KeyError) as error:
        raise AssetFormatError(
            f"truth mesh must be an npz of vertices and faces, got {error} at {path}. Copy it again."
        ) from error


def truth_frames(capture: Capture) -> tuple[int, ...]:
    """Return the frames whose test views have exact channels, ascending."""
    return tuple(sorted({record.frame for record in capture.select(split="test") if record.truth_path is not None}))


def _score_view(
    buffer: GBuffer, radiance: NDArray[np.floating], alpha: NDArray[np.floating], record: CaptureRecord
) -> ViewScores:
    """Score one view."""
    image = record.image().linear_rgba()
    truth = record.truth() if record.truth_path is not None else None
    truth_alpha = image[..., 3] if truth is None or truth.alpha is None else truth.alpha
    ours, theirs = (linear_to_srgb(np.clip(rgb, 0.0, 1.0)) for rgb in (radiance, image[..., :3].astype(np.float64)))
    colors: dict[str, Any] = {
        "name": record.name,
        "novel_view": compare(
            radiance, image[..., :3], alpha=alpha, truth_alpha=truth_alpha, is_color=True, premultiplied=True
        ),
        "whole_psnr": psnr(ours, theirs),
        "whole_ssim": ssim(ours, theirs),
        "alpha_error": float(np.abs(alpha.astype(np.float64) - truth_alpha).mean()),
    }
    if truth is None:
        return ViewScores(**colors)
    solid = truth_alpha > SOLID_ALPHA
    angles = angles_between(
        buffer.channels[SURFACE_NORMALS][solid], truth.stack("normal.X", "normal.Y", "normal.Z")[solid]
    )
    depth = truth.stack("depth")[..., 0][solid].astype(np.float64)
    return ViewScores(
        **colors,
        normals_mean_degrees=float(angles.mean()),
        normals_median_degrees=float(np.median(angles)),
        depth_median_mm=1e3 * float(np.median(np.abs(buffer.depth[solid] - depth))),
        median_depth_median_mm=1e3 * float(np.median(np.abs(buffer.median_depth[solid] - depth))),
    )
