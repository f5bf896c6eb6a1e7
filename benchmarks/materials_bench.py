"""Captures, lights and effort of the materials benchmark, which all its parts share."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from materials_cost import Scale
from materials_truth import Materials, TruthViews

from beam_warp.capture.capture import Capture
from beam_warp.demo.capture import write_demo_capture
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.world.environment import EnvironmentMap

TARGETS = {
    "perfect": {
        "ambient_occlusion_psnr": 40.0,
        "irradiance_relative_rmse": 0.035,
        "base_color_psnr_with_bounce": 35.0,
        "base_color_psnr_direct_only": [31.0, 33.0],
    },
    "reconstructed": {
        "ambient_occlusion": [30.0, 0.95],
        "base_color": [26.0, 0.93],
        "scale": [0.97, 1.03],
        "relit": [30.0, 0.94],
    },
}

LIGHTS = ("studio", "sunrise", "apartment", "night", "workshop")


@dataclass(frozen=True)
class Effort:
    """Effort of the benchmark.

    Attributes:
        perfect_gaussians: On the true surface.
        light_points: Points at which light is compared.
        light_rays: Rays that are judged.
        reference_rays: Rays that they are compared with.
        perfect_rays: Rays a Gaussian of the perfect geometry's materials.
        perfect_samples: Side of the square of samples of its drawn pixels.
        samples: The same of reconstructions.
        frames: Most frames of an ablation.
        high: Rays a pixel of the image path where there are many.
        adam_steps: Of the image path's other solver.
        scale: Of the cost.
        fitting: Changes of the reconstruction's defaults.
    """

    perfect_gaussians: int = 140_000
    light_points: int = 4096
    light_rays: int = 64
    reference_rays: int = 16_384
    perfect_rays: tuple[int, ...] = (64, 256)
    perfect_samples: int = 4
    samples: int = 2
    frames: int = 6
    high: int = 512
    adam_steps: int = 5000
    scale: Scale = field(default_factory=Scale)
    fitting: Any = None


FULL = Effort()

QUICK = Effort(
    perfect_gaussians=1500,
    light_points=32,
    light_rays=16,
    reference_rays=256,
    perfect_rays=(8,),
    perfect_samples=2,
    samples=1,
    frames=2,
    high=16,
    adam_steps=8,
    scale=Scale(
        gaussians=400,
        views=3,
        size=(48, 32),
        repeats=1,
        counts=(200, 400),
        view_counts=(1, 2),
        ray_counts=(8, 16),
        series_views=2,
    ),
    fitting={"color_iterations": 30, "normal_iterations": 30},
)


@dataclass(frozen=True)
class Bench:
    """Inputs that all parts share.

    Attributes:
        captures: With truth, by name.
        lights: Environments by name.
        assets: Reconstructions by the name of their capture; what is missing is made.
        gaussians: Of those that are made.
        effort: How much is measured.
        device: Where.
        pictures: Folder of pictures; None for none.
        say: Hears what is being done.
    """

    captures: Mapping[str, Capture]
    lights: Mapping[str, EnvironmentMap]
    assets: Mapping[str, Path]
    gaussians: int
    effort: Effort
    device: Any
    pictures: Path | None
    say: Callable[[str], None]

    def light_of(self, capture: Capture) -> PreparedEnvironment:
        """Return the light of a capture, prepared."""
        assert capture.environment_path is not None
        return PreparedEnvironment(EnvironmentMap.read(capture.environment_path), self.device)

    def picture(self, truth: TruthViews, cloud: Any, found: Materials | None, *words: str) -> str | None:
        """Write a row's picture; returns its file's name."""
        if self.pictures is None:
            return None
        self.pictures.mkdir(parents=True, exist_ok=True)
        name = re.sub(r"[^a-z0-9]+", "_", " ".join(words).lower()).strip("_") + ".png"
        truth.picture(cloud, found, self.pictures / name)
        return name


def read_lights(data: Path) -> dict[str, EnvironmentMap]:
    """Return the HDRIs of the data folder."""
    return {name: EnvironmentMap.read(data / "hdri" / f"{name}.hdr") for name in LIGHTS}


def quick_bench(folder: Path, device: Any, say: Callable[[str], None]) -> Bench:
    """Return a bench that runs in no time, on the demo's capture and its own light."""
    capture = write_demo_capture(
        folder / "demo", camera_count=6, test_camera_count=1, size=64, samples=4, frame_count=2, device=str(device)
    )
    return bench_of_capture(capture, device, say)


def bench_of_capture(capture: Capture, device: Any, say: Callable[[str], None]) -> Bench:
    """Return a quick bench of one capture."""
    assert capture.environment_path is not None
    lights = {"its own": EnvironmentMap.read(capture.environment_path)}
    return Bench({"demo": capture}, lights, {}, 600, QUICK, device, None, say)
