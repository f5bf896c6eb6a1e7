"""Cost of decomposing at the paper's scale: a figure of many Gaussians in a dome of many large images, one frame.

Images are drawn by the rasteriser once, before the clock starts, and lie in memory decoded, as the package takes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from device_memory import peak_memory
from materials_contenders import OURS, Decomposed, Method, Subject, SubjectFrame, by_images, direct
from materials_truth import SHARP, Row

from beam_warp.capture.capture import Capture
from beam_warp.capture.views import CapturedView
from beam_warp.demo.capture import dome_cameras
from beam_warp.jobs.progress import StageTimer
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.materials.images import crop_to_subject
from beam_warp.raster.gbuffer import upload_gaussians
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.study.true_surface import colored_by_views, gaussians_on_mesh
from beam_warp.trace.denoise import chosen_denoiser
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud

PAPER = {"gaussians": 140_000, "views": 81, "width": 3840, "height": 2160, "seconds": 240.0, "device": "RTX 3090"}

TARGETS = {"direct": 2.0, "image path": 20.0, "peak_bytes": 16 * 2**30}


@dataclass(frozen=True)
class Scale:
    """Size of the problem.

    Attributes:
        gaussians: Of the figure.
        views: Cameras around it.
        size: Width and height of their images.
        repeats: Timed runs of the direct path on the whole; the fastest counts.
        counts: Gaussians of the series over them.
        view_counts: Views of the series over them, of the same images.
        ray_counts: Rays a Gaussian, or a pixel's occlusion, of the series over them.
        series_views: Views of the series that do not vary them.
    """

    gaussians: int = 140_000
    views: int = 81
    size: tuple[int, int] = (3840, 2160)
    repeats: int = 3
    counts: tuple[int, ...] = (35_000, 70_000, 140_000, 280_000)
    view_counts: tuple[int, ...] = (5, 10, 20, 40)
    ray_counts: tuple[int, ...] = (16, 32, 64, 128, 256)
    series_views: int = 10


def figure(capture: Capture, count: int, device: Any) -> GaussianCloud:
    """Return Gaussians on the true surface of the capture's first frame, with its colours."""
    frame = capture.frames[0]
    mesh = read_truth_mesh(capture, frame)
    views = [record.view() for record in capture.select(split="train", frames=[frame])]
    bare = gaussians_on_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), count)
    return colored_by_views(bare, views, options=SHARP, device=str(device))


def drawn_views(cloud: GaussianCloud, cameras: Sequence[Camera], device: Any) -> list[CapturedView]:
    """Draw what cameras see, one at a time, and bring it to the host's memory."""
    gaussians = upload_gaussians(cloud, device, radiance=cloud.radiance)
    rasterizer = Rasterizer(len(cloud), [cameras[0]], radiance=True, options=SHARP, device=device)
    views = []
    for index, camera in enumerate(cameras):
        rasterizer.set_cameras([camera])
        images = rasterizer.draw(gaussians)
        shape = (camera.height, camera.width)
        color = np.maximum(images.channels[0].numpy()[:, :3], 0.0)
        views.append(
            CapturedView(
                name=f"{index:02d}",
                camera=camera,
                color=color.reshape(*shape, 3),
                alpha=np.clip(images.alpha.numpy(), 0.0, 1.0).reshape(shape),
            )
        )
    return views


def measure_cost(
    capture: Capture, light: PreparedEnvironment, scale: Scale, device: Any, say: Callable[[str], None]
) -> Iterable[tuple[str, Row]]:
    """Yield the whole's rows and three series, each as soon as it is measured."""
    clouds = {count: figure(capture, count, device) for count in sorted({scale.gaussians, *scale.counts})}
    cloud = clouds[scale.gaussians]
    width, height = scale.size
    mesh = read_truth_mesh(capture, capture.frames[0])
    dome = dome_cameras([np.asarray(mesh.vertices)], scale.views, 0, width, height)
    say(f"drawing {scale.views} views of {width} x {height}")
    views = drawn_views(cloud, [entry.camera for entry in dome], device)
    share = float(np.mean([(view.alpha > 0.0).mean() for view in views if view.alpha is not None]))
    whole = Subject("paper's scale", [SubjectFrame(0, cloud, views)], SHARP, light, device)
    yield "scene", {"gaussians": scale.gaussians, "views": len(views), "size": [width, height], "covered": share}
    small = whole.small()
    ways: dict[str, Method] = {"direct": lambda s: direct(s, OURS.but(joint=False)), "image path": by_images}
    others: dict[str, Method] = {"direct, views cut to the subject": cut_first}
    if chosen_denoiser("auto") == "oidn":
        others["image path, bilateral"] = lambda s: by_images(s, denoiser="bilateral")
    others["image path, not denoised"] = lambda s: by_images(s, denoiser="none")
    for name, way in (ways | others).items():
        row = timed(way, whole, scale.repeats if name.startswith("direct") else 1, small)
        target = TARGETS["direct" if name.startswith("direct") else "image path"]
        row["target_seconds"] = target
        row["reached"] = bool(row["seconds"] <= target)
        if "peak_device_bytes" in row:
            row["memory_reached"] = bool(row["peak_device_bytes"] <= TARGETS["peak_bytes"])
        say(f"{name}: {described(row)}")
        yield name, row
    few = replace(whole, frames=[SubjectFrame(0, cloud, views[: scale.series_views])])
    series: dict[str, list[Row]] = {"gaussians": [], "views": [], "rays": []}
    for name, way in ways.items():
        for count in scale.counts:
            subject = replace(few, frames=[SubjectFrame(0, clouds[count], few.frames[0].views)])
            series["gaussians"].append({"way": name, "gaussians": count, **timed(way, subject, 1)})
        for count in scale.view_counts:
            subject = replace(whole, frames=[SubjectFrame(0, cloud, views[:count])])
            series["views"].append({"way": name, "views": count, **timed(way, subject, 1)})
        for count in scale.ray_counts:
            series["rays"].append({"way": name, "rays": count, **timed(with_rays(name, count), few, 1)})
        say(f"{name}: series over Gaussians, views and rays done")
        yield "series", series


def cut_first(subject: Subject) -> Decomposed:
    """Cut views to the subject, then decompose by the direct path."""
    stages = StageTimer(subject.device)
    with stages("cut views"):
        frames = [replace(frame, views=[crop_to_subject(view) for view in frame.views]) for frame in subject.frames]
    found = direct(replace(subject, frames=frames), OURS.but(joint=False))
    return replace(found, seconds={**stages.seconds, **found.seconds})


def with_rays(way: str, count: int) -> Method:
    """Return a way with another number of rays; the image path takes twice as many for light, as the paper does."""
    if way == "direct":
        return lambda subject: direct(subject, OURS.but(joint=False, sample_count=count))
    return lambda subject: by_images(subject, occlusion_samples=count, light_samples=2 * count)


def timed(way: Method, subject: Subject, repeats: int, warm: Subject | None = None) -> Row:
    """Return seconds by stage of the fastest repeat, and the most memory of any; compiles on ``warm`` first."""
    if warm is not None:
        way(warm)
    with peak_memory(subject.device) as memory:
        rows = [way(subject) for _ in range(repeats)]
    totals = [sum(row.seconds.values()) for row in rows]
    best = rows[int(np.argmin(totals))]
    return {
        "seconds": min(totals),
        "all_seconds": totals,
        "stages": best.seconds,
        "views": len(subject.frames[0].views),
        "notes": list(best.notes),
        **memory,
    }


def described(row: Row) -> str:
    """Return a row in words."""
    stages = ", ".join(f"{stage} {seconds:.3f}" for stage, seconds in row["stages"].items())
    peak = f", {row['peak_device_bytes'] / 2**30:.2f} GiB" if "peak_device_bytes" in row else ""
    return f"{row['seconds']:.3f} s ({stages}){peak}"
