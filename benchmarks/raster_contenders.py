"""Contenders of the raster benchmark, drawing as they are or as a CUDA graph, and their times, taken in turn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray
from raster_readable import ReadableRasterizer
from raster_scenes import RasterScene
from timing import Task, Times, take_turns

from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import RasterOptions
from beam_warp.raster.sources import upload_gaussians

GEOMETRY = ("positions", "orientations", "scales", "opacities")


class Seen(NamedTuple):
    """Images of one view, or a loss's derivatives to them; rows are pixels.

    Attributes:
        channels: Sums of channels weighted by visibility, ``(P, K)``.
        alpha: ``(P,)``.
        depth: Mean depth [m], ``(P,)``.
        median_depth: [m], ``(P,)``.
    """

    channels: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]


def random_adjoints(pixel_count: int, channel_count: int) -> Seen:
    """Return normally distributed derivatives of a loss to every image."""
    rng = np.random.default_rng(0)
    draw = lambda *shape: rng.standard_normal(shape, dtype=np.float32)  # noqa: E731
    return Seen(draw(pixel_count, channel_count), draw(pixel_count), draw(pixel_count), draw(pixel_count))


class Drawing:
    """A scene on a device and the rasteriser that has drawn it; derivatives to its images are random.

    Args:
        scene: What is drawn.
        device: A resolved Warp device.
        values: What is composited of the Gaussians' own, ``(N, K)``; the scene's 11 channels without.
        radiance: Spherical harmonics of captured colour ``(N, B, 3)``, composited too.
        normals: Whether the normals of the geometry are composited.
        options: Of the rasteriser.
        readable: Whether the oracle composites.
        checkpoints: Whether the way back shares out long lists.
    """

    def __init__(
        self,
        scene: RasterScene,
        device: Any,
        *,
        values: NDArray[np.float32] | None = None,
        radiance: NDArray[np.float32] | None = None,
        normals: bool = False,
        options: RasterOptions | None = None,
        readable: bool = False,
        checkpoints: bool = False,
    ) -> None:
        values = scene.values() if values is None else values
        self.device = device
        self.rasterizer = (ReadableRasterizer if readable else Rasterizer)(
            len(scene.cloud),
            [scene.camera],
            value_count=values.shape[1],
            radiance=radiance is not None,
            normals=normals,
            options=options,
            device=device,
            checkpoints=checkpoints,
        )
        self.channel_count = self.rasterizer.value_channels.stop
        self.gaussians = upload_gaussians(scene.cloud, device, values=values, radiance=radiance)
        self.draw()
        self.set_adjoints(random_adjoints(scene.camera.width * scene.camera.height, self.channel_count))

    def draw(self) -> None:
        """Draw with as much room as it takes, which waits for the device."""
        self.rasterizer.draw(self.gaussians)

    def forward(self) -> None:
        """Draw without waiting."""
        self.rasterizer.redraw()

    def backward(self) -> None:
        """Find the gradients of the Gaussians."""
        self.rasterizer.backward()

    def training(self) -> None:
        """Draw without waiting, and find the gradients."""
        self.rasterizer.redraw()
        self.rasterizer.backward()

    def seen(self) -> Seen:
        """Return the images, without padding."""
        images = self.rasterizer.images
        channels = np.concatenate([rows.numpy() for rows in images.channels], axis=1)[:, : self.channel_count]
        return Seen(channels, images.alpha.numpy(), images.depth.numpy(), images.median_depth.numpy())

    def set_adjoints(self, adjoints: Seen) -> None:
        """Write the derivatives that `backward` starts from."""
        target = self.rasterizer.adjoints()
        start = 0
        for rows in target.channels:
            columns = adjoints.channels[:, start : start + rows.shape[1]]
            rows.assign(np.pad(columns, ((0, 0), (0, rows.shape[1] - columns.shape[1]))))
            start += rows.shape[1]
        for name in ("alpha", "depth", "median_depth"):
            getattr(target, name).assign(getattr(adjoints, name))

    def gradients(self) -> dict[str, NDArray[np.float32]]:
        """Return the gradients of the Gaussians by name."""
        found = self.rasterizer.backward()
        names = (*GEOMETRY, "values", "radiance")
        arrays = {name: getattr(found, name) for name in names}
        return {name: array.numpy() for name, array in arrays.items() if array is not None}


def captured(work: Callable[[], Any], device: Any) -> Callable[[], Any]:
    """Return what launches the work as one CUDA graph."""
    for _ in range(2):  # modules load and buffers are made before anything is captured
        work()
    wp.synchronize_device(device)
    with wp.ScopedCapture(device) as capture:
        work()
    graph = capture.graph

    def launch() -> Any:
        wp.capture_launch(graph)
        return work  # held: the graph reads and writes the arrays of what does the work

    return launch


@dataclass
class Clocked:
    """Work, and the events around each time it was done.

    Attributes:
        work: Does it once.
        event: Records an event where the work is queued; None for the CPU.
        elapsed: Seconds between two events that the device has passed.
        marks: Pairs of events.
    """

    work: Callable[[], Any]
    event: Callable[[], Any] | None = None
    elapsed: Callable[[Any, Any], float] | None = None
    marks: list[tuple[Any, Any]] = field(default_factory=list)

    @classmethod
    def on(cls, device: Any, work: Callable[[], Any]) -> Clocked:
        """Wrap work on a Warp device."""
        if not device.is_cuda:
            return cls(work)
        return cls(work, lambda: record_event(device), seconds_between)

    def run(self) -> None:
        """Do the work once."""
        if self.event is None:
            self.work()
            return
        begin = self.event()
        self.work()
        self.marks.append((begin, self.event()))


def record_event(device: Any) -> wp.Event:
    """Record an event on the stream that Warp launches on."""
    return wp.get_stream(device).record_event(wp.Event(device, enable_timing=True))


def seconds_between(begin: wp.Event, end: wp.Event) -> float:
    """Return the seconds from one event to another, which the device has passed."""
    return 1e-3 * wp.get_event_elapsed_time(begin, end, synchronize=False)


class Measured(NamedTuple):
    """Seconds of each repeat: by the host's clock, and between events on a CUDA device."""

    times: Times
    device: NDArray[np.float64] | None

    def summary(self) -> dict[str, Any]:
        """Return medians and ranges in milliseconds."""
        if self.device is not None:
            return {"wall_ms": spread(self.times.alone), "device_ms": spread(self.device)}
        found: dict[str, Any] = {"process_ms": spread(self.times.alone)}
        if self.times.one_thread is not None:
            found["wall_ms"] = spread(self.times.one_thread)
        if self.times.two_threads is not None:
            found |= {"wall_two_threads_ms": spread(self.times.two_threads), "thread_gain": self.times.thread_gain()}
        return found


def spread(seconds: NDArray[np.float64]) -> dict[str, float]:
    """Return median and range in milliseconds, to four digits."""
    middle, low, high = np.median(seconds), seconds.min(), seconds.max()
    return {"median": digits(1e3 * middle), "lowest": digits(1e3 * low), "highest": digits(1e3 * high)}


def digits(number: Any) -> float:
    """Return a number to four digits: more are noise in a report."""
    return float(f"{float(number):.4g}")


def measure_in_turn(
    contenders: Mapping[str, Clocked], repeats: int, device: Any, *, two_threads: bool = False
) -> dict[str, Measured]:
    """Time contenders in turn; see `timing.take_turns`."""
    tasks = {name: Task(entry.run) for name, entry in contenders.items()}
    times = take_turns(tasks, repeats, device, two_threads=two_threads)
    found = {}
    for name, entry in contenders.items():
        events = None
        if entry.elapsed is not None:
            events = np.array([entry.elapsed(begin, end) for begin, end in entry.marks[-repeats:]])
        entry.marks.clear()
        found[name] = Measured(times[name], events)
    return found
