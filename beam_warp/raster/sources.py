"""Gaussians of a cloud on a device, drawn with channels for as many cameras at a time as memory allows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from beam_warp.checks import require_choice
from beam_warp.device.arrays import resolve_device, upload
from beam_warp.errors import InvalidArrayError, InvalidOptionError
from beam_warp.raster.array_checks import require_cameras
from beam_warp.raster.channels import CHANNELS, RADIANCE, SURFACE_NORMALS, column_count, own_channels
from beam_warp.raster.rasterizer import Rasterizer
from beam_warp.raster.records import GaussianArrays, GaussianGradients, RasterOptions
from beam_warp.world.camera import Camera
from beam_warp.world.gaussians import ATTRIBUTES, WORLD_AXES, GaussianCloud

GROUP_SPLATS = 2**23
"""Most splats, Gaussians times cameras, projected at a time unless one camera has more: 1.2 GB with 11 channels."""

GROUP_PIXELS = 2**25
"""Most pixels drawn at a time unless one camera has more: 2.6 GB with 11 channels, 3.1 GB on the CPU."""


GEOMETRY = ("positions", "orientations", "scales", "opacities")
"""Arrays of a cloud that every image depends on."""


@dataclass(frozen=True, eq=False)
class DrawnCloud:
    """Gaussians on a device, and which channels of them are drawn."""

    gaussians: GaussianArrays
    channels: tuple[str, ...]
    device: Any

    @classmethod
    def of(cls, cloud: GaussianCloud, channels: Sequence[str], device: Any) -> DrawnCloud:
        """Upload a cloud's geometry and the channels to draw.

        Raises:
            InvalidOptionError: A channel is unknown, or the cloud is in other axes.
            InvalidArrayError: The cloud lacks a channel.
            DeviceError: The device is not there.
        """
        names = tuple(channels)
        for name in names:
            require_choice("channels", name, CHANNELS)
        require_world_axes(cloud)
        target = resolve_device(device)
        columns = {name: _require_channel(cloud, name) for name in own_channels(names)}
        values = (
            np.concatenate([c.reshape(len(cloud), column_count(name)) for name, c in columns.items()], axis=1)
            if columns
            else None
        )
        radiance = _require_channel(cloud, RADIANCE) if RADIANCE in names else None
        return cls(upload_gaussians(cloud, target, values=values, radiance=radiance), names, target)

    def draw_groups(
        self, cameras: Sequence[Camera], options: RasterOptions | None
    ) -> Iterator[tuple[Rasterizer, range]]:
        """Draw groups of cameras: yield each group's rasteriser and the places of its cameras."""
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
            rasterizer.draw(self.gaussians)
            yield rasterizer, range(first, end)
            first = end

    def places(self, rasterizer: Rasterizer) -> dict[str, slice]:
        """Return where each channel is among those of a rasteriser."""
        places = {}
        start = rasterizer.value_channels.start
        for name in own_channels(self.channels):
            width = column_count(name)
            places[name] = slice(start, start + width)
            start += width
        places[RADIANCE] = slice(rasterizer.color_channels.start, rasterizer.color_channels.stop)
        places[SURFACE_NORMALS] = slice(rasterizer.normal_channels.start, rasterizer.normal_channels.stop)
        return {name: places[name] for name in self.channels}

    def gradients(self, found: GaussianGradients) -> dict[str, NDArray[np.float32]]:
        """Copy gradients to the host, by name of the cloud's array."""
        arrays = {name: getattr(found, name).numpy() for name in GEOMETRY}
        values = np.empty((0, 0), np.float32) if found.values is None else found.values.numpy()
        start = 0
        for name in own_channels(self.channels):
            columns = values[:, start : start + column_count(name)]
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
    """Upload a cloud's geometry, and values or colour to draw.

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


def require_world_axes(cloud: GaussianCloud) -> None:
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
