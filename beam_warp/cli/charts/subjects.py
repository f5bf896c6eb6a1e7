"""What the charts of ``beam chart`` are of: assets, lights and captures, read or built in."""

from __future__ import annotations

from pathlib import Path

from beam_warp import converters
from beam_warp.capture.capture import Capture
from beam_warp.checks import require_count
from beam_warp.cli.charts.flags import MaterialsChart
from beam_warp.decomposition.capture_images import CaptureImages
from beam_warp.demo.capture import write_demo_capture
from beam_warp.demo.lights import sunset
from beam_warp.errors import InvalidOptionError
from beam_warp.jobs.listeners import NotedProgress
from beam_warp.study.materials import MaterialsSubject
from beam_warp.world.axes import change_axes
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianSequence
from beam_warp.world.metadata import numbers_of_frames

FIGURE_CAMERAS, FIGURE_SIZE = 8, 96
"""Cameras of the built-in capture, and width and height of their images [pixel]."""


def sequence_at(path: Path | None, frame: int, source_axes: str | None = None) -> GaussianSequence:
    """Read an asset that has a frame of this index.

    Raises:
        InvalidOptionError: There is no path, or the asset has no such frame.
    """
    if path is None:
        raise InvalidOptionError("asset must be given, got none. Name a relightable asset.")
    sequence = converters.read(path, source_axes=source_axes)
    require_count("frame", frame, 0, len(sequence) - 1)
    return sequence


def light_at(path: Path | None) -> tuple[EnvironmentMap, str]:
    """Read a light, and return what to call it; without a path, the built-in low sun."""
    return (sunset(), "the built-in low sun") if path is None else (EnvironmentMap.read(path), path.name)


def capture_at(
    path: Path | None, folder: Path, frame: int, device: str | None, report: NotedProgress
) -> tuple[Capture, str]:
    """Read a capture, and return what to call it; without a path, the built-in figure, written to the folder."""
    if path is not None:
        return Capture.read(path), path.name
    made = write_demo_capture(
        folder / "capture",
        frame_count=frame + 1,
        camera_count=FIGURE_CAMERAS,
        size=FIGURE_SIZE,
        device=device,
        progress=report,
    )
    return made, "the built-in figure"


def materials_subject(args: MaterialsChart, folder: Path, report: NotedProgress) -> MaterialsSubject:
    """Return what is decomposed; a built-in capture is written to the folder.

    Raises:
        InvalidOptionError: There is an asset without a capture, no light, or no such frame.
    """
    if args.capture is None and args.asset is not None:
        raise InvalidOptionError(
            f"capture must be given with an asset, got {args.asset} alone. Pass what it was reconstructed from."
        )
    capture, name = capture_at(args.capture, folder, args.frame, args.device, report)
    light = args.environment or capture.environment_path
    if light is None:
        raise InvalidOptionError(f"environment must be given, got none and {name} has none. Pass --environment.")
    environment = EnvironmentMap.read(light)
    if args.asset is None:
        if args.frame not in capture.frames:
            raise InvalidOptionError(
                f"frame must be one of the capture's, got {args.frame}. Choose one of {capture.frames[:8]}."
            )
        return MaterialsSubject.on_true_surface(capture, environment, args.frame, name, args.device)
    sequence = sequence_at(args.asset, args.frame)
    images = CaptureImages(capture, sequence)
    views = images.views(args.frame)
    return MaterialsSubject(
        change_axes(sequence[args.frame], "rfu"),
        views,
        environment,
        images.raster,
        capture,
        numbers_of_frames(sequence.metadata, len(sequence))[args.frame],
        args.asset.parent.name or args.asset.name,
        images.ceiling(args.frame, views),
    )
