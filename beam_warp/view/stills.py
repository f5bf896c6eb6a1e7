"""Stills of a take by the package's own renderers: paths, exact shadows, and the channels that a container lacks."""

from __future__ import annotations

import base64
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from beam_warp.checks import require_choice, require_count
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import BeamError, InvalidOptionError
from beam_warp.image.files import write_exr
from beam_warp.raster.records import RasterOptions
from beam_warp.render.channels import channel_range, see_channel
from beam_warp.render.deferred import DeferredRenderer
from beam_warp.render.options import DeferredOptions
from beam_warp.render.path import PathOptions, PathRenderer
from beam_warp.render.pictures import PictureOptions, PictureWriter
from beam_warp.view.kinds import DEFERRED, NONE, TRACED
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.gaussians import GaussianCloud
from beam_warp.world.lights import lights_from_json
from beam_warp.world.shot import RenderedImage, Shot, ShotMesh

MOST_PATHS = 2**16
"""Most paths of a pixel."""

PASS_SECONDS = 0.5
"""Time between two pictures of one still [s]; the first pass is a path a pixel, however long that takes."""

MOST_AT_ONCE = 64
"""Most paths of a pixel between two pictures."""

LEGEND_WIDTH = 300
"""Width of legends [pixel]."""

CACHED_LIGHTS = 4
"""Environments that are kept."""


@dataclass(frozen=True, eq=False)
class Subject:
    """What stills show.

    Attributes:
        frame_count: Number of frames.
        cloud: Returns the Gaussians of a frame, in the world's axes.
        environments: Functions that read or make a light, by its name.
        meshes: Functions that make what stands around, by its name.
        kinds: What can be asked for, as `beam_warp.view.kinds.kinds_of` says.
        raster: How splats are drawn.
    """

    frame_count: int
    cloud: Callable[[int], GaussianCloud]
    environments: Mapping[str, Callable[[], EnvironmentMap]]
    meshes: Mapping[str, Callable[[], ShotMesh | None]]
    kinds: tuple[str, ...]
    raster: RasterOptions


class Stills:
    """Draws stills, one step of one at a time; pages wait for each other's steps."""

    def __init__(self, subject: Subject, *, longest: int, device: str | None, lock: threading.Lock) -> None:
        """Make ready.

        Args:
            subject: What is shown.
            longest: No side of a still is longer [pixel].
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.
            lock: Is held while the device works.

        Raises:
            DeviceError: There is no such device.
        """
        self._subject, self._longest, self._lock = subject, longest, lock
        self._device = str(resolve_device(device))
        # the same objects as long as they are kept, so that renderers know them again
        self._cloud = lru_cache(maxsize=1)(subject.cloud)
        self._environment = lru_cache(maxsize=CACHED_LIGHTS)(lambda name: subject.environments[name]())
        self._mesh = lru_cache(maxsize=2)(lambda name: subject.meshes[name]())
        self._tracer = PathRenderer(PathOptions(samples=MOST_PATHS), device=self._device)
        self._deferred = DeferredRenderer(DeferredOptions(layers=()), raster=subject.raster, device=self._device)
        self._count = 0
        self._layers: tuple[str, Callable[[], Mapping[str, NDArray[np.float32]]]] = ("", dict)

    def draw(self, asked: Any) -> Iterator[dict[str, Any]]:
        """Draw a still.

        Args:
            asked: What ``engines/web/stills.js`` sends: ``kind``, ``frame``, ``camera``; for light ``environment``,
                ``rotation``, ``lights``, ``ground``, ``samples``; ``exposure``, ``transform`` and ``background``.

        Yields:
            What there is so far: ``png`` and, where colours need one, ``legend``, both as base64; ``samples`` and
            ``of``. The last one has ``exr``, the name under which `exr` finds its numbers. If something is wrong,
            ``error`` alone: the sentence to show.
        """
        try:
            yield from self._drawn(asked)
        except BeamError as error:
            yield {"error": str(error)}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            yield {"error": f"a still must be asked for as the page does, got {type(error).__name__}: {error}."}
        except (MemoryError, RuntimeError, OSError) as error:
            yield {"error": f"the still could not be drawn ({error})."}

    def exr(self, name: str) -> bytes | None:
        """Return the numbers of the newest still as an OpenEXR file; None if another is the newest by now."""
        newest, layers = self._layers
        if name != newest:
            return None
        with TemporaryDirectory() as folder:
            path = Path(folder) / "still.exr"
            write_exr(path, layers())
            return path.read_bytes()

    def _drawn(self, asked: Any) -> Iterator[dict[str, Any]]:
        kind = require_choice("kind", asked["kind"], self._subject.kinds)
        frame = require_count("frame", asked["frame"], 0, self._subject.frame_count - 1)
        camera = self._camera(asked["camera"])
        if kind not in (TRACED, DEFERRED):
            with self._lock:
                line, layers = self._channel(kind, self._cloud(frame), camera, asked)
            yield line | self._named(layers)
            return
        options = _options(asked)
        kept = "environment" if options.background == "environment" else "transparent"
        writer, exact = PictureWriter(options), PictureWriter(PictureOptions(background=kept))
        samples = require_count("samples", asked["samples"], 1, MOST_PATHS)
        with self._lock:
            shot = self._shot(frame, camera, asked)
        for image, done, total in self._traced(shot, samples) if kind == TRACED else self._shaded(shot):
            line = {"png": _png(writer.pixels(shot, image)), "samples": done, "of": total}
            is_last = done == total
            yield line | (self._named(lambda image=image: exact.exr_layers(shot, image)) if is_last else {})

    def _traced(self, shot: Shot, samples: int) -> Iterator[tuple[RenderedImage, int, int]]:
        """Yield an image, its paths a pixel, and how many there will be."""
        with self._lock:
            progress = self._tracer.start(shot)
        step = 1
        while progress.sample_count < samples:
            started = time.monotonic()
            with self._lock:
                progress.advance(min(step, samples - progress.sample_count))
                image = progress.image()
            seconds = max(time.monotonic() - started, 1e-3)
            step = max(1, min(MOST_AT_ONCE, int(step * PASS_SECONDS / seconds)))
            yield image, progress.sample_count, samples

    def _shaded(self, shot: Shot) -> Iterator[tuple[RenderedImage, int, int]]:
        with self._lock:
            image = self._deferred.draw(shot)
        yield image, 1, 1

    def _channel(self, kind: str, cloud: GaussianCloud, camera: Camera, asked: Any) -> tuple[dict[str, Any], Any]:
        """Return the picture of a channel and its legend, and a function that returns its layers."""
        seen = see_channel(cloud, camera, kind, options=self._subject.raster, device=self._device)
        ends = channel_range(cloud, kind)
        weight, behind = np.clip(seen.alpha, 0.0, 1.0)[..., None], np.asarray(_options(asked).background)
        pixels = np.rint(255.0 * (weight * seen.colors(ends) + (1.0 - weight) * behind)).astype(np.uint8)
        legend = seen.legend(LEGEND_WIDTH, ends)
        line = {"png": _png(pixels), "samples": 1, "of": 1}
        return line if legend is None else line | {"legend": _png(legend)}, seen.layers

    def _shot(self, frame: int, camera: Camera, asked: Any) -> Shot:
        name, ground = asked["environment"], asked["ground"]
        require_choice("environment", name, (*self._subject.environments, NONE))
        require_choice("ground", ground, tuple(self._subject.meshes))
        return Shot(
            cloud=self._cloud(frame),
            camera=camera,
            environment=None if name == NONE else self._environment(name),
            environment_rotation=asked["rotation"],
            lights=lights_from_json(asked["lights"]),
            mesh=self._mesh(ground),
        )

    def _camera(self, given: Any) -> Camera:
        """Return a camera as the player states it."""
        width, height = (require_count(side, given[side], 1, self._longest) for side in ("width", "height"))
        pose = np.eye(4)
        pose[:3, :3] = np.reshape(np.asarray(given["worldToCamera"], np.float64), (3, 3)).T
        pose[:3, 3] = given["position"]
        (focal_x, focal_y), (center_x, center_y) = given["focal"], given["center"]
        return Camera(width, height, focal_x, focal_y, center_x, center_y, pose)

    def _named(self, layers: Callable[[], Mapping[str, NDArray[np.float32]]]) -> dict[str, str]:
        """Keep the numbers of a still that is done, in place of the last one's."""
        self._count += 1
        self._layers = (f"stills/{self._count}.exr", layers)
        return {"exr": self._layers[0]}


def _options(asked: Any) -> PictureOptions:
    """Return how a still is shown; its background is ``environment`` or a colour such as ``#212121``."""
    behind = asked["background"]
    if behind != "environment":
        try:
            red, green, blue = bytes.fromhex(behind.removeprefix("#"))
        except ValueError:
            raise InvalidOptionError(f"background must be a colour such as #212121, got {behind!r:.40}.") from None
        behind = red / 255.0, green / 255.0, blue / 255.0
    return PictureOptions(view=asked["transform"], exposure=asked["exposure"], background=behind)


def _png(pixels: NDArray[np.uint8]) -> str:
    """Return pixels as PNG, in base64."""
    content = BytesIO()
    Image.fromarray(pixels).save(content, format="PNG", compress_level=1)
    return base64.b64encode(content.getvalue()).decode("ascii")
