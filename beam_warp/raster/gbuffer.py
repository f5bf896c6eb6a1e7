"""G-buffers of a cloud: alpha, depth and any channel of every pixel, and the gradients of a loss on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.checks import require_array, require_choice, require_finite, require_same_length
from beam_warp.device.arrays import resolve_device
from beam_warp.errors import InvalidOptionError
from beam_warp.raster.array_checks import require_cameras
from beam_warp.raster.channels import UNIT_CHANNELS, channel_layers, is_vector
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import CAMERA_PARAMETERS, RasterOptions
from beam_warp.raster.sources import GEOMETRY, DrawnCloud, require_world_axes, upload_gaussians
from beam_warp.raster.view_images import ValueImages, ViewImages, host_images, view_images
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import ATTRIBUTES, MATERIAL_CHANNELS, GaussianCloud

IMAGES = ("alpha", "depth", "median_depth")
"""Images besides channels that a loss may depend on."""


@dataclass(frozen=True, eq=False)
class GBuffer:
    """Alpha, depth and channels of every pixel of a camera.

    Attributes:
        camera: The camera.
        alpha: Coverage in [0, 1], ``(H, W)`` float32.
        depth: Expected distance along the optical axis [m], ``(H, W)`` float32.
        median_depth: Distance of the last splat in front of which more than half of the light still passes [m],
            ``(H, W)`` float32. At edges it jumps where the expected depth blurs.
        gaussian_ids: The last Gaussian that was seen, -1 for none, ``(H, W)`` int32.
        channels: Images by name: the mean over what the pixel sees, weighted by visibility and *not* multiplied by
            alpha, ``(H, W)`` or ``(H, W, C)`` float32, in the units and colour space of the cloud's array of that name.
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

        Names: ``A``, ``depth``, ``roughness``, ``ambient_occlusion``, ``base_color.R`` …, ``normal.X`` …, and
        every other channel by its own name: ``roughness_error``, ``base_color_error.R`` …; values as they are here,
        not multiplied by alpha.
        """
        layers = {"A": self.alpha, "depth": self.depth}
        for name, array in self.channels.items():
            layers.update(channel_layers(name, array))
        return layers


@overload
def rasterize(
    cloud: GaussianCloud,
    cameras: Camera,
    *,
    channels: Sequence[str] = ...,
    options: RasterOptions | None = ...,
    device: Any = ...,
) -> GBuffer: ...


@overload
def rasterize(
    cloud: GaussianCloud,
    cameras: Sequence[Camera],
    *,
    channels: Sequence[str] = ...,
    options: RasterOptions | None = ...,
    device: Any = ...,
) -> list[GBuffer]: ...


def rasterize(
    cloud: GaussianCloud,
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
        cloud: Gaussians in the internal world (axes ``rfu``).
        cameras: A camera, or any number of them, of any sizes.
        channels: What to draw, of `CHANNELS`.
        options: How splats are drawn; see `RasterOptions`.
        device: Warp device; the first GPU without, or the CPU where there is none.

    Returns:
        What the camera sees; for a sequence of cameras, what each one sees.

    Raises:
        InvalidOptionError: A channel is unknown, ``cameras`` holds something else, or the cloud is in other axes.
        InvalidArrayError: The cloud lacks a channel, or it covers an image too often to be drawn.
        DeviceError: The device is not there.

    Source: Zwicker et al. 2001; Kerbl et al. 2023, Section 6; Zhang et al. 2024 (depth and normals).
    """
    drawn = DrawnCloud.of(cloud, channels, device)
    views = [cameras] if isinstance(cameras, Camera) else list(cameras)
    buffers = [
        _mean_images(drawn, rasterizer, view, camera)
        for rasterizer, _ in drawn.draw_groups(views, options)
        for view, camera in zip(view_images(rasterizer), rasterizer.cameras, strict=True)
    ]
    return buffers[0] if isinstance(cameras, Camera) else buffers


def rasterize_values(
    cloud: GaussianCloud, camera: Camera, values: ArrayLike, *, options: RasterOptions | None = None, device: Any = None
) -> ValueImages:
    """Draw any per-Gaussian values: the linear map from values to pixels that `rasterize` rests on.

    Options and device are those of `rasterize`.

    Args:
        cloud: Gaussians in the internal world (axes ``rfu``).
        camera: The camera.
        values: ``(N, K)`` finite float32, K at least 0.

    Raises:
        InvalidOptionError: The cloud is in other axes.
        InvalidArrayError: ``values`` breaks its contract, or the cloud covers the image too often to be drawn.
        DeviceError: The device is not there.
    """
    rows = require_array("values", values, (None, None))
    require_same_length("values", rows, "positions", len(cloud))
    require_finite("values", rows)
    require_world_axes(cloud)
    target = resolve_device(device)
    rasterizer = Rasterizer(len(cloud), [camera], value_count=rows.shape[1], options=options, device=target)
    rasterizer.draw(upload_gaussians(cloud, target, values=rows))
    return host_images(view_images(rasterizer)[0], rows.shape[1])


@dataclass(frozen=True, eq=False)
class CloudGradients:
    """Derivatives of a loss with respect to a cloud's arrays, float32 and of their shapes.

    Attributes:
        positions, scales: [1/m].
        orientations: To the quaternions xyzw as given, orthogonal to them.
        opacities: To the opacities.
        channels: Derivatives to the arrays of the channels that were drawn, by name. ``surface_normals`` have none of
            their own: theirs are in ``orientations``, ``scales`` and ``positions``.
        cameras: Derivatives to the numbers of each camera that `CAMERA_PARAMETERS` names, ``(V, 12)``; None where they
            were not asked for.
    """

    positions: NDArray[np.float32]
    orientations: NDArray[np.float32]
    scales: NDArray[np.float32]
    opacities: NDArray[np.float32]
    channels: Mapping[str, NDArray[np.float32]]
    cameras: NDArray[np.float32] | None = None


def rasterize_backward(
    cloud: GaussianCloud,
    cameras: Camera | Sequence[Camera],
    adjoints: Mapping[str, ArrayLike] | Sequence[Mapping[str, ArrayLike]],
    *,
    channels: Sequence[str] = MATERIAL_CHANNELS,
    cameras_too: bool = False,
    options: RasterOptions | None = None,
    device: Any = None,
) -> CloudGradients:
    """Return the gradient of a loss with respect to a cloud, given its gradient with respect to the G-buffers.

    The cloud is drawn again: a loop that draws and differentiates holds a `Rasterizer` instead. Discrete decisions
    are held still: which splats count, their order, the cap of alpha, the pick of the median. The bits depend on the
    device alone. All other arguments are those of `rasterize`.

    Args:
        adjoints: Derivatives of the loss to the images, by name: of an attribute of `GBuffer` (``alpha``, ``depth``,
            ``median_depth``) or of a channel. Images left out have derivatives of 0. One mapping for a camera, as
            many as cameras for a sequence.
        cameras_too: Whether derivatives to the cameras are wanted as well.

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
    drawn = DrawnCloud.of(cloud, channels, device)
    for mapping in given:
        for name in mapping:
            require_choice("adjoints", name, (*IMAGES, *drawn.channels))
    totals: dict[str, Any] = {}
    of_cameras = []
    for rasterizer, part in drawn.draw_groups(views, options):
        for place, index in enumerate(part):
            _set_adjoints(drawn, rasterizer, place, given[index])
        rows = wp.zeros((len(part), len(CAMERA_PARAMETERS)), dtype=float, device=drawn.device) if cameras_too else None
        for name, array in drawn.gradients(rasterizer.backward(rows)).items():
            totals[name] = totals[name] + array if name in totals else array
        if rows is not None:
            of_cameras.append(rows.numpy())
    geometry = {name: totals.pop(name) for name in GEOMETRY}
    return CloudGradients(**geometry, channels=totals, cameras=np.concatenate(of_cameras) if of_cameras else None)


def _mean_images(cloud: DrawnCloud, rasterizer: Rasterizer, view: ViewImages, camera: Camera) -> GBuffer:
    """Turn one view's sums into means."""
    images = host_images(view, rasterizer.value_channels.stop)
    alpha = images.alpha
    drawn = {}
    for name, place in cloud.places(rasterizer).items():
        layer = images.values[..., place]
        if name in UNIT_CHANNELS:
            layer = _quotient(layer, np.linalg.norm(layer, axis=-1, keepdims=True))
        else:
            layer = _quotient(layer, alpha[..., None])
            # A mean stays in the range of what it averages, but for the last bit.
            layer = np.clip(layer, ATTRIBUTES[name].low, ATTRIBUTES[name].high, dtype=np.float32)
        drawn[name] = layer if is_vector(name) else layer[..., 0]
    return GBuffer(
        camera, np.minimum(alpha, np.float32(1.0)), images.depth, images.median_depth, images.gaussian_ids, drawn
    )


def _set_adjoints(cloud: DrawnCloud, rasterizer: Rasterizer, place: int, given: Mapping[str, ArrayLike]) -> None:
    """Turn derivatives to the means of one view into those to its sums, and write them where they are read."""
    camera = rasterizer.cameras[place]
    shape = (camera.height, camera.width)
    drawn = host_images(view_images(rasterizer)[place], rasterizer.value_channels.stop)
    arrays = {}
    for name in IMAGES:
        array = require_array(name, given.get(name, np.zeros(shape)), shape, np.float64).copy()
        require_finite(name, array)
        arrays[name] = array
    to_sums = np.zeros(drawn.values.shape)
    alpha = drawn.alpha.astype(np.float64)[..., None]
    for name, columns in cloud.places(rasterizer).items():
        layer = drawn.values[..., columns].astype(np.float64)
        trailing = (layer.shape[-1],) if is_vector(name) else ()
        array = require_array(name, given.get(name, np.zeros(shape + trailing)), shape + trailing, np.float64)
        require_finite(name, array)
        array = array.reshape(layer.shape)
        if name in UNIT_CHANNELS:
            length = np.linalg.norm(layer, axis=-1, keepdims=True)
            unit = _quotient(layer, length)
            across = array - unit * (unit * array).sum(axis=-1, keepdims=True)
            to_sums[..., columns] = _quotient(across, length)
        else:
            per_weight = _quotient(array, alpha)
            to_sums[..., columns] = per_weight
            arrays["alpha"] -= (per_weight * _quotient(layer, alpha)).sum(axis=-1)
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


def _quotient(numerator: NDArray[Any], denominator: NDArray[Any]) -> NDArray[Any]:
    """Divide; return 0 where the denominator is not positive."""
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=denominator > 0.0)
