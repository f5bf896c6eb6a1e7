"""Pictures of a viewer's state: frames are read when they are wanted, light is prepared when it is chosen."""

from __future__ import annotations

import contextlib
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from beam_warp.checks import require_choice
from beam_warp.device.arrays import device_label, resolve_device
from beam_warp.errors import BeamError, InvalidOptionError
from beam_warp.raster.gbuffer import rasterize
from beam_warp.raster.records import RasterOptions
from beam_warp.render.channels import SeenChannel, channel_range, see_channel
from beam_warp.render.path import PathOptions, PathProgress, PathRenderer
from beam_warp.view.renderers import DeferredPair, displayed
from beam_warp.view.state import (
    ALPHA,
    DEPTH,
    LIT,
    NO_ENVIRONMENT,
    NO_GROUND,
    SHADOW_GROUND,
    Color,
    SubjectBox,
    ViewState,
    channels_of,
)
from beam_warp.world.axes import change_axes
from beam_warp.world.camera import Camera
from beam_warp.world.environment import EnvironmentMap
from beam_warp.world.framing import bulk_of
from beam_warp.world.gaussians import WORLD_AXES, GaussianCloud, GaussianSequence
from beam_warp.world.mesh import MaterialMesh
from beam_warp.world.shot import RenderedImage, Shot, ShotMesh

CACHED_BYTES = 1 << 30
"""Frames that were read are kept up to this size: short sequences are read once."""

CACHED_LIGHTS = 4
"""Environments that are kept."""

LEGEND_WIDTH = 300
"""Width of legends beside a picture [pixel]."""

MOST_PATHS = 2**20
"""Paths of a pixel beyond which none are added."""

GROUND_REACH = 6.0
"""Half the side of the ground over the subject's diagonal."""

GROUND_GREY = 0.3
GROUND_ROUGHNESS = 0.9


class FrameCache:
    """Reads frames of a sequence into the world's axes, and keeps the latest ones."""

    def __init__(self, sequence: GaussianSequence, capacity: int = CACHED_BYTES) -> None:
        """Start with none.

        Args:
            sequence: Sequence that frames are read from.
            capacity: Size of the frames that are kept [byte]; the latest one is kept whatever its size.
        """
        self.sequence = sequence
        self._capacity = capacity
        self._held: OrderedDict[int, GaussianCloud] = OrderedDict()

    def __getitem__(self, frame: int) -> GaussianCloud:
        """Return a frame; beyond the end, the last one."""
        index = min(max(frame, 0), len(self.sequence) - 1)
        cloud = self._held.get(index)
        if cloud is None:
            cloud = change_axes(self.sequence[index], WORLD_AXES)
            self._held[index] = cloud
        self._held.move_to_end(index)
        while len(self._held) > 1 and sum(map(_size, self._held.values())) > self._capacity:
            self._held.popitem(last=False)
        return cloud

    def __len__(self) -> int:
        """Return how many are kept."""
        return len(self._held)


@dataclass(frozen=True, eq=False)
class Picture:
    """What is to be seen of a state.

    Attributes:
        pixels: Display sRGB, ``(H, W, 3)`` uint8.
        layers: The same as numbers, the layers of an image file: name to ``(H, W)``.
        gaussian_count: Number of Gaussians.
        samples: Paths a pixel; 0 where none were traced.
        legend: Legend of its colours, ``(h, w, 3)`` uint8; None where they need none.
    """

    pixels: NDArray[np.uint8]
    layers: Callable[[], dict[str, NDArray[np.float32]]]
    gaussian_count: int
    samples: int = 0
    legend: NDArray[np.uint8] | None = None


class CloudPainter:
    """Draws a sequence: lit, or one of its channels; called from one thread.

    Attributes:
        subject: The box that the first, the middle and the last frame are in.
        channels: Channels that can be shown.
        can_trace: Whether paths can be traced.
        device: Name of the device that draws.
    """

    def __init__(
        self,
        sequence: GaussianSequence,
        environments: Mapping[str, Callable[[], EnvironmentMap]],
        *,
        raster: RasterOptions | None = None,
        device: str | None = None,
    ) -> None:
        """Read the first frame.

        Args:
            sequence: Gaussians to draw.
            environments: Functions that read or make a light, by its name.
            raster: How splats are drawn; as the sequence says by default.
            device: Warp device; None takes the first CUDA device, or the CPU where there is none.

        Raises:
            DeviceError: There is no such device.
            AssetFormatError: The first frame cannot be read.
        """
        target = resolve_device(device)
        self._target = str(target)
        self.device = device_label(target)
        self.is_cuda = bool(target.is_cuda)
        self._frames = FrameCache(sequence)
        self._environments = dict(environments)
        self._lights: OrderedDict[str, EnvironmentMap] = OrderedDict()
        self._raster = RasterOptions.from_metadata(sequence.metadata) if raster is None else raster
        self._deferred = DeferredPair(self._raster, self._target)
        clouds = self._looked_at()
        self.subject = SubjectBox.of(bulk_of(clouds))
        self.channels = channels_of(next(filter(len, clouds), clouds[0]))
        self._tracer = (
            PathRenderer(PathOptions(samples=MOST_PATHS), device=self._target) if LIT in self.channels else None
        )
        self.can_trace = self._tracer is not None
        self._ground: tuple[str, ShotMesh] | None = None

    def cost_key(self, state: ViewState) -> object:
        """Return what must be the same for two pictures of a size to take about the same time."""
        return state.channel, state.environment, state.ground, len(state.lights), state.environment_shadows

    def draw(self, state: ViewState, camera: Camera, *, is_quick: bool = False) -> Picture:
        """Draw a state at once; quickly, if something moves."""
        cloud = self._frames[state.frame]
        if state.channel == LIT:
            image = self._deferred.draw(
                self._shot(state, cloud, camera),
                lighting=state.lighting,
                is_thorough=state.environment_shadows,
                is_quick=is_quick,
            )
            return _lit_picture(image, state, len(cloud))
        seen = self._seen(state.channel, cloud, camera)
        value_range = _depth_range(seen) if state.channel == DEPTH else channel_range(cloud, state.channel)
        pixels = _over(seen.colors(value_range), seen.alpha, state.background)
        return Picture(pixels, seen.layers, len(cloud), legend=seen.legend(LEGEND_WIDTH, value_range))

    def trace(self, state: ViewState, camera: Camera) -> TracedPicture:
        """Begin to trace paths.

        Raises:
            InvalidOptionError: There is nothing that traces them.
        """
        if self._tracer is None:
            raise InvalidOptionError(
                "mode must be deferred, got path traced: there is no path tracer. Choose deferred."
            )
        cloud = self._frames[state.frame]
        return TracedPicture(self._tracer.start(self._shot(state, cloud, camera)), state, len(cloud))

    def _looked_at(self) -> list[GaussianCloud]:
        """Return the first, the middle and the last frame; a broken one but the first says so when it is drawn."""
        last = len(self._frames.sequence) - 1
        clouds = [self._frames[0]]
        for frame in sorted({last // 2, last} - {0}):
            with contextlib.suppress(BeamError):
                clouds.append(self._frames[frame])
        return clouds

    def _shot(self, state: ViewState, cloud: GaussianCloud, camera: Camera) -> Shot:
        return Shot(
            cloud=cloud,
            camera=camera,
            environment=self._environment(state.environment),
            environment_rotation=state.rotation,
            lights=state.lights,
            mesh=self._ground_mesh(state.ground),
        )

    def _environment(self, name: str) -> EnvironmentMap | None:
        """Return a light: the same object as long as it is kept, so that renderers know it again."""
        if name == NO_ENVIRONMENT:
            return None
        require_choice("environment", name, tuple(self._environments))
        if name not in self._lights:
            self._lights[name] = self._environments[name]()
            if len(self._lights) > CACHED_LIGHTS:
                self._lights.popitem(last=False)
        self._lights.move_to_end(name)
        return self._lights[name]

    def _ground_mesh(self, ground: str) -> ShotMesh | None:
        """Return a square below the subject; the same object as long as it is asked for."""
        if ground == NO_GROUND:
            return None
        if self._ground is None or self._ground[0] != ground:
            self._ground = ground, ground_mesh(self.subject, catches_shadows=ground == SHADOW_GROUND)
        return self._ground[1]

    def _seen(self, channel: str, cloud: GaussianCloud, camera: Camera) -> SeenChannel:
        if channel in (DEPTH, ALPHA):
            buffer = rasterize(cloud, camera, channels=(), options=self._raster, device=self._target)
            if channel == DEPTH:
                return SeenChannel(DEPTH, buffer.alpha, buffer.depth)
            return SeenChannel(ALPHA, np.ones_like(buffer.alpha), np.repeat(buffer.alpha[..., None], 3, -1), True)
        return see_channel(cloud, camera, channel, options=self._raster, device=self._target)


@dataclass(frozen=True)
class TracedPicture:
    """Picture of a state that gets better as paths are added."""

    progress: PathProgress
    state: ViewState
    gaussian_count: int

    @property
    def sample_count(self) -> int:
        """Paths a pixel so far."""
        return self.progress.sample_count

    def advance(self, samples: int) -> None:
        """Add paths to every pixel."""
        self.progress.advance(samples)

    def picture(self) -> Picture:
        """Return what there is so far."""
        return _lit_picture(self.progress.image(), self.state, self.gaussian_count, self.sample_count)


def ground_mesh(subject: SubjectBox, *, catches_shadows: bool) -> ShotMesh:
    """Return a horizontal square that a subject stands on."""
    reach = GROUND_REACH * subject.extent
    x, y, _ = subject.center.tolist()
    corners = np.array([[x - reach, y - reach], [x + reach, y - reach], [x + reach, y + reach], [x - reach, y + reach]])
    surface = MaterialMesh(
        vertices=np.column_stack([corners, np.full(4, subject.low[2])]).astype(np.float32),
        faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        normals=np.tile(np.array([0.0, 0.0, 1.0], np.float32), (4, 1)),
        base_color=np.full((4, 3), GROUND_GREY, np.float32),
        roughness=np.full(4, GROUND_ROUGHNESS, np.float32),
    )
    return ShotMesh(surface=surface, catches_shadows=np.full(2, catches_shadows))


def _lit_picture(image: RenderedImage, state: ViewState, gaussian_count: int, samples: int = 0) -> Picture:
    """Return an image as it is shown."""
    pixels = displayed(image, state.transform, state.exposure, state.background)
    return Picture(pixels, partial(_lit_layers, image), gaussian_count, samples)


def _lit_layers(image: RenderedImage) -> dict[str, NDArray[np.float32]]:
    """Return light as the layers of an image file, multiplied by alpha and without exposure."""
    return {**{name: image.rgb[..., i] for i, name in enumerate("RGB")}, "A": image.alpha}


def _over(colors: NDArray[np.float64], alpha: NDArray[np.float32], background: Color) -> NDArray[np.uint8]:
    """Lay display colours over one: they stand for numbers, and are mixed as they are."""
    weight = np.clip(alpha, 0.0, 1.0)[..., None]
    behind = np.asarray(background, np.float64) / 255.0
    return np.rint(255.0 * (weight * np.clip(colors, 0.0, 1.0) + (1.0 - weight) * behind)).astype(np.uint8)


def _depth_range(seen: SeenChannel) -> tuple[float, float]:
    """Return the ends of a scale for what most of the picture shows."""
    depths = seen.values[seen.alpha > 0.5]
    if not len(depths):
        return 0.0, 1.0
    low, high = np.quantile(depths, (0.02, 0.98)).tolist()
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-6)))  # ends that people can read
    first, last = math.floor(low / step) * step, math.ceil(high / step) * step
    return first, last if last > first else first + step


def _size(cloud: GaussianCloud) -> int:
    """Return what a cloud's arrays take [byte]."""
    return sum(array.nbytes for array in cloud.arrays().values())
