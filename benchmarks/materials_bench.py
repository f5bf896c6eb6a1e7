"""Captures, lights and effort of the materials benchmark, which all its parts share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from materials_cost import Scale

from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import write_demo_capture
from beam_warp.demo.lights import sunset
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.world.environment import EnvironmentMap

LIGHTS = ("studio", "sunrise", "apartment", "night", "workshop")


@dataclass(frozen=True)
class Effort:
    """Effort of the benchmark.

    Attributes:
        gaussians: Of reconstructions that are made here.
        perfect_gaussians: On the true surface.
        light_points: Points at which light is compared.
        light_rays: Rays that are judged.
        reference_rays: Rays that they are compared with.
        perfect_rays: Rays a Gaussian of the perfect geometry's materials.
        perfect_samples: Side of the square of samples of its drawn pixels.
        samples: The same of reconstructions.
        frames: Most frames of a reconstruction.
        evaluated_frames: Frames that are evaluated, those with truth first.
        paths: Of a pixel of relit images that are path traced.
        high: Rays a pixel of the image path where there are many.
        scale: Of the cost.
        fitting: Changes of the reconstruction's defaults.
    """

    gaussians: int = 140_000
    perfect_gaussians: int = 140_000
    light_points: int = 4096
    light_rays: int = 64
    reference_rays: int = 16_384
    perfect_rays: tuple[int, ...] = (64, 256)
    perfect_samples: int = 4
    samples: int = 2
    frames: int = 6
    evaluated_frames: int = 2
    paths: int = 256
    high: int = 512
    scale: Scale = field(default_factory=Scale)
    fitting: Any = None


FULL = Effort()

QUICK = Effort(
    gaussians=600,
    perfect_gaussians=1500,
    light_points=32,
    light_rays=16,
    reference_rays=256,
    perfect_rays=(8,),
    perfect_samples=2,
    samples=1,
    frames=2,
    evaluated_frames=1,
    paths=4,
    high=16,
    scale=Scale(gaussians=400, views=3, size=(48, 32), repeats=1, few_views=1),
    fitting={"color_iterations": 30, "normal_iterations": 30},
)


@dataclass(frozen=True)
class Bench:
    """Inputs that all parts share.

    Attributes:
        captures: With truth, by name.
        lights: Environments by name.
        assets: Folder of reconstructions, NAME/gaussians.usda; what is missing there is made.
        effort: How much is measured.
        device: Where.
        folder: For what is made on the way.
        keep: Folder for the assets of the direct path; None for those that nobody needs afterwards.
        pictures: Folder for the pictures of them; None for none.
    """

    captures: Mapping[str, Capture]
    lights: Mapping[str, EnvironmentMap]
    assets: Path | None
    effort: Effort
    device: Any
    folder: Path
    keep: Path | None = None
    pictures: Path | None = None

    def light_of(self, capture: Capture) -> PreparedEnvironment:
        """Return the light of a capture, prepared."""
        assert capture.environment_path is not None
        return PreparedEnvironment(EnvironmentMap.read(capture.environment_path), self.device)


def read_lights(data: Path) -> dict[str, EnvironmentMap]:
    """Return the HDRIs of the data folder."""
    return {name: EnvironmentMap.read(data / "hdri" / f"{name}.hdr") for name in LIGHTS}


def quick_capture(folder: Path, device: Any, **sizes: int) -> Capture:
    """Return the demo's capture, so small that all runs in no time, relit by one more light."""
    relit = {"sunset": sunset()}
    return write_demo_capture(folder / "demo", samples=4, relit=relit, device=str(device), **sizes)


def quick_bench(folder: Path, device: Any) -> Bench:
    """Return a bench of the demo's capture and its own light."""
    sizes = {"camera_count": 6, "test_camera_count": 1, "size": 64, "frame_count": 2}
    return bench_of_capture(quick_capture(folder, device, **sizes), folder, device)


def bench_of_capture(capture: Capture, folder: Path, device: Any) -> Bench:
    """Return a quick bench of one capture."""
    assert capture.environment_path is not None
    lights = {"its own": EnvironmentMap.read(capture.environment_path)}
    return Bench({"demo": capture}, lights, None, QUICK, device, folder)
