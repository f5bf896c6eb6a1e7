"""Cost of decomposing at the paper's scale: a figure of many Gaussians in a dome of many large images, one frame.

Images are drawn by the rasteriser once, before the clock starts, and lie in memory decoded, as the package takes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from device_memory import peak_memory
from materials_contenders import OURS, Method, Subject, SubjectFrame, by_images, direct
from parts import Row, say
from timing import spread

from beam_warp.capture.capture import Capture
from beam_warp.capture.views import CapturedView
from beam_warp.demo.capture import dome_cameras
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.raster.gbuffer import upload_gaussians
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.reconstruction.scores import read_truth_mesh
from beam_warp.study.true_surface import SHARP, surface_of_capture
from beam_warp.trace.denoise import chosen_denoiser
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import GaussianCloud


@dataclass(frozen=True)
class Scale:
    """Size of the problem.

    Attributes:
        gaussians: Of the figure.
        views: Cameras around it.
        size: Width and height of their images.
        repeats: Timed runs of every way.
        few_views: Of those on which Open Image Denoise is compared, which denoises on the CPU.
    """

    gaussians: int = 140_000
    views: int = 81
    size: tuple[int, int] = (3840, 2160)
    repeats: int = 3
    few_views: int = 2


def figure(capture: Capture, count: int, device: Any) -> GaussianCloud:
    """Return Gaussians on the true surface of the capture's first frame, with its colours."""
    return surface_of_capture(capture, capture.frames[0], count, options=SHARP, device=str(device))[0]


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


def measure_cost(capture: Capture, light: PreparedEnvironment, scale: Scale, device: Any) -> Iterable[tuple[str, Row]]:
    """Yield the scene and what each way costs on it, each as soon as it is measured."""
    cloud = figure(capture, scale.gaussians, device)
    width, height = scale.size
    mesh = read_truth_mesh(capture, capture.frames[0])
    dome = dome_cameras([np.asarray(mesh.vertices)], scale.views, 0, width, height)
    say(f"drawing {scale.views} views of {width} x {height}")
    views = drawn_views(cloud, [entry.camera for entry in dome], device)
    share = float(np.mean([(view.alpha > 0.0).mean() for view in views if view.alpha is not None]))
    whole = Subject("paper's scale", [SubjectFrame(0, cloud, views)], SHARP, light, device)
    few = replace(whole, frames=[SubjectFrame(0, cloud, views[: scale.few_views])])
    yield "scene", {"gaussians": len(cloud), "views": len(views), "size": [width, height], "covered": share}
    small, alone = whole.small(), OURS.but(joint=False)
    ways: list[tuple[str, Subject, Method]] = [
        ("direct, roughness given", whole, lambda s: direct(s, alone)),
        ("direct, with roughness", whole, lambda s: direct(s, alone.but(roughness=True))),
        ("paper, bilateral", whole, by_images),
        ("paper, bilateral, few views", few, by_images),
    ]
    if chosen_denoiser("auto") == "oidn":
        ways.append(("paper, OIDN, few views", few, lambda s: by_images(s, denoiser="oidn")))
    for name, subject, way in ways:
        row = timed(way, subject, scale.repeats, small)
        say(f"{name}: {described(row)}")
        yield name, row


def timed(way: Method, subject: Subject, repeats: int, warm: Subject) -> Row:
    """Return seconds, those of the stages in the median repeat, and the most memory; compiles on ``warm`` first."""
    way(warm)
    with peak_memory(subject.device) as memory:
        rows = [way(subject) for _ in range(repeats)]
    rows.sort(key=lambda row: sum(row.seconds.values()))
    return {
        "seconds": spread(np.array([sum(row.seconds.values()) for row in rows])),
        "stages": rows[len(rows) // 2].seconds,
        "views": len(subject.frames[0].views),
        **memory,
    }


def described(row: Row) -> str:
    """Return a row in words."""
    stages = ", ".join(f"{stage} {seconds:.3f}" for stage, seconds in row["stages"].items())
    peak = f", {row['peak_device_bytes'] / 2**30:.2f} GiB" if "peak_device_bytes" in row else ""
    return f"{row['seconds']['median']:.3f} s ({stages}){peak}"
