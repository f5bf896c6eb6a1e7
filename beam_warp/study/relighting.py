"""What relit images cost and how wrong they are: the render study of ``beam chart``, and pilots of ``beam render``.

Errors are of display values (sRGB, 0 to 1) over pixels that the subject covers, chosen at random. The truth is path
traced at these pixels, in two halves whose difference tells its own noise.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isqrt
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp._version import __version__
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidArrayError
from beam_warp.image.color import LUMINANCE, linear_to_srgb
from beam_warp.image.metrics import root_mean_square
from beam_warp.light.prepared import PreparedEnvironment
from beam_warp.raster.records import RasterOptions
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import UNSHADOWED, DeferredOptions
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.study.table import Axis, Interval, Metric, Row, Settings, Study, StudySubject
from beam_warp.study.tracing import device_name
from beam_warp.world.shot import RenderedImage, Shot

TRUE_PIXELS = {False: 512, True: 16_384}
"""Pixels whose truth is traced, on a CPU or on CUDA."""

TRUE_PATHS = {False: 256, True: 4096}
"""Paths of such a pixel."""

TRUE_BOUNCES = 4
TRUE_SEEDS = (0x51EED, 0x7EED5)
"""Seeds of the two halves: no render of a user's is likely to share them."""

TRUTH = "path tracing with {paths} paths a pixel, {bounces} bounces, at {pixels} pixels that the subject covers"

ERROR = "display_error"


@dataclass(frozen=True, eq=False)
class TruePixels:
    """Pixels of a shot whose true display values are known.

    Attributes:
        shot: The shot.
        pixels: Their numbers, row by row, ``(K,)``.
        covered: How many pixels the subject covers.
        values: True display values, ``(K, 3)``.
        noise: Root mean square error of the truth itself.
        note: The truth in words.
    """

    shot: Shot
    pixels: NDArray[np.int64]
    covered: int
    values: NDArray[np.float64]
    noise: float
    note: str

    @classmethod
    def traced(cls, shot: Shot, raster: RasterOptions, device: Any, *, seed: int = 0) -> TruePixels:
        """Choose pixels at random and trace their truth.

        Raises:
            InvalidArrayError: The subject covers no pixel.
        """
        chosen, covered = covered_pixels(shot, raster, device, seed=seed)
        paths = TRUE_PATHS[device.is_cuda]
        halves = [
            traced_pixels(shot, chosen, PathOptions(samples=paths // 2, bounces=TRUE_BOUNCES, seed=each + seed), device)
            for each in TRUE_SEEDS
        ]
        first, second = (half.rgb.reshape(-1, 3)[chosen] for half in halves)
        noise = float(np.sqrt(np.mean((linear_to_srgb(_cut(first)) - linear_to_srgb(_cut(second))) ** 2)) / 2.0)
        values = linear_to_srgb(_cut(0.5 * (first + second)))
        note = TRUTH.format(paths=paths, bounces=TRUE_BOUNCES, pixels=len(chosen))
        return cls(shot, chosen, covered, values, noise, note)

    def error(self, image: RenderedImage) -> Interval:
        """Return the root mean square error of an image at the pixels, the truth's own noise taken off."""
        found = linear_to_srgb(_cut(image.rgb.reshape(-1, 3)[self.pixels]))
        raw = Interval.of_root_mean_square(np.square(found - self.values).mean(axis=1))
        return Interval(*(float(np.sqrt(max(value**2 - self.noise**2, 0.0))) for value in raw))


def covered_pixels(shot: Shot, raster: RasterOptions, device: Any, *, seed: int = 0) -> tuple[NDArray[np.int64], int]:
    """Return the numbers of pixels that the subject covers, some of them at random, and how many there are.

    Raises:
        InvalidArrayError: There is none.
    """
    image = DeferredRenderer(UNSHADOWED, raster=raster, device=device).draw(shot)
    covered = np.flatnonzero(image.alpha.reshape(-1) > 1.0 / 255.0)
    if not len(covered):
        raise InvalidArrayError("image must show the subject for its error to be measured, got none of it. Look at it.")
    count = min(len(covered), TRUE_PIXELS[resolve_device(device).is_cuda])
    return np.sort(np.random.default_rng(seed).choice(covered, count, replace=False)), len(covered)


def traced_pixels(shot: Shot, pixels: NDArray[np.int64], options: PathOptions, device: Any) -> RenderedImage:
    """Path trace some pixels of a shot; the others are black."""
    progress = PathRenderer(options, device=str(device)).start(shot)
    progress.only(pixels)
    while not progress.done:
        progress.advance()
    return progress.image()


def noise_of(image: RenderedImage, pixels: NDArray[np.int64] | None = None) -> float:
    """Return the root mean square standard error of display values of a path-traced image, over what is covered.

    A display value is about the square root of luminance, whose slope has no bound at black.

    Args:
        image: Path-traced image, not denoised.
        pixels: Only these, by their numbers row by row.
    """
    chosen = np.flatnonzero(image.alpha.reshape(-1) > 1.0 / 255.0) if pixels is None else pixels
    if not len(chosen):
        return 0.0
    luminance = image.rgb.reshape(-1, 3)[chosen] @ LUMINANCE
    error = image.layers["standard_error"].reshape(-1)[chosen] / (2.0 * np.sqrt(np.maximum(luminance, 1e-3)))
    return root_mean_square(error)


def deferred_frame(
    shot: Shot,
    options: DeferredOptions,
    raster: RasterOptions,
    device: Any,
    repeats: int = 1,
    prepared: Sequence[PreparedEnvironment] = (),
) -> tuple[RenderedImage, list[float]]:
    """Draw a shot by deferred shading; return the image, and times of frames of which everything is redrawn [s].

    The first time, which comes before those of the repeats, is that of a first frame: kernels may be compiled in it,
    and an environment that is not prepared yet is.
    """
    renderer = DeferredRenderer(options, raster=raster, device=device, prepared=prepared)
    seconds, image = list[float](), None
    for _ in range(repeats + 1):
        moved = replace(shot, cloud=shot.cloud.with_arrays())
        wp.synchronize_device(device)
        started = time.perf_counter()
        image = renderer.draw(moved)
        seconds.append(time.perf_counter() - started)
    assert image is not None
    return image, seconds


def path_frame(
    shot: Shot, pixels: NDArray[np.int64], covered: int, samples: int, bounces: int, device: Any, repeats: int = 1
) -> tuple[RenderedImage, list[float]]:
    """Path trace some of the pixels that are covered; return the image, and times scaled to all of them [s]."""
    seconds, image = list[float](), traced_pixels(shot, pixels[:8], PathOptions(samples=4, bounces=bounces), device)
    for repeat in range(repeats):
        started = time.perf_counter()
        image = traced_pixels(shot, pixels, PathOptions(samples=samples, bounces=bounces, seed=repeat), device)
        seconds.append((time.perf_counter() - started) * covered / len(pixels))
    return image, seconds


def _cut(rgb: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    return np.clip(np.asarray(rgb, np.float64), 0.0, 1.0)


DEFERRED_SAMPLES, PATH_SAMPLES = (1, 4, 9, 16), (4, 16, 64, 256)
"""Samples a pixel of either renderer; those of the deferred one are squares."""

SHADOWS, MAPS, BOUNCES = (16, 0, 4, 64), (256, 64, 512), (2, 0, 1)
"""Directions of the environment that cast shadows, sides of their maps, and bounces, the defaults first."""


def relighting_study(
    shot: Shot, raster: RasterOptions, *, name: str = "Gaussians", device: str | None = None, repeats: int = 3
) -> Study:
    """Prepare the render study: both renderers at rising samples, and the deferred one's shadows, maps and bounces.

    Args:
        shot: What is rendered.
        raster: How its splats are drawn.
        name: What to call it.
        device: Warp device; None takes the first CUDA device, or the CPU where there is none.
        repeats: Timed frames a setting.

    Raises:
        InvalidArrayError: The image does not show the subject.
        DeviceError: There is no such device.
    """
    target = resolve_device(device)
    true = TruePixels.traced(shot, raster, target)
    camera = shot.camera
    subject = StudySubject(
        name="render",
        title=f"Error against time of relit images: {name}, {len(shot.cloud):,} Gaussians, {camera.width} x "
        f"{camera.height}, {device_name(target)}",
        axes=(
            Axis("samples", "Samples", tuple(sorted({*DEFERRED_SAMPLES, *PATH_SAMPLES})), "samples", "A pixel's."),
            Axis("renderer", "Renderer", ("deferred", "path"), sentence="As --mode of beam render."),
            Axis("shadows", "Shadows", SHADOWS, sentence="Directions from which the environment casts shadows."),
            Axis("maps", "Maps", MAPS, "texels", "Side of the environment's shadow maps."),
            Axis("bounces", "Bounces", BOUNCES, sentence="Between surfaces; the path tracer's are the truth's."),
        ),
        metrics=(
            Metric(
                ERROR,
                "RMS error of display values",
                color="shadows",
                marker="renderer",
                line="bounces",
                floor=true.noise,
                sentence=f"Against {true.note}; sRGB, 0 to 1.",
            ),
        ),
        cost="Time of a frame, everything redrawn",
        cost_unit="s",
        ladder="samples",
        notes={
            "Truth": true.note,
            "Time": f"median of {repeats} frames; of path tracing, that of the pixels whose truth is known, scaled",
            "Error bars": "95 %, bootstrap over pixels",
            "Plan": "one factor at a time around the defaults, the first level of each axis",
            "Versions": f"beam-warp {__version__}, Warp {wp.__version__}",
        },
    )

    def measure(settings: Settings) -> Row:
        samples = int(settings["samples"])
        if settings["renderer"] == "path":
            image, seconds = path_frame(shot, true.pixels, true.covered, samples, TRUE_BOUNCES, target, repeats)
        else:
            options = DeferredOptions(
                samples=isqrt(samples),
                environment_shadows=int(settings["shadows"]),
                environment_map_size=int(settings["maps"]),
                bounces=int(settings["bounces"]),
                layers=(),
            )
            image, (_, *seconds) = deferred_frame(shot, options, raster, target, repeats)
        return Row(settings, Interval.of_median(seconds), {ERROR: true.error(image)})

    return Study(subject, _plan(), measure, _work)


def _plan() -> list[Settings]:
    usual = {"renderer": "deferred", "shadows": SHADOWS[0], "maps": MAPS[0], "bounces": BOUNCES[0]}
    varied = [usual, *({**usual, "shadows": level} for level in SHADOWS[1:])]
    varied += [{**usual, "bounces": level} for level in BOUNCES[1:]] + [{**usual, "shadows": 0, "bounces": 0}]
    varied += [{**usual, "maps": level} for level in MAPS[1:]]
    deferred = [{"samples": count, **each} for each in varied for count in DEFERRED_SAMPLES]
    path = [{"samples": count, "renderer": "path"} for count in PATH_SAMPLES]
    return [*deferred[: len(DEFERRED_SAMPLES)], *path, *deferred[len(DEFERRED_SAMPLES) :]]


def _work(settings: Settings) -> int:
    """Return about how long a setting takes, in samples of a path-traced pixel."""
    samples = int(settings["samples"])
    return 16 + (samples if settings["renderer"] == "path" else samples + int(settings["shadows"]))
