"""What a camera sees of a cloud: alpha, depth and any per-Gaussian channel on every pixel (a G-buffer)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from beam_warp.assets import ATTRIBUTES, WORLD_AXES, GaussianCloud
from beam_warp.cameras import Camera
from beam_warp.checks import require_array, require_choice, require_finite, require_same_length
from beam_warp.devices import resolve_device
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.kernels.bin_tiles import (
    Band,
    count_pairs_kernel,
    emit_pairs_kernel,
    find_ranges_kernel,
    make_depth_keys_kernel,
)
from beam_warp.kernels.composite import CHANNEL_COUNTS, channel_vector, composite_kernel
from beam_warp.kernels.launching import launch
from beam_warp.kernels.project import Gaussians, Pinhole, Splats, project_gaussians_kernel
from beam_warp.spherical_harmonics import sh_color

MATERIAL_CHANNELS = ("base_color", "roughness", "ambient_occlusion", "normals")
"""The channels that relighting reads."""

RADIANCE = "radiance"
"""The channel that is evaluated towards the camera before it is composited."""

CHANNELS = (
    RADIANCE,
    *(a.name for a in ATTRIBUTES.values() if a.dtype == "float32" and not a.required and a.name != RADIANCE),
)
"""Every channel that `rasterize` knows; a cloud may lack some."""

TILE = 8
"""Side of a tile [pixel]. A pixel reads the whole list of its tile: small tiles waste less of it on small splats."""

MAX_BAND_PAIRS = 2**25
"""Most (tile, splat) pairs held at a time, 16 bytes each: beyond it the image is drawn in bands of tile rows."""

MAX_ROW_PAIRS = 2**30
"""Most pairs in one row of tiles, the least that can be drawn: positions in their list are 32-bit."""


@dataclass(frozen=True, eq=False)
class GBuffer:
    """What every pixel sees.

    Attributes:
        camera: The camera that sees it.
        alpha: Coverage in [0, 1], ``(H, W)`` float32.
        depth: Expected distance along the optical axis [m], ``(H, W)`` float32.
        channels: By name, the mean over what the pixel sees, weighted by visibility and *not* multiplied by alpha:
            ``(H, W)`` or ``(H, W, C)`` float32 in the units and colour space of the cloud's array of that name.
            ``normals`` are of unit length; ``radiance`` is the captured colour towards the camera, composited in its
            own colour space, as viewers do.

    Depth and channels are 0 where alpha is 0.
    """

    camera: Camera
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    channels: Mapping[str, NDArray[np.float32]]

    def layers(self) -> dict[str, NDArray[np.float32]]:
        """Return alpha, depth and the material channels as the layers of an image file, ``(H, W)`` each.

        Names: ``A``, ``depth``, ``roughness``, ``ambient_occlusion``, ``base_color.R`` …, ``normal.X`` …; values as
        they are here, not multiplied by alpha.
        """
        layers = {"A": self.alpha, "depth": self.depth}
        for name, array in self.channels.items():
            prefix, parts = _LAYER_PARTS.get(name, (name, "RGB"))
            if array.ndim == 2:
                layers[prefix] = array
            else:
                layers.update({f"{prefix}.{part}": array[..., i] for i, part in enumerate(parts)})
        return layers


_LAYER_PARTS = {"normals": ("normal", "XYZ")}
"""Channels whose layers are named otherwise than NAME.R, NAME.G and NAME.B."""


def rasterize(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    channels: Sequence[str] = MATERIAL_CHANNELS,
    device: Any = None,
    antialiased: bool = False,
) -> GBuffer:
    """Draw a cloud.

    Splats are composited front to back in the order of their centres' depth, with the constants of 3DGS: low-pass
    0.3 pixel^2, near plane 0.01 m, alpha at most 0.99 and at least 1/255. Same device, same input: same bits.

    Args:
        cloud: Gaussians in the internal world (axes ``rfu``).
        camera: The camera.
        channels: What to draw, of `CHANNELS`.
        device: Warp device; the first GPU without, or the CPU where there is none.
        antialiased: Keep a splat's total opacity when the low-pass widens it. For clouds trained that way, and for
            views from further away than the training views.

    Raises:
        InvalidOptionError: A channel is unknown, or the cloud is in other axes.
        InvalidArrayError: The cloud lacks a channel, or it covers the image too often to be drawn.
        DeviceError: The device is not there.

    Source: Zwicker et al. 2001; Kerbl et al. 2023, Section 6; Yu et al. 2024, Eq. 9 (``antialiased``).
    """
    columns = [_channel(cloud, camera, name) for name in channels]
    widths = [column.shape[1] for column in columns]
    values = np.concatenate(columns, axis=1) if columns else np.zeros((len(cloud), 0), np.float32)
    alpha, depth, image = rasterize_values(cloud, camera, values, device=device, antialiased=antialiased)
    covered = alpha > 0.0
    drawn = {}
    for name, start, width in zip(channels, np.cumsum([0, *widths]), widths, strict=False):
        layer = image[..., start : start + width]
        if name == "normals":
            length = np.linalg.norm(layer, axis=-1, keepdims=True)
            layer = np.divide(layer, length, out=np.zeros_like(layer), where=length > 0.0)
        else:
            layer = np.divide(layer, alpha[..., None], out=np.zeros_like(layer), where=covered[..., None])
            # A mean stays in the range of what it averages, but for the last bit.
            layer = np.clip(layer, ATTRIBUTES[name].low, ATTRIBUTES[name].high, dtype=np.float32)
        drawn[name] = layer[..., 0] if ATTRIBUTES[name].trailing == () else layer
    depth = np.divide(depth, alpha, out=np.zeros_like(depth), where=covered)
    return GBuffer(camera, np.minimum(alpha, np.float32(1.0)), depth, drawn)


def rasterize_values(
    cloud: GaussianCloud,
    camera: Camera,
    values: ArrayLike,
    *,
    device: Any = None,
    antialiased: bool = False,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Draw any per-Gaussian values: the linear map from values to pixels that `rasterize` rests on.

    Args:
        cloud: Gaussians in the internal world (axes ``rfu``).
        camera: The camera.
        values: ``(N, K)`` finite float32, K at least 0.
        device: See `rasterize`.
        antialiased: See `rasterize`.

    Returns:
        Alpha ``(H, W)``, the sum of the weights of what a pixel sees and so at most 1 but for rounding; and the sums
        of depth [m] ``(H, W)`` and of values ``(H, W, K)`` with the same weights; float32.

    Raises:
        InvalidOptionError: The cloud is in other axes.
        InvalidArrayError: ``values`` breaks its contract, or the cloud covers the image too often to be drawn.
        DeviceError: The device is not there.
    """
    rows = require_array("values", values, (None, None))
    require_same_length("values", rows, "positions", len(cloud))
    require_finite("values", rows)
    if cloud.axes != WORLD_AXES:
        raise InvalidOptionError(
            f"cloud must be in the axes {WORLD_AXES!r}, got {cloud.axes!r}. Convert it with "
            f"beam_warp.axes.change_axes(cloud, {WORLD_AXES!r})."
        )
    target = resolve_device(device)
    with wp.ScopedDevice(target):
        return _draw(cloud, camera, rows, antialiased, target)


def _draw(
    cloud: GaussianCloud, camera: Camera, values: NDArray[np.float32], antialiased: bool, device: Any
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Run the pipeline: project, sort by depth, and composite band by band and pass by pass."""
    shape = (camera.height, camera.width)
    pinhole = _pinhole(camera)
    splats = _project(cloud, pinhole, antialiased, device)
    order = _depth_order(splats, device)
    alpha = wp.zeros(camera.height * camera.width, dtype=float)
    depth = wp.zeros_like(alpha)
    passes = _passes(values)
    images = [wp.zeros(len(alpha), dtype=channels.dtype) for channels in passes]
    for band in _bands(splats.boxes.numpy(), camera):
        pairs, ranges = _bin(splats, order, band, device)
        for channels, image in zip(passes, images, strict=True):
            launch(
                composite_kernel(channels.dtype._length_),
                (band.end_row - band.first_row) * band.columns * band.tile**2,
                inputs=[splats, pairs, ranges, channels, pinhole, band],
                outputs=[image, alpha, depth],
                device=device,
            )
    layers = [image.numpy().reshape(*shape, -1) for image in images]
    image = np.concatenate(layers, axis=-1)[..., : values.shape[1]]
    return alpha.numpy().reshape(shape), depth.numpy().reshape(shape), image


def _pinhole(camera: Camera) -> Pinhole:
    """Describe a camera to the kernels."""
    pinhole = Pinhole()
    pinhole.world_to_camera = wp.mat33(camera.world_to_camera[:3, :3].astype(np.float32))
    pinhole.position = wp.vec3(*camera.position)
    pinhole.focal = wp.vec2(camera.focal_x, camera.focal_y)
    pinhole.center = wp.vec2(camera.center_x, camera.center_y)
    pinhole.width = camera.width
    pinhole.height = camera.height
    return pinhole


def _project(cloud: GaussianCloud, pinhole: Pinhole, antialiased: bool, device: Any) -> Splats:
    """Project every Gaussian; those on no pixel have an empty box and infinite depth."""
    count = len(cloud)
    gaussians = Gaussians()
    gaussians.positions = wp.array(cloud.positions, dtype=wp.vec3)
    gaussians.orientations = wp.array(cloud.orientations, dtype=wp.quat)
    gaussians.scales = wp.array(cloud.scales, dtype=wp.vec3)
    gaussians.opacities = wp.array(cloud.opacities, dtype=float)
    splats = Splats()
    splats.centers = wp.zeros(count, dtype=wp.vec2)
    splats.shapes = wp.zeros(count, dtype=wp.vec4)
    splats.planes = wp.zeros(count, dtype=wp.vec3)
    splats.depth_ranges = wp.zeros(count, dtype=wp.vec2)
    splats.depths = wp.zeros(count, dtype=float)
    splats.boxes = wp.zeros(count, dtype=wp.vec4i)
    launch(
        project_gaussians_kernel,
        count,
        inputs=[gaussians, pinhole, int(antialiased)],
        outputs=[splats],
        device=device,
    )
    return splats


def _depth_order(splats: Splats, device: Any) -> wp.array[int]:
    """Return the indices of all splats, nearest first and ties by index; those on no pixel come last."""
    count = len(splats.depths)
    keys = wp.zeros(2 * count, dtype=int)  # the sort wants room for as many again
    order = wp.zeros(2 * count, dtype=int)
    launch(make_depth_keys_kernel, count, inputs=[splats.depths], outputs=[keys, order], device=device)
    if count:
        wp.utils.radix_sort_pairs(keys, order, count)
    return order


def _bands(boxes: NDArray[np.int32], camera: Camera) -> Iterator[Band]:
    """Cut the image into bands of tile rows whose pairs fit in memory: usually one."""
    columns, rows = -(-camera.width // TILE), -(-camera.height // TILE)
    drawn = boxes[boxes[:, 2] > boxes[:, 0]].astype(np.int64)
    across = (drawn[:, 2] - 1) // TILE + 1 - drawn[:, 0] // TILE
    begins = np.bincount(drawn[:, 1] // TILE, across, rows + 1)
    ends = np.bincount((drawn[:, 3] - 1) // TILE + 1, across, rows + 1)
    pairs = np.cumsum(begins - ends)[:rows]
    if pairs.max() > MAX_ROW_PAIRS:
        raise InvalidArrayError(
            f"positions and scales must cover a row of tiles at most {MAX_ROW_PAIRS} times, got {int(pairs.max())} "
            f"at tile row {int(pairs.argmax())}. Drop Gaussians that are larger than the scene."
        )
    first = 0
    while first < rows:
        total = np.cumsum(pairs[first:])
        end = first + max(1, int(np.searchsorted(total, MAX_BAND_PAIRS, side="right")))
        band = Band()
        band.tile, band.columns, band.first_row, band.end_row = TILE, columns, first, end
        yield band
        first = end


def _bin(splats: Splats, order: wp.array[int], band: Band, device: Any) -> tuple[wp.array[int], wp.array[wp.vec2i]]:
    """Return the splats of all tiles of a band, tile by tile and nearest first, and each tile's range in that list."""
    tiles = (band.end_row - band.first_row) * band.columns
    ranges = wp.zeros(tiles, dtype=wp.vec2i)
    count = len(splats.depths)
    if not count:
        return order, ranges
    counts = wp.zeros(count, dtype=int)
    launch(count_pairs_kernel, count, inputs=[order, splats.boxes, band], outputs=[counts], device=device)
    ends = wp.zeros(count, dtype=int)
    wp.utils.array_scan(counts, ends, inclusive=True)
    total = int(ends[count - 1 :].numpy()[0])  # waits for the device: the number of pairs sizes what follows
    keys = wp.zeros(2 * total, dtype=int)
    pairs = wp.zeros(2 * total, dtype=int)
    if total:
        launch(emit_pairs_kernel, count, inputs=[order, splats.boxes, ends, band], outputs=[keys, pairs], device=device)
        wp.utils.radix_sort_pairs(keys, pairs, total, end_bit=max(1, (tiles - 1).bit_length()))
        launch(find_ranges_kernel, total, inputs=[keys, total], outputs=[ranges], device=device)
    return pairs, ranges


def _passes(values: NDArray[np.float32]) -> list[wp.array]:
    """Cut channels into vectors of the lengths there are kernels for, padded with zeros; at least one."""
    count, channel_count = values.shape
    passes = []
    for start in range(0, max(channel_count, 1), CHANNEL_COUNTS[-1]):
        chunk = values[:, start : start + CHANNEL_COUNTS[-1]]
        length = next(length for length in CHANNEL_COUNTS if length >= chunk.shape[1])
        padded = np.zeros((count, length), np.float32)
        padded[:, : chunk.shape[1]] = chunk
        passes.append(wp.array(padded, dtype=channel_vector(length)))
    return passes


def _channel(cloud: GaussianCloud, camera: Camera, name: str) -> NDArray[np.float32]:
    """Return what a channel composites, ``(N, C)``."""
    require_choice("channels", name, CHANNELS)
    array = getattr(cloud, name)
    if array is None:
        raise InvalidArrayError(
            f"channels must name arrays that the cloud holds, got {name!r}, which it lacks "
            f"(it has {', '.join(cloud.arrays())}). Add it, or leave the channel out."
        )
    if name == RADIANCE:
        toward = cloud.positions - camera.position
        length = np.linalg.norm(toward, axis=1, keepdims=True)
        # A Gaussian around the very pinhole has no direction and is not drawn.
        toward = np.divide(toward, length, out=np.zeros_like(toward), where=length > 0.0)
        return sh_color(array, toward).astype(np.float32)
    return array[:, None] if array.ndim == 1 else array
