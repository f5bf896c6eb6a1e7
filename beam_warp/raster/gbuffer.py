"""What cameras see of a cloud: alpha, depth and any channel of every pixel (a G-buffer), and the way back."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_choice, require_finite, require_same_length
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.raster.array_checks import require_cameras
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, GaussianGradients, RasterImages, RasterOptions
from beam_warp.trace.scene import Scene
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import ATTRIBUTES, WORLD_AXES, GaussianCloud

MATERIAL_CHANNELS = ("base_color", "roughness", "ambient_occlusion", "normals")
"""The channels that relighting reads."""

RADIANCE = "radiance"
"""The channel that is evaluated towards the camera before it is composited."""

SURFACE_NORMALS = "surface_normals"
"""The channel of normals that geometry alone gives: of the surface of largest response, towards the camera."""

CHANNELS = (
    RADIANCE,
    SURFACE_NORMALS,
    *(a.name for a in ATTRIBUTES.values() if a.dtype == "float32" and not a.required and a.name != RADIANCE),
)
"""Every channel that `rasterize` knows; a cloud may lack some."""

ERROR_CHANNELS = tuple(name for name in CHANNELS if name.endswith("_error"))
"""The channels of standard errors: their mean over what a pixel sees, as if all of it were wrong the same way."""

UNIT_CHANNELS = ("normals", SURFACE_NORMALS)
"""Channels of directions: their mean is brought to unit length."""

GROUP_SPLATS = 2**23
"""Most splats, Gaussians times cameras, projected at a time unless one camera has more: 1.2 GB with 11 channels."""

GROUP_PIXELS = 2**25
"""Most pixels drawn at a time unless one camera has more: 2.6 GB with 11 channels, 3.1 GB on the CPU."""


@dataclass(frozen=True, eq=False)
class GBuffer:
    """What every pixel of a camera sees.

    Attributes:
        camera: The camera that sees it.
        alpha: Coverage in [0, 1], ``(H, W)`` float32.
        depth: Expected distance along the optical axis [m], ``(H, W)`` float32.
        median_depth: Distance of the last splat that more than half of the light passes before [m], ``(H, W)``
            float32: it jumps where the expected one blurs.
        gaussian_ids: The last Gaussian that was seen, -1 for none, ``(H, W)`` int32.
        channels: By name, the mean over what the pixel sees, weighted by visibility and *not* multiplied by alpha:
            ``(H, W)`` or ``(H, W, C)`` float32 in the units and colour space of the cloud's array of that name.
            ``normals`` and ``surface_normals`` are of unit length; ``radiance`` is the captured colour towards the
            camera, composited in its own colour space, as viewers do.

    Depths and channels are 0 where alpha is 0.
    """

    camera: Camera
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]
    gaussian_ids: NDArray[np.int32]
    channels: Mapping[str, NDArray[np.float32]]

    def layers(self) -> dict[str, NDArray[np.float32]]:
        """Return alpha, depth and the material channels as the layers of an image file, ``(H, W)`` each.

        Names: ``A``, ``depth``, ``roughness``, ``ambient_occlusion``, ``base_color.R`` …, ``normal.X`` …, and what else
        was drawn by its own name: ``roughness_error``, ``base_color_error.R`` …; values as they are here, not
        multiplied by alpha.
        """
        layers = {"A": self.alpha, "depth": self.depth}
        for name, array in self.channels.items():
            layers.update(channel_layers(name, array))
        return layers


_LAYER_PARTS = {"normals": ("normal", "XYZ"), SURFACE_NORMALS: ("surface_normal", "XYZ")}
"""Channels whose layers are named otherwise than NAME.R, NAME.G and NAME.B."""


def channel_layers(name: str, array: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """Return an image of a channel, ``(H, W)`` or ``(H, W, 3)``, as the layers of an image file."""
    prefix, parts = _LAYER_PARTS.get(name, (name, "RGB"))
    if array.ndim == 2:
        return {prefix: array}
    return {f"{prefix}.{part}": array[..., i] for i, part in enumerate(parts)}


class ValueImages(NamedTuple):
    """Sums over what every pixel of a camera sees, weighted by visibility.

    Attributes:
        alpha: Sum of the weights, ``(H, W)`` float32; at most 1 but for rounding.
        depth: Mean depth [m], ``(H, W)`` float32; 0 where nothing is seen.
        median_depth: See `GBuffer`.
        gaussian_ids: See `GBuffer`.
        values: Sums of values, ``(H, W, K)`` float32.
    """

    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    median_depth: NDArray[np.float32]
    gaussian_ids: NDArray[np.int32]
    values: NDArray[np.float32]


@overload
def rasterize(
    source: GaussianCloud | Scene,
    cameras: Camera,
    *,
    channels: Sequence[str] = ...,
    options: RasterOptions | None = ...,
    device: Any = ...,
) -> GBuffer: ...


@overload
def rasterize(
    source: GaussianCloud | Scene,
    cameras: Sequence[Camera],
    *,
    channels: Sequence[str] = ...,
    options: RasterOptions | None = ...,
    device: Any = ...,
) -> list[GBuffer]: ...


def rasterize(
    source: GaussianCloud | Scene,
    cameras: Camera | Sequence[Camera],
    *,
    channels: Sequence[str] = MATERIAL_CHANNELS,
    options: RasterOptions | None = None,
    device: Any = None,
) -> GBuffer | list[GBuffer]:
    """Draw a cloud.

    Splats are composited front to back in the order of their centres' depth, ties in the order of the cloud, with the
    constants of 3DGS: alpha at most 0.99 and at least 1/255. Same device, same input: same bits.

    Args:
        source: Gaussians in the internal world (axes ``rfu``); or a `Scene`, drawn where it is on its device, whose
            only channels are ``surface_normals`` and, where its cloud has them, ``normals``.
        cameras: A camera, or any number of them, of any sizes.
        channels: What to draw, of `CHANNELS`.
        options: How splats are drawn; see `RasterOptions`.
        device: Warp device; the first GPU without, or the CPU where there is none. A scene has its own.

    Returns:
        What the camera sees; for a sequence of cameras, what each one sees.

    Raises:
        InvalidOptionError: A channel is unknown, ``cameras`` holds something else, or the cloud is in other axes.
        InvalidArrayError: The cloud lacks a channel, or it covers an image too often to be drawn.
        DeviceError: The device is not there.

    Source: Zwicker et al. 2001; Kerbl et al. 2023, Section 6; Zhang et al. 2024 (depth and normals).
    """
    drawn = _Source.of(source, channels, device)
    if isinstance(cameras, Camera):
        return next(drawn.draw([cameras], options))
    return list(drawn.draw(list(cameras), options))


def rasterize_values(
    cloud: GaussianCloud,
    camera: Camera,
    values: ArrayLike,
    *,
    options: RasterOptions | None = None,
    device: Any = None,
) -> ValueImages:
    """Draw any per-Gaussian values: the linear map from values to pixels that `rasterize` rests on.

    Args:
        cloud: Gaussians in the internal world (axes ``rfu``).
        camera: The camera.
        values: ``(N, K)`` finite float32, K at least 0.
        options: See `rasterize`.
        device: See `rasterize`.

    Raises:
        InvalidOptionError: The cloud is in other axes.
        InvalidArrayError: ``values`` breaks its contract, or the cloud covers the image too often to be drawn.
        DeviceError: The device is not there.
    """
    rows = require_array("values", values, (None, None))
    require_same_length("values", rows, "positions", len(cloud))
    require_finite("values", rows)
    _require_world_axes(cloud)
    target = resolve_device(device)
    rasterizer = Rasterizer(len(cloud), [camera], value_count=rows.shape[1], options=options, device=target)
    images = rasterizer.draw(upload_gaussians(cloud, target, values=rows))
    return _view_images(rasterizer, images, 0, camera)


@dataclass(frozen=True, eq=False)
class CloudGradients:
    """Derivatives of a loss with respect to a cloud's arrays, float32 and of their shapes.

    Attributes:
        positions, scales: [1/m].
        orientations: To the quaternions xyzw as given, orthogonal to them.
        opacities: To the opacities.
        channels: By name, to the arrays of the channels that were drawn; ``surface_normals`` have none of their own,
            what they say is in ``orientations``, ``scales`` and ``positions``.
    """

    positions: NDArray[np.float32]
    orientations: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    channels: Mapping[str, NDArray[np.float32]]


def rasterize_backward(
    cloud: GaussianCloud,
    cameras: Camera | Sequence[Camera],
    adjoints: Mapping[str, ArrayLike] | Sequence[Mapping[str, ArrayLike]],
    *,
    channels: Sequence[str] = MATERIAL_CHANNELS,
    options: RasterOptions | None = None,
    device: Any = None,
) -> CloudGradients:
    """Return how a loss changes with a cloud, from how it changes with what `rasterize` returns for it.

    The cloud is drawn again: a loop that draws and differentiates holds a `Rasterizer` instead. What is discrete is
    held still: which splats count, their order, the cap of alpha, the pick of the median. The bits depend on the device
    alone.

    Args:
        cloud: See `rasterize`.
        cameras: See `rasterize`.
        adjoints: By name of an attribute of `GBuffer` (``alpha``, ``depth``, ``median_depth``) or of a channel, the
            derivatives of the loss to that image; what is left out is 0. One mapping for a camera, as many as cameras
            for a sequence.
        channels: See `rasterize`.
        options: See `rasterize`.
        device: See `rasterize`.

    Raises:
        InvalidOptionError: A name is neither an image nor a channel drawn, or their number is not that of the cameras;
            else as for `rasterize`.
        InvalidArrayError: A derivative has another shape than its image, or is not finite; else as for `rasterize`.
        DeviceError: The device is not there.

    Source: see `Rasterizer.backward`.
    """
    views = [cameras] if isinstance(cameras, Camera) else list(cameras)
    require_cameras(views)
    given = [adjoints] if isinstance(adjoints, Mapping) else list(adjoints)
    if len(given) != len(views):
        raise InvalidOptionError(
            f"adjoints must hold one mapping for each of {len(views)} cameras, got {len(given)}. Pass an empty one "
            "where nothing changes."
        )
    drawn = _Source.of(cloud, channels, device)
    for mapping in given:
        for name in mapping:
            require_choice("adjoints", name, (*IMAGES, *drawn.channels))
    totals: dict[str, Any] = {}
    for rasterizer, images, part in drawn.draw_groups(views, options):
        for place, index in enumerate(part):
            drawn.set_adjoints(rasterizer, images, place, given[index])
        for name, array in drawn.gradients(rasterizer.backward()).items():
            totals[name] = totals[name] + array if name in totals else array
    return CloudGradients(**{name: totals.pop(name) for name in GEOMETRY}, channels=totals)


IMAGES = ("alpha", "depth", "median_depth")
"""Images besides channels that a loss may depend on."""

GEOMETRY = ("positions", "orientations", "scales", "opacities")
"""Arrays of a cloud that every image depends on."""


@dataclass(frozen=True, eq=False)
class _Source:
    """Gaussians on a device, and which of their arrays are drawn."""

    gaussians: GaussianArrays
    channels: tuple[str, ...]
    device: Any

    @classmethod
    def of(cls, source: GaussianCloud | Scene, channels: Sequence[str], device: Any) -> _Source:
        """Bring what is drawn to the device."""
        names = tuple(channels)
        for name in names:
            require_choice("channels", name, CHANNELS)
        if isinstance(source, Scene):
            return cls(_scene_arrays(source, names), names, source.device)
        _require_world_axes(source)
        target = resolve_device(device)
        columns = {name: _require_channel(source, name) for name in _own(names)}
        values = (
            np.concatenate([c.reshape(len(source), _width(name)) for name, c in columns.items()], axis=1)
            if columns
            else None
        )
        radiance = _require_channel(source, RADIANCE) if RADIANCE in names else None
        return cls(upload_gaussians(source, target, values=values, radiance=radiance), names, target)

    def draw(self, cameras: Sequence[Camera], options: RasterOptions | None) -> Iterator[GBuffer]:
        """Draw for cameras, some at a time."""
        for rasterizer, images, part in self.draw_groups(cameras, options):
            for place, index in enumerate(part):
                yield self._buffer(_view_images(rasterizer, images, place, cameras[index]), rasterizer, cameras[index])

    def draw_groups(
        self, cameras: Sequence[Camera], options: RasterOptions | None
    ) -> Iterator[tuple[Rasterizer, RasterImages, range]]:
        """Draw for as many cameras at a time as memory allows: what drew them, the images, and which ones."""
        if cameras:
            require_cameras(cameras)
        first = 0
        while first < len(cameras):
            end = first + 1
            pixels = cameras[first].width * cameras[first].height
            while end < len(cameras):
                pixels += cameras[end].width * cameras[end].height
                if pixels > GROUP_PIXELS or (end + 1 - first) * len(self.gaussians.positions) > GROUP_SPLATS:
                    break
                end += 1
            rasterizer = Rasterizer(
                len(self.gaussians.positions),
                cameras[first:end],
                value_count=0 if self.gaussians.values is None else self.gaussians.values.shape[1],
                radiance=RADIANCE in self.channels,
                normals=SURFACE_NORMALS in self.channels,
                options=options,
                device=self.device,
            )
            yield rasterizer, rasterizer.draw(self.gaussians), range(first, end)
            first = end

    def _places(self, rasterizer: Rasterizer) -> dict[str, slice]:
        """Return where each channel is among those of a rasteriser."""
        places = {}
        start = rasterizer.value_channels.start
        for name in _own(self.channels):
            width = _width(name)
            places[name] = slice(start, start + width)
            start += width
        places[RADIANCE] = slice(rasterizer.color_channels.start, rasterizer.color_channels.stop)
        places[SURFACE_NORMALS] = slice(rasterizer.normal_channels.start, rasterizer.normal_channels.stop)
        return {name: places[name] for name in self.channels}

    def _buffer(self, images: ValueImages, rasterizer: Rasterizer, camera: Camera) -> GBuffer:
        """Turn sums into means."""
        alpha = images.alpha
        drawn = {}
        for name, place in self._places(rasterizer).items():
            layer = images.values[..., place]
            if name in UNIT_CHANNELS:
                length = np.linalg.norm(layer, axis=-1, keepdims=True)
                layer = np.divide(layer, length, out=np.zeros_like(layer), where=length > 0.0)
            else:
                layer = np.divide(layer, alpha[..., None], out=np.zeros_like(layer), where=alpha[..., None] > 0.0)
                # A mean stays in the range of what it averages, but for the last bit.
                layer = np.clip(layer, ATTRIBUTES[name].low, ATTRIBUTES[name].high, dtype=np.float32)
            drawn[name] = layer if name == SURFACE_NORMALS or ATTRIBUTES[name].trailing else layer[..., 0]
        return GBuffer(
            camera, np.minimum(alpha, np.float32(1.0)), images.depth, images.median_depth, images.gaussian_ids, drawn
        )

    def set_adjoints(
        self, rasterizer: Rasterizer, images: RasterImages, place: int, given: Mapping[str, ArrayLike]
    ) -> None:
        """Turn derivatives to the means of one view into those to its sums, and write them where they are read."""
        camera = rasterizer.cameras[place]
        shape = (camera.height, camera.width)
        drawn = _view_images(rasterizer, images, place, camera)
        arrays = {}
        for name in IMAGES:
            array = require_array(name, given.get(name, np.zeros(shape)), shape, np.float64).copy()
            require_finite(name, array)
            arrays[name] = array
        to_sums = np.zeros(drawn.values.shape)
        alpha = drawn.alpha.astype(np.float64)[..., None]
        for name, columns in self._places(rasterizer).items():
            layer = drawn.values[..., columns].astype(np.float64)
            trailing = () if name != SURFACE_NORMALS and not ATTRIBUTES[name].trailing else (layer.shape[-1],)
            array = require_array(name, given.get(name, np.zeros(shape + trailing)), shape + trailing, np.float64)
            require_finite(name, array)
            array = array.reshape(layer.shape)
            if name in UNIT_CHANNELS:
                length = np.linalg.norm(layer, axis=-1, keepdims=True)
                unit = np.divide(layer, length, out=np.zeros_like(layer), where=length > 0.0)
                across = array - unit * (unit * array).sum(axis=-1, keepdims=True)
                to_sums[..., columns] = np.divide(across, length, out=np.zeros_like(layer), where=length > 0.0)
            else:
                per_weight = np.divide(array, alpha, out=np.zeros_like(layer), where=alpha > 0.0)
                mean = np.divide(layer, alpha, out=np.zeros_like(layer), where=alpha > 0.0)
                to_sums[..., columns] = per_weight
                arrays["alpha"] -= (per_weight * mean).sum(axis=-1)
        target = rasterizer.adjoints()
        first, end = rasterizer.first_pixels[place : place + 2]
        for name in IMAGES:
            getattr(target, name)[first:end].assign(arrays[name].reshape(-1).astype(np.float32))
        start = 0
        for rows in target.channels:
            columns = to_sums[..., start : start + rows.shape[1]].reshape(end - first, -1).astype(np.float32)
            padded = np.zeros((end - first, rows.shape[1]), np.float32)
            padded[:, : columns.shape[1]] = columns
            rows[first:end].assign(padded)
            start += rows.shape[1]

    def gradients(self, found: GaussianGradients) -> dict[str, NDArray[np.float32]]:
        """Bring gradients back, by name of the cloud's array."""
        arrays = {name: getattr(found, name).numpy() for name in GEOMETRY}
        values = np.empty((0, 0), np.float32) if found.values is None else found.values.numpy()
        start = 0
        for name in _own(self.channels):
            columns = values[:, start : start + _width(name)]
            arrays[name] = np.ascontiguousarray(columns if ATTRIBUTES[name].trailing else columns[:, 0])
            start += columns.shape[1]
        if found.radiance is not None:
            arrays[RADIANCE] = found.radiance.numpy()
        return arrays


def upload_gaussians(
    cloud: GaussianCloud,
    device: Any,
    *,
    values: NDArray[np.float32] | None = None,
    radiance: NDArray[np.float32] | None = None,
) -> GaussianArrays:
    """Bring a cloud's geometry, and what of it is drawn, to a device.

    Args:
        cloud: Gaussians.
        device: A Warp device.
        values: ``(N, K)`` float32, or None.
        radiance: ``(N, B, 3)`` float32 spherical harmonics, or None.
    """
    return GaussianArrays(
        upload(cloud.positions, wp.vec3, device),
        upload(cloud.orientations, wp.quat, device),
        upload(cloud.scales, wp.vec3, device),
        upload(cloud.opacities, float, device),
        None if values is None else upload(values, float, device),
        None if radiance is None else upload(radiance, wp.vec3, device),
    )


def _own(channels: Sequence[str]) -> list[str]:
    """Return the channels that are Gaussians' own values: neither seen towards a camera nor of geometry."""
    return [name for name in channels if name not in (RADIANCE, SURFACE_NORMALS)]


def _width(name: str) -> int:
    """Return how many columns a channel of the Gaussians' own values takes."""
    return math.prod(side or 1 for side in ATTRIBUTES[name].trailing)


def _scene_arrays(scene: Scene, channels: Sequence[str]) -> GaussianArrays:
    """Return a scene's arrays as they are on its device."""
    packed = scene.packed
    own = _own(channels)
    if RADIANCE in channels or own not in ([], ["normals"]) or (own and not scene.has_normals):
        raise InvalidArrayError(
            f"channels of a scene must be of {SURFACE_NORMALS} and, where its cloud has them, normals, got "
            f"{', '.join(channels)}. Draw the cloud instead."
        )
    normals = packed.gaussians.normals
    values = None
    if own:
        values = wp.array(ptr=normals.ptr, shape=(len(normals), 3), dtype=float, device=scene.device)
    return GaussianArrays(packed.positions, packed.orientations, packed.scales, packed.opacities, values)


def _view_images(rasterizer: Rasterizer, images: RasterImages, place: int, camera: Camera) -> ValueImages:
    """Bring one view's images back; of its channels only those that there are, without padding."""
    first, end = rasterizer.first_pixels[place : place + 2]
    shape = (camera.height, camera.width)
    passes = [rows[first:end].numpy().reshape(*shape, -1) for rows in images.channels]
    values = passes[0] if len(passes) == 1 else np.concatenate(passes, axis=-1)
    flat = (images.alpha, images.depth, images.median_depth, rasterizer.gaussian_ids)
    alpha, depth, median_depth, gaussian_ids = (image[first:end].numpy().reshape(shape) for image in flat)
    return ValueImages(alpha, depth, median_depth, gaussian_ids, values[..., : rasterizer.value_channels.stop])


def _require_world_axes(cloud: GaussianCloud) -> None:
    """Refuse a cloud in other axes than the world's."""
    if cloud.axes != WORLD_AXES:
        raise InvalidOptionError(
            f"cloud must be in the axes {WORLD_AXES!r}, got {cloud.axes!r}. Convert it with "
            f"beam_warp.change_axes(cloud, {WORLD_AXES!r})."
        )


def _require_channel(cloud: GaussianCloud, name: str) -> NDArray[np.float32]:
    """Return the array of a channel."""
    array = getattr(cloud, name)
    if array is None:
        raise InvalidArrayError(
            f"channels must name arrays that the cloud holds, got {name!r}, which it lacks "
            f"(it has {', '.join(cloud.arrays())}). Add it, or leave the channel out."
        )
    return array
